"""Text of C99: arrays in memory, tables of constants, and loops over them; in double or in single precision."""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils._pytree import tree_map

from lyapnet.graphs.c_loops import Statement

PER_LINE = 8  # entries of a table in a line


@dataclass(frozen=True)
class Array:
    """A view of an array in C: its name, and a meta tensor with the shape, strides and offset of the view."""

    name: str
    layout: Tensor

    @property
    def shape(self) -> torch.Size:
        return self.layout.shape


class Place(NamedTuple):
    """An entry of an array as text, such as v0[2 * i0]."""

    name: str
    index: str

    def __str__(self) -> str:
        return f"{self.name}[{self.index}]"


class Tables:
    """The constants of functions as tables; equal constants share one, and so do a matrix and its transpose."""

    shares_transposes = True

    def __init__(self) -> None:
        self.text: list[str] = []
        self.count = 0  # of numbers
        self._known: dict[bytes, str] = {}  # numbers ↦ their table

    def of(self, constant: Tensor) -> Array:
        """The table of a constant."""
        numbers = constant.detach().cpu().contiguous().to(torch.float64)
        name = self._known.get(_bytes_of(numbers))
        if name is None and self.shares_transposes and numbers.ndim > 1:
            turned = numbers.mT.contiguous()
            if (other := self._known.get(_bytes_of(turned))) is not None:
                return Array(other, torch.empty(turned.shape, device="meta").mT)
        if name is None:
            name = f"w{len(self._known)}"
            self.text.append(self.format_table(name, numbers))
            self.count += max(1, numbers.numel())
            self._known[_bytes_of(numbers)] = name
        return Array(name, torch.empty(numbers.shape, device="meta"))

    def format_table(self, name: str, numbers: Tensor) -> str:
        """The declaration of a table of float64 numbers."""
        entries = [literal(number) for number in numbers.flatten().tolist()] or ["0.0"]
        rows = [", ".join(entries[i : i + PER_LINE]) for i in range(0, len(entries), PER_LINE)]
        return f"static const double {name}[{len(entries)}] = {{\n    {f',{chr(10)}    '.join(rows)}}};\n"


class Text:
    """The body of a C function, statement by statement; subclasses write similar languages.

    Args:
        tables: collects the constants.
    """

    language, otherwise = "C", "export it to torch"  # for error messages
    to_index = "(int)"  # converts a number to an index
    rows: str | None = "sum_products"  # the function for sums of products of rows; None: loops

    def __init__(self, tables: Tables):
        self.tables, self.statements, self.arrays = tables, list[Statement](), dict[str, int]()
        self._count = 0
        self._known: dict[str, int] = {}  # lines, with their new arrays numbered from 0 ↦ number of the first one

    def new(self, shape: Sequence[int]) -> Array:
        """A new array."""
        name, layout = f"v{self._count}", torch.empty(tuple(shape), device="meta")
        self._count += 1
        self.arrays[name] = max(1, layout.numel())
        return Array(name, layout)

    def add(self, line: str, sizes: Sequence[int] = ()) -> None:
        """Write a line, in loops over sizes."""
        self.statements.append(Statement(tuple(sizes), line))

    def once(self, write: Callable[[], Any]) -> Any:
        """Call `write`; if its lines already exist, remove the new ones and return the earlier arrays.

        This is correct because an array is written only where it is created, so that equal lines have equal results.
        """
        start, first = len(self.statements), self._count
        result = write()
        lines = "\n".join(f"{each.sizes} {each.line}" for each in self.statements[start:])
        earlier = self._known.setdefault(_renamed(lines, first, "v+", 0), first)
        if self._count == first or earlier == first:
            return result
        del self.statements[start:]
        for k in range(first, self._count):
            del self.arrays[f"v{k}"]
        self._count = first
        return tree_map(
            lambda leaf: (
                replace(leaf, name=_renamed(leaf.name, first, "v", earlier)) if isinstance(leaf, Array) else leaf
            ),
            result,
        )

    def each(self, shape: Sequence[int], values: Sequence[Any], line: str, into: Array) -> Array:
        """Write loops over a shape around a line with {0}, {1}, … for entries of the values and {into} for the result.

        Args:
            values: Arrays, tensors or numbers; they are broadcast. Entries of arrays are Places.
            into: the array of the result; it has this shape, possibly with strides of 0.
        """
        arrays = [value if isinstance(value, Array) else self._constant(value) for value in (*values, into)]
        layouts = [array.layout.expand(tuple(shape)) if isinstance(array, Array) else None for array in arrays]
        axes = _axes(shape, [layout for layout in layouts if layout is not None])
        places, column = list[Any](), 0
        for array, layout in zip(arrays, layouts, strict=True):
            if isinstance(array, str) or layout is None:
                places.append(array)
                continue
            steps = [(f"i{k}", strides[column]) for k, (_, strides) in enumerate(axes)]
            places.append(Place(array.name, _index(int(layout.storage_offset()), steps)))
            column += 1
        self.add(line.format(*places[:-1], into=places[-1]), [size for size, _ in axes])
        return into

    def copy(self, source: Any, into: Array) -> Array:
        """Write a loop that copies source."""
        return self.each(into.shape, [source], "{into} = {0};", into)

    def contiguous(self, value: Any) -> Array:
        """A value with contiguous entries."""
        array = value if isinstance(value, Array) else self.tables.of(torch.as_tensor(value, dtype=torch.float64))
        is_whole = array.layout.is_contiguous() and array.layout.storage_offset() == 0
        return array if is_whole else self.copy(array, self.new(array.shape))

    def view(self, target: Any, array: Array, *args: Any, **kwargs: Any) -> Any:
        """A view of an array, or of a contiguous copy if its strides do not allow the view."""
        try:
            found = target(array.layout, *args, **kwargs)
        except RuntimeError:
            array = self.contiguous(array)
            found = target(array.layout, *args, **kwargs)
        return tree_map(lambda layout: Array(array.name, layout), found)

    def _constant(self, value: Any) -> Array | str:
        """A number as text, or a table."""
        if isinstance(value, Tensor) and value.numel() != 1:
            return self.tables.of(value)
        number = literal(float(value))
        return f"({number})" if number.startswith("-") else number


def _renamed(text: str, first: int, letter: str, start: int) -> str:
    """Replace the names of arrays from v`first` on by `letter` and numbers from `start` on."""
    return re.sub(
        r"\bv(\d+)\b", lambda name: name[0] if int(name[1]) < first else f"{letter}{int(name[1]) - first + start}", text
    )


def literal(number: float) -> str:
    """A number in C that keeps every bit."""
    if math.isnan(number):
        return "NAN"
    if math.isinf(number):
        return "INFINITY" if number > 0 else "-INFINITY"
    return repr(float(number))


FUNCTIONS = (  # of the C library, in double precision
    "acosh?|asinh?|atan[2h]?|cbrt|ceil|copysign|cosh?|erfc?|exp2?|expm1|fabs|fdim|floor|fma|fmax|fmin|fmod|hypot|lgamma|"
    "log(?:10|1p|2)?|nearbyint|pow|rint|round|sinh?|sqrt|tanh?|tgamma|trunc"
)
IN_DOUBLE = re.compile(
    rf"\bdouble\b|\b(?:{FUNCTIONS})(?=\()|(?<![\w.])(?:\d+\.\d*(?:e[+-]?\d+)?|\d+e[+-]?\d+)(?![\w.])"
)


def in_single_precision(code: str) -> str:
    """C code in single precision: float, sinf and 0.1f instead of double, sin and 0.1."""
    return IN_DOUBLE.sub(lambda word: _single(word[0]), code)


def _single(word: str) -> str:
    if not word[0].isdigit():
        return "float" if word == "double" else f"{word}f"
    with np.errstate(over="ignore"):
        number = np.float32(word)
    return f"{number!s}f" if np.isfinite(number) else "INFINITY"


def _bytes_of(numbers: Tensor) -> bytes:
    return numbers.numpy().tobytes()


def _axes(shape: Sequence[int], layouts: Sequence[Tensor]) -> list[tuple[int, tuple[int, ...]]]:
    """The axes to loop over, as (size, a stride for each array); axes that are contiguous in all arrays are merged."""
    axes = list[tuple[int, tuple[int, ...]]]()
    for size, strides in zip(shape, zip(*(layout.stride() for layout in layouts), strict=True), strict=True):
        if size == 1:
            continue
        if axes and axes[-1][1] == tuple(size * stride for stride in strides):
            axes[-1] = axes[-1][0] * size, strides
        else:
            axes.append((size, strides))
    return axes


def _index(offset: int, steps: Sequence[tuple[str, int]]) -> str:
    """offset + Σ stride · counter as text, without zeros and ones."""
    terms = [counter if stride == 1 else f"{stride} * {counter}" for counter, stride in steps if stride]
    return " + ".join([*([str(offset)] if offset or not terms else []), *terms])


def shape_of(value: Any) -> torch.Size:
    """The shape of an array or a tensor; that of a number is empty."""
    return value.shape if isinstance(value, Array | Tensor) else torch.Size()

"""Text of C99: arrays in memory, tables of constants, and loops over them."""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils._pytree import tree_map

PER_LINE = 8  # numbers of a table in one line


@dataclass(frozen=True)
class Array:
    """A place in memory: the name of an array, and a meta tensor for its shape, strides and offset."""

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
    """The constants of functions; equal constants share one table."""

    def __init__(self) -> None:
        self.text: list[str] = []
        self._known: dict[tuple[Any, ...], Array] = {}

    def of(self, constant: Tensor) -> Array:
        """The table of a constant."""
        numbers = constant.detach().cpu().contiguous().to(torch.float64)
        key = tuple(numbers.shape), numbers.numpy().tobytes()
        if key not in self._known:
            name = f"w{len(self._known)}"
            self.text.append(self.format_table(name, numbers))
            self._known[key] = Array(name, torch.empty(numbers.shape, device="meta"))
        return self._known[key]

    def format_table(self, name: str, numbers: Tensor) -> str:
        """The declaration of a table of float64 numbers."""
        entries = [literal(number) for number in numbers.flatten().tolist()] or ["0.0"]
        rows = [", ".join(entries[i : i + PER_LINE]) for i in range(0, len(entries), PER_LINE)]
        return f"static const double {name}[{len(entries)}] = {{\n    {f',{chr(10)}    '.join(rows)}}};\n"


class Text:
    """The body of a C function, line by line; subclasses write similar languages.

    Args:
        tables: collects the constants.
    """

    language, otherwise = "C", "export it to torch"  # for error messages
    declaration = "double {name}[{size}];"  # of an array
    counter = "int"  # declares a loop counter
    to_index = "(int)"  # converts a number to an index

    def __init__(self, tables: Tables):
        self.tables, self.lines, self.bytes, self._count = tables, list[str](), 0, 0
        self._known: dict[str, int] = {}  # lines, with their new arrays numbered from 0 ↦ number of the first one

    def new(self, shape: Sequence[int]) -> Array:
        """Declare a new array."""
        name, layout = f"v{self._count}", torch.empty(tuple(shape), device="meta")
        size = max(1, layout.numel())
        self._count, self.bytes = self._count + 1, self.bytes + 8 * size
        self.lines.append(self.declaration.format(name=name, size=size))
        return Array(name, layout)

    def once(self, write: Callable[[], Any]) -> Any:
        """Call `write`; if its lines already exist, remove the new ones and return the earlier arrays.

        This is correct because an array is written only where it is created, so that equal lines have equal results.
        """
        lines, first, size = len(self.lines), self._count, self.bytes
        result = write()
        earlier = self._known.setdefault(_renamed("\n".join(self.lines[lines:]), first, "v+", 0), first)
        if self._count == first or earlier == first:
            return result
        del self.lines[lines:]
        self._count, self.bytes = first, size
        return tree_map(
            lambda leaf: (
                replace(leaf, name=_renamed(leaf.name, first, "v", earlier)) if isinstance(leaf, Array) else leaf
            ),
            result,
        )

    def mark_unused(self, name: str) -> None:
        """Tell the compiler not to warn if an array is unused."""
        self.lines.append(f"(void){name};")

    def mark_unread(self) -> None:
        """Mark arrays as unused that are written but never read, such as unused results of an operation."""
        at = dict[str, list[int]]()
        for k, line in enumerate(self.lines):
            for name in set(re.findall(r"\bv\d+\b", line)):
                at.setdefault(name, []).append(k)
        for name, places in at.items():
            written = rf"\s*{name}\[[^]]*\] = (?!.*\b{name}\b)"
            if all(re.match(written, self.lines[k]) for k in places[1:]):
                self.lines[places[0]] += f" (void){name};"

    def each(self, shape: Sequence[int], values: Sequence[Any], line: str, into: Array) -> Array:
        """Write loops over a shape around a line, in which {0}, {1}, … are entries of the values, {into} the result.

        An entry of an array is a Place.

        Args:
            values: Arrays, tensors or numbers; they are broadcast.
            into: has that shape, possibly with strides of 0.
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
        for k, (size, _) in enumerate(axes):
            self.lines.append(f"{'    ' * k}for ({self.counter} i{k} = 0; i{k} < {size}; i{k}++)")
        self.lines.append("    " * len(axes) + line.format(*places[:-1], into=places[-1]))
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


def _axes(shape: Sequence[int], layouts: Sequence[Tensor]) -> list[tuple[int, tuple[int, ...]]]:
    """The axes to loop over: (size, a stride for each array); axes that are contiguous in all arrays are merged."""
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

"""The operations of a function on Taylor forms as a flat list of numbers, which program.cpp runs on many boxes."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lyapnet.prover.taylor import monomials

OPERATIONS = {
    name: code
    for code, name in enumerate((
        "combine", "matrix_product", "multiply", "functions", "where", "within_limits", "sign", "positive", "negation",
        "conjunction", "rounded",
    ))
}  # fmt: skip
FUNCTIONS = {
    name: code
    for code, name in enumerate((
        "exp", "log", "log1p", "sqrt", "reciprocal", "sigmoid", "softplus", "sin", "cos", "tan", "square", "absolute",
        "leaky", "clamp", "within_ball", "slope_within_ball",
    ))
}  # fmt: skip
ALWAYS_LINEAR = {"tan", "square", "absolute", "leaky", "clamp", "within_ball", "slope_within_ball"}
"""Functions whose result is linear in their argument for forms of any degree."""

Support = tuple[int, ...]  # increasing indices in `monomials` of the terms that may be nonzero; 0, the constant, is one
CONSTANT: Support = (0,)


def supports_of_boxes(axes: int, wide: Sequence[int]) -> list[Support]:
    """The support of each coordinate of a box; those along wide axes have an ε of their own."""
    return [(0, 1 + wide.index(k)) if k in wide else CONSTANT for k in range(axes)]


class Entry(int):
    """The form of one number, given by its index in the list of forms of a program."""


ZERO = Entry(0)  # the form of the number 0: operators that pad entries with 0 thus pad with zeros


@dataclass(frozen=True, eq=False)
class Forms:
    """A value that depends on the point, as forms of its numbers.

    Args:
        entries: (*shape), the Entry of each number as an integer; operators that arrange entries act on this tensor.
    """

    entries: Tensor

    @property
    def shape(self) -> torch.Size:
        """The shape of the value."""
        return self.entries.shape


class Assembled(NamedTuple):
    """A program as program.cpp reads it."""

    tables: np.ndarray
    code: np.ndarray
    numbers: np.ndarray
    arena: int  # memory for the forms of one box, in float64 numbers
    spare: int  # memory for intermediate results of one operation, in float64 numbers


class Program:
    """Operations on the forms of single numbers; equal operations are written once.

    Args:
        inputs: the support of each input number.
        dimension, degree: those of the forms.
    """

    def __init__(self, inputs: Sequence[Support], dimension: int, degree: int):
        self.degree, self.dimension = degree, dimension
        self.monomials = monomials(self.dimension, degree)
        number = {powers: k for k, powers in enumerate(self.monomials)}
        self._monomial_product = [
            [number.get(tuple(sorted(a + b)), -1) for b in self.monomials] for a in self.monomials
        ]
        self._product_supports: dict[tuple[Support, Support], Support] = {}
        self._products: dict[tuple[Support, Support, Support], int] = {}
        self._placings: dict[tuple[Support, Support], int] = {}
        self._written: dict[tuple[object, ...], Entry] = {}
        self._numbers: list[float] = []
        self._indices: dict[float | bytes, int] = {}
        self._instructions: list[list[int]] = []
        self._functions: dict[Entry, list[int]] = {}
        self._spare = 3 * (len(self.monomials) + 4)
        self.supports: list[Support] = []
        self.constants: dict[Entry, float] = {}
        self.constant(0.0)
        self.inputs = [self._new(support) for support in inputs]

    def constant(self, value: float) -> Entry:
        """The form of a constant."""
        key = ("constant", value)
        if key not in self._written:
            self._written[key] = self._new(CONSTANT)
            self.constants[self._written[key]] = value
        return self._written[key]

    def combine(self, summands: Iterable[tuple[float, Entry]], offset: float = 0.0, operations: int = 1) -> Entry:
        """Σ w x + offset.

        Args:
            operations: number of rounded operations for each term of the result; 0 if it is exact.
        """
        summands = [(weight, x) for weight, x in summands if x != ZERO]
        if not summands:
            return self.constant(offset)
        if summands[0][0] == 1 and len(summands) == 1 and not offset:
            return summands[0][1]
        support = self._union(x for _, x in summands)
        words = [
            word for weight, x in summands for word in (x, self._placing_table(x, support), self._number_index(weight))
        ]
        return self._emit(
            "combine", support, operations, len(summands), self._number_index(offset), *words, result_first=True
        )

    def scale(self, x: Entry, factor: float) -> Entry:
        """factor · x."""
        return self.combine([(factor, x)])

    def multiply(self, x: Entry, y: Entry) -> Entry:
        """x · y."""
        if x in self.constants or y in self.constants:
            x, y = (y, x) if x in self.constants else (x, y)
            return self.scale(x, self.constants[y])
        x, y = min(x, y), max(x, y)
        a, b = self.supports[x], self.supports[y]
        support = self._product_support(a, b)
        return self._emit("multiply", support, x, y, behind=(self._product_table(a, b, support),))

    def square(self, x: Entry) -> Entry:
        """x²."""
        return self.function("square", x) if self.degree == 1 else self.multiply(x, x)

    def function(self, name: str, x: Entry, p: float = 0.0, q: float = 0.0) -> Entry:
        """f(x) with parameters p and q."""
        support = power = self.supports[x]
        if name not in ALWAYS_LINEAR:
            for _ in range(self.degree - 1):
                power = self._product_support(power, self.supports[x])
                support = tuple(sorted({*support, *power}))
        a = self.supports[x]
        powers = (
            self._product_table(a, a, support),
            self._product_table(support, a, support),
            self._placing_table(x, support),
        )
        parameters = self._number_index(p), self._number_index(q)
        key = (name, x, *parameters)
        if key not in self._written:
            self._written[key] = self._new(support)
            if x not in self._functions:  # functions of one form are one operation: they share its bounds and powers
                self._functions[x] = [OPERATIONS["functions"], x, 0]
                self._instructions.append(self._functions[x])
            self._functions[x][2] += 1
            self._functions[x] += [FUNCTIONS[name], self._written[key], *parameters, *powers]
        return self._written[key]

    def matrix_product(self, row: Sequence[Entry], weight: Tensor) -> list[Entry]:
        """A row times a constant matrix."""
        if not any(row):
            return [ZERO] * weight.shape[1]
        at, support = self._matrix_index(weight), self._union(row)
        key = ("matrix_product", at, *row)
        if key not in self._written:
            results = [self._new(support) for _ in range(weight.shape[1])]
            self._written[key] = results[0]
            head = [OPERATIONS["matrix_product"], *weight.shape, at, len(support)]
            padded = [word for x in row for word in (x, self._placing_table(x, support))]
            self._instructions.append([*head, *padded, *results])
            self._spare = max(self._spare, len(row) * (len(support) + 1))
        return [Entry(self._written[key] + j) for j in range(weight.shape[1])]

    def where(self, truth: Entry, x: Entry, y: Entry) -> Entry:
        """x where the truth is not 0, else y; on undecided boxes a form that encloses both."""
        support = self._union((x, y))
        return self._emit(
            "where", support, x, y, truth, behind=(self._placing_table(x, support), self._placing_table(y, support))
        )

    def truth(self, name: str, *operands: Entry) -> Entry:
        """The truth value or sign that the operation `name` makes of the operands."""
        return self._emit(name, CONSTANT, *operands)

    def within_limits(self, x: Entry, low: float, high: float) -> Entry:
        """x, replaced by [low, high] on boxes where its bounds are wider."""
        return self._emit(
            "within_limits", self.supports[x], x, behind=(self._number_index(low), self._number_index(high))
        )

    def rounded(self, x: Entry, *limits: float) -> Entry:
        """x, rounded in another arithmetic; limits are its relative and absolute error and its largest number."""
        return self._emit("rounded", self.supports[x], x, behind=tuple(self._number_index(limit) for limit in limits))

    def assembled(self, results: Sequence[Entry]) -> Assembled:
        """The program with its results; the memory of a form is reused after the last operation that reads it."""
        offset, arena = self._layout(results)
        of_support = {support: k for k, support in enumerate(dict.fromkeys(self.supports))}

        def words(items: Iterable[int]) -> Iterable[int]:
            for word in items:
                if isinstance(word, Entry):
                    yield offset[word]
                    yield of_support[self.supports[word]]
                else:
                    yield word

        code = [
            len(self.constants),
            *(word for x, value in self.constants.items() for word in (x, self._number_index(value))),
        ]
        code += [len(self.inputs), *self.inputs, len(self._instructions)]
        code += [word for instruction in self._instructions for word in instruction]
        code += [len(results), *results]
        numbers = np.array(self._numbers, dtype=np.float64)
        tables = np.array(list(self._tables(of_support)), dtype=np.int32)
        return Assembled(tables, np.array(list(words(code)), dtype=np.int32), numbers, arena, self._spare)

    def _layout(self, results: Sequence[Entry]) -> tuple[dict[int, int], int]:
        """(offset of each form in memory, total size); a form may take the memory of one that is no longer used."""
        kept = {*self.constants, *results}
        last = {word: k for k, line in enumerate(self._instructions) for word in line if isinstance(word, Entry)}
        offset: dict[int, int] = {}
        free: dict[int, list[int]] = {}
        arena = 0

        def place(x: Entry) -> None:
            nonlocal arena
            size = self._size(x)
            if free.get(size):
                offset[x] = free[size].pop()
            else:
                offset[x], arena = arena, arena + size

        for x in (*self.constants, *self.inputs):
            place(x)
        for k, line in enumerate(self._instructions):
            entries = {word for word in line if isinstance(word, Entry)}
            for x in sorted(entries - offset.keys()):
                place(x)
            for x in sorted(entries - kept):
                if last[x] == k:
                    free.setdefault(self._size(x), []).append(offset[x])
        return offset, arena

    def _size(self, x: Entry) -> int:
        """The size of a form: its terms, r, and Σ |terms| of each degree."""
        return len(self.supports[x]) + 1 + self.degree

    def _tables(self, of_support: dict[Support, int]) -> Iterable[int]:
        yield from (self.dimension, self.degree, len(self.monomials))
        for powers in self.monomials:
            yield from (*powers, *(-1,) * (3 - len(powers)))
        yield len(of_support)
        for support in of_support:
            yield from self._counts(support)
            yield from support
        yield len(self._products)
        for a, b, support in self._products:
            factors = self._factors(a, b, support)
            yield sum(1 + 2 * len(pairs) for pairs in factors)
            for pairs in factors:
                yield len(pairs)
                for pair in pairs:
                    yield from pair
        yield len(self._placings)
        for a, support in self._placings:
            yield len(a)
            yield from map(support.index, a)

    def _counts(self, support: Support) -> list[int]:
        """The numbers of monomials of degree ≤ 0, 1, 2 and 3 in a support."""
        of_degree = [len(self.monomials[k]) for k in support]
        return list(accumulate(of_degree.count(k) for k in range(4)))

    def _emit(
        self, name: str, support: Support, *words: int, behind: tuple[int, ...] = (), result_first: bool = False
    ) -> Entry:
        """Write an operation, unless it is written already; its result. `behind` are words after the result."""
        key = (name, *words, *behind)
        if key not in self._written:
            self._written[key] = result = self._new(support)
            line = [result, *words] if result_first else [*words, result, *behind]
            self._instructions.append([OPERATIONS[name], *line])
        return self._written[key]

    def _new(self, support: Support) -> Entry:
        self.supports.append(support)
        return Entry(len(self.supports) - 1)

    def _union(self, entries: Iterable[Entry]) -> Support:
        return tuple(sorted({*CONSTANT, *(k for x in entries for k in self.supports[x])}))

    def _product_support(self, a: Support, b: Support) -> Support:
        """The support of the product of two forms with these supports."""
        if (a, b) not in self._product_supports:
            self._product_supports[a, b] = tuple(sorted({self._monomial_product[i][j] for i in a for j in b} - {-1}))
        return self._product_supports[a, b]

    def _product_table(self, a: Support, b: Support, support: Support) -> int:
        """The number of the table for products of forms with supports a and b in a third support."""
        return self._products.setdefault((a, b, support), len(self._products))

    def _placing_table(self, x: Entry, support: Support) -> int:
        """The number of the table that gives the position of each term of x in a larger support."""
        return self._placings.setdefault((self.supports[x], support), len(self._placings))

    def _factors(self, a: Support, b: Support, support: Support) -> list[list[tuple[int, int]]]:
        """For each monomial of a support: all (i, j) such that it is the i-th monomial of a times the j-th of b."""
        factors: dict[int, list[tuple[int, int]]] = {monomial: [] for monomial in support}
        for i, m in enumerate(a):
            for j, n in enumerate(b):
                factors.get(self._monomial_product[m][n], []).append((i, j))
        return list(factors.values())

    def _number_index(self, number: float) -> int:
        """The index of a number in the list of numbers."""
        if number not in self._indices:
            self._indices[number] = len(self._numbers)
            self._numbers.append(number)
        return self._indices[number]

    def _matrix_index(self, weight: Tensor) -> int:
        content = repr(tuple(weight.shape)).encode() + weight.contiguous().numpy().tobytes()
        if content not in self._indices:
            self._indices[content] = len(self._numbers)
            self._numbers += weight.flatten().tolist()
        return self._indices[content]

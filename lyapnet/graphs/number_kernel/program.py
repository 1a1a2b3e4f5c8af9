"""Flat programs on tensors: instructions as rows of integers, and their memory; some are shared by all steps."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lyapnet.base.linear_algebra import MOST_UNKNOWNS
from lyapnet.graphs.operators import OPERATORS

# in the order of INSTRUCTIONS in program.cpp, which are followed by `elementwise_instructions`
OPERATIONS = (
    "reduce_sum", "reduce_maximum", "reduce_minimum", "index_of_largest", "index_of_least", "take_at_index",
    "put_at_index", "move", "add_moved", "pack", "product_with_packed", "products", "symmetric_inverse", "active_set",
)  # fmt: skip
OWN = {  # elementwise instructions that are not in the table of operators: (operands, expression of x, y, z)
    "copy": (1, "x"), "cube": (1, "x * x * x"), "truth": (1, "x != 0 ? ONE : ZERO"),
    "product_and_sum": (3, "x + y * z"),
}  # fmt: skip
MOST_RANK = 8  # largest number of axes, as in program.cpp
LINE = 64  # bytes of a cache line; buffers are aligned to it


def elementwise_instructions() -> dict[str, tuple[int, str]]:
    """name ↦ (operands, expression) of every elementwise instruction."""
    rows = [row for row in OPERATORS.values() if row.instruction is not None]
    return {**OWN, **{row.name: (row.operands, str(row.instruction)) for row in rows}}


def operations_in_order() -> list[str]:
    """The names of all instructions; the index of a name is its code."""
    return [*OPERATIONS, *elementwise_instructions()]


class Place(NamedTuple):
    """The location of the numbers of a tensor."""

    buffer: int
    offset: int
    strides: tuple[int, ...]


class Instruction(NamedTuple):
    """A row of a program."""

    row: list[int]
    reads: tuple[int, ...]  # buffers
    writes: int


@dataclass
class Buffer:
    """Memory of a program: from its caller, a constant, or a part of the arena."""

    numbers: int
    varies: bool  # whether its numbers change from step to step
    constant: Tensor | None = None
    given: bool = False  # whether it belongs to an argument or a result of each call


class Program:
    """A program under construction: its buffers, and instructions in their order.

    Args:
        dtype: of all numbers; booleans are 1 and 0.
    """

    def __init__(self, dtype: torch.dtype):
        self.dtype = dtype
        self.buffers: list[Buffer] = []
        self.shared: list[Instruction] = []  # run once
        self.repeated: list[Instruction] = []  # run at every step
        self.tables: list[np.ndarray] = []
        self._positions = 0
        self._codes = {name: code for code, name in enumerate(operations_in_order())}
        self._packed = dict[tuple[Place, int, int], int]()

    def new_buffer(self, numbers: int, varies: bool, constant: Tensor | None = None, given: bool = False) -> int:
        """Declare a buffer for some numbers; return its index."""
        self.buffers.append(Buffer(numbers, varies, constant, given))
        return len(self.buffers) - 1

    def table(self, positions: Tensor) -> int:
        """Add a table of positions; return its offset in the joined tables."""
        self.tables.append(positions.flatten().numpy().astype(np.int64))
        self._positions += positions.numel()
        return self._positions - positions.numel()

    def elementwise(self, operation: str, shape: Sequence[int], out: Place, inputs: Sequence[Place]) -> None:
        """out = operation(inputs) for each number of a shape; a repeated operand has stride 0 along that axis."""
        if 0 in shape:
            return
        places = [out, *inputs]
        row = _row(places, *_merge_axes(shape, [place.strides for place in places]))
        self._append(operation, row, [place.buffer for place in inputs], out.buffer)

    def reduce(self, operation: str, shape: Sequence[int], out: Place, given: Place) -> None:
        """out = operation(out, given) over a shape; out has stride 0 along the reduced axes."""
        if 0 in shape:
            return
        sizes, (from_strides, to_strides) = _merge_axes(shape, [given.strides, out.strides])
        row = _row([out, given], sizes, [to_strides, from_strides])
        self._append(operation, row, [out.buffer, given.buffer], out.buffer)

    def find_extreme(self, operation: str, shape: Sequence[int], axis: int, out: Place, given: Place) -> None:
        """out = the index of the largest or least number of `given` along an axis, along which out has stride 0."""
        if 0 in shape:
            return
        others = [k for k in range(len(shape)) if k != axis]
        sizes, strides = _merge_axes([shape[k] for k in others], [[p.strides[k] for k in others] for p in (out, given)])
        strides = [[*own, place.strides[axis]] for place, own in zip((out, given), strides, strict=True)]
        self._append(operation, _row([out, given], [*sizes, shape[axis]], strides), [given.buffer], out.buffer)

    def index(
        self, shape: Sequence[int], axis: int, size: int, out: Place, given: Place, index: Place, into: bool = False
    ) -> None:
        """out = given[index], or out[index] = given, along an axis of some size, over the shape of the index."""
        if 0 in shape:
            return
        places = [out, given, index]
        stride = places[0 if into else 1].strides[axis]
        strides = [list(place.strides) for place in places]
        strides[0 if into else 1][axis] = 0
        row = [size, stride, *_row(places, *_merge_axes(shape, strides))]
        reads = [given.buffer, index.buffer, *([out.buffer] if into else [])]
        self._append("put_at_index" if into else "take_at_index", row, reads, out.buffer)

    def move(self, out: Place, to: Tensor, given: Place, source: Tensor, add: bool = False) -> None:
        """out[to] = given[source], or out[to] += given[source]; positions count numbers from the start of each."""
        row = [to.numel(), self.table(to), self.table(source), out.buffer, out.offset, given.buffer, given.offset]
        reads = [given.buffer, *([out.buffer] if add else [])]
        self._append("add_moved" if add else "move", row, reads, out.buffer)

    def multiply(self, shape: tuple[int, int, int], places: Sequence[Place], add: bool, width: int) -> None:
        """out (M, N) = A (M, K) B (K, N), or out += A B.

        Args:
            shape: (M, N, K).
            places: of out, A and B.
            width: numbers in a row of a panel of packed columns, as in program.cpp.
        """
        (M, N, K), (out, A, B) = shape, places
        if 0 in (M, N):
            return
        if width // 4 > N or out.strides[1] != 1:
            self.multiply_batch(1, shape, [place._replace(strides=(0, *place.strides)) for place in places], add)
            return
        if (B, K, N) not in self._packed:
            packed = self.new_buffer(-(-N // width) * width * K, self.buffers[B.buffer].varies)
            self._append("pack", [K, N, B.buffer, B.offset, *B.strides, packed, 0], [B.buffer], packed)
            self._packed[B, K, N] = packed
        packed = self._packed[B, K, N]
        row = [M, N, K, int(add), out.buffer, out.offset, out.strides[0], A.buffer, A.offset, *A.strides, packed, 0]
        reads = [A.buffer, packed, *([out.buffer] if add else [])]
        self._append("product_with_packed", row, reads, out.buffer)

    def multiply_batch(self, batch: int, shape: tuple[int, int, int], places: Sequence[Place], add: bool) -> None:
        """Like `multiply`, for a batch of small matrices; the batch is the first axis of the strides."""
        row, (out, A, B) = [batch, *shape, int(add)], places
        for place in places:
            row += [place.buffer, place.offset, *place.strides]
        reads = [A.buffer, B.buffer, *([out.buffer] if add else [])]
        self._append("products", row, reads, out.buffer)

    def small_matrices(self, operation: str, shape: Sequence[int], places: Sequence[Place]) -> None:
        """places[0] = operation(other places), for each matrix of a batch (*batch, d, d).

        Strides are 0 along axes where an operand is repeated, and along the last axis of vectors.
        """
        if 0 in shape:
            return
        if shape[-1] > MOST_UNKNOWNS:
            raise NotImplementedError(f"a small linear system of more than {MOST_UNKNOWNS} unknowns")
        sizes, strides = _merge_axes(shape[:-2], [place.strides[:-2] for place in places])
        strides = [[*own, *place.strides[-2:]] for place, own in zip(places, strides, strict=True)]
        row = _row(places, [*sizes, *shape[-2:]], strides)
        self._append(operation, row, [place.buffer for place in places[1:]], places[0].buffer)

    def _append(self, operation: str, row: list[int], reads: Sequence[int], writes: int) -> None:
        self.buffers[writes].varies |= any(self.buffers[each].varies for each in reads)
        part = self.repeated if self.buffers[writes].varies else self.shared
        part.append(Instruction([self._codes[operation], len(row) + 2, *row], tuple(reads), writes))

    def remove_unread(self, results: Iterable[int]) -> None:
        """Remove instructions that write buffers which are neither read later nor results."""
        read = set(results)
        for part in (self.repeated, self.shared):
            needed = []
            for instruction in reversed(part):
                if instruction.writes in read:
                    needed.append(instruction)
                    read.update(instruction.reads)
            part[:] = reversed(needed)

    def lay_out(self) -> tuple[list[int], int]:
        """(the offset of each buffer in the arena, or −1 for other buffers; the size of the arena).

        A buffer may share memory with later buffers after its last reader. A buffer that is written once and read at
        every step does not share memory.
        """
        rows = [*self.shared, *self.repeated]
        ends = dict[int, int]()
        begins = dict[int, int]()
        for k, instruction in enumerate(rows):
            for buffer in (*instruction.reads, instruction.writes):
                begins.setdefault(buffer, k)
                ends[buffer] = k
        for buffer, k in begins.items():
            if k < len(self.shared) <= ends[buffer]:
                ends[buffer] = len(rows)
        offsets, arena = [-1] * len(self.buffers), 0
        line = LINE // self.dtype.itemsize
        alive: list[tuple[int, int, int]] = []  # (offset, numbers, end)
        in_arena = [b for b in begins if self.buffers[b].constant is None and not self.buffers[b].given]
        for buffer in sorted(in_arena, key=lambda b: begins[b]):
            # one more line, because vector instructions may read beyond the last number
            size = -(-self.buffers[buffer].numbers // line) * line + line
            alive = sorted(each for each in alive if each[2] >= begins[buffer])
            offset = 0
            for start, numbers, _ in alive:
                if start - offset >= size:
                    break
                offset = max(offset, start + numbers)
            offsets[buffer] = offset
            alive.append((offset, size, ends[buffer]))
            arena = max(arena, offset + size)
        return offsets, arena


def _row(places: Sequence[Place], sizes: Sequence[int], strides: Sequence[Sequence[int]]) -> list[int]:
    """A shape and its operands in the format of `Machine::operand` in program.cpp."""
    row = [len(sizes), *sizes]
    for place, own in zip(places, strides, strict=True):
        row += [place.buffer, place.offset, *own]
    return row


def _merge_axes(shape: Sequence[int], strides: Sequence[Sequence[int]]) -> tuple[list[int], list[list[int]]]:
    """A shape and its operands' strides with as few axes as possible, by decreasing strides of the first operand."""
    axes = [(n, *each) for n, *each in zip(shape, *strides, strict=True) if n != 1]
    axes.sort(key=lambda axis: axis[1:], reverse=True)
    merged: list[tuple[int, ...]] = []
    for axis in axes:
        if merged and all(a == b * axis[0] for a, b in zip(merged[-1][1:], axis[1:], strict=True)):
            merged[-1] = (merged[-1][0] * axis[0], *axis[1:])
        else:
            merged.append(axis)
    merged = merged or [(1, *[0] * len(strides))]
    if len(merged) > MOST_RANK:
        raise NotImplementedError(f"a tensor of more than {MOST_RANK} axes")
    return [axis[0] for axis in merged], [[axis[k + 1] for axis in merged] for k in range(len(strides))]

"""Programs with memory for their runs, and calls of the compiled C++."""

import ctypes
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lyapnet.graphs.compilation import file_of_library, library_of
from lyapnet.graphs.number_kernel.program import Instruction, Place, Program, elementwise_instructions
from lyapnet.graphs.number_kernel.rules import RULES
from lyapnet.graphs.number_kernel.writing import Writer

SOURCE = Path(__file__).with_name("program.cpp")
NUMBERS = {torch.float64: "double", torch.float32: "float"}  # type of numbers ↦ its name in C++


@cache
def library(*options: str) -> ctypes.CDLL:
    """The library compiled from program.cpp with some options; from the cache if it is there.

    Raises:
        CompilationError: as library_of.
    """
    return library_of("numbers", (SOURCE,), *options)


def compiler_options(dtype: torch.dtype) -> tuple[str, str, str]:
    """The options for program.cpp: the type of its numbers, the elementwise instructions, and how much to optimise.

    The source names the loops that have to be unrolled; -O3 takes longer and is no faster then.
    """
    rows = (
        f"OPERANDS_{count}({name}, {expression})" for name, (count, expression) in elementwise_instructions().items()
    )
    return f"-DNUMBER={NUMBERS[dtype]}", f"-DELEMENTWISE={' '.join(rows)}", "-O2"


def is_built(dtype: torch.dtype) -> bool:
    """Whether the C++ for a type of numbers is compiled already."""
    return dtype in NUMBERS and file_of_library("numbers", (SOURCE,), *compiler_options(dtype)).is_file()


class _Memory(NamedTuple):
    """The memory of one run of a program."""

    arena: Tensor  # for intermediate results
    addresses: np.ndarray  # of all buffers


class AssembledProgram:
    """A program with memory for its runs.

    Args:
        arguments: examples, as in NumberKernel.
    """

    def __init__(self, arguments: Sequence[Tensor]):
        self.dtype = next(each.dtype for each in reversed(arguments) if each.is_floating_point())
        if self.dtype not in NUMBERS or any(each.device.type != "cpu" for each in arguments):
            raise NotImplementedError(f"{self.dtype} on {arguments[-1].device}")
        self._options = compiler_options(self.dtype)
        self.writer = Writer(Program(self.dtype), int(self._function("width")()), RULES)
        self.result_shapes: list[torch.Size] = []
        self._arguments, self._results = list[int](), list[int]()  # indices of buffers; −1 for none
        self._frozen: list[tuple[int, Tensor]] = []  # arguments of other types, which are constants of the program
        self._shapes = [each.shape for each in arguments]
        self._idle = list[_Memory]()  # of finished runs; each run needs its own

    def arguments(self, examples: Sequence[Tensor], varying: int) -> list[Tensor]:
        """Declare arguments, of which the last `varying` ones change in each step; return copies of the examples."""
        copies = [each.detach().contiguous().clone() for each in examples]
        for k, example in enumerate(copies):
            is_number = example.dtype in (self.dtype, torch.bool)
            if is_number and example.numel():
                self._arguments.append(self.writer.argument(example, varies=k >= len(copies) - varying))
            else:
                self._arguments.append(-1)
                self._frozen += [] if is_number else [(k, example)]
        return copies

    def finish(self, results: Sequence[Tensor], sums: int = 0, prepared: bool = False) -> None:
        """Complete the program. Results are copied to the outputs; the last `sums` of them are added to the outputs.

        Args:
            prepared: whether the shared instructions depend on constants only, and run once for each memory.
        """
        program, self.sums, self._prepared = self.writer.program, sums, prepared
        for k, result in enumerate(results):
            buffer = program.new_buffer(result.numel(), varies=True, given=True)
            contiguous = torch.empty(result.shape, dtype=torch.int8).stride()
            out, place = Place(buffer, 0, contiguous), self.writer.place(result)
            if k < len(results) - sums:
                program.elementwise("copy", result.shape, out, [place])
            else:
                program.elementwise("add", result.shape, out, [out, place])
            self._results.append(buffer)
            self.result_shapes.append(result.shape)
        program.remove_unread(self._results)
        self._offsets, self._numbers = program.lay_out()
        self._constants = [each.constant for each in program.buffers]
        self.shared, self.repeated = _array(program.shared), _array(program.repeated)
        self._tables = np.concatenate([*program.tables, np.zeros(1, dtype=np.int64)])
        del self.writer  # and with it the tensors that torch computed from the examples

    def is_scan(self, columns: int) -> bool:
        """Whether the program can run a scan: x and each column are not empty, and x' has the shape of x."""
        return min(self._arguments[-columns - 1 :]) >= 0 and self.result_shapes[0] == self._shapes[-1]

    def new_results(self) -> list[Tensor]:
        """New tensors for the results."""
        return [torch.empty(shape, dtype=self.dtype) for shape in self.result_shapes]

    def run(self, code: np.ndarray, arguments: Sequence[Tensor], results: Sequence[Tensor]) -> None:
        """Run instructions that write the results."""
        given = self._convert(arguments, self._shapes)
        with self._memory() as memory:
            self._run(code, self._buffers(memory, given, results))

    def scan(
        self, state: Sequence[Tensor], moving: Sequence[Tensor], x0: Tensor, two: Tensor, columns: Sequence[Tensor]
    ) -> None:
        """Run all steps of a scan.

        Args:
            two: memory for two states x.
            columns: memory for the outputs over time and for the sums.
        """
        first = len(state)
        shapes = [torch.Size([len(moving[0]), *shape]) for shape in self._shapes[first:-1]]
        given = self._convert([*state, *moving, x0], [*self._shapes[:first], *shapes, self._shapes[-1]])
        *read, carried = self._arguments[first:]
        written, *kept = self._results
        stacked = len(kept) - self.sums
        over_time = zip([*read, *kept[:stacked]], [*moving, *columns[:stacked]], strict=True)
        advances = np.array([(buffer, column[0].numel()) for buffer, column in over_time], dtype=np.int64)
        with self._memory() as memory:
            table = self._buffers(memory, given, [two[0], *columns])
            self._function("scan")(
                _address(self.shared), _long(len(self.shared)), _address(self.repeated), _long(len(self.repeated)),
                _address(self._tables), _address(table), _long(len(moving[0])), _address(advances),
                _long(len(advances)), _long(carried), _long(written), ctypes.c_void_p(two[1].data_ptr()),
            )  # fmt: skip

    def _convert(self, arguments: Sequence[Tensor], shapes: Sequence[torch.Size]) -> list[Tensor]:
        """The arguments in the type and memory layout that the program reads.

        Raises:
            ValueError: shapes, devices or frozen values differ from those of the examples.
        """
        got = [each.shape for each in arguments]
        if got != [*shapes] or any(each.device.type != "cpu" for each in arguments):
            raise ValueError(
                f"Expected arguments {[*map(tuple, shapes)]}, got {[*map(tuple, got)]}; build another kernel."
            )
        for k, example in self._frozen:
            if not torch.equal(arguments[k], example):
                raise ValueError(
                    f"Expected the {example.dtype} values of the examples, got others; build another kernel."
                )
        return [argument.detach().to(self.dtype).contiguous() for argument in arguments]

    @contextmanager
    def _memory(self) -> Iterator["_Memory"]:
        """Memory that no other thread uses."""
        try:
            memory = self._idle.pop()
        except IndexError:
            memory = self._new_memory()
        try:
            yield memory
        finally:
            self._idle.append(memory)

    def _new_memory(self) -> "_Memory":
        arena = torch.empty(self._numbers + 1, dtype=self.dtype)
        pairs = zip(self._constants, self._offsets, strict=True)
        addresses = [
            arena[max(offset, 0) :].data_ptr() if constant is None else constant.data_ptr()
            for constant, offset in pairs
        ]
        memory = _Memory(arena, np.array(addresses, dtype=np.int64))
        if self._prepared:
            self._run(self.shared, memory.addresses)
        return memory

    def _run(self, code: np.ndarray, table: np.ndarray) -> None:
        self._function("run")(_address(code), _long(len(code)), _address(self._tables), _address(table))

    def _buffers(self, memory: "_Memory", arguments: Sequence[Tensor], results: Sequence[Tensor]) -> np.ndarray:
        """The addresses of all buffers, with those of arguments and results."""
        table = memory.addresses.copy()
        for buffer, tensor in zip((*self._arguments, *self._results), (*arguments, *results), strict=True):
            if buffer >= 0:
                table[buffer] = tensor.data_ptr()
        return table

    def _function(self, name: str) -> Any:
        return getattr(library(*self._options), f"lyapnet_{name}")


def _array(instructions: Sequence[Instruction]) -> np.ndarray:
    rows = [np.array(instruction.row, dtype=np.int64) for instruction in instructions]
    return np.concatenate(rows) if rows else np.zeros(0, dtype=np.int64)


def _address(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def _long(number: int) -> ctypes.c_int64:
    return ctypes.c_int64(number)

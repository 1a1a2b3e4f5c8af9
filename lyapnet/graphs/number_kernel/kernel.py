"""Traced functions run as flat programs by compiled C++, in the place of torch's operators one by one."""

import ctypes
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.fx import GraphModule

from lyapnet.errors import LyapnetError
from lyapnet.graphs.compilation import file_of_library, library_of
from lyapnet.graphs.number_kernel.program import Instruction, Place, Program
from lyapnet.graphs.number_kernel.rewriting import rewritten
from lyapnet.graphs.number_kernel.rules import RULES
from lyapnet.graphs.number_kernel.writing import Writer
from lyapnet.graphs.scan import Scan

SOURCE = Path(__file__).with_name("program.cpp")
CHECKED = 2  # steps of a scan that are held against torch
Kernel = TypeVar("Kernel", bound="NumberKernel | ScanKernel")
NUMBERS = {torch.float64: "double", torch.float32: "float"}  # in C++


@cache
def library(dtype: torch.dtype) -> ctypes.CDLL:
    """The compiled C++ for one type of numbers, from disk, or compiled now: one file for each machine.

    Raises:
        CompilationError: as library_of.
    """
    return library_of("numbers", (SOURCE,), f"NUMBER={NUMBERS[dtype]}")


def is_built(dtype: torch.dtype) -> bool:
    """Whether the C++ for one type of numbers was compiled before."""
    return dtype in NUMBERS and file_of_library("numbers", (SOURCE,), f"NUMBER={NUMBERS[dtype]}").is_file()


class NumberKernel:
    """A graph of tensor operations for arguments of some shapes, as a program; truths in its results are 1 and 0.

    What it computes differs from torch's by rounding: sums are taken in another order. It does not depend on the number
    of threads, as it runs on one.

    Args:
        graph: a trace.
        arguments: examples, on which the program is held against the graph.
        handed: how many arguments, the last ones, are results of another kernel, and so numbers whatever their type.

    Raises:
        NotImplementedError: an operation has no rule; or the results are others.
        CompilationError: there is no machine code.
    """

    def __init__(self, graph: GraphModule, arguments: Sequence[Tensor], handed: int = 0):
        self._program = program = _Assembled(arguments, handed)
        results = program.writer.write(rewritten(graph), program.arguments(arguments, varying=len(arguments)))
        program.finish(results)
        program.run(program.shared, arguments, program.new_results())  # of constants alone: there from now on
        _require_same(self(*arguments), results)

    def __call__(self, *arguments: Tensor) -> list[Tensor]:
        """The graph's results.

        Raises:
            ValueError: arguments of other shapes, or other integers than in the examples.
        """
        results = self._program.new_results()
        self._program.run(self._program.repeated, arguments, results)
        return results


class ScanKernel:
    """`Scan` of two graphs as a program: what all steps share is computed once.

    Args:
        prepare: of the state.
        step: (*state, *columns at its time, x, *prepared) ↦ (x', *kept, *summed).
        arguments: (*state, *columns, x₀), columns over some steps, of which calls may have others.
        columns: how many there are.
        sums: how many of the step's results, the last ones, are summed over the steps.

    Raises:
        NotImplementedError, CompilationError: as NumberKernel.
    """

    def __init__(
        self, prepare: GraphModule, step: GraphModule, arguments: Sequence[Tensor], columns: int = 2, sums: int = 0
    ):
        state, moving, x0 = _split(arguments, columns)
        self._columns = columns
        examples = [*state, *(column[0] for column in moving), x0]
        self._program = program = _Assembled(examples)
        own = program.arguments(examples, varying=columns + 1)
        shared = program.writer.write(rewritten(prepare), own[: len(state)])
        program.finish(program.writer.write(rewritten(step), [*own, *shared]), sums)
        if not program.is_scan(columns):
            raise NotImplementedError("a scan of an empty batch, or of a state whose shape changes")
        with torch.no_grad():
            first = [column[:CHECKED] for column in moving]
            expected = Scan(prepare, step, len(state), sums).loop(*state, *first, x0)
        _require_same(self(*state, *first, x0), expected)

    def __call__(self, *arguments: Tensor) -> list[Tensor]:
        """What each step keeps, stacked over time, and the sums.

        Raises:
            ValueError: as NumberKernel; or columns of other lengths than each other.
        """
        program, dtype, (state, moving, x0) = self._program, self._program.dtype, _split(arguments, self._columns)
        following, *others = program.result_shapes
        kept, summed = others[: len(others) - program.sums], others[len(others) - program.sums :]
        results = [torch.empty(len(moving[0]), *shape, dtype=dtype) for shape in kept]
        results += [torch.zeros(shape, dtype=dtype) for shape in summed]
        program.scan(state, moving, x0, torch.empty(2, *following, dtype=dtype), results)
        return results


def kernel_or_none(write: Callable[[], Kernel]) -> Kernel | None:
    """What is written; None where the function has no trace, an operation no rule, or there is no compiler."""
    try:
        return write()
    except (LyapnetError, NotImplementedError, RuntimeError, TypeError, ValueError):
        return None


def _split(arguments: Sequence[Tensor], columns: int) -> tuple[Sequence[Tensor], Sequence[Tensor], Tensor]:
    """(state, columns over time, x₀) of the arguments of a scan."""
    *state, x0 = arguments
    return state[: len(state) - columns], state[len(state) - columns :], x0


class _Assembled:
    """A program with its memory.

    Args:
        arguments, handed: as NumberKernel.
    """

    def __init__(self, arguments: Sequence[Tensor], handed: int = 0):
        self.dtype = next(
            each.dtype for each in arguments[len(arguments) - handed - 1 :: -1] if each.is_floating_point()
        )
        if self.dtype not in NUMBERS or any(each.device.type != "cpu" for each in arguments):
            raise NotImplementedError(f"{self.dtype} on {arguments[-1].device}")
        self.writer = Writer(Program(self.dtype), int(self._function("width")()), RULES)
        self.result_shapes: list[torch.Size] = []
        self._handed = handed
        self._given, self._results = list[int](), list[int]()  # buffers
        self._frozen: list[tuple[int, Tensor]] = []  # arguments of other types, which are constants of the program
        self._shapes = [each.shape for each in arguments]
        self._lock = Lock()  # a program has one memory

    def arguments(self, examples: Sequence[Tensor], varying: int) -> list[Tensor]:
        """Examples of their own memory, the last ones of which vary from step to step."""
        own = [each.detach().contiguous().clone() for each in examples]
        for k, example in enumerate(own):
            is_number = example.dtype in (self.dtype, torch.bool) or k >= len(own) - self._handed
            if is_number and example.numel():
                self._given.append(self.writer.argument(example, varies=k >= len(own) - varying))
            else:
                self._given.append(-1)
                self._frozen += [] if is_number else [(k, example)]
        return own

    def finish(self, results: Sequence[Tensor], sums: int = 0) -> None:
        """Lay out the memory, for results that are copied out, the last ones added to what is there."""
        program, self.sums = self.writer.program, sums
        for k, result in enumerate(results):
            buffer = program.new_buffer(result.numel(), varies=True, given=True)
            in_line = torch.empty(result.shape, dtype=torch.int8).stride()
            out, place = Place(buffer, 0, in_line), self.writer.place(result)
            if k < len(results) - sums:
                program.elementwise("copy", result.shape, out, [place])
            else:
                program.elementwise("sum", result.shape, out, [out, place])
            self._results.append(buffer)
            self.result_shapes.append(result.shape)
        program.without_unread(self._results)
        offsets, numbers = program.laid_out()
        self._arena = torch.empty(numbers + 1, dtype=self.dtype)
        self._constants = [each.constant for each in program.buffers]
        self._addresses = np.array(
            [
                self._arena[max(offset, 0) :].data_ptr() if constant is None else constant.data_ptr()
                for constant, offset in zip(self._constants, offsets, strict=True)
            ],
            dtype=np.int64,
        )
        self.shared, self.repeated = _array(program.shared), _array(program.repeated)
        self._tables = np.concatenate([*program.tables, np.zeros(1, dtype=np.int64)])
        del self.writer  # and with it all that torch has computed of the examples

    def is_scan(self, columns: int) -> bool:
        """Whether there are numbers in x and each column, and x' is like x."""
        return min(self._given[-columns - 1 :]) >= 0 and self.result_shapes[0] == self._shapes[-1]

    def new_results(self) -> list[Tensor]:
        """Tensors for the results."""
        return [torch.empty(shape, dtype=self.dtype) for shape in self.result_shapes]

    def run(self, code: np.ndarray, arguments: Sequence[Tensor], results: Sequence[Tensor]) -> None:
        """Run instructions, and have them write the results."""
        given = self._checked(arguments, self._shapes)
        table = self._buffers(given, results)
        with self._lock:
            self._function("run")(_address(code), _long(len(code)), _address(self._tables), _address(table))

    def scan(
        self, state: Sequence[Tensor], moving: Sequence[Tensor], x0: Tensor, two: Tensor, columns: Sequence[Tensor]
    ) -> None:
        """Run all steps: `two` is memory for two states x, `columns` for what the steps keep, over time, and sums."""
        first = len(state)
        shapes = [torch.Size([len(moving[0]), *shape]) for shape in self._shapes[first:-1]]
        given = self._checked([*state, *moving, x0], [*self._shapes[:first], *shapes, self._shapes[-1]])
        table = self._buffers(given, [two[0], *columns])
        *read, carried = self._given[first:]
        written, *kept = self._results
        stacked = len(kept) - self.sums
        over_time = zip([*read, *kept[:stacked]], [*moving, *columns[:stacked]], strict=True)
        advances = np.array([(buffer, column[0].numel()) for buffer, column in over_time], dtype=np.int64)
        with self._lock:
            self._function("scan")(
                _address(self.shared), _long(len(self.shared)), _address(self.repeated), _long(len(self.repeated)),
                _address(self._tables), _address(table), _long(len(moving[0])), _address(advances),
                _long(len(advances)), _long(carried), _long(written), ctypes.c_void_p(two[1].data_ptr()),
            )  # fmt: skip

    def _checked(self, arguments: Sequence[Tensor], shapes: Sequence[torch.Size]) -> list[Tensor]:
        """Arguments as the program reads them."""
        got = [each.shape for each in arguments]
        if got != [*shapes] or any(each.device.type != "cpu" for each in arguments):
            raise ValueError(
                f"Expected arguments {[*map(tuple, shapes)]}, got {[*map(tuple, got)]}; build another kernel."
            )
        for k, example in self._frozen:
            if not torch.equal(arguments[k], example):
                raise ValueError(
                    f"Expected {example.dtype} as it was traced in a program of {self.dtype}, got other numbers; build "
                    "the kernel anew."
                )
        return [argument.detach().to(self.dtype).contiguous() for argument in arguments]

    def _buffers(self, arguments: Sequence[Tensor], results: Sequence[Tensor]) -> np.ndarray:
        """The addresses of all buffers."""
        table = self._addresses.copy()
        for buffer, tensor in zip((*self._given, *self._results), (*arguments, *results), strict=True):
            if buffer >= 0:
                table[buffer] = tensor.data_ptr()
        return table

    def _function(self, name: str) -> Any:
        return getattr(library(self.dtype), f"lyapnet_{name}")


def _require_same(results: Sequence[Tensor], expected: Sequence[Tensor]) -> None:
    """Hold a program against its graph up to a third of the digits: a rule that is wrong is not to be trained with."""
    for result, value in zip(results, expected, strict=True):
        third = torch.finfo(result.dtype).eps ** (1 / 3)
        scale = float(value.to(result.dtype).nan_to_num(0, 0, 0).abs().max()) if value.numel() else 0.0
        if not torch.allclose(result, value.to(result.dtype), rtol=third, atol=third * scale, equal_nan=True):
            raise NotImplementedError("another result than torch's")


def _array(instructions: Sequence[Instruction]) -> np.ndarray:
    rows = [np.array(instruction.row, dtype=np.int64) for instruction in instructions]
    return np.concatenate(rows) if rows else np.zeros(0, dtype=np.int64)


def _address(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def _long(number: int) -> ctypes.c_int64:
    return ctypes.c_int64(number)

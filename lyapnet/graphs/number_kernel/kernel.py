"""Traced functions run as flat programs by compiled C++, in the place of torch's operators one by one."""

import ctypes
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.fx import GraphModule

from lyapnet.graphs.libraries import file_of_library, library_of
from lyapnet.graphs.number_kernel.program import Instruction, Program
from lyapnet.graphs.number_kernel.rules import RULES
from lyapnet.graphs.number_kernel.writing import Writer

SOURCE = Path(__file__).with_name("program.cpp")
NAMES = {torch.float64: "float64", torch.float32: "float32"}


@cache
def library() -> ctypes.CDLL:
    """The compiled C++, from disk, or compiled now: one file for each machine.

    Raises:
        CompilationError: as library_of.
    """
    return library_of("numbers", (SOURCE,))


def is_built() -> bool:
    """Whether the C++ was compiled before."""
    return file_of_library("numbers", (SOURCE,)).is_file()


class NumberKernel:
    """A graph of tensor operations for arguments of some shapes, as a program; truths in its results are 1 and 0.

    What it computes differs from torch's by rounding: sums are taken in another order. It does not depend on the number
    of threads, as it runs on one.

    Args:
        graph: a trace.
        arguments: examples, on which the program is held against the graph.

    Raises:
        NotImplementedError: an operation has no rule; or the results are others.
        CompilationError: there is no machine code.
    """

    def __init__(self, graph: GraphModule, arguments: Sequence[Tensor]):
        self._program = _Assembled(arguments)
        given = self._program.arguments(arguments, varying=len(arguments))
        results = self._program.writer.write(graph, given)
        program = self._program
        program.finish(results)
        # what depends on constants alone is there from now on
        program.function("run")(*program.first, program.tables, program.buffers(arguments, results))
        _require_same(self(*arguments), results)

    def __call__(self, *arguments: Tensor) -> list[Tensor]:
        """The graph's results."""
        program = self._program
        results = program.new_results()
        buffers = program.buffers(arguments, results)
        program.function("run")(*program.every, program.tables, buffers)
        return results


class ScanKernel:
    """`Scan` of two graphs as a program: what all steps share is computed once.

    Args:
        prepare: of the state.
        step: (*state, t, Δt, x, *prepared) ↦ (x', *kept).
        arguments: (*state, t, Δt, x₀), t and Δt of all steps.

    Raises:
        NotImplementedError, CompilationError: as NumberKernel.
    """

    def __init__(self, prepare: GraphModule, step: GraphModule, arguments: Sequence[Tensor]):
        *state, t, dt, x0 = arguments
        self._steps = len(t)
        examples = [*state, t[0].clone(), dt[0].clone(), x0]
        program = self._program = _Assembled(examples)
        *given, t0, dt0, x = program.arguments(examples, varying=3)
        shared = program.writer.write(prepare, given)
        following, *kept = program.writer.write(step, [*given, t0, dt0, x, *shared])
        program.finish([following, *kept])
        with torch.no_grad():
            following_of_torch, *kept_of_torch = step(*examples, *prepare(*state))
        del following_of_torch
        columns = self(*arguments)
        _require_same([column[0] for column in columns], kept_of_torch)

    def __call__(self, *arguments: Tensor) -> list[Tensor]:
        """What each step keeps, stacked over time."""
        program, (*state, t, dt, x0) = self._program, arguments
        following, *kept = program.result_shapes
        columns = [torch.empty(self._steps, *shape, dtype=program.dtype) for shape in kept]
        first, spare = (torch.empty(following, dtype=program.dtype) for _ in range(2))
        buffers = program.buffers([*state, t, dt, x0], [first, *columns])
        inputs, results = program.given[-3:], program.results
        advances = [(inputs[0], 1), (inputs[1], 1)]
        advances += [(buffer, shape.numel()) for buffer, shape in zip(results[1:], kept, strict=True)]
        moving = np.array(advances, dtype=np.int64)
        program.function("scan")(
            *program.first, *program.every, program.tables, buffers, _long(self._steps), _address(moving),
            _long(len(advances)), _long(inputs[2]), _long(results[0]), ctypes.c_void_p(spare.data_ptr()),
        )  # fmt: skip
        return columns


class _Assembled:
    """A program with its memory."""

    def __init__(self, arguments: Sequence[Tensor]):
        floating = [each.dtype for each in arguments if each.is_floating_point()]
        self.dtype = floating[-1]
        if self.dtype not in NAMES or any(each.device.type != "cpu" for each in arguments):
            raise NotImplementedError(f"{self.dtype} on {arguments[-1].device}")
        self._width = int(self.function("width")())
        self._program = Program(self.dtype)
        self.writer = Writer(self._program, self._width, RULES)
        self.given, self.results = list[int](), list[int]()
        self.result_shapes: list[torch.Size] = []
        self._frozen: list[tuple[int, Tensor]] = []  # arguments of other types, which are constants of the program
        self._shapes = [each.shape for each in arguments]

    def arguments(self, examples: Sequence[Tensor], varying: int) -> list[Tensor]:
        """Examples of their own memory, the last ones of which vary from step to step."""
        own = [each.detach().contiguous().clone() for each in examples]
        for k, example in enumerate(own):
            if example.dtype not in (self.dtype, torch.bool):
                self._frozen.append((k, example))
                self.given.append(-1)
            elif not example.numel():
                self.given.append(-1)
            else:
                self.given.append(self.writer.argument(example, varies=k >= len(own) - varying))
        return own

    def finish(self, results: Sequence[Tensor]) -> None:
        """Lay out the memory, for results that are copied out."""
        program = self._program
        for result in results:
            buffer = program.new_buffer(result.numel(), varies=True, given=True)
            place = self.writer.place(result)
            contiguous = torch.empty(result.shape, dtype=torch.int8).stride()
            program.elementwise(
                "copy", result.shape, place._replace(buffer=buffer, offset=0, strides=contiguous), [place]
            )
            self.results.append(buffer)
            self.result_shapes.append(result.shape)
        program.without_unread(self.results)
        offsets, arena = program.laid_out()
        self._arena = torch.empty(arena + 1, dtype=self.dtype)
        self._constants = [each.constant for each in program.buffers]
        addresses = [
            constant.data_ptr()
            if constant is not None
            else self._arena.data_ptr() + max(offset, 0) * self.dtype.itemsize
            for constant, offset in zip(self._constants, offsets, strict=True)
        ]
        self._addresses = np.array(addresses, dtype=np.int64)
        self._code = [_array(program.shared), _array(program.repeated)]
        self._tables = np.concatenate([*program.tables, np.zeros(1, dtype=np.int64)])
        self.first, self.every = ((_address(code), _long(len(code))) for code in self._code)
        self.tables = _address(self._tables)
        del self._program

    def new_results(self) -> list[Tensor]:
        return [torch.empty(shape, dtype=self.dtype) for shape in self.result_shapes]

    def buffers(self, arguments: Sequence[Tensor], results: Sequence[Tensor]) -> ctypes.c_void_p:
        """The addresses of all buffers for a call."""
        for k, example in self._frozen:
            if not torch.equal(arguments[k], example):
                raise ValueError(
                    f"Expected {example.dtype} as it was traced in a program of {self.dtype}, got other numbers; build "
                    "the kernel anew."
                )
        # kept until the call is over
        self._alive = [argument.detach().to(self.dtype).contiguous() for argument in arguments]
        table = self._addresses.copy()
        for buffer, argument in zip(self.given, self._alive, strict=True):
            if buffer >= 0:
                table[buffer] = argument.data_ptr()
        for buffer, result in zip(self.results, results, strict=True):
            table[buffer] = result.data_ptr()
        self._table = table
        return _address(table)

    def function(self, name: str) -> Any:
        return getattr(library(), f"lyapnet_{name}_{NAMES[self.dtype]}")


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


def _long(number: int) -> ctypes.c_long:
    return ctypes.c_long(number)

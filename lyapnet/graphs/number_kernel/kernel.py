"""Runs traced functions as flat programs in compiled C++, instead of calling torch's operators one by one."""

from collections.abc import Callable, Sequence
from typing import TypeVar

import torch
from torch import Tensor
from torch.fx import GraphModule

from lyapnet.base.errors import LyapnetError
from lyapnet.graphs.agreement import THIRD, are_close
from lyapnet.graphs.number_kernel.assembly import AssembledProgram
from lyapnet.graphs.number_kernel.rewriting import rewrite
from lyapnet.graphs.scan import Scan

CHECKED = 2  # number of steps of a scan that are compared with torch
Kernel = TypeVar("Kernel", bound="NumberKernel | ScanKernel")


class NumberKernel:
    """A graph of tensor operations for arguments of given shapes, as a program; booleans in its results are 1 and 0.

    Its results differ from torch's by rounding, since sums are taken in another order. A call runs on one thread.

    Args:
        graph: a trace.
        arguments: examples, on which the program is compared with the graph.

    Raises:
        NotImplementedError: an operation has no rule, or the results differ from torch's.
        CompilationError: the C++ cannot be compiled.
    """

    def __init__(self, graph: GraphModule, arguments: Sequence[Tensor]):
        self._program = program = AssembledProgram(arguments)
        copies = program.arguments(arguments, varying=len(arguments))
        program.finish(program.writer.write(rewrite(graph), copies), prepared=True)
        with torch.no_grad():
            _require_same(self(*arguments), graph(*arguments))

    def __call__(self, *arguments: Tensor) -> list[Tensor]:
        """The graph's results.

        Raises:
            ValueError: the arguments have other shapes, or other integers, than the examples.
        """
        results = self._program.new_results()
        self._program.run(self._program.repeated, arguments, results)
        return results


class ScanKernel:
    """A `Scan` of two graphs as a program; computations that all steps share run once.

    Args:
        prepare: state ↦ the tensors that all steps share.
        step: (*state, *columns at its time, x, *prepared) ↦ (x', *outputs, *summed outputs).
        arguments: examples (*state, *columns, x₀); calls may have another number of steps.
        columns: the number of columns.
        sums: the number of summed outputs.

    Raises:
        NotImplementedError, CompilationError: as NumberKernel.
    """

    def __init__(
        self, prepare: GraphModule, step: GraphModule, arguments: Sequence[Tensor], columns: int = 2, sums: int = 0
    ):
        state, moving, x0 = _split(arguments, columns)
        self._columns = columns
        examples = [*state, *(column[0] for column in moving), x0]
        self._program = program = AssembledProgram(examples)
        copies = program.arguments(examples, varying=columns + 1)
        shared = program.writer.write(rewrite(prepare), copies[: len(state)])
        program.finish(program.writer.write(rewrite(step), [*copies, *shared]), sums)
        if not program.is_scan(columns):
            raise NotImplementedError("a scan of an empty batch, or of a state whose shape changes")
        with torch.no_grad():
            first = [column[:CHECKED] for column in moving]
            expected = Scan(prepare, step, len(state), sums).loop(*state, *first, x0)
        _require_same(self(*state, *first, x0), expected)

    def __call__(self, *arguments: Tensor) -> list[Tensor]:
        """The outputs of the steps stacked over time, and the sums.

        Raises:
            ValueError: as NumberKernel; or the columns differ in length.
        """
        program, dtype, (state, moving, x0) = self._program, self._program.dtype, _split(arguments, self._columns)
        following, *others = program.result_shapes
        stacked, summed = others[: len(others) - program.sums], others[len(others) - program.sums :]
        results = [torch.empty(len(moving[0]), *shape, dtype=dtype) for shape in stacked]
        results += [torch.zeros(shape, dtype=dtype) for shape in summed]
        program.scan(state, moving, x0, torch.empty(2, *following, dtype=dtype), results)
        return results


def kernel_or_none(write: Callable[[], Kernel]) -> Kernel | None:
    """The kernel that `write` returns; None without a trace, a rule for each operation, or a compiler."""
    try:
        return write()
    except (LyapnetError, NotImplementedError, RuntimeError, TypeError, ValueError):
        return None


def _split(arguments: Sequence[Tensor], columns: int) -> tuple[Sequence[Tensor], Sequence[Tensor], Tensor]:
    """(state, columns over time, x₀) of the arguments of a scan."""
    *state, x0 = arguments
    return state[: len(state) - columns], state[len(state) - columns :], x0


def _require_same(results: Sequence[Tensor], expected: Sequence[Tensor]) -> None:
    """Refuse a program whose results differ from its graph's in the first third of the digits, as by a wrong rule."""
    for result, value in zip(results, expected, strict=True):
        if not are_close(result, value.to(result.dtype), THIRD):
            raise NotImplementedError("another result than torch's")

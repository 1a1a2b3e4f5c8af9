"""The pieces of work of a discretised closed loop: integrate, linearise, and pull back to the parameters."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.fx import GraphModule

from lyapnet.errors import CompilationError
from lyapnet.graphs.compilation import Scan, compilation_errors, compiled
from lyapnet.graphs.number_kernel.kernel import NumberKernel, ScanKernel
from lyapnet.types import ControlPath, StagePath, ValuePath


class Nodes(NamedTuple):
    """What a rollout leaves at its nodes 0 … N; at the last one, of a step of length zero."""

    stages: StagePath  # where each step evaluates the closed loop, the node itself first
    step_cost: ValuePath  # ∫ℓ over the step
    u: ControlPath  # at the node
    value: ValuePath  # V at the node


BATCH_AXES = (-2, -1, -2, -1)  # of the columns of Nodes


class Routines(NamedTuple):
    """The three pieces of work, for one shape of batch; `state` is the tensors that a closed loop is made of."""

    integrate: Callable[..., Sequence[Tensor]]  # (*state, t, Δt, x₀) ↦ the columns of Nodes at the nodes t
    linearise: Callable[..., Sequence[Any]]  # (*state, *block) ↦ (Φᵀ, source, *intermediate)
    product: Callable[..., Sequence[Tensor]]  # (*state, *block, costate, *intermediate) ↦ θ̄
    block: int  # K, steps in a block


class TracedRoutines(NamedTuple):
    """The three pieces of work as graphs, and arguments that show their shapes."""

    prepare: GraphModule  # what all steps share
    step: GraphModule
    linearise: GraphModule
    product: GraphModule
    block: int
    path_arguments: list[Tensor]
    block_arguments: list[Tensor]

    def routines(self) -> Routines:
        """The graphs, replayed operation by operation."""
        return Routines(self._scan().loop, self.linearise, self.product, self.block)

    def compiled(self) -> Routines:
        """The graphs as machine code: on a CPU run by lyapnet's own kernel, on a GPU compiled for this task.

        Raises:
            CompilationError: there is no compiler, or it failed; or the kernel has no rule for an operation.
        """
        with compilation_errors():
            if self.path_arguments[-1].device.type == "cpu":
                return self._by_kernel()
            integrate, linearise, product = (compiled(*piece) for piece in self.pieces())
        return Routines(integrate, linearise, product, self.block)

    def _by_kernel(self) -> Routines:
        try:
            (_, path), (_, block), (_, every) = self.pieces()
            integrate = ScanKernel(self.prepare, self.step, path)
            linearise = NumberKernel(self.linearise, block)
            product = NumberKernel(self.product, every, handed=len(every) - len(self.block_arguments))
        except NotImplementedError as error:
            raise CompilationError(f"Expected operations that the kernel has, got {error}") from error
        return Routines(integrate, linearise, product, self.block)

    def pieces(self) -> list[tuple[nn.Module, list[Tensor]]]:
        """What there is to compile, and for which arguments."""
        with torch.no_grad():
            intermediate = self.linearise(*self.block_arguments[:-1])[2:]
        return [
            (self._scan(), self.path_arguments),
            (self.linearise, self.block_arguments[:-1]),
            (self.product, [*self.block_arguments, *intermediate]),
        ]

    def _scan(self) -> Scan:
        return Scan(self.prepare, self.step, len(self.path_arguments) - 3)

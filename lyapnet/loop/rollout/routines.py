"""The routines of a discretised closed loop: its integration, and the backward pass for the gradient."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.fx import GraphModule

from lyapnet.base.errors import CompilationError, LyapnetError, UntraceableError, one_line
from lyapnet.base.threads import in_threads
from lyapnet.base.types import ControlPath, StagePath, State, ValuePath
from lyapnet.graphs.compilation import compilation_errors
from lyapnet.graphs.cuda_graphs import RecordedFunction, Replay, record
from lyapnet.graphs.number_kernel.kernel import ScanKernel
from lyapnet.graphs.scan import Scan
from lyapnet.graphs.stateless import stateless, trained_of
from lyapnet.graphs.tracing import cut, trace
from lyapnet.loop.rollout.backwards import BlockwiseGradient, PathWithDerivatives, StepwiseGradient
from lyapnet.loop.rollout.closed_loop import ClosedLoop
from lyapnet.loop.rollout.runge_kutta import Linearise, PullBack, Step
from lyapnet.task.horizon import ButcherTableau


class Nodes(NamedTuple):
    """The results of a rollout at its nodes 0 … N; the last node has a step of length zero."""

    stages: StagePath  # stages of each step; the first one is the node itself
    step_cost: ValuePath  # ∫ℓ over the step
    u: ControlPath  # at the node
    value: ValuePath  # V at the node


MOST_STATES_OF_BLOCKS = 12  # n above which pulling back one step at a time is faster than the Jacobians of a block
BATCH_AXES = (-2, -1, -2, -1)  # batch axis of each column of Nodes


class Routines(NamedTuple):
    """The two routines for one batch shape; `state` is the list of tensors of the closed loop."""

    # (*state, t, Δt, x₀), with noise ΔW before x₀ ↦ the columns of Nodes at the nodes t
    integrate: Callable[..., Sequence[Tensor]]
    gradient: Callable[[Sequence[Tensor], PathWithDerivatives], tuple[State, list[Tensor]]]  # (x̄₀, θ̄)


def in_parts(routines: Routines, size: int) -> Routines:
    """Routines for a batch, from those for a part of it: parts of that size run on several threads.

    The parts do not depend on the number of threads, nor do the results.
    """

    def integrate(*arguments: Tensor) -> list[Tensor]:
        *state, t, dt, x0 = arguments
        parts = in_threads(lambda rows: routines.integrate(*state, t, dt, rows), x0.split(size))
        return [torch.cat(column, axis) for column, axis in zip(zip(*parts, strict=True), BATCH_AXES, strict=True)]

    def gradient(state: Sequence[Tensor], path: PathWithDerivatives) -> tuple[State, list[Tensor]]:
        t, dt, stages, *derivatives = path.columns
        rows = zip(stages.split(size, 2), *(column.split(size, 1) for column in derivatives), strict=True)
        parts = in_threads(lambda part: routines.gradient(state, PathWithDerivatives(t, dt, *part)), [*rows])
        costates, shares = zip(*parts, strict=True)
        return torch.cat(costates), [torch.stack(share).sum(0) for share in zip(*shares, strict=True)]

    return Routines(integrate, gradient)


class TracedRoutines:
    """The routines for one batch shape as graphs, each traced on first use.

    Args:
        loop, tableau: the closed loop, and the integrator of its steps.
        state: the tensors of the loop, the trained ones first.
        grid: t and Δt at all nodes; with noise also ΔW.
        x0: a batch (b, n).
        block: K, the number of nodes in a block.
        limit: limit of the costates, see `limit_costates`.
        visited: returns the arguments (t, Δt, x), with noise ΔW before x, at which the trace of a step is compared with
            the loop itself.
    """

    def __init__(
        self,
        loop: ClosedLoop,
        tableau: ButcherTableau,
        state: list[Tensor],
        grid: Sequence[Tensor],
        x0: State,
        block: int,
        limit: float | None,
        visited: Callable[[], list[list[Tensor]]],
    ):
        self.state, self.grid, self.x0, self.block, self.limit = state, grid, x0, block, limit
        self._step, self._linearise = Step(loop, tableau), Linearise(loop, tableau)
        self._visited, self._trained, self._stages = visited, len(trained_of(loop)), len(tableau.b)

    def traced(self) -> Routines:
        """The graphs, run operation by operation.

        Raises:
            UntraceableError: the control flow depends on tensor values, or the code leaves torch.
        """
        if self.x0.shape[-1] > MOST_STATES_OF_BLOCKS:
            back = Scan(*self._backwards, len(self.state), sums=self._trained)
            return Routines(self._scan().loop, StepwiseGradient(back.loop, self.limit))
        return Routines(self._scan().loop, BlockwiseGradient(*self._block_pieces, self.block, self.limit))

    def compiled(self) -> Routines:
        """The compiled graphs: by lyapnet's kernel on a CPU, as CUDA graphs on a GPU.

        Raises:
            UntraceableError: as traced.
            CompilationError: there is no compiler, it failed, or the kernel has no rule for an operation.
        """
        with compilation_errors():
            return self._by_kernel() if self.x0.device.type == "cpu" else self.recorded()

    def recorded(self, record: Callable[..., Replay] = record) -> Routines:
        """The graphs as CUDA graphs, one for the whole path and one for the whole gradient."""
        by_blocks, tensors = BlockwiseGradient(*self._block_pieces, self.block, self.limit), len(self.state)
        integrate = RecordedFunction(self._scan().loop, [*self.state, *self.grid, self.x0], record)
        (t, dt, *noise), nodes = self.grid, self.x0.expand(len(self.grid[0]), *self.x0.shape)
        stages = nodes[:, None].expand(-1, self._stages, -1, -1)
        path = PathWithDerivatives(
            t, dt, stages, nodes, torch.zeros_like(nodes[..., 0]), torch.zeros_like(nodes[..., 0]), *noise
        )

        def backwards(*arguments: Tensor) -> list[Tensor]:
            costate, share = by_blocks(arguments[:tensors], PathWithDerivatives(*arguments[tensors:]))
            return [costate, *share]

        gradient = RecordedFunction(backwards, [*self.state, *path.columns], record)

        def unpacked(state: Sequence[Tensor], path: PathWithDerivatives) -> tuple[State, list[Tensor]]:
            costate, *share = gradient(*state, *path.columns)
            return costate, share

        return Routines(integrate, unpacked)

    def _by_kernel(self) -> Routines:
        (t, dt, *noise), x0 = self.grid, self.x0
        nodes, per_node = x0.expand(len(t), *x0.shape), torch.ones_like(x0[:, 0]).expand(len(t), -1)
        columns = [t, dt, nodes, nodes, per_node, per_node, *noise]
        try:
            integrate = ScanKernel(*self._forwards, [*self.state, *self.grid, x0], len(self.grid))
            back = ScanKernel(*self._backwards, [*self.state, *columns, x0], len(columns), sums=self._trained)
        except NotImplementedError as error:
            raise CompilationError(f"Expected operations that the kernel has, got {error}") from error
        return Routines(integrate, StepwiseGradient(back, self.limit))

    def _scan(self) -> Scan:
        return Scan(*self._forwards, len(self.state))

    @cached_property
    def _forwards(self) -> tuple[GraphModule, GraphModule]:
        """(the part common to all steps, one step)."""
        arguments = [*self.state, *(column[0] for column in self.grid), self.x0]
        with _tracing():
            elsewhere = self._visited()
        return cut(
            self._trace(self._step, arguments, elsewhere), late=1 + len(self.grid), early_outputs=0, repeat=False
        )

    @cached_property
    def _backwards(self) -> tuple[GraphModule, GraphModule]:
        """(the part common to all steps, one backward step)."""
        (t, dt, *noise), x0 = (column[0] for column in self.grid), self.x0
        late = [t, dt, x0, x0.clone(), torch.ones_like(x0[:, 0]), torch.ones_like(x0[:, 0]), *noise, x0.clone()]
        return cut(
            self._trace(PullBack(self._step), [*self.state, *late]), late=len(late), early_outputs=0, repeat=False
        )

    @cached_property
    def _block_pieces(self) -> tuple[GraphModule, GraphModule]:
        """(linearise, product) of a block."""
        return cut(self._trace(self._linearise, self._block_arguments()), late=1, early_outputs=2)

    def _block_arguments(self) -> list[Tensor]:
        """Arguments for tracing the functions of a block."""
        (t, dt, *noise), x0 = (column[: self.block] for column in self.grid), self.x0
        nodes = x0.expand(self.block, *x0.shape)
        stages = nodes[:, None].repeat(1, self._stages, 1, 1)
        bars = [nodes.clone(), torch.ones_like(nodes[..., 0]), torch.ones_like(nodes[..., 0])]
        return [*self.state, t, dt, stages, *bars, *noise, nodes.clone()]

    def _trace(
        self, module: nn.Module, arguments: list[Tensor], elsewhere: Sequence[Sequence[Tensor]] = ()
    ) -> GraphModule:
        with _tracing():
            return trace(stateless(module), arguments, elsewhere, whole=self.x0.device.type == "cpu")


@contextmanager
def _tracing() -> Iterator[None]:
    """Convert any error of the loop's functions during tracing to an UntraceableError."""
    try:
        yield
    except LyapnetError:
        raise
    except Exception as error:  # raised by the user's functions
        reason = one_line(error).split(". ")[0].rstrip(".")
        raise UntraceableError(
            f"Expected a closed loop that can be traced, got {type(error).__name__}: {reason}."
        ) from error

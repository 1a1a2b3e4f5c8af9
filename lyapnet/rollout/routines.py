"""The pieces of work of a discretised closed loop: integrate it, and run backwards along it to the gradient."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.fx import GraphModule

from lyapnet.errors import CompilationError, LyapnetError, UntraceableError, one_line
from lyapnet.graphs.compilation import Scan, compilation_errors, compiled
from lyapnet.graphs.number_kernel.kernel import ScanKernel
from lyapnet.graphs.stateless import stateless
from lyapnet.graphs.tracing import batched, cut, trace
from lyapnet.horizon import ButcherTableau
from lyapnet.rollout.backwards import BlockwiseGradient, Columns, StepwiseGradient
from lyapnet.rollout.closed_loop import ClosedLoop
from lyapnet.rollout.runge_kutta import Linearise, PullBack, Step
from lyapnet.types import ControlPath, StagePath, State, Times, ValuePath


class Nodes(NamedTuple):
    """What a rollout leaves at its nodes 0 … N; at the last one, of a step of length zero."""

    stages: StagePath  # where each step evaluates the closed loop, the node itself first
    step_cost: ValuePath  # ∫ℓ over the step
    u: ControlPath  # at the node
    value: ValuePath  # V at the node


BATCH_AXES = (-2, -1, -2, -1)  # of the columns of Nodes


class Routines(NamedTuple):
    """The two pieces of work, for one shape of batch; `state` is the tensors that a closed loop is made of."""

    integrate: Callable[..., Sequence[Tensor]]  # (*state, t, Δt, x₀) ↦ the columns of Nodes at the nodes t
    gradient: Callable[[Sequence[Tensor], Columns], tuple[State, list[Tensor]]]  # (x̄₀, θ̄)


class TracedRoutines:
    """The pieces of work for one shape of batch as graphs, each traced when it is first asked for.

    Args:
        loop, tableau: the closed loop, and its steps.
        state, trained: the tensors that it is made of, and how many of them, the first ones, are trained.
        grid: t and Δt at all nodes.
        x0: a batch, (b, n) or, of members with trained tensors of their own, (E, b, n).
        block: K, nodes in a block.
        limit: of the costates.
        visited: gives (t, Δt, x) at which the trace of a step is held against the loop itself.
    """

    def __init__(
        self,
        loop: ClosedLoop,
        tableau: ButcherTableau,
        state: list[Tensor],
        trained: int,
        grid: tuple[Times, Times],
        x0: State,
        block: int,
        limit: float | None,
        visited: Callable[[], list[list[Tensor]]],
    ):
        self.state, self.grid, self.x0, self.block, self.limit = state, grid, x0, block, limit
        self._step, self._linearise = Step(loop, tableau), Linearise(loop, tableau)
        self._visited, self._trained, self._stages = visited, trained, len(tableau.b)

    def require_traces(self) -> None:
        """Hold that the loop can be traced, forwards and backwards.

        Raises:
            UntraceableError: its control flow depends on tensor values, or it leaves torch.
        """
        _ = self._forwards, self._backwards

    def forwards(self) -> Callable[..., Sequence[Tensor]]:
        """`integrate` of the graphs, for what asks for no gradient: nothing is traced backwards.

        Raises:
            UntraceableError: its control flow depends on tensor values, or it leaves torch.
        """
        return self._scan().loop

    def traced(self) -> Routines:
        """The graphs, replayed operation by operation.

        Raises:
            UntraceableError: as require_traces.
        """
        return Routines(self.forwards(), BlockwiseGradient(*self._block_pieces, self.block, self.limit))

    def compiled(self) -> Routines:
        """The graphs as machine code: on a CPU run by lyapnet's own kernel, on a GPU compiled for this task.

        Raises:
            UntraceableError: as require_traces.
            CompilationError: there is no compiler, or it failed; or the kernel has no rule for an operation.
        """
        with compilation_errors():
            if self.x0.device.type == "cpu":
                return self._by_kernel()
            arguments = self._block_arguments()
            linearise, product = self._block_pieces
            with torch.no_grad():
                intermediate = linearise(*arguments[:-1])[2:]
            by_blocks = compiled(linearise, arguments[:-1]), compiled(product, [*arguments, *intermediate])
            integrate = compiled(self._scan(), [*self.state, *self.grid, self.x0])
        return Routines(integrate, BlockwiseGradient(*by_blocks, self.block, self.limit))

    def _by_kernel(self) -> Routines:
        (t, dt), x0 = self.grid, self.x0
        nodes, per_node = x0.expand(len(t), *x0.shape), torch.ones_like(x0[..., 0]).expand(len(t), *x0.shape[:-1])
        columns = [t, dt, nodes, nodes, per_node, per_node]
        try:
            integrate = ScanKernel(*self._forwards, [*self.state, *self.grid, x0])
            back = ScanKernel(*self._backwards, [*self.state, *columns, x0], len(columns), sums=self._trained)
        except NotImplementedError as error:
            raise CompilationError(f"Expected operations that the kernel has, got {error}") from error
        return Routines(integrate, StepwiseGradient(back, self.limit))

    def _scan(self) -> Scan:
        return Scan(*self._forwards, len(self.state))

    @cached_property
    def _forwards(self) -> tuple[GraphModule, GraphModule]:
        """(what all steps share, a step)."""
        t, dt = self.grid
        arguments = [*self.state, t[0], dt[0], self.x0]
        with _tracing():
            elsewhere = self._visited()
        graph = self._trace(self._step, arguments, [None, None, 0], [0, 1, 0, 0, 0], elsewhere)
        return cut(graph, late=3, early_outputs=0, repeat=False)

    @cached_property
    def _backwards(self) -> tuple[GraphModule, GraphModule]:
        """(what all steps share, a step pulled back)."""
        (t, dt), x0 = self.grid, self.x0
        late = [t[0], dt[0], x0, x0.clone(), torch.ones_like(x0[..., 0]), torch.ones_like(x0[..., 0]), x0.clone()]
        results = [0] * (2 + self._trained)
        graph = self._trace(PullBack(self._step), [*self.state, *late], [None, None, *[0] * 5], results)
        return cut(graph, late=len(late), early_outputs=0, repeat=False)

    @cached_property
    def _block_pieces(self) -> tuple[GraphModule, GraphModule]:
        """(linearise, product) of a block."""
        arguments = self._block_arguments()
        axes, results = [None, None, 2, 1, 1, 1, 1], [1, 1, *[0] * self._trained]
        return cut(self._trace(self._linearise, arguments, axes, results), late=1, early_outputs=2)

    def _block_arguments(self) -> list[Tensor]:
        """What the pieces of a block are traced on."""
        (t, dt), x0 = self.grid, self.x0
        nodes = x0.expand(self.block, *x0.shape)
        stages = nodes.unsqueeze(1).repeat(1, self._stages, *[1] * x0.ndim)
        bars = [nodes.clone(), torch.ones_like(nodes[..., 0]), torch.ones_like(nodes[..., 0])]
        return [*self.state, t[: self.block], dt[: self.block], stages, *bars, nodes.clone()]

    def _trace(
        self,
        module: nn.Module,
        arguments: list[Tensor],
        axes: list[int | None],
        result_axes: list[int],
        elsewhere: Sequence[Sequence[Tensor]] = (),
    ) -> GraphModule:
        """The trace of a piece; over the members, where there are some, along an axis of arguments and results."""
        with _tracing():
            if self.x0.ndim == 2:
                return trace(stateless(module), arguments, elsewhere)
            of_state = [*[0] * self._trained, *[None] * (len(self.state) - self._trained)]
            return batched(stateless(module), arguments, [*of_state, *axes], result_axes, elsewhere)


@contextmanager
def _tracing() -> Iterator[None]:
    """Turn whatever a loop's own functions raise in a trace into an UntraceableError."""
    try:
        yield
    except LyapnetError:
        raise
    except Exception as error:  # of any kind, from inside the user's own functions
        reason = one_line(error).split(". ")[0].rstrip(".")
        raise UntraceableError(
            f"Expected a closed loop that can be traced, got {type(error).__name__}: {reason}."
        ) from error

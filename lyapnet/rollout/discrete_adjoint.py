"""The exact gradient of a discretised closed loop: Pontryagin's estimator in discrete time.

The closed loop is integrated without a graph. Backwards, block by block of time steps, it is linearised at all states
of the block at once; the costate runs through the block; and one product gives the block's share of the parameters'
gradient (lyapnet.rollout.runge_kutta has the equations). Memory is that of the path and of one block.
"""

import logging
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from lyapnet.errors import LyapnetError, UntraceableError, one_line
from lyapnet.graphs.compilation import Scan
from lyapnet.graphs.stateless import state_of, stateless, trained_of, untrained_of
from lyapnet.graphs.tracing import batched, cut, trace
from lyapnet.horizon import TABLEAUX
from lyapnet.rollout.closed_loop import ClosedLoop
from lyapnet.rollout.routines import BATCH_AXES, Nodes, Routines, TracedRoutines
from lyapnet.rollout.runge_kutta import Linearise, Step
from lyapnet.types import ControlPath, Jacobians, StagePath, State, StatePath, ValuePath

_LOG = logging.getLogger(__name__)
Rolled = tuple[StatePath, ValuePath, ValuePath, ControlPath]  # (x, ∫ℓ, V, u) at the nodes
VISITED = 6  # steps of a rollout at which its trace is held against the loop itself
EVERY = 4  # nodes from one limit of the costates to the next
BLOCK = 512  # states linearised at once: 64 float64 units of each are a quarter of a megabyte, which a cache holds


class DiscreteAdjoint:
    """x₀ ↦ the path of the discretised closed loop, with its exact gradient in x₀ and the loop's parameters.

    The work is traced for one batch shape at its first use (lyapnet.graphs.tracing). Parameters and buffers of the
    system, the cost and V are arguments of what is traced and may change between rollouts; what else f, g and V read is
    frozen. A loop that cannot be traced, since its control flow depends on tensor values or leaves torch, runs eagerly;
    the log says why.

    With an axis of members before the batch, x₀ (E, b, n) and parameters (E, *shape), it is E closed loops at once.

    Args:
        loop: the closed loop.
        steps, dt: N and Δt in s.
        method: a key of TABLEAUX.
        costate_limit: L; backwards, at each EVERY-th node, the costates of a batch longer than L times their median are
            cut to that length. None: no limit, and the exact gradient. It is the exact one too where none is so long.
    """

    loop: ClosedLoop
    steps: int
    dt: float
    stages: int

    def __init__(self, loop: ClosedLoop, steps: int, dt: float, method: str, costate_limit: float | None = None):
        self.loop, self.steps, self.dt, self.stages = loop, steps, dt, len(TABLEAUX[method].b)
        self.costate_limit = costate_limit
        self._step, self._linearise = Step(loop, TABLEAUX[method]), Linearise(loop, TABLEAUX[method])
        self._traced: dict[tuple[Any, ...], TracedRoutines] = {}
        self._routines: dict[tuple[Any, ...], Routines] = {}
        self._compiled: Tensor | None = None  # an x₀ of the batches that run as machine code
        self._compiled_key: tuple[Any, ...] | None = None
        self._told = False  # whether the log has said why the loop runs as it is written

    def __getstate__(self) -> dict[str, Any]:
        """Without the work, which belongs to these very tensors: a copy does its own."""
        return {**vars(self), "_traced": {}, "_routines": {}, "_compiled": None, "_compiled_key": None}

    def __call__(self, x0: State, theta: Sequence[Tensor] | None = None) -> Rolled:
        """(x, ∫ℓ, V, u) at the nodes.

        Args:
            x0: (b, n), or (E, b, n) with members.
            theta: the members' parameters, in the order of `trained`; None for the loop's own.

        Raises:
            ValueError: parameters without an axis of members in x₀.
            UsageError: the loop draws random numbers, which the way back could not repeat.
        """
        if theta is not None and x0.ndim != 3:
            raise ValueError(f"Expected x0 (E, b, n) with the members' parameters, got {tuple(x0.shape)}; stack them.")
        x0 = x0.contiguous()  # as machine code takes it, which does not check
        theta = self.trained() if theta is None else theta
        if torch.is_grad_enabled() and (x0.requires_grad or any(p.requires_grad for p in theta)):
            x, running_cost, value, u = _Rollout.apply(self, x0, *theta)  # pyright: ignore[reportGeneralTypeIssues]
            return x, running_cost, value, u
        return _read(self._integrate_any(x0, theta))

    def trained(self) -> list[Tensor]:
        """The loop's parameters that ask for a gradient."""
        return trained_of(self.loop)

    def compile(self, x0: State, theta: Sequence[Tensor] | None = None) -> None:
        """Have batches like x₀ run as machine code, and others, where no gradient is asked for, in slices of that size.

        Raises:
            UntraceableError: the loop cannot be traced.
            CompilationError: as TracedRoutines.compiled.
        """
        if self._compiled_key != self._key(x0):
            self._routines[self._key(x0)] = self._work(x0, self.trained() if theta is None else theta).compiled()
            self._compiled, self._compiled_key = x0.detach(), self._key(x0)

    def compile_like(self, other: "DiscreteAdjoint") -> None:
        """Have batches run as machine code where another loop has them; of one member, where that has several.

        Raises:
            UntraceableError, CompilationError: as compile.
        """
        if other._compiled is not None:
            self.compile(other._compiled if other._compiled.ndim == 2 else other._compiled[0])

    def require_trace(self, x0: State, theta: Sequence[Tensor]) -> None:
        """Hold that the loop can be traced for batches like x₀.

        Raises:
            UntraceableError: it cannot.
        """
        self._work(x0, theta)

    def routines(self, x0: State, theta: Sequence[Tensor]) -> Routines:
        """The work for batches like x₀: compiled, else traced, else as written."""
        key = self._key(x0)
        if key not in self._routines:
            try:
                self._routines[key] = self._work(x0, theta).routines()
            except UntraceableError as error:
                if x0.ndim > 2:  # members exist in a trace alone
                    raise
                if not self._told:
                    _LOG.warning("%s It runs as it is written, which is slower.", error)
                    self._told = True
                self._routines[key] = self._as_written(x0)
        return self._routines[key]

    def integrate(self, routines: Routines, x0: State, theta: Sequence[Tensor]) -> Nodes:
        """The path from x₀; its last node takes a step of length zero, which makes it a node like the others."""
        with torch.no_grad():
            return Nodes(*routines.integrate(*self._state(theta), *self._grid(x0, self.steps + 1), x0))

    def gradient(
        self, routines: Routines, theta: Sequence[Tensor], stages: StagePath, bars: Sequence[Tensor]
    ) -> tuple[State, list[Tensor]]:
        """(x̄₀, θ̄) from the loss's derivatives by x, ∫ℓ and V at the nodes."""
        x_bar, running_cost_bar, value_bar = bars
        # a step's cost is part of the running cost of every later node
        cost_bar = running_cost_bar.flip(0).cumsum(0).flip(0)[1:]
        K, nodes, state = routines.block, len(stages), self._state(theta)
        length = K * math.ceil(nodes / K)
        t, dt = self._grid(stages, length)
        stages = torch.cat([stages, stages[-1:].expand(length - nodes, *stages.shape[1:])])
        node_bars = (padded(column, length).contiguous() for column in (x_bar, cost_bar, value_bar))
        columns = [t, dt, stages, *node_bars]
        costate, gradient = torch.zeros_like(x_bar[0]), [torch.zeros_like(p) for p in theta]
        for start in reversed(range(0, length, K)):
            block = [column[start : start + K] for column in columns]
            transition, source, *intermediate = routines.linearise(*state, *block)
            costate, after = _run_costate(transition, source, costate, start, self.costate_limit)
            share = routines.product(*state, *block, after, *intermediate)
            gradient = [total + part for total, part in zip(gradient, share, strict=True)]
        return costate, gradient

    def _integrate_any(self, x0: Tensor, theta: Sequence[Tensor]) -> Nodes:
        """The path without a gradient: by compiled routines, in slices if need be; else without a trace."""
        if self._key(x0) in self._routines:
            return self.integrate(self._routines[self._key(x0)], x0, theta)
        if (
            not x0.numel()
            or self._compiled is None
            or self._key(self._compiled) not in self._routines  # other parameters were trained then
            or self._key(self._compiled[..., 0, :]) != self._key(x0[..., 0, :])
        ):
            routines = self._as_written(x0) if x0.ndim == 2 else self.routines(x0, theta)
            return self.integrate(routines, x0, theta)
        size, batch = self._compiled.shape[-2], x0.shape[-2]
        full = torch.cat([x0, x0[..., -1:, :].expand(*x0.shape[:-2], -batch % size, x0.shape[-1])], -2)
        routines = self._routines[self._key(self._compiled)]
        paths = [self.integrate(routines, part.contiguous(), theta) for part in full.split(size, -2)]
        columns = zip(zip(*paths, strict=True), BATCH_AXES, strict=True)
        return Nodes(*(torch.cat(parts, axis).narrow(axis, 0, batch) for parts, axis in columns))

    def _key(self, x0: Tensor) -> tuple[Any, ...]:
        """What the work is done for: a shape, and parameters that are trained."""
        return tuple(x0.shape), x0.dtype, x0.device, tuple(p.requires_grad for p in self.loop.parameters())

    def _state(self, theta: Sequence[Tensor]) -> list[Tensor]:
        """The tensors that the loop is made of, the trained ones first."""
        return state_of(self.loop, theta)

    def _work(self, x0: Tensor, theta: Sequence[Tensor]) -> TracedRoutines:
        """The work for batches like x₀ as graphs, traced once.

        Raises:
            UntraceableError: its control flow depends on tensor values, or it leaves torch.
        """
        key = self._key(x0)
        if key not in self._traced:
            try:
                self._traced[key] = self._trace(x0, theta)
            except LyapnetError:
                raise
            except Exception as error:  # of any kind, from inside the user's own functions
                reason = one_line(error).split(". ")[0].rstrip(".")
                raise UntraceableError(
                    f"Expected a closed loop that can be traced, got {type(error).__name__}: {reason}."
                ) from error
        return self._traced[key]

    def _trace(self, x0: Tensor, theta: Sequence[Tensor]) -> TracedRoutines:
        """The work for batches like x₀ as graphs; raises whatever the loop's own functions raise."""
        x0, state, block = x0.detach().contiguous(), self._state(theta), self._block(x0)
        t, dt = self._grid(x0, block)
        nodes = x0.expand(block, *x0.shape)
        stages = nodes.unsqueeze(1).repeat(1, self.stages, *[1] * x0.ndim)
        bars = [nodes.clone(), torch.ones_like(nodes[..., 0]), torch.ones_like(nodes[..., 0])]
        grid = self._grid(x0, self.steps + 1)
        node_arguments, block_arguments = [*state, t[0], dt[0], x0], [*state, t, dt, stages, *bars, nodes.clone()]
        elsewhere = self._visited(x0, theta)
        step, joint = stateless(self._step), stateless(self._linearise)
        if x0.ndim == 2:
            step, joint = trace(step, node_arguments, elsewhere), trace(joint, block_arguments)
        else:
            axes = [*[0] * len(theta), *[None] * (len(state) - len(theta)), None, None]
            step = batched(step, node_arguments, [*axes, 0], [0, 1, 0, 0, 0], elsewhere)
            joint = batched(joint, block_arguments, [*axes, 2, 1, 1, 1, 1], [1, 1, *[0] * len(theta)])
        prepare, step = cut(step, late=3, early_outputs=0, repeat=False)
        linearise, product = cut(joint, late=1, early_outputs=2)
        return TracedRoutines(prepare, step, linearise, product, block, [*state, *grid, x0], block_arguments)

    def _visited(self, x0: Tensor, theta: Sequence[Tensor]) -> list[list[Tensor]]:
        """(t, Δt, x) of some steps along the loop as it is written; near its start where there are members."""
        t, dt = self._grid(x0, self.steps + 1)
        if x0.ndim > 2:
            return [[t[1], dt[0], 0.9 * x0 + 0.1 * torch.linspace(-1, 1, x0.numel()).to(x0).reshape(x0.shape)]]
        path = self.integrate(self._as_written(x0), x0, theta).stages[:, 0]
        return [[t[k], dt[k], path[k]] for k in torch.linspace(0, self.steps, VISITED).long()]

    def _as_written(self, x0: Tensor) -> Routines:
        """The work in Python, on the loop's own tensors."""
        skipped = len(self._state(self.trained()))

        def step(*arguments: Tensor) -> tuple[Tensor, ...]:
            return self._step(*arguments[skipped:])

        def linearise(*arguments: Tensor) -> tuple[Any, ...]:
            linearisation = self._linearise.linearise(*arguments[skipped:])
            return linearisation.transition, linearisation.source, linearisation

        def product(*arguments: Any) -> tuple[Tensor, ...]:
            *block, linearisation = arguments[skipped:]
            return self._linearise.product(linearisation, *block)

        return Routines(Scan(lambda *_: (), step, skipped).loop, linearise, product, self._block(x0))

    def _block(self, x0: Tensor) -> int:
        """K: blocks of equal length with about BLOCK states in each."""
        nodes, states = self.steps + 1, max(1, x0[..., 0].numel())
        return math.ceil(nodes / math.ceil(nodes * self.stages * states / BLOCK))

    def _grid(self, like: Tensor, nodes: int) -> tuple[Tensor, Tensor]:
        """(t, Δt) of the first nodes; from the last one of the horizon on, t = T and Δt = 0."""
        index = torch.arange(nodes, device=like.device)
        t = index.clamp(max=self.steps).to(like.dtype) * self.dt
        return t, (index < self.steps).to(like.dtype) * self.dt


class _Rollout(torch.autograd.Function):
    """(adjoint, x₀, *θ) ↦ (x, ∫ℓ, V, u), where u is a record without a gradient."""

    @staticmethod
    def forward(ctx: Any, adjoint: DiscreteAdjoint, x0: Tensor, *theta: Tensor) -> tuple[Tensor, ...]:
        routines = adjoint.routines(x0, theta)
        path = adjoint.integrate(routines, x0, theta)
        result = _read(path)
        ctx.adjoint, ctx.routines = adjoint, routines
        ctx.save_for_backward(path.stages, *theta, *untrained_of(adjoint.loop))
        ctx.mark_non_differentiable(result[-1])
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *bars: Tensor) -> tuple[Tensor | None, ...]:
        stages, *state = ctx.saved_tensors  # torch refuses tensors that were changed in between
        theta, facts = state[: len(ctx.needs_input_grad) - 2], state[len(ctx.needs_input_grad) - 2 :]
        now = [tensor.data_ptr() for tensor in untrained_of(ctx.adjoint.loop)]
        if now != [tensor.data_ptr() for tensor in facts]:
            raise RuntimeError(
                "Expected the closed loop as it was rolled out, got another buffer; replace it afterwards."
            )
        x0_bar, theta_bar = ctx.adjoint.gradient(ctx.routines, theta, stages, bars[:3])
        return None, x0_bar, *theta_bar


def _read(nodes: Nodes) -> Rolled:
    """(x, ∫ℓ, V, u) at the nodes."""
    running_cost = torch.cat([torch.zeros_like(nodes.step_cost[:1]), nodes.step_cost[:-1].cumsum(0)])
    return nodes.stages[:, 0], running_cost, nodes.value, nodes.u[:-1]


def _run_costate(
    transition: Jacobians, source: StatePath, costate: State, first: int = 0, limit: float | None = None
) -> tuple[State, StatePath]:
    """λ = Φᵀλ' + source backwards through a block: (λ before its first step, λ' after each of its steps).

    Args:
        first: the index of its first node.
        limit: of the length of λ.
    """
    K, n = len(source), source.shape[-1]
    transition, source = transition.reshape(K, -1, n, n), source.reshape(K, -1, n, 1)
    after, running = torch.empty_like(source), costate.reshape(-1, n, 1)
    for k in reversed(range(K)):
        after[k] = running
        running = torch.baddbmm(source[k], transition[k], running)
        if limit is not None and (first + k) % EVERY == 0:
            running = limited(running.reshape(costate.shape), limit).reshape(running.shape)
    return running.reshape(costate.shape), after.reshape(K, *costate.shape)


def limited(costate: State, limit: float) -> State:
    """Costates (*members, b, n), none longer than `limit` times the median length of its batch.

    The median says how long a costate is where a small change of x is a small change of what follows. Where a closed
    loop is unstable, or a change of x decides whether the goal is reached, λ grows exponentially backwards, and one
    such trajectory outweighs all others in the gradient of their mean, while it says little about where to go.
    """
    length = torch.linalg.vector_norm(costate, dim=-1, keepdim=True)
    longest = limit * length.median(-2, keepdim=True).values
    return costate * (longest / length).clamp_max(1).where(longest > 0, 1)


def padded(column: Tensor, length: int) -> Tensor:
    """The column with zeros after it: steps that no loss depends on."""
    return torch.cat([column, column.new_zeros(length - len(column), *column.shape[1:])])

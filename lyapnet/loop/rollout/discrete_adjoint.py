"""The exact gradient of a discretised closed loop: Pontryagin's estimator in discrete time.

The closed loop is integrated without a graph. Backwards the costate runs from step to step, and each step gives its
share of the parameters' gradient (lyapnet.loop.rollout.runge_kutta has the equations). Memory is that of the path, and
of one step or one block of steps.
"""

import logging
import math
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from lyapnet.base.errors import UntraceableError
from lyapnet.base.types import ControlPath, StagePath, State, StatePath, ValuePath
from lyapnet.graphs.agreement import are_close
from lyapnet.graphs.number_kernel.kernel import in_threads
from lyapnet.graphs.scan import Scan
from lyapnet.graphs.stateless import state_of, trained_of, untrained_of
from lyapnet.loop.rollout.backwards import BlockwiseGradient, PathWithDerivatives, padded
from lyapnet.loop.rollout.closed_loop import ClosedLoop
from lyapnet.loop.rollout.routines import BATCH_AXES, Nodes, Routines, TracedRoutines
from lyapnet.loop.rollout.runge_kutta import Linearise, Step
from lyapnet.task.horizon import TABLEAUX

_LOG = logging.getLogger(__name__)
Rolled = tuple[StatePath, ValuePath, ValuePath, ControlPath]  # (x, ∫ℓ, V, u) at the nodes
VISITED = 6  # steps of a rollout at which its trace, or shared code, is held against the loop itself
BLOCK = 512  # states linearised at once: 64 float64 units of each are a quarter of a megabyte, which a cache holds
ON_GPU = 131_072  # states linearised at once there


class DiscreteAdjoint:
    """x₀ ↦ the path of the discretised closed loop, with its exact gradient in x₀ and the loop's parameters.

    The work is traced for one batch shape at its first use (lyapnet.graphs.tracing). Parameters and buffers of the
    system, the cost and V are arguments of what is traced and may change between rollouts; what else f, g and V read is
    frozen. A loop that cannot be traced, since its control flow depends on tensor values or leaves torch, runs eagerly;
    the log says why.

    Args:
        loop: the closed loop.
        steps, dt: N and Δt in s.
        method: a key of TABLEAUX.
        costate_limit: L; backwards, at every fourth node, the costates of a batch longer than L times their median are
            cut to that length. None: no limit, and the exact gradient. It is the exact one too where none is so long.
    """

    loop: ClosedLoop
    steps: int
    dt: float

    def __init__(self, loop: ClosedLoop, steps: int, dt: float, method: str, costate_limit: float | None = None):
        self.loop, self.steps, self.dt, self._tableau = loop, steps, dt, TABLEAUX[method]
        self.costate_limit = costate_limit
        self._traced: dict[tuple[Any, ...], TracedRoutines] = {}
        self._routines: dict[tuple[Any, ...], Routines] = {}
        self._compiled: Tensor | None = None  # an x₀ of the batches that run as machine code
        self._compiled_key: tuple[Any, ...] | None = None
        self._told = False  # whether the log has said why the loop runs as it is written

    def __getstate__(self) -> dict[str, Any]:
        """Without the work, which belongs to these very tensors: a copy does its own."""
        return {**vars(self), "_traced": {}, "_routines": {}, "_compiled": None, "_compiled_key": None}

    def __call__(self, x0: State) -> Rolled:
        """(x, ∫ℓ, V, u) at the nodes, from x₀ (b, n).

        Raises:
            UsageError: the loop draws random numbers, which the way back could not repeat.
        """
        x0, theta = x0.contiguous(), self.trained()  # contiguous as machine code takes it, which does not check
        if torch.is_grad_enabled() and (x0.requires_grad or any(p.requires_grad for p in theta)):
            x, running_cost, value, u = _Rollout.apply(self, x0, *theta)  # pyright: ignore[reportGeneralTypeIssues]
            return x, running_cost, value, u
        return _read(self._integrate_any(x0, theta))

    def trained(self) -> list[Tensor]:
        """The loop's parameters that ask for a gradient."""
        return trained_of(self.loop)

    def compile(self, x0: State) -> None:
        """Have batches like x₀ run as machine code, and others, where no gradient is asked for, in slices of that size.

        Raises:
            UntraceableError: the loop cannot be traced.
            CompilationError: as TracedRoutines.compiled.
        """
        if self._compiled_key != self._key(x0):
            self._take_compiled(self._work(x0).compiled(), x0)

    @property
    def compiled_batch(self) -> int:
        """How many states the batches have that run as machine code; 0 where there is none."""
        return 0 if self._compiled is None else len(self._compiled)

    def compile_like(self, other: "DiscreteAdjoint") -> None:
        """Have batches run as machine code where another loop has them.

        Raises:
            UntraceableError, CompilationError: as compile.
        """
        if other._compiled is not None:
            self.compile(other._compiled)

    def share_code(self, other: "DiscreteAdjoint", x0: State) -> bool:
        """Run by the machine code of a loop that differs in tensors alone, if it has some and agrees along its paths.

        What a trace has frozen, a number or a tensor that no buffer holds, may be another one here. So the code is held
        against this loop as it is written: at some steps of its paths from x₀ and, where something is trained, by their
        gradient. A loop of which nothing is trained takes the code of one of which everything is, as its tensors are in
        the same order.

        Args:
            x0: (b, n) where closed loops begin, as many as the other has code for.
        """
        routines = None if other._compiled is None else other._routines.get(other._key(other._compiled))
        flags, of_other = ([p.requires_grad for p in each.loop.parameters()] for each in (self, other))
        if (
            routines is None
            or self._compiled_for(x0) != other._compiled_for(x0)
            or (flags != of_other and (any(flags) or not all(of_other)))
        ):
            return False
        agrees = False
        with suppress(RuntimeError, ValueError):  # tensors of other shapes
            agrees = self._agrees(routines, x0)
        if agrees:
            self._take_compiled(routines, x0)
        return agrees

    def _compiled_for(self, x0: State) -> tuple[Any, ...]:
        """What is frozen in a trace for sure, besides the code of f, g, the cost and V."""
        system, cost = self.loop.system, self.loop.cost
        return self._key(x0)[:3], self.steps, self.dt, self._tableau, self.costate_limit, type(system), type(cost)

    def _agrees(self, routines: Routines, x0: State) -> bool:
        """Whether paths from x₀ have steps of this loop, and the gradient of the sum of their x, ∫ℓ and V."""
        theta, step = self.trained(), Step(self.loop, self._tableau)
        nodes, (t, dt) = self.integrate(routines, x0, theta), self._grid(x0, self.steps + 1)
        found, expected = list[Tensor](), list[Tensor]()
        with torch.no_grad():
            for k in self._some_steps():
                following, *kept = step(t[k], dt[k], nodes.stages[k, 0])
                found += [column[k] for column in nodes]
                expected += kept
                if k < self.steps:
                    found.append(nodes.stages[k + 1, 0])
                    expected.append(following)
        if theta:
            ones = [torch.ones_like(each) for each in (nodes.stages[:, 0], nodes.step_cost, nodes.value)]
            for routes, results in ((routines, found), (self._as_written(x0), expected)):
                x0_bar, theta_bar = self.gradient(routes, theta, nodes.stages, ones)
                results += [x0_bar, *theta_bar]
        return all(are_close(mine, theirs) for mine, theirs in zip(found, expected, strict=True))

    def _some_steps(self) -> list[int]:
        """VISITED steps, from the first one to the last node."""
        return torch.linspace(0, self.steps, VISITED).long().tolist()

    def _take_compiled(self, routines: Routines, x0: State) -> None:
        self._routines[self._key(x0)] = routines
        self._compiled, self._compiled_key = x0.detach(), self._key(x0)

    def routines(self, x0: State) -> Routines:
        """The work for batches like x₀: compiled, else traced, else as written."""
        key = self._key(x0)
        if key not in self._routines:
            try:
                self._routines[key] = self._work(x0).traced()
            except UntraceableError as error:
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
        cost_bar = padded(running_cost_bar.flip(0).cumsum(0).flip(0)[1:], len(stages))
        path = PathWithDerivatives(*self._grid(stages, len(stages)), stages, x_bar, cost_bar, value_bar)
        costate, share = routines.gradient(self._state(theta), path)
        return costate, share[: len(theta)]  # shared code may have the gradient of more than is trained here

    def _integrate_any(self, x0: Tensor, theta: Sequence[Tensor]) -> Nodes:
        """The path without a gradient: by compiled routines, in slices if need be; else without a trace."""
        if self._key(x0) in self._routines:
            return self.integrate(self._routines[self._key(x0)], x0, theta)
        if (
            not x0.numel()
            or self._compiled is None
            or self._key(self._compiled) not in self._routines  # other parameters were trained then
            or self._key(self._compiled[0]) != self._key(x0[0])
        ):
            return self.integrate(self._as_written(x0), x0, theta)
        size, batch = len(self._compiled), len(x0)
        full = torch.cat([x0, x0[-1:].expand(-batch % size, -1)])
        routines = self._routines[self._key(self._compiled)]
        parts = [part.contiguous() for part in full.split(size)]
        on_threads = in_threads if x0.device.type == "cpu" else map
        paths = list(on_threads(lambda part: self.integrate(routines, part, theta), parts))
        columns = zip(zip(*paths, strict=True), BATCH_AXES, strict=True)
        return Nodes(*(torch.cat(parts, axis).narrow(axis, 0, batch) for parts, axis in columns))

    def _key(self, x0: Tensor) -> tuple[Any, ...]:
        """What the work is done for: a shape, and parameters that are trained."""
        return tuple(x0.shape), x0.dtype, x0.device, tuple(p.requires_grad for p in self.loop.parameters())

    def _state(self, theta: Sequence[Tensor]) -> list[Tensor]:
        """The tensors that the loop is made of, the trained ones first."""
        return state_of(self.loop, theta)

    def _work(self, x0: Tensor) -> TracedRoutines:
        """The work for batches like x₀ as graphs, each traced once."""
        key = self._key(x0)
        if key not in self._traced:
            state, grid, x0 = self._state(self.trained()), self._grid(x0, self.steps + 1), x0.detach().contiguous()
            visited = partial(self._visited, x0)
            self._traced[key] = TracedRoutines(
                self.loop, self._tableau, state, grid, x0, self._block(x0), self.costate_limit, visited
            )
        return self._traced[key]

    def _visited(self, x0: Tensor) -> list[list[Tensor]]:
        """(t, Δt, x) of some steps along the loop as it is written."""
        t, dt = self._grid(x0, self.steps + 1)
        path = self.integrate(self._as_written(x0), x0, self.trained()).stages[:, 0]
        return [[t[k], dt[k], path[k]] for k in self._some_steps()]

    def _as_written(self, x0: Tensor) -> Routines:
        """The work in Python, on the loop's own tensors."""
        skipped, own_step = len(self._state(self.trained())), Step(self.loop, self._tableau)
        own_linearise = Linearise(self.loop, self._tableau)

        def step(*arguments: Tensor) -> tuple[Tensor, ...]:
            return own_step(*arguments[skipped:])

        def linearise(*arguments: Tensor) -> tuple[Any, ...]:
            linearisation = own_linearise.linearise(*arguments[skipped:])
            return linearisation.transition, linearisation.source, linearisation

        def product(*arguments: Any) -> tuple[Tensor, ...]:
            *block, linearisation = arguments[skipped:]
            return own_linearise.product(linearisation, *block)

        gradient = BlockwiseGradient(linearise, product, self._block(x0), self.costate_limit)
        return Routines(Scan(lambda *_: (), step, skipped).loop, gradient)

    def _block(self, x0: Tensor) -> int:
        """K: blocks of equal length with about BLOCK states in each."""
        nodes, states = self.steps + 1, max(1, len(x0))
        most = BLOCK if x0.device.type == "cpu" else ON_GPU
        return math.ceil(nodes / math.ceil(nodes * len(self._tableau.b) * states / most))

    def _grid(self, like: Tensor, nodes: int) -> tuple[Tensor, Tensor]:
        """(t, Δt) of the first nodes; from the last one of the horizon on, t = T and Δt = 0."""
        index = torch.arange(nodes, device=like.device)
        t = index.clamp(max=self.steps).to(like.dtype) * self.dt
        return t, (index < self.steps).to(like.dtype) * self.dt


class _Rollout(torch.autograd.Function):
    """(adjoint, x₀, *θ) ↦ (x, ∫ℓ, V, u), where u is a record without a gradient."""

    @staticmethod
    def forward(ctx: Any, adjoint: DiscreteAdjoint, x0: Tensor, *theta: Tensor) -> tuple[Tensor, ...]:
        routines = adjoint.routines(x0)
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

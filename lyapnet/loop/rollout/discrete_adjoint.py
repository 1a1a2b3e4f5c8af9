"""The exact gradient of a discretised closed loop by the discrete costate equation (Pontryagin).

The closed loop is integrated without a graph. The backward pass computes the costate step by step, and each step's
contribution to the parameters' gradient; the equations are in lyapnet.loop.rollout.runge_kutta. It needs memory for the
path and for one step or one block of steps.
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
from lyapnet.base.threads import in_threads, size_of_parts
from lyapnet.base.types import ControlPath, StagePath, State, StatePath, ValuePath
from lyapnet.graphs.agreement import are_close
from lyapnet.graphs.scan import Scan
from lyapnet.graphs.stateless import state_of, trained_of, untrained_of
from lyapnet.loop.rollout.backwards import BlockwiseGradient, PathWithDerivatives, padded
from lyapnet.loop.rollout.closed_loop import ClosedLoop
from lyapnet.loop.rollout.routines import BATCH_AXES, Nodes, Routines, TracedRoutines, in_parts
from lyapnet.loop.rollout.runge_kutta import Linearise, Step
from lyapnet.task.horizon import TABLEAUX
from lyapnet.task.noise import Increments

_LOG = logging.getLogger(__name__)
RolledPath = tuple[StatePath, ValuePath, ValuePath, ControlPath]  # (x, ∫ℓ, V, u) at the nodes
CHECKED_STEPS = 6  # steps of a rollout at which a trace or shared code is compared with the loop itself
STATES_PER_PART = 16  # closed loops of a batch on one thread, at least: with 8 the kernel needs a third more work
STATES_PER_BLOCK = 512  # states linearised at once: 64 hidden units each in float64 are 256 kB, which fit into a cache
STATES_PER_BLOCK_ON_GPU = 131_072  # the same on a GPU


class DiscreteAdjoint:
    """x₀ ↦ the path of the discretised closed loop, with its exact gradient in x₀ and the loop's parameters.

    The computations are traced for each batch shape at its first use (lyapnet.graphs.tracing). Parameters and buffers
    of the system, the cost and V are arguments of the trace and may change between rollouts; all other numbers that f,
    g and V use are frozen. A loop that cannot be traced, because its control flow depends on tensor values or leaves
    torch, runs eagerly; the log says why.

    Args:
        loop: the closed loop.
        steps, dt: N and Δt in s.
        method: a key of TABLEAUX.
        costate_limit: L; at every fourth node, costates of a batch that are longer than L times their median are
            shortened to that length. None: no limit. The gradient is exact if no costate is shortened.
    """

    loop: ClosedLoop
    steps: int
    dt: float

    def __init__(self, loop: ClosedLoop, steps: int, dt: float, method: str, costate_limit: float | None = None):
        self.loop, self.steps, self.dt, self._tableau = loop, steps, dt, TABLEAUX[method]
        self.costate_limit = costate_limit
        self._traced: dict[tuple[Any, ...], TracedRoutines] = {}
        self._routines: dict[tuple[Any, ...], Routines] = {}
        self._compiled: Tensor | None = None  # an x₀ with the shape of the compiled batches
        self._compiled_key: tuple[Any, ...] | None = None
        self._has_warned = False  # whether it was logged why the loop runs eagerly

    def __getstate__(self) -> dict[str, Any]:
        """Without traces and code, which belong to these very tensors; a copy makes its own."""
        return {**vars(self), "_traced": {}, "_routines": {}, "_compiled": None, "_compiled_key": None}

    def __call__(self, x0: State, increments: Increments | None = None) -> RolledPath:
        """(x, ∫ℓ, V, u) at the nodes, from x₀ (b, n).

        Args:
            increments: ΔW of each step (N, b, k), data for the gradient; None: the loop without its noise.

        Raises:
            UsageError: the loop draws random numbers, which the backward pass could not repeat.
        """
        x0, theta = x0.contiguous(), self.trained()  # compiled code assumes contiguous tensors without a check
        noise = self._noise(x0, increments)
        if torch.is_grad_enabled() and (x0.requires_grad or any(p.requires_grad for p in theta)):
            x, running_cost, value, u = _Rollout.apply(self, noise, x0, *theta)  # pyright: ignore[reportGeneralTypeIssues]
            return x, running_cost, value, u
        return _path_of(self._integrate_without_gradient(x0, theta, noise))

    def trained(self) -> list[Tensor]:
        """The loop's parameters that require a gradient."""
        return trained_of(self.loop)

    def compile(self, x0: State) -> None:
        """Compile for batches like x₀; other batches then also use this code in slices, if they need no gradient.

        Raises:
            UntraceableError: the loop cannot be traced.
            CompilationError: as TracedRoutines.compiled.
        """
        if self._compiled_key != self._key(x0):
            size = len(x0)
            # a limit of the costates is relative to their median in the batch; increments are not divided
            if x0.device.type == "cpu" and self.costate_limit is None and self.loop.noise is None:
                size = size_of_parts(size, STATES_PER_PART)
            compiled = self._work(x0[:size]).compiled()
            self._set_compiled(compiled if size == len(x0) else in_parts(compiled, size), x0)

    @property
    def compiled_batch(self) -> int:
        """The size of compiled batches; 0 if nothing is compiled."""
        return 0 if self._compiled is None else len(self._compiled)

    def compile_like(self, other: "DiscreteAdjoint") -> None:
        """Compile for the same batches as another loop.

        Raises:
            UntraceableError, CompilationError: as compile.
        """
        if other._compiled is not None:
            self.compile(other._compiled)

    def share_code(self, other: "DiscreteAdjoint", x0: State) -> bool:
        """Use the compiled code of another loop that differs only in its tensors; return whether that is possible.

        The trace may have frozen numbers, or tensors outside of buffers, that differ in this loop. Therefore the code
        is compared with this loop run eagerly, at some steps of its paths from x₀ and by their gradient if anything is
        trained. A loop without trained parameters may use the code of one where all are trained, because its tensors
        have the same order.

        Args:
            x0: initial states (b, n), with the size of the other's compiled batches.
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
            self._set_compiled(routines, x0)
        return agrees

    def _compiled_for(self, x0: State) -> tuple[Any, ...]:
        """The facts that are certainly frozen in a trace, besides the code of f, g, the cost and V."""
        system, cost = self.loop.system, self.loop.cost
        return self._key(x0)[:3], self.steps, self.dt, self._tableau, self.costate_limit, type(system), type(cost)

    def _agrees(self, routines: Routines, x0: State) -> bool:
        """Whether routines give this loop's steps from x₀, and the gradient of the sum of x, ∫ℓ and V."""
        theta, step = self.trained(), Step(self.loop, self._tableau)
        noise = self._drawn_noise(x0)
        nodes, columns = self.integrate(routines, x0, theta, noise), [*self._grid(x0, self.steps + 1), *noise]
        found, expected = list[Tensor](), list[Tensor]()
        with torch.no_grad():
            for k in self._steps_to_check():
                following, *kept = step(*(column[k] for column in columns), nodes.stages[k, 0])
                found += [column[k] for column in nodes]
                expected += kept
                if k < self.steps:
                    found.append(nodes.stages[k + 1, 0])
                    expected.append(following)
        if theta:
            ones = [torch.ones_like(each) for each in (nodes.stages[:, 0], nodes.step_cost, nodes.value)]
            for routes, results in ((routines, found), (self._eager_routines(x0), expected)):
                x0_bar, theta_bar = self.gradient(routes, theta, nodes.stages, ones, noise)
                results += [x0_bar, *theta_bar]
        return all(are_close(mine, theirs) for mine, theirs in zip(found, expected, strict=True))

    def _steps_to_check(self) -> list[int]:
        """The indices of CHECKED_STEPS steps, from the first step to the last node."""
        return torch.linspace(0, self.steps, CHECKED_STEPS).long().tolist()

    def _set_compiled(self, routines: Routines, x0: State) -> None:
        self._routines[self._key(x0)] = routines
        self._compiled, self._compiled_key = x0.detach(), self._key(x0)

    def routines(self, x0: State) -> Routines:
        """The routines for batches like x₀: compiled, else traced, else eager."""
        key = self._key(x0)
        if key not in self._routines:
            try:
                self._routines[key] = self._work(x0).traced()
            except UntraceableError as error:
                if not self._has_warned:
                    _LOG.warning("%s It runs without being traced, which is slower.", error)
                    self._has_warned = True
                self._routines[key] = self._eager_routines(x0)
        return self._routines[key]

    def integrate(self, routines: Routines, x0: State, theta: Sequence[Tensor], noise: Sequence[Tensor] = ()) -> Nodes:
        """The path from x₀; a step of length zero at its last node makes all nodes alike.

        Args:
            noise: ΔW at the nodes (N + 1, b, k), if there is noise.
        """
        with torch.no_grad():
            return Nodes(*routines.integrate(*self._state(theta), *self._grid(x0, self.steps + 1), *noise, x0))

    def gradient(
        self,
        routines: Routines,
        theta: Sequence[Tensor],
        stages: StagePath,
        bars: Sequence[Tensor],
        noise: Sequence[Tensor] = (),
    ) -> tuple[State, list[Tensor]]:
        """(x̄₀, θ̄) from the loss's derivatives by x, ∫ℓ and V at the nodes, and ΔW there if there is noise."""
        x_bar, running_cost_bar, value_bar = bars
        # a step's cost is part of the running cost of every later node
        cost_bar = padded(running_cost_bar.flip(0).cumsum(0).flip(0)[1:], len(stages))
        path = PathWithDerivatives(*self._grid(stages, len(stages)), stages, x_bar, cost_bar, value_bar, *noise)
        costate, share = routines.gradient(self._state(theta), path)
        return costate, share[: len(theta)]  # shared code may have gradients of parameters that are not trained here

    def _noise(self, x0: State, increments: Increments | None) -> list[Tensor]:
        """ΔW at the nodes (N + 1, b, k), zero at the last one; empty for a loop without noise.

        Raises:
            ValueError: increments for a loop without noise, or of another shape.
        """
        noise, given = self.loop.noise, None if increments is None else tuple(increments.shape)
        expected = None if noise is None else (self.steps, len(x0), noise.sources)
        if given is not None and given != expected:
            raise ValueError(f"Expected increments of shape {expected or 'None'}, got {given}; see Noise.draw.")
        if noise is None:
            return []
        shape = (self.steps + 1, len(x0), noise.sources)
        return [x0.new_zeros(shape) if increments is None else padded(increments.to(x0), self.steps + 1)]

    def _drawn_noise(self, x0: State) -> list[Tensor]:
        """ΔW of fixed random draws, for comparisons."""
        noise = self.loop.noise
        if noise is None:
            return []
        return self._noise(x0, noise.draw(self.steps, self.dt, x0, torch.Generator().manual_seed(0)))

    def _integrate_without_gradient(self, x0: Tensor, theta: Sequence[Tensor], noise: Sequence[Tensor]) -> Nodes:
        """The path without a gradient: by compiled routines, if necessary in slices; else eagerly."""
        if self._key(x0) in self._routines:
            return self.integrate(self._routines[self._key(x0)], x0, theta, noise)
        if (
            not x0.numel()
            or self._compiled is None
            or self._key(self._compiled) not in self._routines  # it was compiled for other trained parameters
            or self._key(self._compiled[0]) != self._key(x0[0])
        ):
            return self.integrate(self._eager_routines(x0), x0, theta, noise)
        size, batch = len(self._compiled), len(x0)
        full = torch.cat([x0, x0[-1:].expand(-batch % size, -1)])
        drawn = [torch.cat([w, w[:, -1:].expand(-1, -batch % size, -1)], 1) for w in noise]
        routines = self._routines[self._key(self._compiled)]
        parts = [
            (full[k : k + size].contiguous(), [w[:, k : k + size].contiguous() for w in drawn])
            for k in range(0, len(full), size)
        ]
        on_threads = in_threads if x0.device.type == "cpu" else map
        paths = list(on_threads(lambda part: self.integrate(routines, part[0], theta, part[1]), parts))
        columns = zip(zip(*paths, strict=True), BATCH_AXES, strict=True)
        return Nodes(*(torch.cat(parts, axis).narrow(axis, 0, batch) for parts, axis in columns))

    def _key(self, x0: Tensor) -> tuple[Any, ...]:
        """The key of routines: shape, dtype, device, and which parameters are trained."""
        return tuple(x0.shape), x0.dtype, x0.device, tuple(p.requires_grad for p in self.loop.parameters())

    def _state(self, theta: Sequence[Tensor]) -> list[Tensor]:
        """The tensors of the loop, the trained ones first."""
        return state_of(self.loop, theta)

    def _work(self, x0: Tensor) -> TracedRoutines:
        """The traced routines for batches like x₀."""
        key = self._key(x0)
        if key not in self._traced:
            x0 = x0.detach().contiguous()
            state, grid = self._state(self.trained()), [*self._grid(x0, self.steps + 1), *self._drawn_noise(x0)]
            visited = partial(self._visited, x0)
            self._traced[key] = TracedRoutines(
                self.loop, self._tableau, state, grid, x0, self._block(x0), self.costate_limit, visited
            )
        return self._traced[key]

    def _visited(self, x0: Tensor) -> list[list[Tensor]]:
        """(t, Δt, x) of some steps of the loop run eagerly, with noise ΔW before x."""
        noise = self._drawn_noise(x0)
        columns = [*self._grid(x0, self.steps + 1), *noise]
        path = self.integrate(self._eager_routines(x0), x0, self.trained(), noise).stages[:, 0]
        return [[*(column[k] for column in columns), path[k]] for k in self._steps_to_check()]

    def _eager_routines(self, x0: Tensor) -> Routines:
        """The routines in Python, on the loop's own tensors."""
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
        """K for blocks of equal length with about STATES_PER_BLOCK states in each."""
        nodes, states = self.steps + 1, max(1, len(x0))
        most = STATES_PER_BLOCK if x0.device.type == "cpu" else STATES_PER_BLOCK_ON_GPU
        return math.ceil(nodes / math.ceil(nodes * len(self._tableau.b) * states / most))

    def _grid(self, like: Tensor, nodes: int) -> tuple[Tensor, Tensor]:
        """(t, Δt) of the first nodes; t = T and Δt = 0 from the last node of the horizon on."""
        index = torch.arange(nodes, device=like.device)
        t = index.clamp(max=self.steps).to(like.dtype) * self.dt
        return t, (index < self.steps).to(like.dtype) * self.dt


class _Rollout(torch.autograd.Function):
    """(adjoint, ΔW, x₀, *θ) ↦ (x, ∫ℓ, V, u), where ΔW and u have no gradient."""

    @staticmethod
    def forward(
        ctx: Any, adjoint: DiscreteAdjoint, noise: Sequence[Tensor], x0: Tensor, *theta: Tensor
    ) -> tuple[Tensor, ...]:
        routines = adjoint.routines(x0)
        path = adjoint.integrate(routines, x0, theta, noise)
        result = _path_of(path)
        ctx.adjoint, ctx.routines, ctx.noise = adjoint, routines, noise
        ctx.save_for_backward(path.stages, *theta, *untrained_of(adjoint.loop))
        ctx.mark_non_differentiable(result[-1])
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *bars: Tensor) -> tuple[Tensor | None, ...]:
        stages, *state = ctx.saved_tensors  # torch raises an error if they were changed in between
        theta, facts = state[: len(ctx.needs_input_grad) - 3], state[len(ctx.needs_input_grad) - 3 :]
        now = [tensor.data_ptr() for tensor in untrained_of(ctx.adjoint.loop)]
        if now != [tensor.data_ptr() for tensor in facts]:
            raise RuntimeError(
                "Expected the closed loop as it was rolled out, got another buffer; replace it afterwards."
            )
        x0_bar, theta_bar = ctx.adjoint.gradient(ctx.routines, theta, stages, bars[:3], ctx.noise)
        return None, None, x0_bar, *theta_bar


def _path_of(nodes: Nodes) -> RolledPath:
    """(x, ∫ℓ, V, u) at the nodes."""
    running_cost = torch.cat([torch.zeros_like(nodes.step_cost[:1]), nodes.step_cost[:-1].cumsum(0)])
    return nodes.stages[:, 0], running_cost, nodes.value, nodes.u[:-1]

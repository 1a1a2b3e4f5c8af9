"""State constraints: the level of V below which no closed loop violates one, and a search for closed loops that do."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from lyapnet.base.errors import DivergenceError, UsageError
from lyapnet.base.types import Corner, Corners, PerState, State, Time
from lyapnet.loop.rollout import Rollout
from lyapnet.loop.rollout.closed_loop import ClosedLoop
from lyapnet.prover.branch_and_bound import Budget, minimum
from lyapnet.prover.branches import CHOICES, JUMPS, KINKS
from lyapnet.prover.condition import DecreaseCondition, own_constraints
from lyapnet.task.constraints import Constraints, names_of
from lyapnet.task.problem import Problem
from lyapnet.value.calculus import gradients

SHELL = 1e-2  # the surface {h = 0} is replaced by {0 ≤ h ≤ SHELL}, which boxes can cover
SIMULATED_LOOPS, SUBSTEPS = 1000, 4  # number of simulated closed loops, and of their steps in each Δt
LEAST_VIOLATION = 1e-6  # h above which a simulated closed loop violates a constraint; smaller ones may be its errors


class Violation(NamedTuple):
    """A state of X₀ whose closed loop, simulated by Runge-Kutta steps, violates a constraint."""

    x0: list[float]
    t: float
    constraint: str
    h: float


def crossing_level(condition: DecreaseCondition, domain: tuple[Corner, Corner], budget: Budget, enough: float) -> float:
    """A lower bound of W on {(t, x): h_j(x) = 0 and ∇h_jᵀ(f + gu) ≥ 0 for some j}; ∞ if this set is empty.

    A closed loop that starts with h ≤ 0 and whose W stays below this bound keeps h ≤ 0. Otherwise some h_j would become
    positive, and at the last time with h_j = 0 before that, the loop would be in this set.

    Args:
        enough: the search stops when the bound is at least this level.

    Raises:
        UsageError: h has kinks or jumps, where it has no gradient.

    Source: Blanchini, "Set invariance in control", Automatica 1999 (Nagumo's theorem).
    """
    if condition.constraints is None:
        return float("inf")
    constraints = own_constraints(condition.constraints, domain)
    if unsmooth := constraints.operators & {*KINKS, *JUMPS, *CHOICES}:
        raise UsageError(
            f"Expected smooth constraints, got {' and '.join(sorted(map(str, unsmooth)))}; write a maximum as several "
            "components."
        )
    loop, (lower, upper) = condition.closed_loop, (side[None] for side in domain)

    def crossing(j: int, t: Time, x: State) -> PerState:
        """A function that is ≤ 0 where 0 ≤ h_j ≤ SHELL and ḣ_j ≥ 0."""

        def h(t: Time, x: State) -> Tensor:
            return constraints(x)[..., j]

        rate = (gradients(h, t, x)[1] * loop.system.dynamics(x, loop.policy(t, x))).sum(-1)
        outside = (h(t, x) - SHELL / 2).abs() - (1 + 1e-6) * SHELL / 2
        return torch.maximum(outside, -rate)

    return _least(condition, (lower, upper), crossing, budget, enough)


def initial_violation_level(
    condition: DecreaseCondition, states: tuple[Corners, Corners], budget: Budget, enough: float
) -> float:
    """A lower bound of W(0, ·) on {x ∈ X₀: some h_j ≥ LEAST_VIOLATION}; ∞ if this set is proved to be empty.

    Samples of X₀ could miss a violation.
    """
    if condition.constraints is None:
        return float("inf")
    h: Constraints = condition.constraints
    return _least(condition, states, lambda j, t, x: LEAST_VIOLATION - h(x)[..., j], budget, enough)


def _least(
    condition: DecreaseCondition,
    boxes: tuple[Corners, Corners],
    where: Callable[[int, Time, State], PerState],
    budget: Budget,
    enough: float,
) -> float:
    """A lower bound of W on the points of boxes with where(j, t, x) ≤ 0 for some constraint j."""
    components = range(len(names_of(condition.constraints)))
    return min(minimum(condition.height, *boxes, budget, partial(where, j), 0.0, enough) for j in components)


def find_violation(closed_loop: ClosedLoop, problem: Problem, generator: torch.Generator | None) -> Violation | None:
    """The worst violation of a constraint among simulated closed loops from corners and samples of X₀, or None."""
    constraints, horizon = problem.constraints, problem.horizon
    if constraints is None:
        return None
    x0 = torch.cat([problem.initial_states.corners(), problem.initial_states.sample(SIMULATED_LOOPS, generator)])
    finer = problem.in_steps(steps=SUBSTEPS * horizon.steps, dt=horizon.dt / SUBSTEPS)
    try:
        with torch.no_grad():
            trajectory = Rollout(finer, closed_loop.policy, "rk4", "backprop", held=False)(x0)
    except DivergenceError:
        return None
    h = constraints(trajectory.x)
    node, i, j = (int(k) for k in torch.unravel_index(h.argmax(), h.shape))
    if float(h[node, i, j]) <= LEAST_VIOLATION:
        return None
    return Violation(x0[i].tolist(), float(trajectory.t[node]), constraints.names[j], float(h[node, i, j]))

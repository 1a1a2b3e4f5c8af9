"""The conditions of claims in discrete time, on V and the steps of the model, which a proof bounds on boxes."""

from collections.abc import Sequence
from functools import reduce
from typing import Any

import torch
from torch import Tensor

from lyapnet.base.errors import UsageError
from lyapnet.base.types import Control, Corner, Corners, PerState, Points, State, Time
from lyapnet.claims.preconditions import over_time
from lyapnet.claims.receding_decrease import RecedingDecrease
from lyapnet.loop.rollout.closed_loop import ClosedLoop
from lyapnet.prover.branch_and_bound import just_below
from lyapnet.prover.condition import DecreaseCondition
from lyapnet.task.constraints import Constraints
from lyapnet.task.horizon import Horizon
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box

TIME_ROUNDING = 1e-9  # largest rounding error of the time of the last step, relative to Δt
# F(x) must lie inside D by these distances, relative to D's half widths and to its ends, which are larger than the
# rounding errors of D's middles and half widths
WITHIN, ROUNDING = 1e-12, 2**-50


class Stepped(DecreaseCondition):
    """A condition on the steps x⁺ = F(x, u) of a problem, which also requires F(x, u) ∈ D.

    Its parts are (c, W, a number that is ≤ 0 if F(x, u) ∈ D; see `outside`).
    """

    problem: Problem
    sides: Sequence[tuple[int, float, float]]  # (axis, middle, half width rounded downwards) of D along bounded axes

    @property
    def facts(self) -> dict[str, Any]:
        return {**super().facts, "steps": steps_of(self.problem.horizon)}

    def keep_within(self, states: Box, axes: Sequence[int]) -> None:
        """Require F(x, u) ∈ D along some axes: all but constants and those without bounds."""
        self.sides = []
        for i in sorted(axes):
            low, high = float(states.lower[i]), float(states.upper[i])
            half = (high - low) / 2
            self.sides.append((i, (low + high) / 2, half - WITHIN * half - ROUNDING * max(abs(low), abs(high))))

    def after(self, x: State, u: Control) -> State:
        """F(x, u)."""
        return x + self.problem.horizon.dt * self.problem.smooth_rates(x, u)[0]

    def outside(self, after: State) -> PerState:
        """The largest distance of a state from D along an axis, relative to D's half width; at most 0 in D."""
        beyond = [(after[..., i] - middle).abs() / half - 1 for i, middle, half in self.sides]
        return reduce(torch.maximum, beyond) if beyond else torch.full_like(after[..., 0], -1.0)

    def values(self, points: Points) -> tuple[PerState, PerState]:
        """(max(c, outside(F)), W) at points (t, x), with −∞ for the first at states that a constraint excludes."""
        t, x = points[:, 0], points[:, 1:]
        c, value, outside = self.parts(t, x)
        return torch.where(self.excluded(x), -torch.inf, torch.maximum(c, outside)), value


class SteppedPayment(Stepped):
    """c = (V(t + Δt, F(x, u)) − V(t, x))/Δt + α max(ℓ̄, 0) − δ with u = policy(t, x) and ℓ̄ the mean of ℓ over the step.

    Where c ≤ 0, W = V − δt falls by at least α times the cost of the step, for 0 ≤ t ≤ T − Δt.

    Args:
        problem: F is one step of its horizon's method, with u held.
    """

    def __init__(self, closed_loop: ClosedLoop, alpha: float, delta: float, problem: Problem):
        super().__init__(closed_loop, alpha, delta)
        self.problem, self.sides = problem, []

    def domain_of(self, states: Box, left_out: Sequence[int]) -> tuple[Corner, Corner]:
        """[0, T − Δt] × D, a little longer because T is rounded.

        From now on, F(x, u) ∈ D is required along all axes but those of states left out and of constants.
        """
        seen = [i for i in range(states.dimension) if i not in (*left_out, *self.closed_loop.system.constants)]
        self.keep_within(states, seen)
        horizon = self.problem.horizon
        return over_time(states, horizon.duration - horizon.dt * (1 - TIME_ROUNDING))

    def parts(self, t: Time, x: State) -> tuple[PerState, PerState, PerState]:
        return self.parts_under(t, x, self.closed_loop.policy(t, x))

    def parts_under(self, t: Time, x: State, u: Control) -> tuple[PerState, PerState, PerState]:
        dt = self.problem.horizon.dt
        rate, cost = self.problem.rates(x, u)
        after = x + dt * rate
        fall = (self.V(t + dt, after) - self.V(t, x)) / dt
        return fall + self.alpha * torch.clamp(cost, min=0) - self.delta, self.height(t, x), self.outside(after)


class SteppedDecrease(Stepped, RecedingDecrease):
    """(V(F(x)) − V(x))/Δt + λV(x) ≤ 0 and F(x) ∈ D with V = V(0, ·), u = u(0, x), except for steps into a hole.

    So V falls at least by the factor 1 − λΔt in each step, until a step leads into the hole {V < (1 − λΔt)c}.

    Args:
        problem: F is one step of its horizon's method, with u(0, x) held.
        parameters, practical: as in RecedingDecrease.
    """

    def __init__(
        self,
        closed_loop: ClosedLoop,
        decay: float,
        problem: Problem,
        parameters: Sequence[str] = (),
        practical: bool = False,
    ):
        RecedingDecrease.__init__(self, closed_loop, decay, parameters=parameters, practical=practical)
        dt = problem.horizon.dt
        if not decay * dt < 1:
            raise UsageError(f"Expected decay < 1/Δt = {1 / dt:g}, got {decay}; V cannot fall by more than itself.")
        self.problem, self.sides = problem, []

    def _around_hole(self, inner: Box, states: Box, seen: Sequence[int]) -> tuple[Corners, Corners]:
        """Boxes that cover D without B; V > c on the boundary of B is not enough, since a step may jump over it."""
        return _outside(inner, states, seen)

    def outside_hole(self, box: Box | None) -> Constraints:
        """Constraints h ≤ 0 that exclude the states from which a step leads into the hole."""
        return IntoTheHole(self)

    def level_reached(self, t: Time, x: State) -> PerState:
        """The level c up to which the hole has to reach if V does not fall at a state: V(F(x))/(1 − λΔt)."""
        after = self.after(x, self.closed_loop.policy(t, x))
        return self.V(t, after) / (1 - self.decay * self.problem.horizon.dt)

    def parts_under(self, t: Time, x: State, u: Control) -> tuple[PerState, PerState, PerState]:
        t, after = torch.zeros_like(t), self.after(x, u)
        value = self.V(t, x)
        return (self.V(t, after) - value) / self.problem.horizon.dt + self.decay * value, value, self.outside(after)


class IntoTheHole(Constraints):
    """h(x) > 0 if the next step leads into the hole: V(F(x)) < (1 − λΔt)c and F(x) ∈ D."""

    names = ("a step into the hole",)

    def __init__(self, condition: SteppedDecrease):
        super().__init__()
        self.of = [condition]  # in a list, since the condition contains this module and must not be a part of it
        self.level = just_below(condition.hole * (1 - condition.decay * condition.problem.horizon.dt))

    def forward(self, x: State) -> Tensor:
        (condition,) = self.of
        t = torch.zeros_like(x[..., 0])
        after = condition.after(x, condition.closed_loop.policy(t, x))
        lower = (self.level - condition.V(t, after)) / self.level
        return torch.minimum(lower, -condition.outside(after))[..., None]


def steps_of(horizon: Horizon) -> dict[str, Any]:
    """Δt and the method of the steps, as plain data."""
    return {"dt": horizon.dt, "method": horizon.method}


def _outside(inner: Box, states: Box, axes: Sequence[int]) -> tuple[Corners, Corners]:
    """Boxes of (0, x) that cover D without the interior of a box in it."""
    lower: list[Corner] = []
    upper: list[Corner] = []
    low, high = over_time(states, 0.0)
    for i in axes:
        below, above = high.clone(), low.clone()
        below[1 + i], above[1 + i] = inner.lower[i], inner.upper[i]
        lower += [low.clone(), above]
        upper += [below, high.clone()]
        low[1 + i], high[1 + i] = inner.lower[i], inner.upper[i]
    return torch.stack(lower), torch.stack(upper)

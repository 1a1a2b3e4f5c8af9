"""The table of measures of a batch of closed loops, one row for each initial state, and its summary."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from lyapnet.base.types import ControlPath, PerState, State
from lyapnet.evaluation.optimality import in_spreads, mean_optimum, ratio_of_means
from lyapnet.loop.programs import Program
from lyapnet.loop.programs.terms import MIN_COST_SHARE, falls, hinge, largest_rise, satisfied
from lyapnet.loop.rollout import Trajectory
from lyapnet.task.cost import arrival_steps, time_cost_of
from lyapnet.task.domain import BORDER_ROUNDING, SLACK
from lyapnet.task.problem import Problem
from lyapnet.task.sets import ControlSet

LOST_RATIO = 1.05  # J / J* above which a state counts as lost


@dataclass(frozen=True)
class StateTable:
    """One row for each initial state."""

    x0: State
    cost: PerState  # J_N(x₀)
    value: PerState  # V(0, x₀)
    optimal_cost: PerState | None  # J*(x₀), NaN if none was found; None without an oracle
    constraint_loss: PerState  # the program's sum along the trajectory
    hinge: PerState  # Σ_n max(V_{n+1} − V_n + Δt ℓ_n, 0)
    decreasing: Tensor  # bool: V_{n+1} ≤ V_n at every step
    falling: Tensor  # bool: V falls by half of each step's cost, within 1e-6 of V(0, x₀)
    largest_rise: PerState  # largest rise of V in a step, relative to V(0, x₀)
    terminal_state: State  # x_N
    terminal_error: PerState  # ‖x_N − goal‖
    at_limits: Tensor | None = None  # (b, 2, m): share of the steps at the lower and upper limit of each control
    at_border: Tensor | None = None  # (b,): share of the steps on the border of a set of controls that is no box
    worst: Tensor | None = None  # (b, k): max_n h(x_n); None without constraints
    worst_time: Tensor | None = None  # (b, k): time of this maximum
    left: Tensor | None = None  # (b,) bool: whether the closed loop leaves the domain; None without a domain
    arrival: PerState | None = None  # time after which x stays near the goal, see TimeCost; infinite if it does not
    has_goal: bool = True  # whether the task has a goal; otherwise only costs, V and constraints are meaningful

    def rows(self, chosen: slice) -> "StateTable":
        """The table of some of the states."""
        columns: dict[str, Any] = {
            key: column[chosen] if isinstance(column, Tensor) else column for key, column in vars(self).items()
        }
        return StateTable(**columns)

    def satisfied(self, tolerance: float) -> Tensor:
        """Whether the summed hinge is at most `tolerance` · V(0, x₀)."""
        return satisfied(self.hinge, self.value, tolerance)

    def summary(self) -> dict[str, float | None]:
        """The means and shares over the rows, under the names of `lyapnet evaluate --json`."""
        summary = {
            "cost_mean": float(self.cost.mean()),
            "cost_max": float(self.cost.max()),
            **self.against_optimum(),
            "value_mean": float(self.value.mean()),
            "constraint_loss": float(self.constraint_loss.mean()),
            **self._arrivals(),
        }
        return {**summary, **self._about_goal()} if self.has_goal else summary

    def _arrivals(self) -> dict[str, float | None]:
        """The mean time of arrival of those that arrive, and the share that does; empty without a cost of time."""
        if self.arrival is None:
            return {}
        arrived = self.arrival.isfinite()
        mean = float(self.arrival[arrived].mean()) if arrived.any() else None
        return {"arrival_time": mean, "arrived_fraction": _share(arrived)}

    def _about_goal(self) -> dict[str, float | None]:
        """The measures of V as a Lyapunov function, relative to its size."""
        return {
            "value_to_cost": float(self.value.mean() / self.cost.mean()),
            "terminal_error": float(self.terminal_error.mean()),
            "bounded_fraction": _share(self.cost <= self.value),
            "falling_fraction": _share(self.falling),
            "largest_rise": float(self.largest_rise.max()),
            "decreasing_fraction": _share(self.decreasing),
            "satisfied_fraction": _share(self.satisfied(1e-2)),
            "satisfied_fraction_1e-3": _share(self.satisfied(1e-3)),
            "satisfied_fraction_1e-6": _share(self.satisfied(1e-6)),
        }

    def use_of_limits(self, names: Sequence[str]) -> dict[str, dict[str, float]]:
        """For each control: the share of steps at its lower and upper limit, and of states that reach either."""
        if self.at_limits is None:
            return {}
        met = self.at_limits.any(1).to(self.at_limits)
        shares = torch.cat([self.at_limits.mean(0), met.mean(0, keepdim=True)]).mT.tolist()
        keys = ("lower", "upper", "states")
        return {name: dict(zip(keys, own, strict=True)) for name, own in zip(names, shares, strict=True)}

    def violations(self, names: Sequence[str]) -> dict[str, dict[str, float]]:
        """For each constraint: the share of states whose closed loop violates it, the largest h, and its time."""
        if self.worst is None or self.worst_time is None:
            return {}
        shares, (worst, of) = (~(self.worst <= 0)).double().mean(0).tolist(), self.worst.max(0)
        times = self.worst_time.gather(0, of[None])[0].tolist()
        columns = zip(names, shares, worst.tolist(), times, strict=True)
        return {name: {"violated": share, "worst": h, "time": t} for name, share, h, t in columns}

    @property
    def violated(self) -> Tensor | None:
        """Whether each closed loop violates a constraint, or h is NaN, (b,); None without constraints."""
        return None if self.worst is None else ~(self.worst <= 0).all(-1)

    def against_optimum(self) -> dict[str, float | None]:
        """Mean J / mean J*, and mean |V(0, x₀) − J*| / mean J*, over the states whose J* is known.

        Besides J / J* of the worst state, and the share of states where it is above LOST_RATIO, with J* at least
        MIN_COST_SHARE of its mean. Without a goal they are the regret, mean (J − J*) / spread of J*, and mean
        |V(0, x₀) − J*| / spread of J*.
        """
        optimal = torch.full_like(self.cost, torch.nan) if self.optimal_cost is None else self.optimal_cost
        error = (self.value - optimal).abs()
        regret = {} if self.has_goal else {"regret": in_spreads(self.cost - optimal, optimal)}
        return {
            "optimal_cost_mean": mean_optimum(optimal),
            "cost_ratio": ratio_of_means(self.cost, optimal) if self.has_goal else None,
            **regret,
            **(_worst_states(self.cost, optimal) if self.has_goal else {}),
            "value_error": ratio_of_means(error, optimal) if self.has_goal else in_spreads(error, optimal),
            "optimum_failures": None if self.optimal_cost is None else int((~optimal.isfinite()).sum()),
        }


def _worst_states(cost: PerState, optimal: PerState) -> dict[str, float | None]:
    """The largest J / J*, and the share of states where it is above LOST_RATIO; None if no J* is known."""
    known = optimal.isfinite()
    if not known.any():
        return {"worst_ratio": None, "lost_fraction": None}
    J, least = cost[known], optimal[known]
    floor = (MIN_COST_SHARE * least.mean()).clamp_min(torch.finfo(least.dtype).tiny)
    ratio = 1 + (J - least) / least.maximum(floor)
    return {"worst_ratio": float(ratio.max()), "lost_fraction": _share(ratio > LOST_RATIO)}


def measure(
    problem: Problem, program: Program, trajectory: Trajectory, optimal_cost: PerState | None = None
) -> StateTable:
    """The table of a batch (b,) of trajectories under the control law of a V.

    With noise a cost is a sample of E J_N, and V falls or rises in expectation (see Trajectory.compensated).

    Args:
        optimal_cost: J* of each trajectory, if known.
    """
    cost, trajectory = trajectory.expected_cost, trajectory.compensated()
    values = trajectory.require_value()
    worst, worst_time = _worst(problem, trajectory)
    return StateTable(
        x0=trajectory.x[0],
        cost=cost,
        value=values[0],
        optimal_cost=optimal_cost,
        constraint_loss=program.constraint_loss(values, trajectory),
        hinge=hinge(values, trajectory.step_cost),
        decreasing=(values.diff(dim=0) <= 0).all(0),
        falling=falls(values, trajectory.step_cost, cost),
        largest_rise=largest_rise(values, cost),
        terminal_state=trajectory.x[-1],
        terminal_error=torch.linalg.vector_norm(problem.cost.from_goal(trajectory.x[-1]), dim=-1),
        at_limits=_at_limits(problem.controls, trajectory.u),
        at_border=_at_border(problem.controls, trajectory.u),
        worst=worst,
        worst_time=worst_time,
        arrival=_arrival(problem, trajectory),
        has_goal=problem.has_goal,
    )


def cost_within_domain(problem: Problem, trajectory: Trajectory) -> tuple[PerState, Tensor | None]:
    """J_N of closed loops, infinite if they are far outside the domain, and whether they leave it; None without one.

    With noise it is a sample of E J_N.
    """
    if problem.domain is None:
        return trajectory.expected_cost, None
    far, left = (problem.domain.left(trajectory.x, slack) for slack in (SLACK, BORDER_ROUNDING))
    return trajectory.expected_cost.masked_fill(far, torch.inf), left


def _arrival(problem: Problem, trajectory: Trajectory) -> PerState | None:
    """The time after which each closed loop stays near the goal; None without a cost of time, and with noise."""
    if time_cost_of(problem.cost) is None or problem.noise is not None:
        return None
    steps, N = arrival_steps(problem.cost, trajectory.x), problem.horizon.steps
    return (problem.horizon.dt * steps.to(trajectory.x)).masked_fill(steps > N, torch.inf)


def _worst(problem: Problem, trajectory: Trajectory) -> tuple[Tensor | None, Tensor | None]:
    """max_n h(x_n) of each trajectory and constraint, and its time."""
    if problem.constraints is None:
        return None, None
    worst, node = problem.constraints(trajectory.x).max(0)
    return worst, trajectory.t[node]


def _at_limits(controls: ControlSet, u: ControlPath) -> Tensor | None:
    if controls.limits is None or not controls.limited:
        return None
    if not controls.is_box:
        return None
    return torch.stack([(u == limit.to(u)).to(u).mean(0) for limit in controls.limits], 1)


def _at_border(controls: ControlSet, u: ControlPath) -> Tensor | None:
    holds = controls.at_border(u)
    return None if holds is None else holds.to(u).mean(0)


def _share(holds: Tensor) -> float:
    return float(holds.double().mean())

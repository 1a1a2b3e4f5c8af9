"""The terms of the programs, pure functions of V along a trajectory and of the cost of its steps.

`values` is V(t_n, x_n) at the nodes, (N + 1, *batch); `step_cost` is ∫ℓ over each step, (N, *batch).
"""

import torch
from jaxtyping import Bool
from torch import Tensor

from lyapnet.base.types import PerState, StepPath, ValuePath

REQUIRED_DECREASE = 0.5  # decrease of V in each step that `falls` requires, relative to the step's cost
DECREASE_TOLERANCE = 1e-6  # tolerance of this decrease, relative to V(0, x₀)
MIN_COST_SHARE = 0.05  # floor of costs in denominators, relative to a typical cost


def residual(values: ValuePath, step_cost: StepPath) -> PerState:
    """Σ_n (V_{n+1} − V_n + Δt ℓ_n)², zero if V is the cost-to-go of the closed loop. Source: P_V of the paper."""
    return (violation(values, step_cost) ** 2).sum(0)


def cost_to_go_error(values: ValuePath, step_cost: StepPath, terminal_cost: PerState) -> PerState:
    """Mean over the nodes of (V_n − J_n)², with the cost to go J_n = Σ_{k≥n} Δt ℓ_k + φ(x_N) of the closed loop.

    V_n − J_n = V_N − φ − Σ_{k≥n} violation_k is zero if residual and terminal residual are zero. These are only weakly
    sensitive to the level of V, to which the violations of all steps add up.
    """
    return ((values - costs_to_go(step_cost, terminal_cost)) ** 2).mean(0)


def costs_to_go(step_cost: StepPath, terminal_cost: PerState) -> ValuePath:
    """J_n = Σ_{k≥n} Δt ℓ_k + φ(x_N) at the nodes, (N + 1, *batch)."""
    return torch.cat([step_cost, terminal_cost[None]]).flip(0).cumsum(0).flip(0)


def hinge(values: ValuePath, step_cost: StepPath, margin: float = 0.0) -> PerState:
    """Σ_n max(V_{n+1} − V_n + (1 + margin) Δt ℓ_n, 0), zero if V decreases at least as fast as the cost accrues.

    Source: P_L of the paper, at margin 0.
    """
    return torch.relu(violation(values, step_cost, margin)).sum(0)


def violation(values: ValuePath, step_cost: StepPath, margin: float = 0.0) -> StepPath:
    """V_{n+1} − V_n + (1 + margin) Δt ℓ_n at each step."""
    return values.diff(dim=0) + (1 + margin) * step_cost


def terminal_residual(values: ValuePath, terminal_cost: PerState) -> PerState:
    """(V(T, x_N) − φ(x_N))², zero if V equals the terminal cost at T."""
    return (values[-1] - terminal_cost) ** 2


def terminal_hinge(values: ValuePath, terminal_cost: PerState) -> PerState:
    """max(φ(x_N) − V(T, x_N), 0), zero if V is at least the terminal cost at T, so that V(0, x₀) bounds the cost."""
    return torch.relu(terminal_cost - values[-1])


def value_floored(value: PerState, cost: Tensor) -> PerState:
    """V(0, x₀), at least MIN_COST_SHARE of the median of costs (k,), as the denominator of relative costs."""
    return value.maximum(MIN_COST_SHARE * cost.median())


def satisfied(summed_hinge: PerState, value: PerState, tolerance: float) -> Bool[Tensor, "*batch"]:
    """Whether Σ_n max(V_{n+1} − V_n + Δt ℓ_n, 0) ≤ tolerance · V(0, x₀), up to rounding.

    The tolerance for rounding, 100 eps of the largest V for a sum over hundreds of steps, matters only at the goal,
    where both sides are zero.
    """
    rounding = 100 * torch.finfo(value.dtype).eps * value.abs().max()
    return summed_hinge <= tolerance * value + rounding


def falls(values: ValuePath, step_cost: StepPath, cost: PerState) -> Bool[Tensor, "*batch"]:
    """Whether V decreases in every step by at least half of the step's cost, up to 1e-6 of V(0, x₀).

    Half of the cost allows for errors of V, the tolerance for rounding.

    Args:
        cost: J_N of the trajectories.
    """
    rounding = 100 * torch.finfo(values.dtype).eps * values.abs().amax()
    missed = (values.diff(dim=0) + REQUIRED_DECREASE * step_cost).amax(0)
    return missed <= DECREASE_TOLERANCE * value_floored(values[0], cost) + rounding


def largest_rise(values: ValuePath, cost: PerState) -> PerState:
    """The largest rise of V from one node to the next, relative to V(0, x₀)."""
    return torch.relu(values.diff(dim=0)).amax(0) / value_floored(values[0], cost).clamp_min(
        torch.finfo(values.dtype).tiny
    )

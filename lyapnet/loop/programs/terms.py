"""The terms of both programs: pure functions of V along a trajectory and of the cost of its steps.

`values` is V(t_n, x_n) at the nodes, (N + 1, *batch); `step_cost` is ∫ℓ over each step, (N, *batch).
"""

import torch
from jaxtyping import Bool
from torch import Tensor

from lyapnet.base.types import PerState, StepPath, ValuePath

FALL, ROUGHLY = 0.5, 1e-6  # what V has to fall by, of a step's cost, and what a step may miss of that, of V(0, x₀)
LEAST = 0.05  # of a typical cost, against which an error counts where the cost itself is less


def residual(values: ValuePath, step_cost: StepPath) -> PerState:
    """Σ_n (V_{n+1} − V_n + Δt ℓ_n)²: zero where V is the cost-to-go of the closed loop. Source: P_V of the paper."""
    return (violation(values, step_cost) ** 2).sum(0)


def cost_to_go_error(values: ValuePath, step_cost: StepPath, terminal_cost: PerState) -> PerState:
    """Mean over the nodes of (V_n − J_n)², J_n = Σ_{k≥n} Δt ℓ_k + φ(x_N) being what the closed loop still pays.

    V_n − J_n = V_N − φ − Σ_{k≥n} violation_k: zero where residual and terminal residual are, which see the level of V
    only faintly, as it adds up over the steps.
    """
    remaining = torch.cat([step_cost, terminal_cost[None]]).flip(0).cumsum(0).flip(0)
    return ((values - remaining) ** 2).mean(0)


def hinge(values: ValuePath, step_cost: StepPath, margin: float = 0.0) -> PerState:
    """Σ_n max(V_{n+1} − V_n + (1 + margin) Δt ℓ_n, 0): zero where V falls at least as fast as the cost accrues.

    Source: P_L of the paper, at margin 0.
    """
    return torch.relu(violation(values, step_cost, margin)).sum(0)


def violation(values: ValuePath, step_cost: StepPath, margin: float = 0.0) -> StepPath:
    """V_{n+1} − V_n + (1 + margin) Δt ℓ_n at each step."""
    return values.diff(dim=0) + (1 + margin) * step_cost


def terminal_residual(values: ValuePath, terminal_cost: PerState) -> PerState:
    """(V(T, x_N) − φ(x_N))²: V ends as the terminal cost."""
    return (values[-1] - terminal_cost) ** 2


def terminal_hinge(values: ValuePath, terminal_cost: PerState) -> PerState:
    """max(φ(x_N) − V(T, x_N), 0): V ends no lower than the terminal cost, so that V(0, x₀) bounds the whole cost."""
    return torch.relu(terminal_cost - values[-1])


def promised(value: PerState, cost: PerState) -> PerState:
    """V(0, x₀), LEAST of the median cost at the least: what the cost of a closed loop is held against."""
    return value.maximum(LEAST * cost.median())


def satisfied(summed_hinge: PerState, value: PerState, tolerance: float) -> Bool[Tensor, "*batch"]:
    """Whether Σ_n max(V_{n+1} − V_n + Δt ℓ_n, 0) ≤ tolerance · V(0, x₀), up to rounding.

    Rounding (100 eps of the largest V, for a sum over hundreds of steps) decides at the goal alone, where both sides
    are zero.
    """
    rounding = 100 * torch.finfo(value.dtype).eps * value.abs().max()
    return summed_hinge <= tolerance * value + rounding


def falls(values: ValuePath, step_cost: StepPath, cost: PerState) -> Bool[Tensor, "*batch"]:
    """Whether V falls at every step by at least FALL of what the step costs, within ROUGHLY of V(0, x₀).

    Half of the cost leaves room for a V that is not exact, and the tolerance for rounding, far below what counts.

    Args:
        cost: of the whole trajectories.
    """
    rounding = 100 * torch.finfo(values.dtype).eps * values.abs().amax()
    missed = (values.diff(dim=0) + FALL * step_cost).amax(0)
    return missed <= ROUGHLY * promised(values[0], cost) + rounding


def largest_rise(values: ValuePath, cost: PerState) -> PerState:
    """The largest rise of V from one node to the next, in units of V(0, x₀)."""
    return torch.relu(values.diff(dim=0)).amax(0) / promised(values[0], cost).clamp_min(torch.finfo(values.dtype).tiny)

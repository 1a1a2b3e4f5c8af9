"""The value program: V is the cost-to-go of its own greedy policy."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import ClassVar

from jaxtyping import Bool
from torch import Tensor

from lyapnet.base.types import PerState, ValuePath
from lyapnet.loop.programs.base import Program
from lyapnet.loop.programs.terms import MIN_COST_SHARE, cost_to_go_error, residual, terminal_residual, value_floored
from lyapnet.loop.rollout import Trajectory

LOST_COST_RATIO = 1.5  # J/V(0, x₀) relative to the batch's median, above which the law, not V, is wrong


@dataclass(frozen=True)
class ValueProgram(Program):
    """C = Σ_n (V_{n+1} − V_n + Δt ℓ_n)² and B = (V(T, x_N) − φ(x_N))². Source: P_V of arXiv 2305.15244.

    The further term is cost_to_go · D, with D the mean over the nodes of (V_n − J_n)² and J_n the cost to go of the
    closed loop. D is zero if C and B are zero, and more sensitive to the level of V.

    With `relative`, a normalised D is divided by the squared cost J of its own trajectory, at least MIN_COST_SHARE of
    J̄, so that V is also accurate where the cost is small. Lost trajectories, which cost far more than V(0, x₀) (see
    `lost`), then have no gradient of D: their cost is no better estimate of the optimum than V. Learning it would raise
    V at states where the way to the goal begins, so that the laws of neighbouring states avoid these and become lost
    too.
    """

    degree: ClassVar[int] = 2
    weighted: ClassVar[tuple[str, ...]] = (*Program.weighted, "cost_to_go")
    recommended: ClassVar[Mapping[str, float | bool]] = MappingProxyType(
        {"constraint": 0, "cost_to_go": 10, "trajectory_cost": 1, "relative": True}
    )

    cost_to_go: float = 0.0
    relative: bool = False

    def per_state(self, values: ValuePath, trajectory: Trajectory) -> dict[str, PerState]:
        error = cost_to_go_error(values, trajectory.step_cost, trajectory.terminal_cost)
        if self.relative:
            error = error.where(~lost(values, trajectory), error.detach())
        return {**super().per_state(values, trajectory), "cost_to_go": error}

    def unit(self, name: str, cost: PerState, mean_cost: Tensor) -> Tensor:
        if self.relative and name == "cost_to_go":
            return cost.maximum(MIN_COST_SHARE * mean_cost) ** 2
        return super().unit(name, cost, mean_cost)

    def without_goal(self, reason: str) -> "ValueProgram":
        return replace(self, relative=False)  # J may have any sign

    def penalty(self, excess: Tensor) -> Tensor:
        return excess**2

    def constraint_loss(self, values: ValuePath, trajectory: Trajectory) -> PerState:
        return residual(values, trajectory.step_cost)

    def terminal_term(self, values: ValuePath, trajectory: Trajectory) -> PerState:
        return terminal_residual(values, trajectory.terminal_cost)


def lost(values: ValuePath, trajectory: Trajectory) -> Bool[Tensor, "*batch"]:
    """Whether J/V(0, x₀) of a trajectory exceeds LOST_COST_RATIO times the batch's median (at least 1)."""
    J = trajectory.cost.detach()
    ratio = J / value_floored(values[0].detach(), J)
    return ratio > LOST_COST_RATIO * ratio.median().clamp_min(1)

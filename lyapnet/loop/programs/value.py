"""The value program: V is the cost-to-go of its own greedy policy."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import ClassVar

from jaxtyping import Bool
from torch import Tensor

from lyapnet.base.types import PerState, ValuePath
from lyapnet.loop.programs.base import Program
from lyapnet.loop.programs.terms import LEAST, cost_to_go_error, promised, residual, terminal_residual
from lyapnet.loop.rollout import Trajectory

LOST = 1.5  # times as much as V(0, x₀) promises, the batch's median of which being one: the law is lost there, not V


@dataclass(frozen=True)
class ValueProgram(Program):
    """C = Σ_n (V_{n+1} − V_n + Δt ℓ_n)² and B = (V(T, x_N) − φ(x_N))². Source: P_V of arXiv 2305.15244.

    The loss has a further term, cost_to_go · D, with D the mean over the nodes of (V_n − J_n)², J_n being what the
    closed loop still pays. D is zero where C and B are, and sees the level of V at once, which they see faintly.

    With `relative`, a normalised D is measured against the cost J of its own trajectory, LEAST of J̄ at the least: V is
    then right in relation to what it costs from where that is little, too. And D then has no gradient of trajectories
    that cost far more than V(0, x₀) says, LOST times the batch's median of J/V(0, x₀), 1 at the least: what a law that
    is lost pays is no better guess of the optimum than V. Taken for the truth it would raise V where the way to the
    goal begins, and lead the laws of the states around away from it, until all of them are lost.
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
            return cost.maximum(LEAST * mean_cost) ** 2
        return super().unit(name, cost, mean_cost)

    def without_goal(self, reason: str) -> "ValueProgram":
        return replace(self, relative=False)  # J of a trajectory may be anything

    def penalty(self, excess: Tensor) -> Tensor:
        return excess**2

    def constraint_loss(self, values: ValuePath, trajectory: Trajectory) -> PerState:
        return residual(values, trajectory.step_cost)

    def terminal_term(self, values: ValuePath, trajectory: Trajectory) -> PerState:
        return terminal_residual(values, trajectory.terminal_cost)


def lost(values: ValuePath, trajectory: Trajectory) -> Bool[Tensor, "*batch"]:
    """Whether a trajectory costs LOST times as much as V(0, x₀) says, in units of the batch's median of that ratio."""
    J = trajectory.cost.detach()
    ratio = J / promised(values[0].detach(), J)
    return ratio > LOST * ratio.median().clamp_min(1)

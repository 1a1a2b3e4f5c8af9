"""The value program: V is the cost-to-go of its own greedy policy."""

from dataclasses import dataclass
from types import MappingProxyType

from torch import Tensor

from lyapnet.programs.base import Program
from lyapnet.programs.terms import cost_to_go_error, residual, terminal_residual
from lyapnet.rollout import Trajectory
from lyapnet.types import PerState, ValuePath


@dataclass(frozen=True)
class ValueProgram(Program):
    """C = Σ_n (V_{n+1} − V_n + Δt ℓ_n)² and B = (V(T, x_N) − φ(x_N))². Source: P_V of arXiv 2305.15244.

    The loss has a further term, cost_to_go · D, with D the mean over the nodes of (V_n − J_n)², J_n being what the
    closed loop still pays. D is zero where C and B are, and sees the level of V at once, which they see faintly.
    """

    degree = 2
    weighted = (*Program.weighted, "cost_to_go")
    recommended = MappingProxyType({"constraint": 0, "cost_to_go": 10, "trajectory_cost": 1})

    cost_to_go: float = 0.0

    def per_state(self, values: ValuePath, trajectory: Trajectory) -> dict[str, PerState]:
        error = cost_to_go_error(values, trajectory.step_cost, trajectory.terminal_cost)
        return {**super().per_state(values, trajectory), "cost_to_go": error}

    def penalty(self, excess: Tensor) -> Tensor:
        return excess**2

    def constraint_loss(self, values: ValuePath, trajectory: Trajectory) -> PerState:
        return residual(values, trajectory.step_cost)

    def terminal_term(self, values: ValuePath, trajectory: Trajectory) -> PerState:
        return terminal_residual(values, trajectory.terminal_cost)

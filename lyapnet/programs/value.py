"""The value program: V is the cost-to-go of its own greedy policy."""

from dataclasses import dataclass

from lyapnet.programs.base import Program
from lyapnet.programs.terms import residual, terminal_residual
from lyapnet.rollout import Trajectory
from lyapnet.types import PerState, ValuePath


@dataclass(frozen=True)
class ValueProgram(Program):
    """C = Σ_n (V_{n+1} − V_n + Δt ℓ_n)² and B = (V(T, x_N) − φ(x_N))². Source: P_V of arXiv 2305.15244."""

    degree = 2

    def constraint_loss(self, values: ValuePath, trajectory: Trajectory) -> PerState:
        return residual(values, trajectory.step_cost)

    def terminal_term(self, values: ValuePath, trajectory: Trajectory) -> PerState:
        return terminal_residual(values, trajectory.terminal_cost)

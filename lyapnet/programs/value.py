"""The value program: V is the cost-to-go of its own greedy policy."""

from dataclasses import dataclass

from torch import Tensor

from lyapnet.programs.base import Program
from lyapnet.programs.terms import residual, terminal_residual
from lyapnet.rollout import Trajectory
from lyapnet.types import PerState, ValuePath


@dataclass(frozen=True)
class ValueProgram(Program):
    """C = Σ_n (V_{n+1} − V_n + Δt ℓ_n)² and B = (V(T, x_N) − φ(x_N))². Source: P_V of arXiv 2305.15244."""

    def constraint_loss(self, values: ValuePath, trajectory: Trajectory) -> PerState:
        return residual(values, trajectory.step_cost)

    def _constraint_in_units(self, values: ValuePath, trajectory: Trajectory, unit: Tensor) -> PerState:
        # N Σ (ΔV + Δtℓ)² / J̄² is the mean over time of ((V̇ + ℓ) / (J̄/T))²: free of N and Δt
        per_time = len(trajectory.step_cost) if self.normalise else 1
        return per_time * residual(values, trajectory.step_cost) / unit**2

    def _terminal_in_units(self, values: ValuePath, trajectory: Trajectory, unit: Tensor) -> PerState:
        return terminal_residual(values, trajectory.terminal_cost) / unit**2

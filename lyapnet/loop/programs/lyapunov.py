"""The Lyapunov program: V decreases along its closed loop at least as fast as the cost accrues."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar

import torch
from torch import Tensor

from lyapnet.base.errors import UsageError
from lyapnet.base.types import PerState, ValuePath
from lyapnet.loop.programs.base import Program
from lyapnet.loop.programs.terms import hinge, terminal_hinge
from lyapnet.loop.programs.tolerances import Tolerances
from lyapnet.loop.rollout import Trajectory


@dataclass(frozen=True)
class LyapunovProgram(Program):
    """C = Σ_n max(V_{n+1} − V_n + (1 + margin) Δt ℓ_n, 0) and B = max(φ(x_N) − V(T, x_N), 0).

    If both are zero, J_N(x₀) ≤ V(0, x₀). A margin > 0 requires more than this, as a reserve for states between the
    sampled ones; the logged constraint loss has no margin.

    The further term bound · V(0, x₀) makes the bound tight: the least V(0, ·) with C = B = 0 is the optimal cost. As
    V(0, x₀) ≥ J_N − C − B for any V, reducing V(0, x₀) below the cost increases C or B by as much. If the weights of
    both exceed that of the bound, this does not pay, and C and B are exact penalties. If V(T, ·) = φ by construction, B
    is zero and needs no weight.

    Source: P_L of arXiv 2305.15244.
    """

    degree: ClassVar[int] = 1
    needs_goal: ClassVar[bool] = True
    weighted: ClassVar[tuple[str, ...]] = (*Program.weighted, "bound")
    recommended: ClassVar[Mapping[str, float | bool]] = MappingProxyType(
        {"constraint": 50, "terminal": 50, "trajectory_cost": 1, "margin": 0.02, "bound": 1}
    )

    margin: float = 0.0
    bound: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.margin >= 0:
            raise ValueError(f"Expected margin ≥ 0, got {self.margin}; a negative one asks for less than is claimed.")
        if self.bound and not self.bound < self.constraint:
            raise ValueError(
                f"Expected bound < constraint, got {self.bound} ≥ {self.constraint}; V would sink below the cost."
            )

    def tolerances(self, radius: float | None = None, cost: float = 0.05) -> Tolerances:
        """As in the base class; also V has to decrease along the closed loop, within 1 % of V(0, x₀)."""
        return Tolerances(radius, 1e-2, cost)

    def excess(self, rate: Tensor, running: Tensor) -> Tensor:
        return rate + (1 + self.margin) * running

    def penalty(self, excess: Tensor) -> Tensor:
        return torch.relu(excess)

    def check_terminal(self, exact: bool) -> None:
        if not exact and self.bound >= self.terminal and self.bound:
            raise UsageError(
                f"Expected program.terminal > program.bound = {self.bound:g}, got {self.terminal:g}; V(T, ·) would "
                "sink below φ: raise it, or set network.terminal=exact."
            )

    def constraint_loss(self, values: ValuePath, trajectory: Trajectory) -> PerState:
        return hinge(values, trajectory.step_cost)

    def constraint_term(self, values: ValuePath, trajectory: Trajectory) -> PerState:
        return hinge(values, trajectory.step_cost, self.margin)

    def terminal_term(self, values: ValuePath, trajectory: Trajectory) -> PerState:
        return terminal_hinge(values, trajectory.terminal_cost)

    def per_state(self, values: ValuePath, trajectory: Trajectory) -> dict[str, PerState]:
        return {**super().per_state(values, trajectory), "bound": values[0]}

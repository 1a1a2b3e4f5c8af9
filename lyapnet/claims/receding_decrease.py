"""What a region of attraction asks of V and the receding law u(0, x), as a condition that boxes prove."""

import math
from collections.abc import Sequence
from functools import reduce
from typing import Any

import torch
from torch import Tensor

from lyapnet.base.errors import UsageError
from lyapnet.base.types import PerState, State, Time
from lyapnet.claims.contraction import Contraction
from lyapnet.claims.kept_regions import REMEDY
from lyapnet.claims.preconditions import beside, over_time
from lyapnet.loop.rollout.closed_loop import ClosedLoop
from lyapnet.prover.boxes import faces
from lyapnet.prover.branch_and_bound import Budget, just_below, minimum
from lyapnet.prover.condition import DecreaseCondition
from lyapnet.task.constraints import Constraints
from lyapnet.task.sets import Box


class RecedingDecrease(DecreaseCondition):
    """V̇ + λ max(V, c) ≤ 0 with V = V(0, ·) and V̇ = V_xᵀ(f + g u(0, x)), outside a hole: V falls exponentially.

    With a disturbance V̇ is at its worst, V_xᵀ(f + g u(0, x)) + Σ_i w_i |∂V/∂x_i|.

    Args:
        parameters: names of the constants of the system, on which neither V nor u depends.
    """

    proves, partial = "region", True

    def __init__(
        self,
        closed_loop: ClosedLoop,
        decay: float,
        disturbance: State | None = None,
        parameters: Sequence[str] = (),
    ):
        super().__init__(closed_loop, 1.0, 0.0, disturbance=disturbance)
        if not 0 < decay < math.inf:
            raise UsageError(f"Expected decay > 0, got {decay}; give it in 1/s.")
        self.decay, self.hole, self.around, self.parameter_names = decay, 0.0, None, list(parameters)

    @property
    def facts(self) -> dict[str, Any]:
        B, w = self.around, self.disturbance
        around = {} if B is None else {"box": [B.box.lower.tolist(), B.box.upper.tolist()], "Y": B.coordinates.tolist()}
        pushed = {} if w is None else {"disturbance": w.tolist()}
        of_plants = {"parameters": self.parameter_names} if self.parameter_names else {}
        return {"decay": self.decay, "hole": self.hole, **around, **pushed, **of_plants}

    def open_hole(
        self,
        around: Contraction,
        states: Box,
        seen: Sequence[int],
        level: float,
        budget: Budget,
        proposed: float | None = None,
    ) -> None:
        """Ask nothing in {x ∈ B: V < c}, with c below V on the boundary of B, and at most a level.

        Args:
            states: D, beside the ends of the constants.
            proposed: the c that alone is tried.
        """
        rim = minimum(self.V, *faces(*over_time(beside(around.box, states), 0.0), [1 + i for i in seen]), budget)
        self.around, self.hole = around, min(level, just_below(rim) if proposed is None else proposed)
        if proposed is not None and not self.hole < rim:
            raise UsageError(f"Expected V > c = {self.hole!r} on the boundary of B, got V ≥ {rim:g}; {REMEDY}.")
        self.constraints = OutsideTheHole(self.V, around.box, self.hole)

    def open_everywhere(self, level: float) -> None:
        """Ask nothing in {x ∈ D: V < c}, where pushes may lift V."""
        self.hole, self.constraints = level, OutsideTheHole(self.V, None, level)

    def parts(self, t: Time, x: State) -> tuple[PerState, PerState, PerState]:
        value, slope = self.V.value_and_state_gradient(t, x)
        fall = (slope * self.closed_loop.system.dynamics(x, self.closed_loop.policy(t, x))).sum(-1)
        if self.disturbance is not None:
            fall = fall + self.worst_push(slope)
        return fall + self.decay * torch.clamp(value, min=self.hole), self.V(t, x), fall


class OutsideTheHole(Constraints):
    """h(x) > 0 where x ∈ B, or D without one, and V(0, x) < c: there V need not fall."""

    names = ("outside the hole",)

    def __init__(self, V: torch.nn.Module, box: Box | None, level: float):
        super().__init__()
        self.V, self.level, self.axes = V, level, []
        if box is None:
            return
        ends = zip(box.center.tolist(), box.widths.tolist(), strict=True)
        self.axes = [(i, middle, width / 2) for i, (middle, width) in enumerate(ends) if width > 0]

    def forward(self, x: State) -> Tensor:
        below = self.level - self.V(x.new_zeros(()), x)
        within = [1 - 1e-9 - (x[..., i] - middle).abs() / reach for i, middle, reach in self.axes]
        return reduce(torch.minimum, within, below)[..., None]

"""The condition of a region of attraction of the receding law u(0, x), which a proof bounds on boxes."""

import math
from collections.abc import Sequence
from functools import reduce
from typing import Any

import torch
from torch import Tensor

from lyapnet.base.errors import UsageError
from lyapnet.base.types import Control, Corners, PerState, State, Time
from lyapnet.claims.contraction import Contraction
from lyapnet.claims.kept_regions import REMEDY
from lyapnet.claims.preconditions import append_constants, over_time
from lyapnet.loop.rollout.closed_loop import ClosedLoop
from lyapnet.prover.boxes import faces
from lyapnet.prover.branch_and_bound import Budget, just_below, minimum
from lyapnet.prover.condition import DecreaseCondition
from lyapnet.prover.readings import Readings
from lyapnet.task.constraints import Constraints
from lyapnet.task.sets import Box


class RecedingDecrease(DecreaseCondition):
    """V̇ + λ max(V, c) ≤ 0 with V = V(0, ·) and V̇ = V_xᵀ(f + g u(0, x)): V falls exponentially, but in a hole V < c.

    With a disturbance V̇ is replaced by its largest value, V_xᵀ(f + g u(0, x)) + Σ_i w_i |∂V/∂x_i|.

    Args:
        parameters: names of the constants of the system, on which neither V nor u depends.
        readings: when u(0, x) is read and then held; None: it is read at every t.
        practical: whether the hole is all of {V < c}, and not a set on which the law contracts; always so with a
            disturbance or readings.
    """

    proves, partial = "region", True

    def __init__(
        self,
        closed_loop: ClosedLoop,
        decay: float,
        disturbance: State | None = None,
        parameters: Sequence[str] = (),
        readings: Readings | None = None,
        practical: bool = False,
    ):
        super().__init__(closed_loop, 1.0, 0.0, disturbance=disturbance, readings=readings)
        if not 0 < decay < math.inf:
            raise UsageError(f"Expected decay > 0, got {decay}; give it in 1/s.")
        self.decay, self.hole, self.around, self.parameter_names = decay, 0.0, None, list(parameters)
        self.is_undisturbed = disturbance is None and readings is None
        self.is_practical = practical or not self.is_undisturbed

    @property
    def facts(self) -> dict[str, Any]:
        B, w = self.around, self.disturbance
        hole = {} if B is None else {"box": [B.box.lower.tolist(), B.box.upper.tolist()], "Y": B.coordinates.tolist()}
        disturbance = {} if w is None else {"disturbance": w.tolist()}
        parameters = {"parameters": self.parameter_names} if self.parameter_names else {}
        practical = {"practical": True} if self.is_practical and self.is_undisturbed else {}
        return {
            "decay": self.decay, "hole": self.hole, **hole, **disturbance, **parameters, **practical,
            **self.facts_of_readings,
        }  # fmt: skip

    def open_hole(
        self,
        around: Contraction,
        states: Box,
        seen: Sequence[int],
        level: float,
        budget: Budget,
        proposed: float | None = None,
    ) -> None:
        """Exclude the hole {x ∈ B: V < c} from the condition, with c ≤ level and V > c around the hole.

        Args:
            around: the contraction on B.
            states: D, extended by the bounds of the constants.
            proposed: the only c to test; None to choose the largest.

        Raises:
            UsageError: the proposed c is not below V around the hole.
        """
        rim = minimum(self.V, *self._around_hole(append_constants(around.box, states), states, seen), budget)
        self.around, self.hole = around, min(level, just_below(rim) if proposed is None else proposed)
        if proposed is not None and not self.hole < rim:
            raise UsageError(f"Expected V > c = {self.hole!r} around the hole, got V ≥ {rim:g}; {REMEDY}.")
        self.constraints = self.outside_hole(around.box)

    def _around_hole(self, inner: Box, states: Box, seen: Sequence[int]) -> tuple[Corners, Corners]:
        """Boxes of (0, x) on which V > c is required: the boundary of B; `inner` is B with the bounds of constants."""
        return faces(*over_time(inner, 0.0), [1 + i for i in seen])

    def outside_hole(self, box: Box | None) -> Constraints:
        """Constraints h ≤ 0 that exclude the hole in a box B, or in D if there is none."""
        return OutsideTheHole(self.V, box, self.hole)

    def open_everywhere(self, level: float) -> None:
        """Exclude {x ∈ D: V < c} with c = level from the condition; V may rise there."""
        self.hole = level
        self.constraints = self.outside_hole(None)

    def level_reached(self, t: Time, x: State) -> PerState:
        """The level c up to which the hole has to reach if V does not fall at a state: V(x)."""
        return self.V(t, x)

    def parts(self, t: Time, x: State) -> tuple[PerState, PerState, PerState]:
        return self.parts_under(t, x, self.closed_loop.policy(t, x))

    def parts_under(self, t: Time, x: State, u: Control) -> tuple[PerState, PerState, PerState]:
        t = torch.zeros_like(t)  # V(0, ·), also after a reading
        value, slope = self.V.value_and_state_gradient(t, x)
        rate = (slope * self.closed_loop.system.dynamics(x, u)).sum(-1)
        if self.disturbance is not None:
            rate = rate + self.worst_push(slope)
        return rate + self.decay * torch.clamp(value, min=self.hole), self.V(t, x), rate


class OutsideTheHole(Constraints):
    """h(x) > 0 on the hole {x ∈ B: V(0, x) < c}, or {x ∈ D: V(0, x) < c} without B, where V need not fall.

    B is taken a little smaller, for rounding.
    """

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

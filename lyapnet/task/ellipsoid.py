"""An ellipsoid as a set of controls: an affine image of a ball."""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from lyapnet.base.errors import UsageError
from lyapnet.base.linear_algebra import apply, multiply
from lyapnet.base.types import Control, State
from lyapnet.task.ball import ControlBall
from lyapnet.task.mapped_controls import MappedControls
from lyapnet.task.sets import finite_numbers
from lyapnet.task.systems import ControlSystem

ROUNDING = 16  # units of rounding by which controls are moved inside, times `spread`
LARGEST_CONDITION = 1e5  # largest condition number of H; float32 has about 7 digits


class ControlEllipsoid(MappedControls, ControlBall):
    """U = {c + Hv : ‖v‖ ≤ 1}; as a set of shares v, the ball of radius 1.

    Controls are rounded inwards, also in float32.

    Args:
        radii: the half axes, one for each control, for a diagonal H; or the rows of H (m, m).
        center: c (m,), in the units of the controls; None: zero.

    Raises:
        ValueError: radii that are not positive, a matrix that is singular or nearly so, or a centre of another length.
    """

    words: str = "an ellipsoid of controls"
    shape: Float[Tensor, "m m"]  # H
    inverse: Float[Tensor, "m m"]
    center: Float[Tensor, " m"]  # c

    def __init__(self, radii: Sequence[Any], center: Sequence[float] | None = None):
        super().__init__(1.0)
        H = finite_numbers("radii", radii)
        if H.ndim == 1 and bool((H > 0).all()):
            H = torch.diag(H)
        if H.ndim != 2 or H.shape[0] != H.shape[1] or not float(torch.linalg.cond(H)) <= LARGEST_CONDITION:
            raise ValueError(
                f"Expected radii as numbers > 0, one for each control, or as rows of a square matrix of a condition "
                f"of at most {LARGEST_CONDITION:g}, got {radii!r}; correct them."
            )
        c = torch.zeros(len(H), dtype=H.dtype) if center is None else finite_numbers("center", center)
        if c.shape != (len(H),):
            raise ValueError(f"Expected a center of {len(H)} controls, got {center!r}; give one number for each.")
        for name, part in {"shape": H, "inverse": torch.linalg.inv(H), "center": c}.items():
            self.register_buffer(name, part, persistent=False)
        # largest change of v by the rounding of u, in units of rounding
        norm = torch.linalg.matrix_norm
        self.spread: float = float(norm(self.inverse) * (norm(H) + c.norm()))
        self.to(torch.get_default_dtype())

    @property
    def shares(self) -> ControlBall:
        return ControlBall(1.0).to(self.radius)

    def of(self, system: ControlSystem) -> "ControlEllipsoid":
        if len(self.center) != system.m:
            raise UsageError(
                f"Expected an ellipsoid of {system.m} controls ({', '.join(system.control_names)}), got "
                f"{len(self.center)}; give a radius for each."
            )
        return self

    @property
    def fixed_limits(self) -> tuple[Tensor, Tensor]:
        widths = torch.linalg.vector_norm(self.shape, dim=1)
        return self.center - widths, self.center + widths

    def limits_at(self, x: State) -> tuple[Tensor, Tensor]:
        return self.fixed_limits

    def moved(self, x: State, u: Control) -> Control:
        return self.center + apply(self.shape, u)

    def stretched(self, x: State, rows: Tensor) -> Tensor:
        return multiply(rows, self.shape)

    def applied(self, x: State, u: Control) -> Control:
        return self.moved(x, (1 - ROUNDING * self.rounding * self.spread) * self.project(u))

    def asked(self, x: State, u: Control) -> Control:
        return apply(self.inverse, u - self.center)

    def extra_repr(self) -> str:
        return f"radii {self.shape.tolist()}, center {self.center.tolist()}"

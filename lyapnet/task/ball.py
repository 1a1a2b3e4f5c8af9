"""The ball ‖u‖ ≤ r as a set of controls, and the minimiser of a quadratic cost and ‖u‖ in it."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lyapnet.base.linear_algebra import apply, norm, solve
from lyapnet.base.types import Control, ControlMatrix, State
from lyapnet.task.sets import ControlSet, passed_through

NEWTON_STEPS = 10  # number of steps for a multiplier; they converge monotonically and quadratically
TINY = 1e-100  # replaces 0 in denominators
LEAST_NUMBER = 1e-12  # least weight or limit that is accepted; its inverse is the largest
INWARDS = 8  # units of rounding by which projected controls are inside; controls inside by half of it are not moved


class ControlBall(ControlSet):
    """U = {u : ‖u‖ ≤ r}: a thrust of limited size in any direction.

    Args:
        radius: r > 0, in the unit of the controls.

    Raises:
        ValueError: the radius is not positive and finite.
    """

    radius: Float[Tensor, ""]

    def __init__(self, radius: float):
        super().__init__()
        largest = torch.tensor(positive_number("radius", radius), dtype=torch.get_default_dtype())
        self.register_buffer("radius", largest, persistent=False)

    @property
    def limits(self) -> tuple[Tensor, Tensor]:
        return -self.radius, self.radius

    @property
    def is_box(self) -> bool:
        return False

    def excess(self, u: Control) -> Tensor:
        return (u * u).sum(-1, keepdim=True) / self.radius**2 - 1

    def minimise(self, R: ControlMatrix, b: Control) -> Control:
        return self.project(minimise_in_ball(R, b, self.radius))

    def contains(self, u: Control) -> Bool[Tensor, "*batch"]:
        return (u.double() ** 2).sum(-1) <= self.radius.double() ** 2

    def rounded_for(self, dtype: torch.dtype) -> ControlSet:
        return passed_through(self, dtype)

    def applied(self, x: State, u: Control) -> Control:
        return self._inwards(u, self.rounding) if self.rounding > torch.finfo(u.dtype).eps else u

    def project(self, u: Control) -> Control:
        """u, or r u/‖u‖ rounded inwards."""
        return self._inwards(u, torch.finfo(u.dtype).eps)

    def _inwards(self, u: Control, unit: float) -> Control:
        """The projection with a given unit of rounding."""
        rounding = INWARDS * unit
        within = self.radius * (1 - rounding)
        if u.shape[-1] == 1:
            return u.clamp(-within, within)
        largest = u.detach().abs().amax(-1, keepdim=True).clamp_min(torch.finfo(u.dtype).tiny)  # squares may overflow
        size = largest * norm(u / largest)[..., None]
        return torch.where(size > self.radius * (1 - rounding / 2), u * (within / torch.where(size > 0, size, 1.0)), u)

    def extra_repr(self) -> str:
        return f"radius={float(self.radius):g}"


def minimise_in_ball(R: ControlMatrix, b: Control, radius: Tensor | None, weight: Tensor | None = None) -> Control:
    """argmin over ‖u‖ ≤ r of uᵀRu + bᵀu + w‖u‖, (*batch, m), in double precision.

    At the minimum (2R + λ)u = −b: λ = w/‖u‖, or a larger λ with which ‖u‖ = r; u = 0 if ‖b‖ ≤ w. 1/‖u‖ is concave in
    λ, so that Newton's method finds both λ from one side. The result may leave the ball by rounding.

    Args:
        R: (*batch, m, m), symmetric positive definite.
        b: (*batch, m).
        radius: r, (); None: no limit.
        weight: w ≥ 0, (); None: 0.

    Source: Moré, Sorensen, "Computing a trust region step", SIAM Journal on Scientific and Statistical Computing 1983.
    """
    given, R, b = b, R.double(), b.double()
    size, largest = norm(b), 2 * R.abs().sum(-1).amax(-1)  # ‖b‖; a bound of the largest eigenvalue of 2R
    moves = size > (0.0 if weight is None else weight)
    b, size = torch.where(moves[..., None], b, 1.0), torch.where(moves, size, 1.0)
    multiplier = torch.zeros_like(size)
    if weight is not None:
        w = weight.to(b)
        start = w * largest / (size - w).clamp_min(TINY * size)
        multiplier = _multiplier(R, b, 0.0, 1 / w.clamp_min(TINY), start)
    if radius is not None:
        r = radius.to(b)
        multiplier = multiplier.maximum(_multiplier(R, b, 1 / r, 0.0, (size / r - largest).clamp_min(0)))
    u = -_shifted(R, b, multiplier)[0]
    return torch.where(moves[..., None], u, 0.0).to(given)


def _multiplier(R: ControlMatrix, b: Control, offset: Tensor | float, rise: Tensor | float, start: Tensor) -> Tensor:
    """The λ ≥ 0 at which 1/‖(2R + λ)⁻¹b‖ = offset + rise · λ; its derivative is that of the last Newton step."""
    with torch.no_grad():
        multiplier = start
        for _ in range(NEWTON_STEPS):
            multiplier = _newton_step(R, b, offset, rise, multiplier)
    if not torch.is_grad_enabled():
        return multiplier
    return _newton_step(R, b, offset, rise, multiplier)


def _newton_step(
    R: ControlMatrix, b: Control, offset: Tensor | float, rise: Tensor | float, multiplier: Tensor
) -> Tensor:
    v, inverse = _shifted(R, b, multiplier)
    size = norm(v)
    slope = ((v * apply(inverse, v)).sum(-1) / size**3 - rise).detach()
    return (multiplier - (1 / size - offset - rise * multiplier) / slope).clamp_min(0)


def _shifted(R: ControlMatrix, b: Control, multiplier: Tensor) -> tuple[Control, ControlMatrix]:
    """(2R + λ)⁻¹b, and the inverse."""
    one = torch.eye(b.shape[-1]).to(b)
    A = 2 * R + multiplier[..., None, None] * one
    inverse = solve(A, one.expand(A.shape))
    return apply(inverse, b), inverse


def positive_number(name: str, number: float) -> float:
    """A positive number as a float.

    Raises:
        ValueError: it is no number between LEAST_NUMBER and its inverse.
    """
    if type(number) not in (int, float) or not LEAST_NUMBER <= number <= 1 / LEAST_NUMBER:
        raise ValueError(f"Expected {name} > 0, got {number!r}; correct it.")
    return float(number)

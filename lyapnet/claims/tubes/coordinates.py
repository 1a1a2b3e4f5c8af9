"""Moving coordinates along closed loops: bounds in other coordinates, and bounds of how far coordinates turn."""

from typing import NamedTuple

import torch
from torch import Tensor

from lyapnet.base.types import State
from lyapnet.prover.taylor import EPSILON

ROOM = 1 + 1e-12  # factor for the rounding of a sum of a few dozen numbers ≥ 0


class Moving(NamedTuple):
    """Coordinates x = p + Φ(τ)z over one step: Φ = middle + τ · slope + τ² · bend, (cells, n, n) each."""

    middle: Tensor
    slope: Tensor
    bend: Tensor

    def at(self, tau: int) -> Tensor:
        """Φ(±1), up to rounding."""
        return self.middle + tau * self.slope + self.bend

    @property
    def size(self) -> Tensor:
        """|middle| + |slope| + |bend|, an upper bound of |Φ(τ)|."""
        return self.middle.abs() + self.slope.abs() + self.bend.abs()

    def __getitem__(self, chosen: Tensor) -> "Moving":  # pyright: ignore[reportIncompatibleMethodOverride]
        return Moving(*(part[chosen] for part in tuple(self)))


def bound_in_new_frame(
    before: Tensor, size: Tensor, after: Tensor, size_after: Tensor, jump: Tensor, r: State
) -> State:
    """A bound of |z'| where Az + j = Bz', |z| ≤ r and |j| ≤ jump, (cells, n).

    With Y ≈ B⁻¹, |Y(Az + j)| ≤ v = |YA|r + |Y| jump. Since B⁻¹ = (YB)⁻¹Y, |z'| ≤ v + ν/(1 − ν) max v, where ν is the
    largest row sum of |YB − 1|. Rounding is added.

    Args:
        before, after: A and B, computed in floating point.
        size, size_after: sums of the absolute values of A's and B's summands, for their rounding errors.
    """
    Y, n = near_inverse(after), r.shape[-1]
    into = (Y @ before).abs() + 4 * (n + 4) * EPSILON * (Y.abs() @ size)
    v = ((into @ r[..., None] + Y.abs() @ jump[..., None])[..., 0]) * ROOM
    return (v + ratio_of_errors(_inverse_error(Y, after, size_after)) * v.amax(-1, keepdim=True)) * ROOM


def bound_turn(frame: Moving) -> tuple[Tensor, Tensor]:
    """(Y, E), (cells, n, n) each: Y ≈ Φ(0)⁻¹ in the middle of a step, and |YΦ(τ) − 1| ≤ E for every τ of the step."""
    Y = near_inverse(frame.middle)
    n = Y.shape[-1]
    moved = (Y @ frame.slope).abs() + (Y @ frame.bend).abs() + 4 * (n + 4) * EPSILON * (Y.abs() @ frame.size)
    return Y, (moved + _inverse_error(Y, frame.middle, frame.size)) * ROOM


def near_inverse(A: Tensor) -> Tensor:
    """A⁻¹ up to rounding, (*batch, n, n); arbitrary numbers for a matrix that is singular or not finite.

    Proofs hold for any result: cells with arbitrary numbers are not proved.
    """
    return torch.linalg.inv_ex(A).inverse


def ratio_of_errors(E: Tensor) -> Tensor:
    """ν/(1 − ν) for the largest row sum ν of E, (cells, 1); ∞ if ν ≥ 1."""
    nu = E.sum(-1).amax(-1, keepdim=True) * ROOM
    return torch.where(nu < 1, nu / (1 - nu) * ROOM, torch.inf)


def _inverse_error(Y: Tensor, B: Tensor, size: Tensor) -> Tensor:
    """A bound of |YB − 1| with rounding, (cells, n, n)."""
    n = B.shape[-1]
    return (Y @ B - torch.eye(n, dtype=B.dtype)).abs() + 4 * (n + 4) * EPSILON * (Y.abs() @ size)

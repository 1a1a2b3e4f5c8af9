"""Coordinates that move with closed loops: what a change of them, and their turning, does to bounds."""

from typing import NamedTuple

import torch
from torch import Tensor

from lyapnet.base.types import State
from lyapnet.prover.taylor import EPSILON

ROOM = 1 + 1e-12  # for the rounding of sums of numbers ≥ 0, of a few dozen terms each


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
        """Σ of the parts' absolute values, at least |Φ|."""
        return self.middle.abs() + self.slope.abs() + self.bend.abs()

    def __getitem__(self, chosen: Tensor) -> "Moving":  # pyright: ignore[reportIncompatibleMethodOverride]
        return Moving(*(part[chosen] for part in tuple(self)))


def rotated(before: Tensor, size: Tensor, after: Tensor, size_after: Tensor, jump: Tensor, r: State) -> State:
    """A bound of |z'| where Az + j = Bz', |z| ≤ r, |j| ≤ jump, (cells, n): with Y near B⁻¹, |YA|r + |Y|j, and more.

    B⁻¹ = (YB)⁻¹Y, and |(YB)⁻¹v| ≤ |v| + ν/(1 − ν) max |v| where ν = ‖YB − 1‖ in the greatest row sum.

    Args:
        before, after: A and B as floating point has them …
        size, size_after: … with bounds of the numbers that they are sums of.
    """
    Y, n = near_inverse(after), r.shape[-1]
    into = (Y @ before).abs() + 4 * (n + 4) * EPSILON * (Y.abs() @ size)
    v = ((into @ r[..., None] + Y.abs() @ jump[..., None])[..., 0]) * ROOM
    return (v + ratio_of(_off(Y, after, size_after)) * v.amax(-1, keepdim=True)) * ROOM


def turning(frame: Moving) -> tuple[Tensor, Tensor]:
    """(Y, E): Y near the inverse of Φ in the middle of a step, and |YΦ(τ) − 1| ≤ E at every τ; (cells, n, n) each."""
    Y = near_inverse(frame.middle)
    n = Y.shape[-1]
    moved = (Y @ frame.slope).abs() + (Y @ frame.bend).abs() + 4 * (n + 4) * EPSILON * (Y.abs() @ frame.size)
    return Y, (moved + _off(Y, frame.middle, frame.size)) * ROOM


def near_inverse(A: Tensor) -> Tensor:
    """A⁻¹ up to rounding, (*batch, n, n); of a matrix that has none, or is not finite, numbers that are of no use.

    What is proved with it holds for any numbers: a cell whose matrix has no inverse is not proved, the others are.
    """
    return torch.linalg.inv_ex(A).inverse


def ratio_of(E: Tensor) -> Tensor:
    """ν/(1 − ν) of the greatest row sum ν of E, (cells, 1); infinite where ν ≥ 1."""
    nu = E.sum(-1).amax(-1, keepdim=True) * ROOM
    return torch.where(nu < 1, nu / (1 - nu) * ROOM, torch.inf)


def _off(Y: Tensor, B: Tensor, size: Tensor) -> Tensor:
    """A bound of |YB − 1|, (cells, n, n)."""
    n = B.shape[-1]
    return (Y @ B - torch.eye(n, dtype=B.dtype)).abs() + 4 * (n + 4) * EPSILON * (Y.abs() @ size)

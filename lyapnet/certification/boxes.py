"""Boxes of points (t, x): many at once, sorted, cut in two."""

from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from lyapnet.types import Corner, Corners, PerBox


class Boxes(NamedTuple):
    """Boxes of (t, x), 1 + n axes each, time first, and a number for each by which they are sorted."""

    lower: Corners
    upper: Corners
    key: PerBox

    def __getitem__(self, chosen: Tensor) -> "Boxes":  # pyright: ignore[reportIncompatibleMethodOverride]
        return Boxes(*(y[chosen] for y in tuple(self)))

    def joined(self, other: "Boxes") -> "Boxes":
        """Both."""
        return Boxes(*(torch.cat(pair) for pair in zip(self, other, strict=True)))

    @property
    def center(self) -> Corners:
        """The middle of each."""
        return (self.lower + self.upper) / 2

    def first(self, count: int) -> tuple["Boxes", "Boxes"]:
        """(those of smallest key, the others)."""
        if len(self.key) <= count:
            return self, self[torch.zeros(len(self.key), dtype=torch.bool)]
        chosen = torch.zeros(len(self.key), dtype=torch.bool)
        chosen[self.key.topk(count, largest=False).indices] = True
        return self[chosen], self[~chosen]

    def split(self, size: int) -> list["Boxes"]:
        """The boxes in groups of this size, the last perhaps smaller."""
        return [Boxes(*group) for group in zip(*(y.split(size) for y in self), strict=True)]

    @property
    def least(self) -> float:
        """The smallest key; ∞ where there are no boxes."""
        return float(self.key.min()) if len(self.key) else float("inf")

    def volumes(self, lower: Corner, upper: Corner) -> PerBox:
        """The share of each in the box (lower, upper); axes without width do not count."""
        sides = torch.where(upper > lower, upper - lower, 1.0)
        return torch.where(upper > lower, (self.upper - self.lower) / sides, 1.0).prod(-1)

    def halves(self, axis: Tensor) -> "Boxes":
        """Each box cut in two in the middle of an axis of its own."""
        cut = torch.nn.functional.one_hot(axis, self.lower.shape[-1]).bool()
        lower, upper = torch.where(cut, self.center, self.lower), torch.where(cut, self.center, self.upper)
        return Boxes(self.lower, upper, self.key).joined(Boxes(lower, self.upper, self.key))


def single(lower: Corner, upper: Corner, key: float = float("-inf")) -> Boxes:
    """One box."""
    return Boxes(lower[None], upper[None], lower.new_full((1,), key))


def faces(lower: Corner, upper: Corner, axes: Iterable[int]) -> tuple[Corners, Corners]:
    """The faces of a box perpendicular to some of its axes, as 2 · axes boxes without width there."""
    low, high = [], []
    for axis in axes:
        for side in (lower, upper):
            at = torch.arange(len(lower)) == axis
            low.append(torch.where(at, side, lower))
            high.append(torch.where(at, side, upper))
    return torch.stack(low), torch.stack(high)

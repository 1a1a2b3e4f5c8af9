"""Boxes of points (t, x): many at once, sorted, cut in two."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Integer
from torch import Tensor

from lyapnet.base.types import Corner, Corners, PerBox


class Boxes(NamedTuple):
    """Boxes of (t, x), 1 + n axes each, time first, with a number for each by which they are sorted, and a name."""

    lower: Corners
    upper: Corners
    key: PerBox
    node: Integer[Tensor, "boxes"]  # of the CutTree that it comes from

    def __getitem__(self, chosen: Tensor) -> "Boxes":  # pyright: ignore[reportIncompatibleMethodOverride]
        return Boxes(*(y[chosen] for y in tuple(self)))

    def joined(self, other: "Boxes") -> "Boxes":
        """Both."""
        return Boxes(*(torch.cat(pair) for pair in zip(self, other, strict=True)))

    def to(self, device: torch.device) -> "Boxes":
        """The boxes on a device."""
        return Boxes(*(part.to(device) for part in self))

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

    def share(self, lower: Corner, upper: Corner) -> float:
        """That of all of them in the box (lower, upper)."""
        return float(self.volumes(lower, upper).sum())

    def halves(self, axis: Tensor, cuts: Tensor | None = None) -> "Boxes":
        """Each box cut in two in the middle of an axis of its own, by cuts of these numbers in a CutTree."""
        cut = torch.nn.functional.one_hot(axis, self.lower.shape[-1]).bool()
        lower, upper = torch.where(cut, self.center, self.lower), torch.where(cut, self.center, self.upper)
        first = self.node if cuts is None else 1 + 2 * cuts
        return Boxes(self.lower, upper, self.key, first).joined(Boxes(lower, self.upper, self.key, first + 1))


def roots(lower: Corners, upper: Corners, key: float = float("-inf")) -> Boxes:
    """Boxes that no cut made."""
    return Boxes(lower, upper, lower.new_full((len(lower),), key), torch.zeros(len(lower), dtype=torch.long))


def single(lower: Corner, upper: Corner, key: float = float("-inf")) -> Boxes:
    """One box."""
    return roots(lower[None], upper[None], key)


def pieces(lower: Corner, upper: Corner, axes: Sequence[int], count: int = 64) -> tuple[Corners, Corners]:
    """A box in about so many alike, cut across some of its axes: those that have a width."""
    lower, upper, wide = lower[None], upper[None], [axis for axis in axes if upper[axis] > lower[axis]]
    each = max(1, round(count ** (1 / max(1, len(wide)))))
    for axis in wide:
        ends = torch.linspace(float(lower[0, axis]), float(upper[0, axis]), each + 1, dtype=lower.dtype)
        lower, upper = (side.repeat_interleave(each, 0) for side in (lower, upper))
        lower[:, axis], upper[:, axis] = ends[:-1].repeat(len(lower) // each), ends[1:].repeat(len(upper) // each)
    return lower, upper


DEEPEST = 2000  # cuts in a row that a proof may have; after 53 along an axis a box is as thin as rounding


class CutTree:
    """How one box was cut in two, again and again: cut k parts node n_k in the middle of axis a_k.

    Node 0 is the box, 1 + 2k and 2 + 2k are the halves that cut k makes. Whatever the cuts are, the nodes that none of
    them parts, the leaves, cover the box exactly: two halves share the very number at which they meet.
    """

    def __init__(self, node: Tensor | None = None, axis: Tensor | None = None):
        self._cuts = [] if node is None or axis is None else [(node.long(), axis.long())]
        self.size = 0 if node is None else len(node)

    def cut(self, boxes: Boxes, axis: Tensor) -> Boxes:
        """The halves of boxes, recorded."""
        numbers = torch.arange(self.size, self.size + len(axis))
        self._cuts.append((boxes.node, axis.byte()))
        self.size += len(axis)
        return boxes.halves(axis, numbers)

    @property
    def cuts(self) -> tuple[Integer[Tensor, "cuts"], Integer[Tensor, "cuts"]]:
        """(n_k, a_k) of each cut k."""
        empty = (torch.zeros(0, dtype=torch.long), torch.zeros(0, dtype=torch.uint8))
        nodes, axes = zip(empty, *self._cuts, strict=True)
        return torch.cat(nodes), torch.cat(axes)

    def leaves(self, lower: Corner, upper: Corner) -> Boxes:
        """The leaves of the tree of this box, in any order.

        Raises:
            ValueError: it is no tree of cuts.
        """
        node, axis = self.cuts
        number = torch.full((2 * self.size + 1,), -1)
        number[node] = torch.arange(self.size)
        level, found = single(lower, upper), []
        while len(level.key) and len(found) <= DEEPEST:
            cut = number[level.node]
            found.append(level[cut < 0])
            level = level[cut >= 0].halves(axis[cut[cut >= 0]].long(), cut[cut >= 0])
        leaves = Boxes(*(torch.cat(parts) for parts in zip(*found, strict=True)))
        if len(leaves.key) != self.size + 1:  # a node cut twice, one that no cut makes, or too many in a row
            raise ValueError("Expected cuts that part a box and its halves, got others.")
        return leaves


def faces(lower: Corner, upper: Corner, axes: Iterable[int]) -> tuple[Corners, Corners]:
    """The faces of a box perpendicular to some of its axes, as 2 · axes boxes without width there."""
    low, high = [], []
    for axis in axes:
        for side in (lower, upper):
            at = torch.arange(len(lower)) == axis
            low.append(torch.where(at, side, lower))
            high.append(torch.where(at, side, upper))
    return torch.stack(low), torch.stack(high)

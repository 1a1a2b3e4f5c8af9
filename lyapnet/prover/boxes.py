"""Batches of boxes of points (t, x), and the tree of cuts that made them."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Integer
from torch import Tensor

from lyapnet.base.types import Corner, Corners, PerBox


class Boxes(NamedTuple):
    """Boxes of (t, x), time first: their corners, the keys by which the search sorts them, their nodes in a CutTree."""

    lower: Corners  # (boxes, 1 + n)
    upper: Corners
    key: PerBox  # boxes of lowest key are bounded first
    node: Integer[Tensor, "boxes"]  # number of the node of a CutTree

    def __getitem__(self, chosen: Tensor) -> "Boxes":  # pyright: ignore[reportIncompatibleMethodOverride]
        return Boxes(*(y[chosen] for y in tuple(self)))

    def joined(self, other: "Boxes") -> "Boxes":
        """These boxes followed by the others."""
        return Boxes(*(torch.cat(pair) for pair in zip(self, other, strict=True)))

    def to(self, device: torch.device) -> "Boxes":
        """Copy the boxes to a device."""
        return Boxes(*(part.to(device) for part in self))

    @property
    def center(self) -> Corners:
        """The middle of each box."""
        return (self.lower + self.upper) / 2

    def first(self, count: int) -> tuple["Boxes", "Boxes"]:
        """(the `count` boxes of lowest key, the others)."""
        if len(self.key) <= count:
            return self, self[torch.zeros(len(self.key), dtype=torch.bool)]
        chosen = torch.zeros(len(self.key), dtype=torch.bool)
        chosen[self.key.topk(count, largest=False).indices] = True
        return self[chosen], self[~chosen]

    def split(self, size: int) -> list["Boxes"]:
        """The boxes in groups of this size; the last may be smaller."""
        return [Boxes(*group) for group in zip(*(y.split(size) for y in self), strict=True)]

    @property
    def least(self) -> float:
        """The lowest key; ∞ if there are no boxes."""
        return float(self.key.min()) if len(self.key) else float("inf")

    def volumes(self, lower: Corner, upper: Corner) -> PerBox:
        """The volume of each box as a share of the box (lower, upper); axes of width 0 do not count."""
        sides = torch.where(upper > lower, upper - lower, 1.0)
        return torch.where(upper > lower, (self.upper - self.lower) / sides, 1.0).prod(-1)

    def share(self, lower: Corner, upper: Corner) -> float:
        """The volume of all boxes together as a share of the box (lower, upper)."""
        return float(self.volumes(lower, upper).sum())

    def halves(self, axis: Tensor, cuts: Tensor | None = None) -> "Boxes":
        """Cut each box in two, in the middle of one axis: first the lower halves, then the upper ones.

        Args:
            axis: the axis across which each box is cut, (boxes,).
            cuts: the number k of each cut in a CutTree: the halves are its nodes 1 + 2k and 2 + 2k.
        """
        cut = torch.nn.functional.one_hot(axis, self.lower.shape[-1]).bool()
        lower, upper = torch.where(cut, self.center, self.lower), torch.where(cut, self.center, self.upper)
        first = self.node if cuts is None else 1 + 2 * cuts
        return Boxes(self.lower, upper, self.key, first).joined(Boxes(lower, self.upper, self.key, first + 1))


def root_boxes(lower: Corners, upper: Corners, key: float = float("-inf")) -> Boxes:
    """Boxes that are no halves of others, with node 0 and the same key."""
    return Boxes(lower, upper, lower.new_full((len(lower),), key), torch.zeros(len(lower), dtype=torch.long))


def root_box(lower: Corner, upper: Corner, key: float = float("-inf")) -> Boxes:
    """One box, the root of a CutTree."""
    return root_boxes(lower[None], upper[None], key)


def divide_box(lower: Corner, upper: Corner, axes: Sequence[int], count: int = 64) -> tuple[Corners, Corners]:
    """(lower, upper) corners of about `count` equal boxes into which cuts across the given axes divide a box.

    Axes along which the box has no width are not cut.
    """
    lower, upper, wide = lower[None], upper[None], [axis for axis in axes if upper[axis] > lower[axis]]
    each = max(1, round(count ** (1 / max(1, len(wide)))))
    for axis in wide:
        ends = torch.linspace(float(lower[0, axis]), float(upper[0, axis]), each + 1, dtype=lower.dtype)
        lower, upper = (side.repeat_interleave(each, 0) for side in (lower, upper))
        lower[:, axis], upper[:, axis] = ends[:-1].repeat(len(lower) // each), ends[1:].repeat(len(upper) // each)
    return lower, upper


DEEPEST = 2000  # largest depth of a CutTree that is read; 53 cuts across one axis reach the rounding of float64


class CutTree:
    """A binary tree of boxes: cut k divides node n_k in the middle of axis a_k.

    Node 0 is the whole box; nodes 1 + 2k and 2 + 2k are the lower and upper half that cut k makes. Leaves are the nodes
    that no cut divides. They cover the whole box without gaps, as both halves have the same float64 number as their
    common side.
    """

    def __init__(self, node: Tensor | None = None, axis: Tensor | None = None):
        self._cuts = [] if node is None or axis is None else [(node.long(), axis.long())]
        self.size = 0 if node is None else len(node)

    def cut(self, boxes: Boxes, axis: Tensor) -> Boxes:
        """Cut boxes in two, and record the cuts."""
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
        """The leaves, in any order, if node 0 is the box (lower, upper).

        Raises:
            ValueError: the recorded cuts are no tree, or the tree is deeper than DEEPEST.
        """
        node, axis = self.cuts
        number = torch.full((2 * self.size + 1,), -1)
        number[node] = torch.arange(self.size)
        level, found = root_box(lower, upper), []
        while len(level.key) and len(found) <= DEEPEST:
            cut = number[level.node]
            found.append(level[cut < 0])
            level = level[cut >= 0].halves(axis[cut[cut >= 0]].long(), cut[cut >= 0])
        leaves = Boxes(*(torch.cat(parts) for parts in zip(*found, strict=True)))
        if len(leaves.key) != self.size + 1:  # a node is cut twice or does not exist, or the tree is too deep
            raise ValueError("Expected cuts of a box and its halves, got others.")
        return leaves


def faces(lower: Corner, upper: Corner, axes: Iterable[int]) -> tuple[Corners, Corners]:
    """(lower, upper) corners of the faces of a box perpendicular to the given axes, two for each axis, of width 0."""
    low, high = [], []
    for axis in axes:
        for side in (lower, upper):
            at = torch.arange(len(lower)) == axis
            low.append(torch.where(at, side, lower))
            high.append(torch.where(at, side, upper))
    return torch.stack(low), torch.stack(high)


def random_points(lower: Corner, upper: Corner, count: int, generator: torch.Generator | None = None) -> Corners:
    """Points drawn uniformly from a box, (count, axes)."""
    return lower + (upper - lower) * torch.rand(count, len(lower), generator=generator, dtype=torch.float64).to(lower)

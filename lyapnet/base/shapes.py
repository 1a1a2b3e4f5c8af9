"""Shapes in a plane, in metres, with which systems draw themselves in animations."""

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

Point: TypeAlias = Sequence[Any] | np.ndarray  # (2,)
Points: TypeAlias = Sequence[Any] | np.ndarray  # (k, 2), or k pairs


class Line(NamedTuple):
    """A line through points (k, 2): a rod, a rope, the ground.

    Args:
        width: in typographic points, independent of the scale.
        faint: whether it is background, drawn in grey.
    """

    points: Points
    width: float = 3.0
    faint: bool = False


class Disk(NamedTuple):
    """A filled disk around a centre (2,)."""

    center: Point
    radius: float


class Polygon(NamedTuple):
    """A filled polygon with corners (k, 2)."""

    points: Points


class Arrow(NamedTuple):
    """An arrow from (2,) to (2,): a force, a thrust."""

    tail: Point
    head: Point


Shape: TypeAlias = Line | Disk | Polygon | Arrow


def rectangle(center: Point, width: float, height: float, angle: float = 0.0) -> Polygon:
    """A filled rectangle, turned about its centre by an angle in rad, counterclockwise."""
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * (width / 2, height / 2)
    c, s = np.cos(angle), np.sin(angle)
    return Polygon(np.asarray(center) + corners @ [[c, s], [-s, c]])


def chain(lengths: Sequence[float], angles: Sequence[float] | np.ndarray) -> np.ndarray:
    """The joints (k + 1, 2) of a chain of links from the origin, at absolute angles in rad, counterclockwise from →."""
    links = [(length * np.cos(angle), length * np.sin(angle)) for length, angle in zip(lengths, angles, strict=True)]
    return np.cumsum([(0.0, 0.0), *links], 0)


def oblique(points: Points) -> np.ndarray:
    """Oblique projection of points (*batch, 3) to the plane: x to the right, z up, y at 30° and half its length."""
    x, y, z = np.moveaxis(np.asarray(points, dtype=float), -1, 0)
    return np.stack([x + 0.5 * y * np.cos(np.pi / 6), z + 0.5 * y * np.sin(np.pi / 6)], -1)


def corners_of(shape: Shape) -> np.ndarray:
    """Points (k, 2) whose bounding box contains a shape."""
    match shape:
        case Disk(center, radius):
            return np.asarray(center, dtype=float) + radius * np.array([(-1, -1), (1, 1)])
        case Arrow(tail, head):
            return np.asarray([tail, head], dtype=float)
        case _:
            return np.asarray(shape.points, dtype=float).reshape(-1, 2)

"""The width of enclosures relative to the range, its order of convergence, and boxes per second."""

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from lyapnet.base.types import Value
from lyapnet.lab.bench.conditions import Bounded
from lyapnet.lab.bench.enclosures import Enclosure, Sides
from lyapnet.lab.bench.routes import timed

SIDES = (0.5, 0.2, 0.1, 0.05, 0.02, 0.01)
SMALLEST = 3  # number of sides, the smallest, from which an order is computed
AT_ONCE = 512  # number of boxes in a timed call, as in the certifier
SAMPLES, STEPS = 256, 20  # numbers of random points and of ascent steps in the search for a range


@dataclass(frozen=True)
class Tightness:
    """One enclosure of one condition, a row of `lyapnet bench certify --json`."""

    case: str
    enclosure: str
    sides: list[float]  # sides of the boxes, as shares of the axes
    factors: list[float]  # median over boxes of (width of the enclosure) / (width of the range), for each side
    excesses: list[float]  # median of the difference of these widths, in cost per second
    order: float  # p of excess ∝ sideᵖ, over the smallest sides
    boxes_per_second: float  # median, 512 at once


def tightness(
    case: Bounded,
    enclosures: dict[str, Enclosure],
    boxes: int = 200,
    repeats: int = 7,
    sides: Sequence[float] = SIDES,
) -> list[Tightness]:
    """A row for each enclosure, on the same random boxes within that of the case, timed in turns."""
    per_side = [random_boxes(case, side, boxes) for side in sides]
    ranges = [range_widths(case.condition, *pair) for pair in per_side]
    many = random_boxes(case, min(sides), AT_ONCE)
    turns = [{name: timed(partial(enclose, *many))[1] for name, enclose in enclosures.items()} for _ in range(repeats)]
    rows = []
    for name, enclose in enclosures.items():
        widths = [_width(enclose(*pair)) for pair in per_side]
        factors = [_median(width / true) for width, true in zip(widths, ranges, strict=True)]
        excesses = [_median(width - true) for width, true in zip(widths, ranges, strict=True)]
        rate = AT_ONCE / statistics.median(turn[name] for turn in turns)
        rows.append(Tightness(case.name, name, [*sides], factors, excesses, order(sides, excesses), rate))
    return rows


def order(sides: Sequence[float], excesses: Sequence[float]) -> float:
    """The slope of log excess against log side, by least squares over the smallest sides."""
    pairs = sorted(zip(sides, excesses, strict=True))[:SMALLEST]
    if len(pairs) < 2 or not all(0 < excess < math.inf for _, excess in pairs):
        return math.nan
    return statistics.linear_regression(*zip(*((math.log(s), math.log(e)) for s, e in pairs), strict=True)).slope


def random_boxes(case: Bounded, side: float, boxes: int) -> Sides:
    """Random boxes within that of the case, with `side` times its sides, the same at each call."""
    generator = torch.Generator().manual_seed(0)
    unit = torch.rand(boxes, len(case.lower), generator=generator, dtype=torch.float64)
    widths = case.upper - case.lower
    lower = case.lower + (1 - side) * unit * widths
    return lower, lower + side * widths


def range_widths(c: Value, lower: Tensor, upper: Tensor) -> Tensor:
    """A lower bound of max c − min c over each box, (boxes,): from corners, samples, and ascent from the best."""
    d = lower.shape[-1]
    corners = torch.cartesian_prod(*[torch.tensor([0.0, 1.0], dtype=torch.float64)] * d).reshape(-1, d)
    generator = torch.Generator().manual_seed(1)
    unit = torch.cat([corners, torch.rand(SAMPLES, d, generator=generator, dtype=torch.float64)])
    points = lower[:, None] + (upper - lower)[:, None] * unit
    with torch.no_grad():
        values = c(points[..., 0], points[..., 1:])
    return sum((_climbed(c, lower, upper, points, sign * values, sign) for sign in (1.0, -1.0)), torch.zeros(()))


def _climbed(c: Value, lower: Tensor, upper: Tensor, points: Tensor, values: Tensor, sign: float) -> Tensor:
    """The max of sign · c found in each box, by shrinking steps along the gradient's signs from the 4 best points."""
    low, high, widths = lower[:, None], upper[:, None], (upper - lower)[:, None]
    best, at = values.topk(4, 1)
    points = points.gather(1, at[..., None].expand(-1, -1, points.shape[-1]))
    for step in range(STEPS):
        leaf = points.detach().requires_grad_()
        (slope,) = torch.autograd.grad(c(leaf[..., 0], leaf[..., 1:]).sum(), leaf)
        moved = (points + sign * 0.3 * 0.7**step * widths * slope.sign()).clamp(low, high)
        with torch.no_grad():
            reached = sign * c(moved[..., 0], moved[..., 1:])
        points, best = torch.where((reached > best)[..., None], moved, points), torch.maximum(reached, best)
    return best.amax(1)


def _width(sides: Sides) -> Tensor:
    return sides[1] - sides[0]


def _median(values: Tensor) -> float:
    return float(values.median())

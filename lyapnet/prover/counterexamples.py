"""Counterexamples: points (t, x) at which a condition fails, found by sampling and gradient ascent."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from lyapnet.base.types import Corner, PerState, Points
from lyapnet.prover.bounded_readings import BoundedReadings
from lyapnet.prover.bounds import BoundedFunction, Bounds
from lyapnet.prover.boxes import random_points
from lyapnet.prover.condition import DecreaseCondition

SAMPLES = 20_000  # random points of the domain
STARTS = 64  # samples of greatest c at which gradient ascent starts
STEPS = 40  # of an ascent
FIRST_STEP, STEP_RATIO = 0.05, 0.9  # length as a share of the domain's width, which falls to 1/1000; ratio of lengths
CONFIRMED = 256  # largest number of points at which bounds confirm that the condition fails


class Counterexample(NamedTuple):
    """A point at which the condition fails: c is positive there, and so is a lower bound of c or of Ẇ.

    Where u is held, it is read at (t, x), and the condition fails on a closed loop `after` seconds later.
    """

    t: float
    x: list[float]
    condition: float  # c(t, x) > 0
    height: float  # W(t, x) = V(t, x) − δt
    after: float = 0.0  # s since the reading; 0 where u is read at every t


def find_counterexample(
    condition: DecreaseCondition,
    bounded: Bounds,
    lower: Corner,
    upper: Corner,
    level: float,
    generator: torch.Generator | None = None,
) -> Counterexample | None:
    """The point of lowest W with c > 0 and W ≤ level among samples and points of gradient ascent from the worst ones.

    Args:
        bounded: (c, W, Ẇ) with bounds, which confirm the point.
    """
    points = _likely_violations(condition, lower, upper, level, generator)
    return lowest_violation(condition, bounded, points, level)


def lowest_violation(
    condition: DecreaseCondition, bounded: Bounds, points: Points, level: float
) -> Counterexample | None:
    """The point of lowest W with c > 0 and W ≤ level among given ones, or None; a lower bound of c or Ẇ is positive."""
    c, W = _values(condition, points)
    candidates = torch.nonzero((c > 0) & (level >= W)).flatten()
    candidates = candidates[W[candidates].argsort()][:CONFIRMED]
    if not len(candidates):
        return None
    c_low, rise_low = _lower_bounds(condition, bounded, points[candidates])
    candidates = candidates[torch.maximum(c_low, rise_low) > 0]
    if not len(candidates):
        return None
    first = candidates[0]
    t, x, after = condition.parts_of_point(points[first])
    return Counterexample(t, x, float(c[first]), float(W[first]), after)


def violations(
    condition: DecreaseCondition,
    domain: tuple[Corner, Corner],
    level: float,
    count: int,
    generator: torch.Generator | None = None,
) -> Points:
    """The points (t, x) of greatest c, at most `count`, with c > 0 and W ≤ level; not confirmed by bounds.

    Where u is held, they are points at which u is read, and c > 0 some time later.
    """
    points = _likely_violations(condition, *condition.search_box(domain), level, generator)
    c, W = _values(condition, points)
    worst = torch.where(level >= W, c, -torch.inf).topk(min(count, len(points)))
    return points[worst.indices[worst.values > 0], : 1 + condition.n]


def _likely_violations(
    condition: DecreaseCondition,
    lower: Corner,
    upper: Corner,
    level: float,
    generator: torch.Generator | None,
) -> Points:
    """Samples of the box, and all points of gradient ascent from the samples with W ≤ level of greatest c."""
    points = random_points(lower, upper, SAMPLES, generator)
    c, W = _values(condition, points)
    start = points[torch.where(level >= W, c, -torch.inf).topk(STARTS).indices]
    return torch.cat([points, _ascend(condition, start, lower, upper)])


def _ascend(condition: DecreaseCondition, points: Points, lower: Corner, upper: Corner) -> Float[Tensor, "passed axes"]:
    """All points of paths on which c rises: steps of decreasing length along the signs of the gradient of c."""
    path = [points]
    for step in range(STEPS):
        with torch.enable_grad():
            leaf = path[-1].detach().requires_grad_()
            c = condition.values(leaf)[0].sum()
            (slope,) = torch.autograd.grad(c, leaf, materialize_grads=True)
        length = FIRST_STEP * STEP_RATIO**step * (upper - lower)
        path.append((path[-1] + length * slope.sign().nan_to_num()).clamp(lower, upper))
    return torch.cat(path)


def _values(condition: DecreaseCondition, points: Points) -> tuple[PerState, PerState]:
    """(c, W); c is −∞ at states that a constraint excludes, so that they are no counterexamples."""
    with torch.no_grad():
        return condition.values(points)


def _lower_bounds(condition: DecreaseCondition, bounded: Bounds, points: Points) -> tuple[PerState, PerState]:
    """Lower bounds of c and Ẇ at points."""
    if isinstance(bounded, BoundedReadings):
        with torch.no_grad():
            run = condition.after_reading(bounded.readings, points)[1]
        (c_low, _), _, (rise_low, _), *_ = bounded.at(points, run)
    else:
        assert isinstance(bounded, BoundedFunction)
        (c_low, _), _, (rise_low, _), *_ = bounded.bounds(points, points)
    return c_low, rise_low

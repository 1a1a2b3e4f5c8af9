"""Closed forms of u = argmin and h = min over u ∈ U of uᵀWu + bᵀu + s(u), for a diagonal W that does not depend on x.

They are u that is piecewise linear in b, for Σ wᵢ|uᵢ| and limits, and a ball with W a multiple of the identity. Machine
code and the interpreter compute them by the same operations, so that their bounds agree.
"""

import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from lyapnet.task.ball import ControlBall
from lyapnet.task.cost.control_costs import AbsoluteCost
from lyapnet.task.cost.minimum import Known

# how exact u and h of the law are: more than FORWARD and BACKWARD of lyapnet.prover.minima add up to
OF_U, OF_H = 1e-8, 2e-9  # of (|b| + w)/r; and of (b² + w²)/r
TIED = 512 * torch.finfo(torch.float64).eps  # of the cost: the law takes minima in orthants that are as cheap for equal


@runtime_checkable
class Arithmetic(Protocol):
    """Operations on forms of single numbers, as a Program of machine code has them."""

    def combine(self, summands: Any, offset: float = 0.0, operations: int = 1) -> Any:
        """Σ w x + offset of pairs (w, x)."""

    def multiply(self, x: Any, y: Any) -> Any:
        """x · y."""

    def square(self, x: Any) -> Any:
        """x²."""

    def function(self, name: str, x: Any) -> Any:
        """f(x)."""

    def rounded(self, x: Any, *limits: float) -> Any:
        """x with a relative and an absolute error."""


def closed_minimum(arithmetic: Arithmetic, known: Known, W: Tensor, b: Sequence[Any]) -> tuple[list[Any], Any]:
    """(u of each control, h).

    Raises:
        NotImplementedError: there is no closed form.
    """
    bend = 2 * W.diagonal()
    if bool((torch.diag_embed(W.diagonal()) != W).any()) or not bool((bend > 0).all()):
        raise NotImplementedError("W is not diagonal")
    in_ball = isinstance(known.controls, ControlBall) and len(b) > 1
    return (_in_ball if in_ball else _between_limits)(arithmetic, known, bend, b)


def _in_ball(program: Arithmetic, known: Known, bend: Tensor, b: Sequence[Any]) -> tuple[list[Any], Any]:
    """u = −b/r H'(z) and h = −s/(2r) H(z) with z = ‖b‖²/s, s = (r radius)², H(z) = z, or 2√z − 1 from z = 1 on."""
    if known.costs is not None or bool((bend != bend[0]).any()):
        raise NotImplementedError("costs beside uᵀWu, or a W that is no multiple of the identity")
    assert known.controls.limits is not None
    r, radius, m = float(bend[0]), float(known.controls.limits[1]), len(b)
    s = (r * radius) ** 2
    squared = program.combine([(1, program.square(x)) for x in b], operations=m)
    z = program.combine([(1 / s, squared)], operations=4)
    beyond = program.function("slope_within_ball", z)
    off = [(1 / r, _error(program, x, OF_U)) for x in b]
    u = [program.combine([(-1 / r, program.multiply(x, beyond)), *off], operations=m + 2) for x in b]
    least = (-s / (2 * r), program.function("within_ball", z))
    return u, program.combine([least, (1 / r, _error(program, squared, OF_H))], operations=4)


def _between_limits(program: Arithmetic, known: Known, bend: Tensor, b: Sequence[Any]) -> tuple[list[Any], Any]:
    """u(b) = u(β₀) + s₀(b − β₀) + Σ Δsₖ max(b − βₖ, 0) for each control, and h, the integral of it."""
    parts = [] if known.costs is None else [*known.costs.costs]
    absolute = [part for part in parts if isinstance(part, AbsoluteCost)]
    if len(absolute) < len(parts):
        raise NotImplementedError("smooth costs, or ‖u‖")
    assert known.controls.limits is not None
    m, controls, values = len(b), list[Any](), list[tuple[float, Any]]()
    w = sum((part.weight for part in absolute), torch.zeros(m, dtype=torch.float64)).tolist()
    low, high = (side.double().expand(m).tolist() for side in known.controls.limits)
    ties = _ties(program, b, [_Line.of(*numbers) for numbers in zip(bend.tolist(), w, low, high, strict=True)])
    for x, *numbers in zip(b, bend.tolist(), w, low, high, strict=True):
        line = _Line.of(*numbers)
        r, kink, first = line.r, line.w, line.bends[0]
        y = program.combine([(1, x)], -first)
        u, h = [(line.slopes[0], y)], [(line.u, y), (line.slopes[0] / 2, program.square(y))]
        for k, bend_at in enumerate(line.bends):
            if change := line.slopes[k + 1] - line.slopes[k]:
                ramp = program.function("leaky", program.combine([(1, x)], -bend_at))
                u, h = [*u, (change, ramp)], [*h, (change / 2, program.square(ramp))]
        squared = program.combine([(1 / r, program.square(x))], kink * kink / r)
        u += [(1 / r, _error(program, x, OF_U, OF_U * kink)), *((weight / r**0.5, tie) for weight, tie in ties)]
        h.append((1.0, _error(program, squared, OF_H)))
        controls.append(program.combine(u, line.u, operations=len(u) + 2))
        values.append((1.0, program.combine(h, line.h, operations=len(h) + 2)))
    return controls, program.combine(values, operations=m)


def _ties(program: Arithmetic, b: Sequence[Any], lines: Sequence["_Line"]) -> list[tuple[float, Any]]:
    """Summands of √rᵢ times an error of each uᵢ where costs |u| are minimised in each orthant, and the cheapest taken.

    Rounding hides TIED of E = Σⱼ |uⱼ|(rⱼ|uⱼ| + |bⱼ| + wⱼ) ≤ 2 Σⱼ (|bⱼ| + wⱼ + rⱼ least |uⱼ|)²/rⱼ; ½ rᵢ(Δuᵢ)² is at most
    that.
    """
    if len(b) == 1 or not any(line.w for line in lines):
        return []
    share = (2 * TIED) ** 0.5
    sizes = [line.w + line.r * line.least for line in lines]
    return [
        (2 / line.r**0.5, _error(program, x, share, share * size))
        for x, line, size in zip(b, lines, sizes, strict=True)
    ]


def _error(program: Arithmetic, x: Any, relative: float, absolute: float = 0.0) -> Any:
    """0 ± (relative · |x| + absolute)."""
    return program.combine([(1, program.rounded(x, relative, absolute, math.inf)), (-1, x)])


class _Line(NamedTuple):
    """u(b) = argmin over low ≤ u ≤ high of ½ru² + bu + w|u|, a piecewise linear function."""

    r: float
    w: float
    bends: list[float]  # βₖ, increasing
    slopes: list[float]  # left of the first, between them, and right of the last
    u: float  # at the first bend
    h: float  # the minimum there
    least: float  # the least |u|

    @staticmethod
    def of(r: float, w: float, low: float, high: float) -> "_Line":
        def u(b: float) -> float:
            free = -math.copysign(max(abs(b) - w, 0.0), b) / r
            return min(max(free, low), high)

        kinks = [-w, w] if low < 0 < high else []
        ends = [-(r * high + math.copysign(w, high or -1)), -(r * low + math.copysign(w, low or 1))]
        bends = sorted({0.0 + each for each in (*kinks, *ends) if math.isfinite(each)}) or [0.0]
        inner = [-1 / r if u(left) != u(right) else 0.0 for left, right in itertools.pairwise(bends)]
        outer = [-1 / r if math.isinf(side) else 0.0 for side in (high, low)]
        at = u(bends[0])
        value = (r / 2 * at + bends[0]) * at + w * abs(at)
        return _Line(r, w, bends, [outer[0], *inner, outer[1]], at, value, max(low, -high, 0.0))

"""Closed forms of u = argmin and h = min over u ∈ U of uᵀWu + bᵀu + s(u), for a constant diagonal W.

There are two: for s = Σ wᵢ|uᵢ| and limits of each control, u is piecewise linear in b; for a ball without s and W a
multiple of the identity, u is −b times a function of ‖b‖. Machine code and the interpreter of graphs use the same
operations, so that their bounds agree.
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

# Largest error of the law's u, relative to (|b| + w)/r, and of its h, relative to (b² + w²)/r; each is more than the
# errors FORWARD and BACKWARD of lyapnet.prover.minima add up to.
ERROR_OF_U, ERROR_OF_H = 1e-8, 2e-9
TIE = 512 * torch.finfo(torch.float64).eps  # relative difference of costs below which the law may take either orthant


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
    """(the m controls u, h) in the numbers of this arithmetic.

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
    off = [(1 / r, _error(program, x, ERROR_OF_U)) for x in b]
    u = [program.combine([(-1 / r, program.multiply(x, beyond)), *off], operations=m + 2) for x in b]
    least = (-s / (2 * r), program.function("within_ball", z))
    return u, program.combine([least, (1 / r, _error(program, squared, ERROR_OF_H))], operations=4)


def _between_limits(program: Arithmetic, known: Known, bend: Tensor, b: Sequence[Any]) -> tuple[list[Any], Any]:
    """u(b) = u(β₀) + s₀(b − β₀) + Σ Δsₖ max(b − βₖ, 0) for each control, with bends βₖ; h sums the integrals of u."""
    parts = [] if known.costs is None else [*known.costs.costs]
    absolute = [part for part in parts if isinstance(part, AbsoluteCost)]
    if len(absolute) < len(parts):
        raise NotImplementedError("smooth costs, or ‖u‖")
    assert known.controls.limits is not None
    m, controls, values = len(b), list[Any](), list[tuple[float, Any]]()
    w = sum((part.weight for part in absolute), torch.zeros(m, dtype=torch.float64)).tolist()
    low, high = (side.double().expand(m).tolist() for side in known.controls.limits)
    ties = _tie_errors(program, b, [_Line.of(*numbers) for numbers in zip(bend.tolist(), w, low, high, strict=True)])
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
        u += [
            (1 / r, _error(program, x, ERROR_OF_U, ERROR_OF_U * kink)),
            *((weight / r**0.5, tie) for weight, tie in ties),
        ]
        h.append((1.0, _error(program, squared, ERROR_OF_H)))
        controls.append(program.combine(u, line.u, operations=len(u) + 2))
        values.append((1.0, program.combine(h, line.h, operations=len(h) + 2)))
    return controls, program.combine(values, operations=m)


def _tie_errors(program: Arithmetic, b: Sequence[Any], lines: Sequence["_Line"]) -> list[tuple[float, Any]]:
    """Summands of √rᵢ Δuᵢ, where Δuᵢ is the error of u from orthants with nearly equal minima.

    With costs wᵢ|uᵢ| the law minimises in each orthant and takes the cheapest. Rounding hides differences of cost of
    TIE · E with E = Σⱼ |uⱼ|(rⱼ|uⱼ| + |bⱼ| + wⱼ) ≤ 2 Σⱼ (|bⱼ| + wⱼ + rⱼ least |uⱼ|)²/rⱼ, and ½ rᵢ(Δuᵢ)² is at most that.
    """
    if len(b) == 1 or not any(line.w for line in lines):
        return []
    share = (2 * TIE) ** 0.5
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
    slopes: list[float]  # of u left of the first bend, between bends, and right of the last
    u: float  # u at the first bend
    h: float  # the minimum at the first bend
    least: float  # the least |u| of all low ≤ u ≤ high

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

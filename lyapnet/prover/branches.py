"""Rules for functions with kinks and branches: where a box does not decide a branch, the result encloses both branches.

A truth value is a number: 1 or 0 on a box on which it is constant for certain, else the interval [0, 1]. Forms are
closed sets with room for rounding, so if a truth value changes at the common face of two boxes, one of the boxes does
not decide it.
"""

import copy
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.fx import GraphModule, Node

from lyapnet.base.types import OnBoxes
from lyapnet.prover import taylor
from lyapnet.prover.elementary_functions import linearised
from lyapnet.prover.taylor import TaylorForm, constant_form

aten = torch.ops.aten


# Kinks


def kinked(
    x: TaylorForm, function: Callable[[Tensor], Tensor], slope: Callable[[Tensor], Tensor], kinks: Sequence[float]
) -> TaylorForm:
    """f(x) for piecewise linear f: f(x) − ax has its extremes at the ends of the interval or at kinks."""
    return linearised(x, function, slope, lambda a, lo, hi: [torch.full_like(a, kink) for kink in kinks])


def relu(x: TaylorForm) -> TaylorForm:
    """max(x, 0); if l < 0 < u, the slope is a = u/(u − l), and 0 ≤ max(x, 0) − ax ≤ −al on [l, u]."""
    return kinked(x, torch.relu, lambda v: (v > 0).to(v), [0.0])


def leaky_relu(x: TaylorForm, negative_slope: float = 0.01) -> TaylorForm:
    """x for x > 0, and negative_slope · x for x ≤ 0."""
    return kinked(
        x,
        lambda v: torch.where(v > 0, v, negative_slope * v),
        lambda v: torch.where(v > 0, torch.ones_like(v), negative_slope),
        [0.0],
    )


def absolute(x: TaylorForm) -> TaylorForm:
    """|x|, with its kink at 0."""
    return kinked(x, torch.abs, torch.sign, [0.0])


def clamp(x: TaylorForm, low: float | None = None, high: float | None = None) -> TaylorForm:
    """min(max(x, low), high) with constant limits, which are the kinks."""
    kinks = [float(kink) for kink in (low, high) if kink is not None]
    return kinked(x, lambda v: v.clamp(low, high), lambda v: (v == v.clamp(low, high)).to(v), kinks)


def maximum(x: Any, y: Any) -> TaylorForm:
    """max(x, y) = y + max(x − y, 0): common terms of x and y cancel in x − y."""
    x, y = _forms(x, y)
    if not x.dimension:
        return _monotone_of_intervals(torch.maximum, x, y)
    return taylor.add(y, relu(taylor.add(x, taylor.negate(y))))


def minimum(x: Any, y: Any) -> TaylorForm:
    """min(x, y) = x − max(x − y, 0)."""
    x, y = _forms(x, y)
    if not x.dimension:
        return _monotone_of_intervals(torch.minimum, x, y)
    return taylor.add(x, taylor.negate(relu(taylor.add(x, taylor.negate(y)))))


def _monotone_of_intervals(function: Callable[[Tensor, Tensor], Tensor], x: TaylorForm, y: TaylorForm) -> TaylorForm:
    """f(x, y) of intervals for f that does not fall in x or y: its extremes are at both lower and both upper ends."""
    x, y = taylor.aligned(x, y)
    (x_low, x_high), (y_low, y_high) = x.interval(), y.interval()
    return between(function(x_low, y_low), function(x_high, y_high), x).with_rounding(2)


def clamp_between(x: Any, low: Any = None, high: Any = None) -> TaylorForm:
    """min(max(x, low), high), where each may depend on the point; a constant infinite limit is left out."""
    y = x if low is None or _is_constant(low, -math.inf) else maximum(x, low)
    y = y if high is None or _is_constant(high, math.inf) else minimum(y, high)
    if isinstance(low, Tensor) and isinstance(high, Tensor) and bool((low.isfinite() & high.isfinite()).all()):
        return _within_limits(y, low, high)
    return y


def _within_limits(y: TaylorForm, low: Tensor, high: Tensor) -> TaylorForm:
    """The form y; on boxes where its bounds are wider than [low, high] or unknown, the interval [low, high]."""
    least, most = y.interval()
    low, high = (side.to(y.radius).expand_as(y.radius) for side in (torch.minimum(low, high), high))
    wide = ~(most - least <= high - low)
    room = 4 * taylor.EPSILON * (low.abs() + high.abs()) + taylor.TINY  # for the rounding of c and r
    constant = between(low - room, high + room, y)
    return y.with_parts(torch.where(wide, constant.terms, y.terms), torch.where(wide, constant.radius, y.radius))


def _is_constant(y: Any, value: float) -> bool:
    return isinstance(y, Tensor) and bool((y == value).all())


# Truths


def between(low: OnBoxes, high: OnBoxes, like: TaylorForm) -> TaylorForm:
    """The interval [low, high] as c = (low + high)/2 and r = (high − low)/2, with the boxes and the ε of `like`."""
    center = (low + high) / 2
    coefficients = torch.zeros(len(like.terms) - 1, *center.shape, dtype=center.dtype)
    return like.with_parts(torch.cat([center[None], coefficients]), (high - low) / 2)


def sign(x: TaylorForm) -> TaylorForm:
    """sgn x ∈ {−1, 0, 1}, which does not fall with x: between the signs of the lower and the upper bound of x."""
    low, high = x.interval()
    return between(low.sign(), high.sign(), x)


def positive(x: TaylorForm) -> TaylorForm:
    """Whether x > 0: certain if the lower bound of x is positive, possible if the upper bound is."""
    low, high = x.interval()
    return between((low > 0).to(low), (high > 0).to(low), x)


def negation(x: TaylorForm) -> TaylorForm:
    """Whether x = 0, that is, x is not true."""
    certain, possible = _truth(x)
    return between((~possible).to(x.radius), (~certain).to(x.radius), x)


def conjunction(x: Any, y: Any) -> TaylorForm:
    """Whether x ≠ 0 and y ≠ 0."""
    x, y = taylor.aligned(*_forms(x, y))
    certain, possible = (torch.logical_and(*pair) for pair in zip(_truth(x), _truth(y), strict=True))
    return between(certain.to(x.radius), possible.to(x.radius), x)


def disjunction(x: Any, y: Any) -> TaylorForm:
    """Whether x ≠ 0 or y ≠ 0; de Morgan's law."""
    x, y = _forms(x, y)
    return negation(conjunction(negation(x), negation(y)))


def greater(x: Any, y: Any) -> TaylorForm:
    """Whether x > y."""
    x, y = _forms(x, y)
    return positive(taylor.add(x, taylor.negate(y)))


def at_least(x: Any, y: Any) -> TaylorForm:
    """Whether x ≥ y: not y > x."""
    return negation(greater(y, x))


def equal(x: Any, y: Any) -> TaylorForm:
    """Whether x = y: neither x > y nor y > x; never certain, as forms have room for rounding."""
    return conjunction(at_least(x, y), at_least(y, x))


def where(truth: Any, x: Any, y: Any) -> TaylorForm:
    """x where the truth is certain, y where it is impossible, and on undecided boxes a form that encloses both.

    With the polynomials X(ε) and Y(ε) of x and y, both values lie within ½ Σ_k |X_k − Y_k| + max(r, r') of
    ½ (X + Y)(ε), since X − ½ (X + Y) = ½ (X − Y), and |ε| ≤ 1 in each term.
    """
    truth, x, y = taylor.aligned(*_forms(truth, x, y))
    certain, possible = _truth(truth)
    apart = (x.terms - y.terms).abs().sum(0) / 2
    both = x.with_parts((x.terms + y.terms) / 2, apart + torch.maximum(x.radius, y.radius)).with_rounding(len(x.terms))
    return x.with_parts(
        torch.where(certain, x.terms, torch.where(possible, both.terms, y.terms)),
        torch.where(certain, x.radius, torch.where(possible, both.radius, y.radius)),
    )


def _truth(x: TaylorForm) -> tuple[Tensor, Tensor]:
    """(whether x ≠ 0 at all points of the box for certain, whether x ≠ 0 is possible at some point)."""
    low, high = x.interval()
    return (low > 0) | (high < 0), ~(x.magnitude == 0)


def _forms(*values: Any) -> list[TaylorForm]:
    """The values as forms; at least one is a form, and the others are constants."""
    like = next(value for value in values if isinstance(value, TaylorForm))
    return [
        value if isinstance(value, TaylorForm) else constant_form(torch.as_tensor(value, dtype=torch.float64), like)
        for value in values
    ]


# Derivatives, as autograd writes them


def threshold_backward(gradient: Any, x: Any, threshold: float) -> TaylorForm:
    """The gradient where x > threshold, else 0."""
    return where(greater(x, threshold), gradient, 0.0)


def leaky_relu_backward(gradient: Any, x: Any, negative_slope: float, self_is_result: bool) -> TaylorForm:
    """The gradient where x > 0, else negative_slope times the gradient."""
    gradient, x = _forms(gradient, x)
    return where(positive(x), gradient, taylor.scale(gradient, torch.as_tensor(negative_slope, dtype=torch.float64)))


KINKS: dict[Any, Callable[..., TaylorForm]] = {
    aten.relu.default: relu,
    aten.leaky_relu.default: leaky_relu,
    aten.abs.default: absolute,
    aten.clamp.default: clamp,
    aten.clamp_min.default: clamp,
    aten.clamp_max.default: lambda x, high: clamp(x, None, high),
    aten.clamp.Tensor: clamp_between,
    aten.clamp_min.Tensor: maximum,
    aten.clamp_max.Tensor: minimum,
    aten.maximum.default: maximum,
    aten.minimum.default: minimum,
}
"""Operator ↦ its rule, for operators with kinks."""

JUMPS: dict[Any, Callable[..., TaylorForm]] = {
    **dict.fromkeys((aten.sign.default, aten.sgn.default), sign),
    **dict.fromkeys((aten.gt.Scalar, aten.gt.Tensor), greater),
    **dict.fromkeys((aten.ge.Scalar, aten.ge.Tensor), at_least),
    **dict.fromkeys((aten.lt.Scalar, aten.lt.Tensor), lambda x, y: greater(y, x)),
    **dict.fromkeys((aten.le.Scalar, aten.le.Tensor), lambda x, y: at_least(y, x)),
    **dict.fromkeys((aten.eq.Scalar, aten.eq.Tensor), equal),
    **dict.fromkeys((aten.ne.Scalar, aten.ne.Tensor), lambda x, y: negation(equal(x, y))),
    **dict.fromkeys((aten.bitwise_and.Tensor, aten.logical_and.default), conjunction),
    **dict.fromkeys((aten.bitwise_or.Tensor, aten.logical_or.default), disjunction),
    **dict.fromkeys((aten.bitwise_not.default, aten.logical_not.default), negation),
    aten.threshold_backward.default: threshold_backward,
    aten.leaky_relu_backward.default: leaky_relu_backward,
}
"""Operator ↦ its rule, for operators that jump."""

CHOICES: dict[Any, Callable[..., TaylorForm]] = {
    aten.where.self: where,
    **dict.fromkeys((aten.masked_fill.Scalar, aten.masked_fill.Tensor), lambda x, mask, value: where(mask, value, x)),
}
"""Operator ↦ its rule, for operators that choose between two values: they jump with the truth if the values differ."""


# The comparisons in a graph

COMPARISONS = {  # derivative that jumps ↦ (its arguments ↦ (x, threshold), where it jumps with x > threshold)
    aten.threshold_backward.default: lambda gradient, x, threshold: (x, threshold),
    aten.leaky_relu_backward.default: lambda gradient, x, negative_slope, self_is_result: (x, 0.0),
}


def decisions(graph: GraphModule) -> GraphModule | None:
    """(t, x) ↦ all truth values and signs in a graph, as numbers; None if there are none.

    On a set on which all of them are constant, the function is continuous: the other operators are continuous, or
    choose by these values.
    """
    nodes, found = copy.deepcopy(graph.graph), list[Node]()
    for node in list(nodes.nodes):
        if node.op == "call_function" and node.target in JUMPS:
            truth = node
            if node.target in COMPARISONS:
                with nodes.inserting_after(node):
                    truth = nodes.call_function(aten.gt.Scalar, COMPARISONS[node.target](*node.args))
            with nodes.inserting_after(truth):
                found.append(nodes.call_function(aten._to_copy.default, (truth,), {"dtype": torch.float64}))
    if not found:
        return None
    next(node for node in nodes.nodes if node.op == "output").args = (tuple(found),)
    nodes.eliminate_dead_code()
    return GraphModule(graph, nodes)

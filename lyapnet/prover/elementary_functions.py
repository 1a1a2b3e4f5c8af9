"""Functions of one number on Taylor forms: a polynomial in the argument, and a bound of the error.

The accuracy that is assumed of torch's functions is stated in lyapnet.prover.taylor.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from lyapnet.prover import taylor
from lyapnet.prover.taylor import EPSILON, FLOOR, TINY, TaylorForm

Range = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


class Derivatives(NamedTuple):
    """Higher derivatives of a function: values at points, and ranges (lo, hi) ↦ bounds on [lo, hi]."""

    second: Callable[[Tensor], Tensor]
    third: Callable[[Tensor], Tensor]
    third_range: Range
    fourth_range: Range


@dataclass(frozen=True)
class Elementary:
    """A function f of one number and what its bounds need; called with a Taylor form x, it returns bounds of f(x).

    Args:
        function, derivative: f and f'.
        stationary: (a, lo, hi) ↦ points, among them all solutions of f'(x) = a in [lo, hi].
        defined: (lo, hi) ↦ whether f is smooth on [lo, hi]; where it is not, the remainder is infinite. None: always.
        derivatives: the higher derivatives; without them the result is linear in x.
    """

    function: Callable[[Tensor], Tensor]
    derivative: Callable[[Tensor], Tensor]
    stationary: Callable[[Tensor, Tensor, Tensor], Sequence[Tensor]]
    defined: Callable[[Tensor, Tensor], Tensor] | None = None
    derivatives: Derivatives | None = None

    def __call__(self, x: TaylorForm) -> TaylorForm:
        return linearised(x, self.function, self.derivative, self.stationary, self.defined, self.derivatives)


def linearised(
    x: TaylorForm,
    function: Callable[[Tensor], Tensor],
    derivative: Callable[[Tensor], Tensor],
    stationary: Callable[[Tensor, Tensor, Tensor], Sequence[Tensor]],
    defined: Callable[[Tensor, Tensor], Tensor] | None = None,
    derivatives: Derivatives | None = None,
) -> TaylorForm:
    """f(x) = a x + b ± e on the interval [l, u] of x, where a is the slope of the secant; see _expanded for degree > 1.

    h(x) = f(x) − a x has its extremes on [l, u] at l, at u, or where f'(x) = a; b is their mean and e half their
    difference, so that |h(x) − b| ≤ e. This holds for every a, so a may be rounded. With the slope of the secant, e is
    of second order in u − l, and as small as possible for convex and concave f. Computed points with f' = a are assumed
    exact up to η = 1e-12 (1 + |x|); h at such a point differs from the extreme by at most |h'|η, plus terms in η² that
    are below the rounding of float64.

    Args: those of Elementary.
    """
    lo, hi = x.interval()
    known = torch.isfinite(lo) & torch.isfinite(hi)
    if defined is not None:
        known = known & defined(lo, hi)
    lo, hi = torch.where(known, lo, 1.0), torch.where(known, hi, 1.0)
    if x.degree > 1 and derivatives is not None:
        result = _expanded(x, lo, hi, function, derivative, derivatives)
    else:
        result = _secant(x, lo, hi, function, derivative, stationary)
    zeros = torch.zeros_like(result.terms)
    return x.with_parts(torch.where(known, result.terms, zeros), torch.where(known, result.radius, torch.inf))


def _secant(
    x: TaylorForm,
    lo: Tensor,
    hi: Tensor,
    function: Callable[[Tensor], Tensor],
    derivative: Callable[[Tensor], Tensor],
    stationary: Callable[[Tensor, Tensor, Tensor], Sequence[Tensor]],
) -> TaylorForm:
    f_l, f_u = function(lo), function(hi)
    wide = hi - lo > 1e-6 * torch.maximum(-lo, hi)  # on narrower intervals, rounding spoils the slope of the secant
    a = torch.where(wide, (f_u - f_l) / torch.where(wide, hi - lo, 1.0), derivative((lo + hi) / 2))
    a = a if len(x.coefficients) else torch.zeros_like(a)  # the result for an interval, a form without ε, is b ± e
    points = torch.stack([torch.where(p.isnan(), lo, p).clamp(lo, hi) for p in stationary(a, lo, hi)])
    f_p = function(points)
    h = torch.cat([(f_l - a * lo)[None], (f_u - a * hi)[None], f_p - a * points])
    low, high = h.amin(0), h.amax(0)
    nearby = (((derivative(points) - a).abs() + TINY) * 1e-12 * (1 + points.abs())).amax(0)
    largest = torch.maximum(f_l.abs(), f_u.abs()).maximum(f_p.abs().amax(0)) + 2 * a.abs() * torch.maximum(-lo, hi)
    b, e = (low + high) / 2, (high - low) / 2 + nearby + 16 * EPSILON * largest + TINY
    return x.with_parts(torch.cat([(a * x.center + b)[None], a * x.terms[1:]]), a.abs() * x.radius + e).with_rounding(2)


def _expanded(
    x: TaylorForm,
    lo: Tensor,
    hi: Tensor,
    function: Callable[[Tensor], Tensor],
    derivative: Callable[[Tensor], Tensor],
    derivatives: Derivatives,
) -> TaylorForm:
    """f(x) by Taylor's formula in y = x − m, where m is the middle of the interval [l, u] of x and |y| ≤ w.

    In forms of second degree, with M₋ ≤ f‴ ≤ M₊ on [l, u] and M = ½ (M₋ + M₊),

        f(x) = f(m) + (f'(m) + M w²/8) y + ½ f''(m) y² ± (|M| w³/24 + (M₊ − M₋) w³/12).

    Taylor's remainder is f‴(ξ) y³/6. Replacing f‴(ξ) by M changes it by at most ½ (M₊ − M₋) w³/6. Replacing y³ by
    ¾ w² y changes M y³/6 by at most |M|/6 · w³/4, since |y³ − ¾ w² y| ≤ w³/4 (Chebyshev). In forms of third degree,
    with M₋ ≤ f⁗ ≤ M₊,

        f(x) = f(m) − M w⁴/192 + f'(m) y + (½ f''(m) + M w²/24) y² + f‴(m)/6 y³ ± (|M| w⁴/192 + (M₊ − M₋) w⁴/48),

    by the same steps with f⁗(ξ) y⁴/24 and |y⁴ − w² y² + w⁴/8| ≤ w⁴/8.
    """
    m = (lo + hi) / 2
    w = (hi - lo) / 2 * (1 + 8 * EPSILON) + 4 * EPSILON * m.abs()
    cubic = x.degree == 3
    # on [lo, hi] instead of m ± w, which may leave the domain of f
    low, high = (derivatives.fourth_range if cubic else derivatives.third_range)(lo, hi)
    M = (low + high) / 2
    a, b, c, k = function(m), derivative(m), derivatives.second(m) / 2, torch.zeros_like(m)
    if cubic:
        a, c, k = a - M * w * w * w * w / 192, c + M * w * w / 24, derivatives.third(m) / 6
        e = (M.abs() / 192 + (high - low) / 48) * w * w * w * w * (1 + 1e-9)
    else:
        b = b + M * w * w / 8
        e = (M.abs() / 24 + (high - low) / 12) * w * w * w * (1 + 1e-9)
    higher = k.abs() + FLOOR + M.abs() * (w if cubic else 1)
    size = a.abs() + (b.abs() + FLOOR + (c.abs() + FLOOR + higher * w) * w) * w
    e = e + 32 * EPSILON * size + TINY
    y = x.with_parts(torch.cat([(x.center - m)[None], x.terms[1:]]), x.radius).with_rounding()
    yy = taylor.multiply(y, y)
    terms, radius = b * y.terms + c * yy.terms, b.abs() * y.radius + c.abs() * yy.radius
    if cubic:
        yyy = taylor.multiply(yy, y)
        terms, radius = terms + k * yyy.terms, radius + k.abs() * yyy.radius
    return x.with_parts(torch.cat([(terms[0] + a)[None], terms[1:]]), radius + e).with_rounding(6)


def square(x: TaylorForm) -> TaylorForm:
    """x²; f'(x) = 2x = a at x = a/2."""
    if x.degree > 1:
        return taylor.multiply(x, x)
    return linearised(x, lambda v: v * v, lambda v: 2 * v, lambda a, lo, hi: [a / 2])


def _widened(low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """The range [low, high], widened by the rounding errors of its ends."""
    room = 64 * EPSILON * torch.maximum(low.abs(), high.abs()) + TINY
    return low - room, high + room


def _monotone(function: Callable[[Tensor], Tensor]) -> Range:
    """The range on [lo, hi] of a monotone function: it lies between the values at lo and hi."""

    def range_of_ends(lo: Tensor, hi: Tensor) -> tuple[Tensor, Tensor]:
        ends = torch.stack([function(lo), function(hi)])
        return _widened(ends.amin(0), ends.amax(0))

    return range_of_ends


def _wave_range(wave: Callable[[Tensor], Tensor]) -> Range:
    """The range of ±sin or ±cos on [lo, hi]: the value in the middle ± (hi − lo)/2, since the slope is at most 1."""

    def range_around_middle(lo: Tensor, hi: Tensor) -> tuple[Tensor, Tensor]:
        middle, reach = wave((lo + hi) / 2), (hi - lo) / 2 + 2 * EPSILON * torch.maximum(-lo, hi)
        return _widened((middle - reach).clamp_min(-1), (middle + reach).clamp_max(1))

    return range_around_middle


def _within_two_periods(lo: Tensor, hi: Tensor) -> Tensor:
    return hi - lo < 4 * torch.pi


def _periodic(base: Tensor, lo: Tensor, hi: Tensor) -> list[Tensor]:
    """All points ±base + 2πk, 0 ≤ base ≤ π, in an interval of at most two periods, and some outside it."""
    turn = 2 * torch.pi
    middle = ((lo + hi) / (2 * turn)).round() * turn
    return [sign * base + middle + k * turn for sign in (-1, 1) for k in range(-2, 3)]


def _logit(s: Tensor) -> Tensor:
    return torch.log(s) - torch.log1p(-s)


def _sigmoid_derivative(v: Tensor) -> Tensor:
    return torch.sigmoid(v) * torch.sigmoid(-v)  # σ(1 − σ) would cancel where σ is close to 1


def _slope_range(lo: Tensor, hi: Tensor) -> tuple[Tensor, Tensor]:
    """The range of σ' on [lo, hi]: σ' falls with |x|, so its extremes are at the ends, or σ'(0) = ¼."""
    ends = torch.stack([_sigmoid_derivative(lo), _sigmoid_derivative(hi)])
    return _widened(ends.amin(0), torch.where((lo < 0) & (hi > 0), 0.25, ends.amax(0)))


def _sigmoid_third(v: Tensor) -> Tensor:
    p = _sigmoid_derivative(v)
    return p * (1 - 6 * p)


def _sigmoid_third_range(lo: Tensor, hi: Tensor) -> tuple[Tensor, Tensor]:
    """The range of σ‴ = p − 6p² with p = σ' on [lo, hi]: at the ends of the range of p, or at the vertex p = 1/12."""
    least, top = _slope_range(lo, hi)
    p = torch.stack([least, top, least.maximum(top.clamp_max(1 / 12))])
    values = p - 6 * p**2
    return _widened(values.amin(0), values.amax(0))


def _sigmoid_curvature(v: Tensor) -> Tensor:
    return -_sigmoid_derivative(v) * torch.tanh(v / 2)


def softplus_of(v: Tensor) -> Tensor:
    """log(1 + eᵛ) of tensors, without overflow."""
    return v.clamp_min(0) + torch.log1p(torch.exp(-v.abs()))


# The functions; each docstring has the solutions of f'(x) = a

exp = Elementary(
    torch.exp, torch.exp, lambda a, lo, hi: [torch.log(a)],
    derivatives=Derivatives(torch.exp, torch.exp, _monotone(torch.exp), _monotone(torch.exp)),
)  # fmt: skip
"""eˣ; eˣ = a at x = log a."""


def _log_third(v: Tensor) -> Tensor:
    return 2 / v**3


def _log_fourth(v: Tensor) -> Tensor:
    return -6 / v**4


log = Elementary(
    torch.log, torch.reciprocal, lambda a, lo, hi: [1 / a], lambda lo, hi: lo > 0,
    Derivatives(lambda v: -1 / v**2, _log_third, _monotone(_log_third), _monotone(_log_fourth)),
)  # fmt: skip
"""log x for x > 0; 1/x = a at x = 1/a."""

log1p = Elementary(
    torch.log1p, lambda v: 1 / (1 + v), lambda a, lo, hi: [1 / a - 1], lambda lo, hi: lo > -1,
    Derivatives(
        lambda v: -1 / (1 + v) ** 2, lambda v: _log_third(1 + v),
        _monotone(lambda v: _log_third(1 + v)), _monotone(lambda v: _log_fourth(1 + v)),
    ),
)  # fmt: skip
"""log(1 + x) for x > −1; 1/(1 + x) = a at x = 1/a − 1."""


def _sqrt_third(v: Tensor) -> Tensor:
    return 0.375 * v**-2.5


sqrt = Elementary(
    torch.sqrt, lambda v: 0.5 / v.sqrt(), lambda a, lo, hi: [1 / (4 * a * a)], lambda lo, hi: lo > 0,
    Derivatives(
        lambda v: -0.25 * v**-1.5, _sqrt_third, _monotone(_sqrt_third), _monotone(lambda v: -0.9375 * v**-3.5)
    ),
)  # fmt: skip
"""√x for x > 0; 1/(2√x) = a at x = 1/(4a²)."""


def _reciprocal_third(v: Tensor) -> Tensor:
    return -6 / v**4


reciprocal = Elementary(
    torch.reciprocal, lambda v: -1 / (v * v), lambda a, lo, hi: [torch.copysign((-a).rsqrt(), lo)],
    lambda lo, hi: (lo > 0) | (hi < 0),
    Derivatives(lambda v: 2 / v**3, _reciprocal_third, _monotone(_reciprocal_third), _monotone(lambda v: 24 / v**5)),
)  # fmt: skip
"""1/x on intervals without 0; −1/x² = a at x = ±1/√(−a)."""


def _sigmoid_stationary(a: Tensor, lo: Tensor, hi: Tensor) -> Sequence[Tensor]:
    s = 2 * a / (1 + (1 - 4 * a).clamp_min(0).sqrt())  # the smaller root, without cancellation
    point = _logit(s)
    return [point, -point]


def _sigmoid_fourth_range(lo: Tensor, hi: Tensor) -> tuple[Tensor, Tensor]:
    """The range of σ⁗ = p (12p − 1) tanh(x/2) with p = σ': products of the ends of the ranges of the factors."""
    p = _slope_range(lo, hi)
    ranges = p, (12 * p[0] - 1, 12 * p[1] - 1), (torch.tanh(lo / 2), torch.tanh(hi / 2))
    ends = torch.stack([a * b * c for a in ranges[0] for b in ranges[1] for c in ranges[2]])
    return _widened(ends.amin(0), ends.amax(0))


sigmoid = Elementary(
    torch.sigmoid, _sigmoid_derivative, _sigmoid_stationary, None,
    Derivatives(_sigmoid_curvature, _sigmoid_third, _sigmoid_third_range, _sigmoid_fourth_range),
)  # fmt: skip
"""σ(x) = 1/(1 + e⁻ˣ); σ(1 − σ) = a at x = ±(log s − log(1 − s)), s = 2a/(1 + √(1 − 4a))."""


def _sigmoid_curvature_range(lo: Tensor, hi: Tensor) -> tuple[Tensor, Tensor]:
    """The range of σ'': its extremes on [lo, hi] are at the ends, or where σ' = 1/6, which is at ±log(2 + √3)."""
    steepest = torch.log(torch.tensor(2 + 3**0.5, dtype=lo.dtype))
    points = torch.stack([lo, hi, steepest.clamp(lo, hi), (-steepest).clamp(lo, hi)])
    values = _sigmoid_curvature(points)
    return _widened(values.amin(0), values.amax(0))


softplus = Elementary(
    softplus_of, torch.sigmoid, lambda a, lo, hi: [_logit(a)], None,
    Derivatives(_sigmoid_derivative, _sigmoid_curvature, _sigmoid_curvature_range, _sigmoid_third_range),
)  # fmt: skip
"""log(1 + eˣ); σ(x) = a at x = log a − log(1 − a)."""


def _cos_stationary(a: Tensor, lo: Tensor, hi: Tensor) -> Sequence[Tensor]:
    quarter = torch.pi / 2
    return [point - quarter for point in _periodic(torch.acos(a.clamp(-1, 1)), lo + quarter, hi + quarter)]


sin = Elementary(
    torch.sin, torch.cos, lambda a, lo, hi: _periodic(torch.acos(a.clamp(-1, 1)), lo, hi), _within_two_periods,
    Derivatives(
        lambda v: -torch.sin(v), lambda v: -torch.cos(v), _wave_range(lambda v: -torch.cos(v)), _wave_range(torch.sin)
    ),
)  # fmt: skip
"""sin x on at most two periods; cos x = a at x = ±arccos a + 2πk."""

cos = Elementary(
    torch.cos, lambda v: -torch.sin(v), _cos_stationary, _within_two_periods,
    Derivatives(lambda v: -torch.cos(v), torch.sin, _wave_range(torch.sin), _wave_range(torch.cos)),
)  # fmt: skip
"""cos x on at most two periods; −sin x = a at x = −π/2 ± arccos a + 2πk."""


def _branch_center(lo: Tensor, hi: Tensor) -> Tensor:
    return ((lo + hi) / (2 * torch.pi)).round() * torch.pi


def _tan_stationary(a: Tensor, lo: Tensor, hi: Tensor) -> Sequence[Tensor]:
    base = torch.atan((a - 1).clamp_min(0).sqrt())
    return [_branch_center(lo, hi) - base, _branch_center(lo, hi) + base]


tan = Elementary(
    torch.tan, lambda v: 1 + torch.tan(v) ** 2, _tan_stationary,
    lambda lo, hi: (lo - _branch_center(lo, hi) > -1.57) & (hi - _branch_center(lo, hi) < 1.57),
)  # fmt: skip
"""tan x between two poles, not closer than 8e-4 to either; 1 + tan² x = a at x = πk ± atan √(a − 1)."""

ELEMENTARY = {
    "exp": exp, "log": log, "log1p": log1p, "sqrt": sqrt, "reciprocal": reciprocal, "sigmoid": sigmoid, "sin": sin,
    "cos": cos, "tan": tan,
}  # fmt: skip
"""Name of torch's operator ↦ function. Softplus has a rule of its own in bound_rules, because of its options."""

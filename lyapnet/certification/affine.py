"""Affine arithmetic on batches of boxes: sets of values as first-order forms with a rigorous remainder.

Rounding. Forms enclose the values of real arithmetic on the given float64 numbers. Every operation here adds to its
remainder a bound of its own rounding errors: a multiple of ε = 2⁻⁵² times the magnitudes that entered it, at least
twice what the standard model |fl(a ∘ b) − a ∘ b| ≤ ½ε|a ∘ b| gives for sums in any order. Two things are taken on
trust: that torch's elementary functions err by at most 8 ε, and that nothing underflows by more than TINY.

Source: de Figueiredo, Stolfi, "Affine arithmetic: concepts and applications", Numerical Algorithms 2004; the remainder
here is one number for each entry, instead of a new noise symbol for each operation.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

EPSILON = torch.finfo(torch.float64).eps
TINY = 1e-300


@dataclass(frozen=True, eq=False)
class AffineForm:
    """The set {c + Σ_k A_k ε_k + η : |ε_k| ≤ 1, |η| ≤ r} for each box and entry.

    ε_1 … ε_d run over the box and are shared by all its forms; η is anything, another one in each form and entry.
    With d = 0 forms are intervals, and what is computed with them is interval arithmetic.

    Args:
        terms: c, A_1, …, A_d as (1 + d, boxes, *shape).
        radius: r ≥ 0, (boxes, *shape); infinite or nan where nothing is known.
    """

    terms: Tensor
    radius: Tensor

    @property
    def shape(self) -> torch.Size:
        """Of the value at one point."""
        return self.radius.shape[1:]

    @property
    def center(self) -> Tensor:
        """c, (boxes, *shape)."""
        return self.terms[0]

    @property
    def coefficients(self) -> Tensor:
        """A, (d, boxes, *shape)."""
        return self.terms[1:]

    @property
    def spread(self) -> Tensor:
        """Σ_k |A_k|, (boxes, *shape)."""
        return self.coefficients.abs().sum(0)

    @property
    def magnitude(self) -> Tensor:
        """|c| + Σ_k |A_k| + r: no value of the set is larger."""
        return self.terms.abs().sum(0) + self.radius

    def interval(self) -> tuple[Tensor, Tensor]:
        """(lower, upper) of c ± (Σ_k |A_k| + r), rounded outwards; infinite where nothing is known."""
        reach = self.spread + self.radius + len(self.terms) * EPSILON * self.magnitude + TINY
        lower, upper = self.center - reach, self.center + reach
        return torch.where(lower.isnan(), -torch.inf, lower), torch.where(upper.isnan(), torch.inf, upper)

    def rounded(self, operations: int = 1) -> "AffineForm":
        """The form with room for so many rounded operations on each of its entries, in sequence or in one sum."""
        return AffineForm(self.terms, self.radius + (2 * operations * EPSILON) * self.magnitude + TINY)

    def as_rank(self, rank: int) -> "AffineForm":
        """The same value with leading axes of length 1, as broadcasting reads it."""
        ones = (1,) * (rank - len(self.shape))
        boxes = self.radius.shape[:1]
        terms = self.terms.reshape(*self.terms.shape[:1], *boxes, *ones, *self.shape)
        return AffineForm(terms, self.radius.reshape(*boxes, *ones, *self.shape))


def box_form(lower: Tensor, upper: Tensor) -> AffineForm:
    """The boxes {lower ≤ y ≤ upper} themselves, of shape (d,): y_k = middle_k + ½ width_k · ε_k.

    Args:
        lower, upper: (boxes, d) in float64.
    """
    center, half = (lower + upper) / 2, (upper - lower) / 2
    coefficients = half.T[..., None] * torch.eye(lower.shape[-1], dtype=half.dtype)[:, None]
    return AffineForm(torch.cat([center[None], coefficients]), torch.zeros_like(center)).rounded(2)


def interval_form(lower: Tensor, upper: Tensor) -> AffineForm:
    """The boxes as intervals, which forget that they are functions of the same point: no ε, all remainder."""
    return AffineForm(((lower + upper) / 2)[None], (upper - lower) / 2).rounded(2)


def constant_form(value: Tensor, like: AffineForm) -> AffineForm:
    """A value that is the same everywhere, beside the forms of `like`."""
    boxes = len(like.radius)
    center = value.expand(boxes, *value.shape)
    coefficients = torch.zeros(len(like.terms) - 1, *center.shape, dtype=value.dtype)
    return AffineForm(torch.cat([center[None], coefficients]), torch.zeros_like(center))


# Affine operations


def add(x: AffineForm, y: AffineForm) -> AffineForm:
    """x + y: coefficients add, with their signs, and so do remainders."""
    x, y = _aligned(x, y)
    return AffineForm(x.terms + y.terms, x.radius + y.radius).rounded()


def shift(x: AffineForm, offset: Tensor) -> AffineForm:
    """x + offset."""
    x = x.as_rank(max(len(x.shape), offset.ndim))
    center = x.center + offset
    terms = torch.cat([center[None], x.coefficients.expand(-1, *center.shape)])
    return AffineForm(terms, x.radius.expand_as(center)).rounded()


def scale(x: AffineForm, factor: Tensor) -> AffineForm:
    """factor · x, entry by entry; the remainder takes |factor|."""
    x = x.as_rank(max(len(x.shape), factor.ndim))
    return AffineForm(x.terms * factor, x.radius * factor.abs()).rounded()


def negate(x: AffineForm) -> AffineForm:
    """−x, exactly."""
    return AffineForm(-x.terms, x.radius)


def matrix_product(x: AffineForm, weight: Tensor) -> AffineForm:
    """x @ W: c and A_k take W, the remainder |W|, since |Σ_i η_i W_ij| ≤ Σ_i r_i |W_ij|."""
    x = x.rounded(2 * len(weight))  # γ_k Σ_i |x_i||W_ij| bounds the error of each sum, of c, A and r alike
    return AffineForm(x.terms @ weight, x.radius @ weight.abs())


# Products


def multiply(x: AffineForm, y: AffineForm) -> AffineForm:
    """x · y, first order exact: with x = c + L + η and y = c' + L' + η',

        xy = cc' + cL' + c'L + LL' + (c + L)η' + (c' + L')η + ηη',

    where LL' = Σ_k A_k A'_k ε_k² + Σ_{j<k} (A_j A'_k + A_k A'_j) ε_j ε_k and ε_k² ∈ [0, 1], so that LL' lies within
    ½ Σ_k |A_k A'_k| + Σ_{j<k} |A_j A'_k + A_k A'_j| of ½ Σ_k A_k A'_k. Of intervals, between products of their ends.
    """
    x, y = _aligned(x, y)
    if not len(x.coefficients):
        return _interval_product(x, y)
    (c, A, r), (d, B, s) = ((z.center, z.coefficients, z.radius) for z in (x, y))
    diagonal = A * B
    terms = torch.cat([(c * d + diagonal.sum(0) / 2)[None], c * B + d * A])
    pairs = [(A[j] * B[k] + A[k] * B[j]).abs() for j in range(len(A)) for k in range(j + 1, len(A))]
    quadratic = diagonal.abs().sum(0) / 2 + sum(pairs, torch.zeros_like(r + s))
    remainder = (c.abs() + x.spread) * s + (d.abs() + y.spread) * r + r * s
    rounding = (len(x.terms) ** 2 + 8) * EPSILON * x.magnitude * y.magnitude + TINY
    return AffineForm(terms, quadratic + remainder + rounding)


def _interval_product(x: AffineForm, y: AffineForm) -> AffineForm:
    (a, b), (c, d) = x.interval(), y.interval()
    ends = torch.stack([a * c, a * d, b * c, b * d])  # 0 · ∞ is nan, which stays: nothing is known
    low, high = ends.amin(0), ends.amax(0)
    product = AffineForm(((low + high) / 2)[None], (high - low) / 2).rounded(4)
    known = torch.isfinite(low) & torch.isfinite(high)
    return AffineForm(torch.where(known, product.terms, 0.0), torch.where(known, product.radius, torch.inf))


# Functions of one number


def linearised(
    x: AffineForm,
    function: Callable[[Tensor], Tensor],
    derivative: Callable[[Tensor], Tensor],
    stationary: Callable[[Tensor, Tensor, Tensor], Sequence[Tensor]],
    defined: Callable[[Tensor, Tensor], Tensor] | None = None,
) -> AffineForm:
    """f(x) = a x + b ± e, with a the secant's slope over the interval [l, u] of x.

    h(x) = f(x) − a x takes its extremes on [l, u] at l, at u, or where f'(x) = a: b is their middle, e half their
    distance. Any slope is sound, so a needs no care; the secant's makes e of second order in u − l, and for convex and
    concave f the smallest possible. A point where f' = a is found up to rounding, within η = 1e-12 (1 + |x|): h there
    differs from the extreme by at most |h'|η (and terms in η², which are beyond double precision).

    Args:
        stationary: (a, lo, hi) ↦ points that include each solution of f'(x) = a in [lo, hi]; any others do no harm.
        defined: (lo, hi) ↦ whether f is smooth on [lo, hi]; the remainder is infinite where it is not.
    """
    lo, hi = x.interval()
    known = torch.isfinite(lo) & torch.isfinite(hi)
    if defined is not None:
        known = known & defined(lo, hi)
    lo, hi = torch.where(known, lo, 1.0), torch.where(known, hi, 1.0)
    f_l, f_u = function(lo), function(hi)
    wide = hi - lo > 1e-6 * torch.maximum(-lo, hi)  # else the secant's slope is a quotient of rounding errors
    a = torch.where(wide, (f_u - f_l) / torch.where(wide, hi - lo, 1.0), derivative((lo + hi) / 2))
    a = a if len(x.coefficients) else torch.zeros_like(a)  # of an interval: its image, b ± e
    points = torch.stack([torch.where(p.isnan(), lo, p).clamp(lo, hi) for p in stationary(a, lo, hi)])
    f_p = function(points)
    h = torch.cat([(f_l - a * lo)[None], (f_u - a * hi)[None], f_p - a * points])
    low, high = h.amin(0), h.amax(0)
    nearby = ((derivative(points) - a).abs() * 1e-12 * (1 + points.abs())).amax(0)
    largest = torch.maximum(f_l.abs(), f_u.abs()).maximum(f_p.abs().amax(0)) + 2 * a.abs() * torch.maximum(-lo, hi)
    b, e = (low + high) / 2, (high - low) / 2 + nearby + 16 * EPSILON * largest + TINY
    terms = torch.cat([(a * x.center + b)[None], a * x.coefficients])
    result = AffineForm(terms, a.abs() * x.radius + e).rounded(2)
    nothing = torch.zeros_like(result.terms)
    return AffineForm(torch.where(known, result.terms, nothing), torch.where(known, result.radius, torch.inf))


def square(x: AffineForm) -> AffineForm:
    """x²; 2x = a."""
    return linearised(x, lambda v: v * v, lambda v: 2 * v, lambda a, lo, hi: [a / 2])


def exp(x: AffineForm) -> AffineForm:
    """eˣ; eˣ = a."""
    return linearised(x, torch.exp, torch.exp, lambda a, lo, hi: [torch.log(a)])


def log1p(x: AffineForm) -> AffineForm:
    """log(1 + x) for x > −1; 1/(1 + x) = a."""
    return linearised(
        x, torch.log1p, lambda v: 1 / (1 + v), lambda a, lo, hi: [1 / a - 1], defined=lambda lo, hi: lo > -1
    )


def sqrt(x: AffineForm) -> AffineForm:
    """√x for x > 0; 1/(2√x) = a."""
    return linearised(
        x, torch.sqrt, lambda v: 0.5 / v.sqrt(), lambda a, lo, hi: [1 / (4 * a * a)], defined=lambda lo, hi: lo > 0
    )


def reciprocal(x: AffineForm) -> AffineForm:
    """1/x for x of one sign; −1/x² = a."""

    def stationary(a: Tensor, lo: Tensor, hi: Tensor) -> Sequence[Tensor]:
        return [torch.copysign((-a).rsqrt(), lo)]

    return linearised(
        x, torch.reciprocal, lambda v: -1 / (v * v), stationary, defined=lambda lo, hi: (lo > 0) | (hi < 0)
    )


def sigmoid(x: AffineForm) -> AffineForm:
    """σ(x) = 1/(1 + e⁻ˣ); σ(1 − σ) = a at x = ±(log s − log(1 − s)), s = 2a/(1 + √(1 − 4a))."""

    def stationary(a: Tensor, lo: Tensor, hi: Tensor) -> Sequence[Tensor]:
        s = 2 * a / (1 + (1 - 4 * a).clamp_min(0).sqrt())  # the smaller root, without cancellation
        point = _logit(s)
        return [point, -point]

    return linearised(x, torch.sigmoid, _sigmoid_derivative, stationary)


def softplus(x: AffineForm) -> AffineForm:
    """log(1 + eˣ); σ(x) = a."""
    return linearised(x, _softplus, torch.sigmoid, lambda a, lo, hi: [_logit(a)])


def sin(x: AffineForm) -> AffineForm:
    """sin x on at most two periods; cos x = a at x = ±arccos a + 2πk."""

    def stationary(a: Tensor, lo: Tensor, hi: Tensor) -> Sequence[Tensor]:
        return _periodic(torch.acos(a.clamp(-1, 1)), lo, hi)

    return linearised(x, torch.sin, torch.cos, stationary, defined=_two_periods)


def cos(x: AffineForm) -> AffineForm:
    """cos x on at most two periods; −sin x = a at x = −π/2 ± arccos a + 2πk."""

    def stationary(a: Tensor, lo: Tensor, hi: Tensor) -> Sequence[Tensor]:
        quarter = torch.pi / 2
        return [point - quarter for point in _periodic(torch.acos(a.clamp(-1, 1)), lo + quarter, hi + quarter)]

    return linearised(x, torch.cos, lambda v: -torch.sin(v), stationary, defined=_two_periods)


def _two_periods(lo: Tensor, hi: Tensor) -> Tensor:
    return hi - lo < 4 * torch.pi


def _periodic(base: Tensor, lo: Tensor, hi: Tensor) -> list[Tensor]:
    """All of ±base + 2πk, 0 ≤ base ≤ π, in an interval of at most two periods."""
    turn = 2 * torch.pi
    middle = ((lo + hi) / (2 * turn)).round() * turn
    return [sign * base + middle + k * turn for sign in (-1, 1) for k in range(-2, 3)]


def _logit(s: Tensor) -> Tensor:
    return torch.log(s) - torch.log1p(-s)


def _sigmoid_derivative(v: Tensor) -> Tensor:
    s = torch.sigmoid(v)
    return s * (1 - s)


def _softplus(v: Tensor) -> Tensor:
    return v.clamp_min(0) + torch.log1p(torch.exp(-v.abs()))


def _aligned(x: AffineForm, y: AffineForm) -> tuple[AffineForm, AffineForm]:
    rank = max(len(x.shape), len(y.shape))
    return x.as_rank(rank), y.as_rank(rank)

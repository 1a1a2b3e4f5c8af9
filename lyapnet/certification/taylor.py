"""Arithmetic of Taylor forms on batches of boxes: sets of values as polynomials with a rigorous remainder.

Rounding. Forms enclose the values of real arithmetic on the given float64 numbers. Every operation here adds to its
remainder a bound of its own rounding errors: a multiple of ε = 2⁻⁵² times the magnitudes that entered it, at least
twice what the standard model |fl(a ∘ b) − a ∘ b| ≤ ½ε|a ∘ b| gives for sums in any order. Two things are taken on
trust: that torch's elementary functions err by at most 8 ε (1.2 ε is the most that was seen, against mpmath), and that
nothing underflows by more than TINY.

Sources: de Figueiredo, Stolfi, "Affine arithmetic: concepts and applications", Numerical Algorithms 2004, for the first
degree; Neumaier, "Taylor forms: use and limits", Reliable Computing 2003, for higher ones. The remainder here is one
number for each entry, instead of a new noise symbol for each operation.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations_with_replacement

import torch
from torch import Tensor

EPSILON = torch.finfo(torch.float64).eps
TINY = 1e-300


@dataclass(frozen=True, eq=False)
class TaylorForm:
    """The set {c + Σ_k A_k ε_k + Σ_{j≤k} B_jk ε_j ε_k + η : |ε_k| ≤ 1, |η| ≤ r} for each box and entry.

    ε_1 … ε_d run over the box and are shared by all its forms; η is anything, another one in each form and entry. A
    form of first degree has no B: what is of second order in the size of the box is in r. With B, r is of third order,
    and what cancels in a sum of products (as V_xᵀf + q does against ¼ V_xᵀ g R⁻¹ gᵀ V_x) cancels in the bounds too.
    With d = 0 forms are intervals, and what is computed with them is interval arithmetic.

    Args:
        terms: c, A_1, …, A_d and, in the order of `pairs`, B_jk; (1 + d or 1 + d + d(d + 1)/2, boxes, *shape).
        radius: r ≥ 0, (boxes, *shape); infinite or nan where nothing is known.
        dimension: d.
    """

    terms: Tensor
    radius: Tensor
    dimension: int

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
        return self.terms[1 : 1 + self.dimension]

    @property
    def products(self) -> Tensor:
        """B, (d(d + 1)/2 or 0, boxes, *shape)."""
        return self.terms[1 + self.dimension :]

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """(j, k) of each B_jk; none in a form of first degree."""
        return list(combinations_with_replacement(range(self.dimension), 2))[: len(self.products)]

    @cached_property
    def spread(self) -> Tensor:
        """Σ_k |A_k| + Σ_{j≤k} |B_jk|, (boxes, *shape)."""
        return _absolute_sum(self.terms[1:])

    @cached_property
    def magnitude(self) -> Tensor:
        """|c| + Σ_k |A_k| + r: no value of the set is larger."""
        return self.center.abs() + self.spread + self.radius

    def interval(self) -> tuple[Tensor, Tensor]:
        """(lower, upper) bounds of the set, rounded outwards; infinite where nothing is known."""
        slack = self.radius + 4 * len(self.terms) * EPSILON * self.magnitude + TINY
        lower, upper = self.center - self._reach(-1) - slack, self.center + self._reach(1) + slack
        known = lower.isfinite() & upper.isfinite()
        return lower.where(known, -torch.inf), upper.where(known, torch.inf)

    def _reach(self, sign: int) -> Tensor:
        """An upper bound of ±(Σ_k A_k ε_k + Σ_{j≤k} B_jk ε_j ε_k), which is exact where B is diagonal.

        With |ε_j ε_k| ≤ ½ (ε_j² + ε_k²) it splits into d parabolas A_k ε + m_k ε², m_k = ±B_kk + ½ Σ_{j≠k} |B_jk|.
        """
        if not len(self.products):
            return self.spread
        m = torch.zeros_like(self.coefficients)
        for (j, k), B in zip(self.pairs, self.products, strict=True):
            if j == k:
                m[k] += sign * B
            else:
                m[j] += B.abs() / 2
                m[k] += B.abs() / 2
        A = self.coefficients.abs()
        inner = -2 * m > A  # the vertex lies within the box
        return torch.where(inner, A**2 / torch.where(inner, -4 * m, 1.0), A + m).sum(0)

    @property
    def excess(self) -> Tensor:
        """What the bounds have beyond those of the linear part, to either side on average."""
        lower, upper = self.interval()
        return (upper - lower) / 2 - _absolute_sum(self.coefficients)

    def rounded(self, operations: int = 1) -> "TaylorForm":
        """The form with room for so many rounded operations on each of its entries, in sequence or in one sum."""
        return self.with_parts(self.terms, self.radius + (2 * operations * EPSILON) * self.magnitude + TINY)

    def with_parts(self, terms: Tensor, radius: Tensor) -> "TaylorForm":
        """Another form of the same box."""
        return TaylorForm(terms, radius, self.dimension)

    def as_rank(self, rank: int) -> "TaylorForm":
        """The same value with leading axes of length 1, as broadcasting reads it."""
        ones = (1,) * (rank - len(self.shape))
        boxes = self.radius.shape[:1]
        terms = self.terms.reshape(*self.terms.shape[:1], *boxes, *ones, *self.shape)
        return self.with_parts(terms, self.radius.reshape(*boxes, *ones, *self.shape))


def box_form(lower: Tensor, upper: Tensor, degree: int = 1) -> TaylorForm:
    """The boxes {lower ≤ y ≤ upper} themselves, one number an axis: y_k = middle_k + ½ width_k · ε_k.

    Args:
        lower, upper: (boxes, axes) in float64. An axis along which no box has a width has no ε.
        degree: of this form and of all that are computed from it, 1 or 2.
    """
    center, half = (lower + upper) / 2, (upper - lower) / 2
    wide = wide_axes(lower, upper)
    d = len(wide)
    coefficients = (half.T[..., None] * torch.eye(lower.shape[-1], dtype=half.dtype)[:, None])[wide]
    products = center.new_zeros(d * (d + 1) // 2 if degree == 2 else 0, *center.shape)
    return TaylorForm(torch.cat([center[None], coefficients, products]), torch.zeros_like(center), d).rounded(2)


def wide_axes(lower: Tensor, upper: Tensor) -> Tensor:
    """The axes along which any of the boxes (boxes, axes) has a width; of points the first, lest they be intervals."""
    wide = torch.nonzero((upper > lower).any(0)).flatten()
    return wide if len(wide) else torch.zeros(1, dtype=torch.long)


def interval_form(lower: Tensor, upper: Tensor) -> TaylorForm:
    """The boxes as intervals, which forget that they are functions of the same point: no ε, all remainder."""
    return TaylorForm(((lower + upper) / 2)[None], (upper - lower) / 2, 0).rounded(2)


def constant_form(value: Tensor, like: TaylorForm) -> TaylorForm:
    """A value that is the same everywhere, beside the forms of `like`."""
    boxes = len(like.radius)
    center = value.expand(boxes, *value.shape)
    coefficients = torch.zeros(len(like.terms) - 1, *center.shape, dtype=value.dtype)
    return like.with_parts(torch.cat([center[None], coefficients]), torch.zeros_like(center))


def aligned(*forms: TaylorForm) -> list[TaylorForm]:
    """The forms with as many axes each, as broadcasting reads them."""
    rank = max(len(form.shape) for form in forms)
    return [form.as_rank(rank) for form in forms]


# Affine operations


def add(x: TaylorForm, y: TaylorForm) -> TaylorForm:
    """x + y: coefficients add, with their signs, and so do remainders."""
    x, y = aligned(x, y)
    return x.with_parts(x.terms + y.terms, x.radius + y.radius).rounded()


def shift(x: TaylorForm, offset: Tensor) -> TaylorForm:
    """x + offset."""
    x = x.as_rank(max(len(x.shape), offset.ndim))
    center = x.center + offset
    terms = torch.cat([center[None], x.terms[1:].expand(-1, *center.shape)])
    return x.with_parts(terms, x.radius.expand_as(center)).rounded()


def scale(x: TaylorForm, factor: Tensor) -> TaylorForm:
    """factor · x, entry by entry; the remainder takes |factor|."""
    x = x.as_rank(max(len(x.shape), factor.ndim))
    return x.with_parts(x.terms * factor, x.radius * factor.abs()).rounded()


def negate(x: TaylorForm) -> TaylorForm:
    """−x, exactly."""
    return x.with_parts(-x.terms, x.radius)


def matrix_product(x: TaylorForm, weight: Tensor) -> TaylorForm:
    """x @ W: c and A_k take W, the remainder |W|, since |Σ_i η_i W_ij| ≤ Σ_i r_i |W_ij|."""
    x = x.rounded(2 * len(weight))  # γ_k Σ_i |x_i||W_ij| bounds the error of each sum, of c, A and r alike
    return x.with_parts(x.terms @ weight, x.radius @ weight.abs())


# Products


def multiply(x: TaylorForm, y: TaylorForm) -> TaylorForm:
    """x · y: with x = c + L + Q + η and y = c' + L' + Q' + η', L of first and Q of second degree in ε,

        xy = cc' + (cL' + c'L) + (cQ' + c'Q + LL') + (LQ' + QL' + QQ') + (c + L + Q)η' + (c' + L' + Q')η + ηη'.

    The last four go into the remainder, by Σ|A| and Σ|B| of each. In forms of first degree LL' does as well: since
    ε_k² ∈ [0, 1], it lies within ½ Σ_k |A_k A'_k| + Σ_{j<k} |A_j A'_k + A_k A'_j| of ½ Σ_k A_k A'_k.
    Intervals have the products of their ends.
    """
    x, y = aligned(x, y)
    if not x.dimension:
        return _interval_product(x, y)
    (c, A, B, r), (d, E, F, s) = ((z.center, z.coefficients, z.products, z.radius) for z in (x, y))
    remainder = (c.abs() + x.spread) * s + (d.abs() + y.spread) * r + r * s
    rounding = (len(x.terms) ** 2 + 8) * EPSILON * x.magnitude * y.magnitude + TINY
    pairs = list(combinations_with_replacement(range(x.dimension), 2))
    LL = [A[j] * E[k] + (A[k] * E[j] if j != k else 0) for j, k in pairs]
    if len(B):
        terms = torch.cat([(c * d)[None], c * E + d * A, c * F + d * B + torch.stack(LL)])
        L, M, Q, P = (_absolute_sum(z) for z in (A, E, B, F))
        third = L * P + Q * M + Q * P
        return x.with_parts(terms, third + remainder + rounding)
    middle = sum((ll / 2 for (j, k), ll in zip(pairs, LL, strict=True) if j == k), torch.zeros_like(c * d))
    around = sum((ll.abs() / (1 + (j == k)) for (j, k), ll in zip(pairs, LL, strict=True)), torch.zeros_like(r + s))
    terms = torch.cat([(c * d + middle)[None], c * E + d * A])
    return x.with_parts(terms, around + remainder + rounding)


def _interval_product(x: TaylorForm, y: TaylorForm) -> TaylorForm:
    (a, b), (c, d) = x.interval(), y.interval()
    ends = torch.stack([a * c, a * d, b * c, b * d])  # 0 · ∞ is nan, which stays: nothing is known
    low, high = ends.amin(0), ends.amax(0)
    product = x.with_parts(((low + high) / 2)[None], (high - low) / 2).rounded(4)
    known = torch.isfinite(low) & torch.isfinite(high)
    return x.with_parts(torch.where(known, product.terms, 0.0), torch.where(known, product.radius, torch.inf))


# Functions of one number


Range = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


def linearised(
    x: TaylorForm,
    function: Callable[[Tensor], Tensor],
    derivative: Callable[[Tensor], Tensor],
    stationary: Callable[[Tensor, Tensor, Tensor], Sequence[Tensor]],
    defined: Callable[[Tensor, Tensor], Tensor] | None = None,
    second: Callable[[Tensor], Tensor] | None = None,
    third: Range | None = None,
) -> TaylorForm:
    """f(x) = a x + b ± e, a being the secant's slope over the interval [l, u] of x; for second degree see _expanded.

    h(x) = f(x) − a x takes its extremes on [l, u] at l, at u, or where f'(x) = a: b is their middle, e half their
    distance. Any slope is sound, so a needs no care; the secant's makes e of second order in u − l, and for convex and
    concave f the smallest possible. A point where f' = a is found up to rounding, within η = 1e-12 (1 + |x|): h there
    differs from the extreme by at most |h'|η (and terms in η², which are beyond double precision).

    Args:
        stationary: (a, lo, hi) ↦ points that include each solution of f'(x) = a in [lo, hi]; any others do no harm.
        defined: (lo, hi) ↦ whether f is smooth on [lo, hi]; the remainder is infinite where it is not.
        second, third: f'' and (lo, hi) ↦ bounds of f‴ on [lo, hi]; without them forms stay linear in x.
    """
    lo, hi = x.interval()
    known = torch.isfinite(lo) & torch.isfinite(hi)
    if defined is not None:
        known = known & defined(lo, hi)
    lo, hi = torch.where(known, lo, 1.0), torch.where(known, hi, 1.0)
    if len(x.products) and second is not None and third is not None:
        result = _expanded(x, lo, hi, function, derivative, second, third)
    else:
        result = _secant(x, lo, hi, function, derivative, stationary)
    nothing = torch.zeros_like(result.terms)
    return x.with_parts(torch.where(known, result.terms, nothing), torch.where(known, result.radius, torch.inf))


def _secant(
    x: TaylorForm,
    lo: Tensor,
    hi: Tensor,
    function: Callable[[Tensor], Tensor],
    derivative: Callable[[Tensor], Tensor],
    stationary: Callable[[Tensor, Tensor, Tensor], Sequence[Tensor]],
) -> TaylorForm:
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
    return x.with_parts(torch.cat([(a * x.center + b)[None], a * x.terms[1:]]), a.abs() * x.radius + e).rounded(2)


def _expanded(
    x: TaylorForm,
    lo: Tensor,
    hi: Tensor,
    function: Callable[[Tensor], Tensor],
    derivative: Callable[[Tensor], Tensor],
    second: Callable[[Tensor], Tensor],
    third: Range,
) -> TaylorForm:
    """f(x) by Taylor's formula in y = x − m about the middle m of [l, u], with M₋ ≤ f‴ ≤ M₊ there and |y| ≤ w:

        f(x) = f(m) + (f'(m) + M w²/8) y + ½ f''(m) y² ± (|M| w³/24 + (M₊ − M₋) w³/12),   M = ½ (M₋ + M₊),

    as y³ lies within w³/4 of ¾ w² y (Chebyshev), and f − its expansion with f‴ = M within (M₊ − M₋)/2 · w³/6.
    """
    m = (lo + hi) / 2
    w = (hi - lo) / 2 * (1 + 8 * EPSILON) + 4 * EPSILON * m.abs()
    low, high = third(lo, hi)  # not of m ± w, which may leave what f is defined on
    M = (low + high) / 2
    a, b, c = function(m), derivative(m) + M * w**2 / 8, second(m) / 2
    e = (M.abs() / 24 + (high - low) / 12) * w**3 * (1 + 1e-9)
    e = e + 32 * EPSILON * (a.abs() + b.abs() * w + (c.abs() + M.abs() * w) * w**2) + TINY
    y = x.with_parts(torch.cat([(x.center - m)[None], x.terms[1:]]), x.radius).rounded()
    yy = multiply(y, y)
    terms, radius = b * y.terms + c * yy.terms, b.abs() * y.radius + c.abs() * yy.radius
    return x.with_parts(torch.cat([(terms[0] + a)[None], terms[1:]]), radius + e).rounded(4)


def square(x: TaylorForm) -> TaylorForm:
    """x²; 2x = a."""
    if len(x.products):
        return multiply(x, x)
    return linearised(x, lambda v: v * v, lambda v: 2 * v, lambda a, lo, hi: [a / 2])


def exp(x: TaylorForm) -> TaylorForm:
    """eˣ; eˣ = a."""
    return linearised(
        x, torch.exp, torch.exp, lambda a, lo, hi: [torch.log(a)],
        second=torch.exp, third=lambda lo, hi: _between(lo.exp(), hi.exp()),
    )  # fmt: skip


def log(x: TaylorForm) -> TaylorForm:
    """log x for x > 0; 1/x = a."""
    return linearised(
        x, torch.log, torch.reciprocal, lambda a, lo, hi: [1 / a], lambda lo, hi: lo > 0,
        lambda v: -1 / v**2, lambda lo, hi: _between(2 / hi**3, 2 / lo**3),
    )  # fmt: skip


def log1p(x: TaylorForm) -> TaylorForm:
    """log(1 + x) for x > −1; 1/(1 + x) = a."""
    return linearised(
        x, torch.log1p, lambda v: 1 / (1 + v), lambda a, lo, hi: [1 / a - 1], lambda lo, hi: lo > -1,
        lambda v: -1 / (1 + v) ** 2, lambda lo, hi: _between(2 / (1 + hi) ** 3, 2 / (1 + lo) ** 3),
    )  # fmt: skip


def sqrt(x: TaylorForm) -> TaylorForm:
    """√x for x > 0; 1/(2√x) = a."""
    return linearised(
        x, torch.sqrt, lambda v: 0.5 / v.sqrt(), lambda a, lo, hi: [1 / (4 * a * a)], lambda lo, hi: lo > 0,
        lambda v: -0.25 * v**-1.5, lambda lo, hi: _between(0.375 * hi**-2.5, 0.375 * lo**-2.5),
    )  # fmt: skip


def reciprocal(x: TaylorForm) -> TaylorForm:
    """1/x for x of one sign; −1/x² = a."""

    def stationary(a: Tensor, lo: Tensor, hi: Tensor) -> Sequence[Tensor]:
        return [torch.copysign((-a).rsqrt(), lo)]

    def third(lo: Tensor, hi: Tensor) -> tuple[Tensor, Tensor]:
        ends = torch.stack([-6 / lo**4, -6 / hi**4])
        return _between(ends.amin(0), ends.amax(0))

    return linearised(
        x, torch.reciprocal, lambda v: -1 / (v * v), stationary, lambda lo, hi: (lo > 0) | (hi < 0),
        lambda v: 2 / v**3, third,
    )  # fmt: skip


def sigmoid(x: TaylorForm) -> TaylorForm:
    """σ(x) = 1/(1 + e⁻ˣ); σ(1 − σ) = a at x = ±(log s − log(1 − s)), s = 2a/(1 + √(1 − 4a))."""

    def stationary(a: Tensor, lo: Tensor, hi: Tensor) -> Sequence[Tensor]:
        s = 2 * a / (1 + (1 - 4 * a).clamp_min(0).sqrt())  # the smaller root, without cancellation
        point = _logit(s)
        return [point, -point]

    def third(lo: Tensor, hi: Tensor) -> tuple[Tensor, Tensor]:
        # p − 6p² with p = σ', which falls with |x|; the parabola has its top at p = 1/12
        ends = torch.stack([_sigmoid_derivative(lo), _sigmoid_derivative(hi)])
        top = torch.where((lo < 0) & (hi > 0), 0.25, ends.amax(0))
        p = torch.stack([ends.amin(0), top, (ends.amin(0)).maximum(top.clamp_max(1 / 12))])
        values = p - 6 * p**2
        return _between(values.amin(0), values.amax(0))

    return linearised(x, torch.sigmoid, _sigmoid_derivative, stationary, None, _sigmoid_curvature, third)


def softplus(x: TaylorForm) -> TaylorForm:
    """log(1 + eˣ); σ(x) = a."""

    def third(lo: Tensor, hi: Tensor) -> tuple[Tensor, Tensor]:
        # σ'' has its extremes where σ' = 1/6
        steepest = torch.log(torch.tensor(2 + 3**0.5, dtype=lo.dtype))
        points = torch.stack([lo, hi, steepest.clamp(lo, hi), (-steepest).clamp(lo, hi)])
        values = _sigmoid_curvature(points)
        return _between(values.amin(0), values.amax(0))

    return linearised(
        x, _softplus, torch.sigmoid, lambda a, lo, hi: [_logit(a)], None, _sigmoid_derivative, third
    )  # fmt: skip


def sin(x: TaylorForm) -> TaylorForm:
    """sin x on at most two periods; cos x = a at x = ±arccos a + 2πk."""

    def stationary(a: Tensor, lo: Tensor, hi: Tensor) -> Sequence[Tensor]:
        return _periodic(torch.acos(a.clamp(-1, 1)), lo, hi)

    return linearised(
        x, torch.sin, torch.cos, stationary, _two_periods,
        lambda v: -torch.sin(v), lambda lo, hi: _around(lambda v: -torch.cos(v), lo, hi),
    )  # fmt: skip


def cos(x: TaylorForm) -> TaylorForm:
    """cos x on at most two periods; −sin x = a at x = −π/2 ± arccos a + 2πk."""

    def stationary(a: Tensor, lo: Tensor, hi: Tensor) -> Sequence[Tensor]:
        quarter = torch.pi / 2
        return [point - quarter for point in _periodic(torch.acos(a.clamp(-1, 1)), lo + quarter, hi + quarter)]

    return linearised(
        x, torch.cos, lambda v: -torch.sin(v), stationary, _two_periods,
        lambda v: -torch.cos(v), lambda lo, hi: _around(torch.sin, lo, hi),
    )  # fmt: skip


def _between(low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """A range with room for the rounding of its ends."""
    room = 64 * EPSILON * torch.maximum(low.abs(), high.abs()) + TINY
    return low - room, high + room


def _around(wave: Callable[[Tensor], Tensor], lo: Tensor, hi: Tensor) -> tuple[Tensor, Tensor]:
    """The range of a sine or cosine on [lo, hi], from its value in the middle: its slope is at most 1."""
    middle, reach = wave((lo + hi) / 2), (hi - lo) / 2 + 2 * EPSILON * torch.maximum(-lo, hi)
    return _between((middle - reach).clamp_min(-1), (middle + reach).clamp_max(1))


def tan(x: TaylorForm) -> TaylorForm:
    """tan x on one branch, kept off its poles; 1 + tan² x = a at x = ±atan √(a − 1) + πk."""

    def branch(lo: Tensor, hi: Tensor) -> Tensor:
        return ((lo + hi) / (2 * torch.pi)).round() * torch.pi

    def stationary(a: Tensor, lo: Tensor, hi: Tensor) -> Sequence[Tensor]:
        base = torch.atan((a - 1).clamp_min(0).sqrt())
        return [branch(lo, hi) - base, branch(lo, hi) + base]

    def defined(lo: Tensor, hi: Tensor) -> Tensor:
        return (lo - branch(lo, hi) > -1.57) & (hi - branch(lo, hi) < 1.57)

    return linearised(x, torch.tan, lambda v: 1 + torch.tan(v) ** 2, stationary, defined)


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
    return torch.sigmoid(v) * torch.sigmoid(-v)  # 1 − σ would lose all its digits where σ is close to 1


def _sigmoid_curvature(v: Tensor) -> Tensor:
    return -_sigmoid_derivative(v) * torch.tanh(v / 2)


def _softplus(v: Tensor) -> Tensor:
    return v.clamp_min(0) + torch.log1p(torch.exp(-v.abs()))


def _absolute_sum(terms: Tensor) -> Tensor:
    """Σ |term| over the first axis."""
    return terms.abs().sum(0)

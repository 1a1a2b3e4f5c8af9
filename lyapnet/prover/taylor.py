"""Arithmetic of Taylor forms on batches of boxes: sets of values as polynomials with a rigorous remainder.

Rounding. Forms enclose the values of real arithmetic on the given float64 numbers. Every operation here adds to its
remainder a bound of its own rounding errors: a multiple of ε = 2⁻⁵² times the magnitudes that entered it, at least
twice what the standard model |fl(a ∘ b) − a ∘ b| ≤ ½ε|a ∘ b| gives for sums in any order. One thing is taken on
trust: that the elementary functions of torch, and of the C library where lyapnet.prover.bound_kernel uses them, err by
at most 8 ε (1.2 ε is the most that was seen of torch's, against mpmath).

Underflow. Below 2⁻¹⁰²² ≈ 2.2e-308 the model fails: a result errs by up to that number besides, if a processor replaces
subnormal numbers by zero, and by less if not. So there is one rule: whatever is rounded errs by a multiple of ε times
its size, plus TINY = 1e-300. This is room for 4e7 operations on an entry, more than any has.

- The remainder of each result takes TINY, after all its products. An error that is multiplied afterwards takes part: a
  remainder does by itself, and a coefficient counts as larger by FLOOR = TINY/ε where its rounding is bounded.
- A product of three factors is formed so that nothing between underflows when the result does not: A·(A/m) with
  A ≤ 2m, not A²/m; ((M·w)·w)·w, not M·w³; ε·(a·b), not (ε·a)·b.
- Overflow gives an infinity or a nan, in terms or in the remainder, and `interval` gives infinite bounds for either.

Numbers below 1e-300 are thus bounded, but not told from zero; and where derivatives underflow, bounds are wide.

Sources: de Figueiredo, Stolfi, "Affine arithmetic: concepts and applications", Numerical Algorithms 2004, for the first
degree; Neumaier, "Taylor forms: use and limits", Reliable Computing 2003, for higher ones. The remainder here is one
number for each entry, instead of a new noise symbol for each operation.
"""

from dataclasses import dataclass
from functools import cache, cached_property
from itertools import combinations_with_replacement

import torch
from torch import Tensor

from lyapnet.base.types import Corners, OnBoxes, Terms

EPSILON = torch.finfo(torch.float64).eps
TINY = 1e-300
FLOOR = TINY / EPSILON


@dataclass(frozen=True, eq=False)
class TaylorForm:
    """The set {c + Σ_k A_k ε_k + Σ_{j≤k} B_jk ε_j ε_k + Σ_{i≤j≤k} C_ijk ε_i ε_j ε_k + η : |ε_k| ≤ 1, |η| ≤ r} for each
    box and entry.

    ε_1 … ε_d run over the box and are shared by all its forms; η is anything, another one in each form and entry. A
    form of first degree has no B and no C: what is of second order in the size of the box is in r. With B, r is of
    third order, and with C of fourth; and what cancels in a sum of products (as V_xᵀf + q does against
    ¼ V_xᵀ g R⁻¹ gᵀ V_x) cancels in the bounds too. With d = 0 forms are intervals, and what is computed with them is
    interval arithmetic.

    Args:
        terms: c, A, B and C in the order of `monomials`, as many as the degree asks for; (terms, boxes, *shape).
        radius: r ≥ 0, (boxes, *shape); infinite or nan where nothing is known.
        dimension: d.
    """

    terms: Terms
    radius: OnBoxes
    dimension: int

    @property
    def shape(self) -> torch.Size:
        """The shape of the value at one point."""
        return self.radius.shape[1:]

    @property
    def center(self) -> OnBoxes:
        """c."""
        return self.terms[0]

    @property
    def coefficients(self) -> Terms:
        """A, (d, boxes, *shape)."""
        return self.terms[1 : 1 + self.dimension]

    @property
    def products(self) -> Terms:
        """B, (d(d + 1)/2 or 0, boxes, *shape)."""
        return self.of_degree(2)

    @property
    def degree(self) -> int:
        """That of the polynomial; an interval counts as one of first degree."""
        return next(k for k in (1, 2, 3) if len(monomials(self.dimension, k)) == len(self.terms))

    def of_degree(self, k: int) -> Terms:
        """The terms of degree k."""
        start = len(monomials(self.dimension, k - 1)) if k else 0
        return self.terms[start : len(monomials(self.dimension, k))]

    @cached_property
    def spread(self) -> OnBoxes:
        """Σ |A| + Σ |B| + Σ |C|."""
        return _absolute_sum(self.terms[1:])

    @cached_property
    def magnitude(self) -> OnBoxes:
        """|c| + Σ_k |A_k| + r: no value of the set is larger."""
        return self.center.abs() + self.spread + self.radius

    def interval(self) -> tuple[OnBoxes, OnBoxes]:
        """(lower, upper) bounds of the set, rounded outwards; infinite where nothing is known."""
        slack = self.radius + 4 * len(self.terms) * EPSILON * self.magnitude + TINY
        lower, upper = self.center - self._reach(-1) - slack, self.center + self._reach(1) + slack
        known = lower.isfinite() & upper.isfinite()
        return lower.where(known, -torch.inf), upper.where(known, torch.inf)

    def _reach(self, sign: int) -> OnBoxes:
        """An upper bound of ±(Σ A_k ε_k + Σ B_jk ε_j ε_k + Σ C_ijk ε_i ε_j ε_k), exact for a diagonal B without C.

        With |ε_j ε_k| ≤ ½ (ε_j² + ε_k²) it splits into d parabolas A_k ε + m_k ε², m_k = ±B_kk + ½ Σ_{j≠k} |B_jk|, and
        Σ |C|.
        """
        if not len(self.products):
            return self.spread
        m = torch.zeros_like(self.coefficients)
        for (j, k), B in zip(monomials(self.dimension, 2)[1 + self.dimension :], self.products, strict=True):
            if j == k:
                m[k] += sign * B
            else:
                m[j] += B.abs() / 2
                m[k] += B.abs() / 2
        A = self.coefficients.abs()
        inner = -2 * m > A  # the vertex lies within the box
        parabolas = torch.where(inner, A * (A / torch.where(inner, -4 * m, 1.0)), A + m).sum(0)
        return parabolas + _absolute_sum(self.of_degree(3)) if self.degree == 3 else parabolas

    @property
    def excess(self) -> OnBoxes:
        """What the bounds have beyond those of the linear part, to either side on average."""
        lower, upper = self.interval()
        return (upper - lower) / 2 - _absolute_sum(self.coefficients)

    def rounded(self, operations: int = 1) -> "TaylorForm":
        """The form with room for so many rounded operations on each of its entries, in sequence or in one sum."""
        return self.with_parts(self.terms, self.radius + (2 * operations * EPSILON) * self.magnitude + TINY)

    def with_parts(self, terms: Terms, radius: OnBoxes) -> "TaylorForm":
        """Another form of the same box."""
        return TaylorForm(terms, radius, self.dimension)

    def as_rank(self, rank: int) -> "TaylorForm":
        """The same value with leading axes of length 1, as broadcasting reads it."""
        ones = (1,) * (rank - len(self.shape))
        boxes = self.radius.shape[:1]
        terms = self.terms.reshape(*self.terms.shape[:1], *boxes, *ones, *self.shape)
        return self.with_parts(terms, self.radius.reshape(*boxes, *ones, *self.shape))


@cache
def monomials(dimension: int, degree: int) -> list[tuple[int, ...]]:
    """The axes of each monomial of ε_1 … ε_d up to a degree, by degree: (), (0,), …, (0, 0), (0, 1), …"""
    return [axes for k in range(degree + 1) for axes in combinations_with_replacement(range(dimension), k)]


@cache
def _places(dimension: int, degree: int, device: torch.device) -> list[tuple[int, Tensor]]:
    """(i, where the products of monomial i with the first few of degree 1 and more stand), but for constants."""
    every = monomials(dimension, degree)
    number = {axes: k for k, axes in enumerate(every)}
    places = []
    for i, axes in enumerate(every):
        if 0 < len(axes) < degree:
            others = [other for other in every[1:] if len(axes) + len(other) <= degree]
            places.append((i, torch.tensor([number[tuple(sorted(axes + other))] for other in others], device=device)))
    return places


def box_form(lower: Corners, upper: Corners, degree: int = 1) -> TaylorForm:
    """The boxes {lower ≤ y ≤ upper} themselves, one number an axis: y_k = middle_k + ½ width_k · ε_k.

    Args:
        lower, upper: in float64. An axis along which no box has a width has no ε.
        degree: of this form and of all that are computed from it, 1, 2 or 3.
    """
    center, half = (lower + upper) / 2, (upper - lower) / 2
    wide = wide_axes(lower, upper)
    d = len(wide)
    coefficients = (half.T[..., None] * torch.eye(lower.shape[-1], dtype=half.dtype)[:, None])[wide]
    higher = center.new_zeros(len(monomials(d, degree)) - 1 - d, *center.shape)
    return TaylorForm(torch.cat([center[None], coefficients, higher]), torch.zeros_like(center), d).rounded(2)


def wide_axes(lower: Corners, upper: Corners) -> Tensor:
    """The axes along which any of the boxes has a width; the first for points, which would be intervals without one."""
    wide = torch.nonzero((upper > lower).any(0)).flatten()
    return wide if len(wide) else torch.zeros(1, dtype=torch.long)


def interval_form(lower: Corners, upper: Corners) -> TaylorForm:
    """The boxes as intervals, which forget that they are functions of the same point: no ε, all remainder."""
    return TaylorForm(((lower + upper) / 2)[None], (upper - lower) / 2, 0).rounded(2)


def constant_form(value: Tensor, like: TaylorForm) -> TaylorForm:
    """A value that is the same everywhere, beside the forms of `like`."""
    boxes = len(like.radius)
    center = value.to(like.radius.dtype).expand(boxes, *value.shape)
    coefficients = torch.zeros(len(like.terms) - 1, *center.shape, dtype=center.dtype)
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
    return x.with_parts(x.terms @ weight, x.radius @ weight.abs() + TINY)


# Products


def multiply(x: TaylorForm, y: TaylorForm) -> TaylorForm:
    """x · y: with x = c + L + Q + η and y = c' + L' + Q' + η', L of first and Q of second degree in ε,

        xy = cc' + (cL' + c'L) + (cQ' + c'Q + LL') + (LQ' + QL' + QQ') + (c + L + Q)η' + (c' + L' + Q')η + ηη'.

    The last four go into the remainder, by Σ|A| and Σ|B| of each; in forms of third degree LQ' + QL' does not, but what
    C makes with all but constants. In forms of first degree LL' does as well: since ε_k² ∈ [0, 1], it lies within
    ½ Σ_k |A_k A'_k| + Σ_{j<k} |A_j A'_k + A_k A'_j| of ½ Σ_k A_k A'_k. Intervals have the products of their ends.
    """
    x, y = aligned(x, y)
    if not x.dimension:
        return interval_product(x, y)
    remainder = (x.center.abs() + x.spread) * y.radius + (y.center.abs() + y.spread) * x.radius + x.radius * y.radius
    rounding = (len(x.terms) ** 2 + 8) * EPSILON * (x.magnitude * y.magnitude) + TINY
    if x.degree == 1:
        terms, beyond = _linear_product(x, y)
    else:
        terms, beyond = _product(x, y)
    return x.with_parts(terms, beyond + remainder + rounding)


def _linear_product(x: TaylorForm, y: TaylorForm) -> tuple[Terms, OnBoxes]:
    """(the terms, a bound of what LL' has beyond them) of forms of first degree."""
    A, E = x.coefficients, y.coefficients
    middle, around = torch.zeros_like(x.center * y.center), torch.zeros_like(x.radius * y.radius)
    for j, k in combinations_with_replacement(range(x.dimension), 2):
        if j == k:
            middle, around = middle + A[k] * E[k] / 2, around + (A[k] * E[k]).abs() / 2
        else:
            around = around + (A[j] * E[k] + A[k] * E[j]).abs()
    return torch.cat([(x.center * y.center + middle)[None], x.center * E + y.center * A]), around


def _product(x: TaylorForm, y: TaylorForm) -> tuple[Terms, OnBoxes]:
    """(the terms up to the degree of the forms, a bound of those beyond) of the product of two polynomials."""
    terms = x.center * y.terms
    terms[1:] += y.center * x.terms[1:]
    for i, at in _places(x.dimension, x.degree, terms.device):
        terms.index_add_(0, at, x.terms[i] * y.terms[1 : 1 + len(at)])
    sizes = [[_absolute_sum(z.of_degree(k)) for k in range(1, x.degree + 1)] for z in (x, y)]
    beyond = [a * b for j, a in enumerate(sizes[0], 1) for k, b in enumerate(sizes[1], 1) if j + k > x.degree]
    return terms, torch.stack(beyond).sum(0)


def interval_product(x: TaylorForm, y: TaylorForm) -> TaylorForm:
    """x · y of intervals, from the products of their ends."""
    (a, b), (c, d) = x.interval(), y.interval()
    ends = torch.stack([a * c, a * d, b * c, b * d])  # 0 · ∞ is nan, which stays: nothing is known
    low, high = ends.amin(0), ends.amax(0)
    product = x.with_parts(((low + high) / 2)[None], (high - low) / 2).rounded(4)
    known = torch.isfinite(low) & torch.isfinite(high)
    return x.with_parts(torch.where(known, product.terms, 0.0), torch.where(known, product.radius, torch.inf))


def _absolute_sum(terms: Tensor) -> Tensor:
    """Σ |term| over the first axis."""
    return terms.abs().sum(0)

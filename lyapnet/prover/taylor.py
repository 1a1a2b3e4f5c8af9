"""Arithmetic of Taylor forms on batches of boxes: sets of values as polynomials with a rigorous remainder.

Rounding. A form encloses the values that exact real arithmetic gives for the float64 numbers of a function. Each
operation adds a bound of its own rounding errors to the remainder: a multiple of ε = 2⁻⁵² times the magnitudes of its
operands. This is at least twice the error that the standard model |fl(a ∘ b) − a ∘ b| ≤ ½ε|a ∘ b| gives for sums in any
order. One assumption remains: the elementary functions of torch, and those of the C library that
lyapnet.prover.bound_kernel uses, have a relative error of at most 8 ε. The largest error of torch's functions that was
measured against mpmath is 1.2 ε.

Underflow. The model fails for results below 2⁻¹⁰²² ≈ 2.2e-308. If the processor replaces subnormal numbers by zero,
such a result has an additional error of up to 2⁻¹⁰²², otherwise a smaller one. So there is one rule: the error of a
rounded result is at most a multiple of ε times its size, plus TINY = 1e-300. This leaves room for 4e7 operations on an
entry, more than any entry has.

- TINY is added to the remainder of each result, after all products. An underflow error that is multiplied later grows
  with the factor. A remainder already contains its error; for a coefficient, the bound of rounding replaces the size
  |A| by |A| + FLOOR with FLOOR = TINY/ε, since ε · FLOOR = TINY.
- Products of three factors are ordered so that no intermediate result underflows unless the final one does: A·(A/m)
  with A ≤ 2m, not A²/m; ((M·w)·w)·w, not M·w³; ε·(a·b), not (ε·a)·b.
- Overflow gives an infinity or a nan, in terms or in the remainder; `interval` then returns infinite bounds.

So bounds of numbers below 1e-300 are correct but contain 0, and bounds are wide where derivatives underflow.

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

    ε_1 … ε_d are the coordinates of a point in the box, scaled to [−1, 1]; all forms of the box share them. η is an
    unknown number, independent in each form and entry. A form of first degree has no B and no C: r bounds all terms of
    second order in the size of the box. With B, r is of third order; with C, of fourth. So terms that cancel in a sum
    of products (as V_xᵀf + q and ¼ V_xᵀ g R⁻¹ gᵀ V_x do) cancel in the bounds too. With d = 0 forms are intervals, and
    their arithmetic is interval arithmetic.

    Args:
        terms: c, A, B and C in the order of `monomials`, up to the degree; (terms, boxes, *shape).
        radius: r ≥ 0, (boxes, *shape); infinite or nan where no bound is known.
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
        """The degree of the polynomial; 1 for an interval."""
        return next(k for k in (1, 2, 3) if len(monomials(self.dimension, k)) == len(self.terms))

    def of_degree(self, k: int) -> Terms:
        """The terms of degree k."""
        start = len(monomials(self.dimension, k - 1)) if k else 0
        return self.terms[start : len(monomials(self.dimension, k))]

    @cached_property
    def spread(self) -> OnBoxes:
        """Σ |A| + Σ |B| + Σ |C|: the polynomial is nowhere farther from c, since |ε_k| ≤ 1."""
        return _absolute_sum(self.terms[1:])

    @cached_property
    def magnitude(self) -> OnBoxes:
        """|c| + Σ |A| + Σ |B| + Σ |C| + r, an upper bound of |y| for all y of the set."""
        return self.center.abs() + self.spread + self.radius

    def interval(self) -> tuple[OnBoxes, OnBoxes]:
        """(lower, upper) bounds of the set, with room for rounding; both are infinite where one is not finite."""
        slack = self.radius + 4 * len(self.terms) * EPSILON * self.magnitude + TINY
        lower, upper = self.center - self._reach(-1) - slack, self.center + self._reach(1) + slack
        known = lower.isfinite() & upper.isfinite()
        return lower.where(known, -torch.inf), upper.where(known, torch.inf)

    def _reach(self, sign: int) -> OnBoxes:
        """An upper bound of ±(Σ A_k ε_k + Σ B_jk ε_j ε_k + Σ C_ijk ε_i ε_j ε_k), exact if B is diagonal and C = 0.

        Since |ε_j ε_k| ≤ ½ (ε_j² + ε_k²), it is at most the sum of the maxima of d parabolas |A_k| ε + m_k ε² over
        0 ≤ ε ≤ 1, with m_k = ±B_kk + ½ Σ_{j≠k} |B_jk|, plus Σ |C|. A parabola has its maximum −A_k²/(4 m_k) at its
        vertex if that lies in the box, and |A_k| + m_k at the end if not.
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
        inner = -2 * m > A  # the vertex lies in the box
        parabolas = torch.where(inner, A * (A / torch.where(inner, -4 * m, 1.0)), A + m).sum(0)
        return parabolas + _absolute_sum(self.of_degree(3)) if self.degree == 3 else parabolas

    @property
    def excess(self) -> OnBoxes:
        """Half the width of the bounds minus Σ |A|, half the width of the bounds of the linear part."""
        lower, upper = self.interval()
        return (upper - lower) / 2 - _absolute_sum(self.coefficients)

    def with_rounding(self, operations: int = 1) -> "TaylorForm":
        """The form with a larger r, for the errors of this many rounded operations on each entry, in turn or a sum."""
        return self.with_parts(self.terms, self.radius + (2 * operations * EPSILON) * self.magnitude + TINY)

    def with_parts(self, terms: Terms, radius: OnBoxes) -> "TaylorForm":
        """A form with other terms and another r, in the same ε."""
        return TaylorForm(terms, radius, self.dimension)

    def as_rank(self, rank: int) -> "TaylorForm":
        """The same value with leading axes of length 1, as broadcasting adds them."""
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
    """For each monomial i of degree ≥ 1: (i, the positions of its products with monomials 1, 2, … in `monomials`).

    Products above the degree are left out; they are those with the last monomials.
    """
    every = monomials(dimension, degree)
    number = {axes: k for k, axes in enumerate(every)}
    places = []
    for i, axes in enumerate(every):
        if 0 < len(axes) < degree:
            others = [other for other in every[1:] if len(axes) + len(other) <= degree]
            places.append((i, torch.tensor([number[tuple(sorted(axes + other))] for other in others], device=device)))
    return places


def box_form(lower: Corners, upper: Corners, degree: int = 1) -> TaylorForm:
    """The coordinates of points in the boxes {lower ≤ y ≤ upper}: y_k = middle_k + ½ width_k · ε_k.

    Args:
        lower, upper: in float64. An axis along which all boxes have width 0 has no ε.
        degree: 1, 2 or 3; the degree of this form and of all forms computed from it.
    """
    center, half = (lower + upper) / 2, (upper - lower) / 2
    wide = wide_axes(lower, upper)
    d = len(wide)
    coefficients = (half.T[..., None] * torch.eye(lower.shape[-1], dtype=half.dtype)[:, None])[wide]
    higher = center.new_zeros(len(monomials(d, degree)) - 1 - d, *center.shape)
    return TaylorForm(torch.cat([center[None], coefficients, higher]), torch.zeros_like(center), d).with_rounding(2)


def wide_axes(lower: Corners, upper: Corners) -> Tensor:
    """The axes along which some box has a width > 0; axis 0 if there are none, as a form without ε is an interval."""
    wide = torch.nonzero((upper > lower).any(0)).flatten()
    return wide if len(wide) else torch.zeros(1, dtype=torch.long)


def interval_form(lower: Corners, upper: Corners) -> TaylorForm:
    """The coordinates of points in boxes as intervals, forms without ε, which do not know that they share the point."""
    return TaylorForm(((lower + upper) / 2)[None], (upper - lower) / 2, 0).with_rounding(2)


def constant_form(value: Tensor, like: TaylorForm) -> TaylorForm:
    """A value that does not depend on the point, as a form with the boxes and the ε of `like`."""
    boxes = len(like.radius)
    center = value.to_dense().to(like.radius.dtype).expand(boxes, *value.shape)
    coefficients = torch.zeros(len(like.terms) - 1, *center.shape, dtype=center.dtype)
    return like.with_parts(torch.cat([center[None], coefficients]), torch.zeros_like(center))


def aligned(*forms: TaylorForm) -> list[TaylorForm]:
    """The forms with equal numbers of axes, as broadcasting gives them."""
    rank = max(len(form.shape) for form in forms)
    return [form.as_rank(rank) for form in forms]


# Affine operations


def add(x: TaylorForm, y: TaylorForm) -> TaylorForm:
    """x + y: the terms add, and the remainders add, since |η + η'| ≤ r + r'."""
    x, y = aligned(x, y)
    return x.with_parts(x.terms + y.terms, x.radius + y.radius).with_rounding()


def shift(x: TaylorForm, offset: Tensor) -> TaylorForm:
    """x + offset: the offset is added to c."""
    x = x.as_rank(max(len(x.shape), offset.ndim))
    center = x.center + offset
    terms = torch.cat([center[None], x.terms[1:].expand(-1, *center.shape)])
    return x.with_parts(terms, x.radius.expand_as(center)).with_rounding()


def scale(x: TaylorForm, factor: Tensor) -> TaylorForm:
    """factor · x, entry by entry; the remainder is multiplied by |factor|."""
    x = x.as_rank(max(len(x.shape), factor.ndim))
    return x.with_parts(x.terms * factor, x.radius * factor.abs()).with_rounding()


def negate(x: TaylorForm) -> TaylorForm:
    """−x, without rounding; the remainder stays."""
    return x.with_parts(-x.terms, x.radius)


def matrix_product(x: TaylorForm, weight: Tensor) -> TaylorForm:
    """x @ W: the terms are multiplied by W, the remainder by |W|, since |Σ_i η_i W_ij| ≤ Σ_i r_i |W_ij|."""
    x = x.with_rounding(2 * len(weight))  # the error of a sum of k products is at most kε Σ_i |x_i||W_ij|
    return x.with_parts(x.terms @ weight, x.radius @ weight.abs() + TINY)


# Products


def multiply(x: TaylorForm, y: TaylorForm) -> TaylorForm:
    """x · y: with x = c + L + Q + η and y = c' + L' + Q' + η', L of first and Q of second degree in ε,

        xy = cc' + (cL' + c'L) + (cQ' + c'Q + LL') + (LQ' + QL' + QQ') + (c + L + Q)η' + (c' + L' + Q')η + ηη'.

    The last four summands go into the remainder, bounded by |L| ≤ Σ|A|, |Q| ≤ Σ|B| and |η| ≤ r. In forms of third
    degree LQ' + QL' stays among the terms, and the products of degree 4 and higher go into the remainder. In forms of
    first degree LL' has no terms of its own: since ε_k² ∈ [0, 1], it lies within
    ½ Σ_k |A_k A'_k| + Σ_{j<k} |A_j A'_k + A_k A'_j| of ½ Σ_k A_k A'_k. Intervals are multiplied by interval_product.
    """
    x, y = aligned(x, y)
    if not x.dimension:
        return interval_product(x, y)
    remainder = (x.center.abs() + x.spread) * y.radius + (y.center.abs() + y.spread) * x.radius + x.radius * y.radius
    rounding = (len(x.terms) ** 2 + 8) * EPSILON * (x.magnitude * y.magnitude) + TINY
    if x.degree == 1:
        terms, higher = _linear_product(x, y)
    else:
        terms, higher = _product(x, y)
    return x.with_parts(terms, higher + remainder + rounding)


def _linear_product(x: TaylorForm, y: TaylorForm) -> tuple[Terms, OnBoxes]:
    """(the terms of the product, a bound of the rest of LL') for forms of first degree, as in `multiply`."""
    A, E = x.coefficients, y.coefficients
    middle, rest = torch.zeros_like(x.center * y.center), torch.zeros_like(x.radius * y.radius)
    for j, k in combinations_with_replacement(range(x.dimension), 2):
        if j == k:
            middle, rest = middle + A[k] * E[k] / 2, rest + (A[k] * E[k]).abs() / 2
        else:
            rest = rest + (A[j] * E[k] + A[k] * E[j]).abs()
    return torch.cat([(x.center * y.center + middle)[None], x.center * E + y.center * A]), rest


def _product(x: TaylorForm, y: TaylorForm) -> tuple[Terms, OnBoxes]:
    """(the terms up to the degree of the forms, a bound of those above it) of the product of two polynomials."""
    terms = x.center * y.terms
    terms[1:] += y.center * x.terms[1:]
    for i, at in _places(x.dimension, x.degree, terms.device):
        terms.index_add_(0, at, x.terms[i] * y.terms[1 : 1 + len(at)])
    sizes = [[_absolute_sum(z.of_degree(k)) for k in range(1, x.degree + 1)] for z in (x, y)]
    higher = [a * b for j, a in enumerate(sizes[0], 1) for k, b in enumerate(sizes[1], 1) if j + k > x.degree]
    return terms, torch.stack(higher).sum(0)


def interval_product(x: TaylorForm, y: TaylorForm) -> TaylorForm:
    """x · y of intervals [a, b] and [c, d]: between the least and the greatest of ac, ad, bc and bd."""
    (a, b), (c, d) = x.interval(), y.interval()
    ends = torch.stack([a * c, a * d, b * c, b * d])  # 0 · ∞ is nan, and so are then both bounds: none is known
    low, high = ends.amin(0), ends.amax(0)
    product = x.with_parts(((low + high) / 2)[None], (high - low) / 2).with_rounding(4)
    known = torch.isfinite(low) & torch.isfinite(high)
    return x.with_parts(torch.where(known, product.terms, 0.0), torch.where(known, product.radius, torch.inf))


def _absolute_sum(terms: Tensor) -> Tensor:
    """Σ |term| over the first axis."""
    return terms.abs().sum(0)

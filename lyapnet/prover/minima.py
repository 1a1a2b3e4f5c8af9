"""Bounds of h = min over u ∈ U of uᵀWu + bᵀu + s(u) and of its minimiser u: the rule of lyapnet.task.cost.minimum.

The minimum h(b) is concave, and its slope is u(b). With the means D and D' of the derivative u_b on the line from b₀
to b,

    u(b) = u(b₀) + D(b − b₀),     h(b) = h(b₀) + u(b₀)ᵀ(b − b₀) + ½ (b − b₀)ᵀD'(b − b₀).

u_b is symmetric, and −(2W)⁻¹ ≤ u_b ≤ 0 for every convex s and U. In two cases u_b has tighter bounds on a box of b:

* W is diagonal, the costs are Σ σᵢ(uᵢ) and U has limits of each control: u_b is diagonal with −1/(2Wᵢᵢ + σᵢ''(uᵢ)), or
  0 in the kink of |uᵢ| and at a limit. The curvature σᵢ'' of all of lyapnet's costs is monotone in |u|.
* W is a multiple of the identity, s = w‖u‖ and U is a ball: u is −b times a function of ‖b‖.

If W depends on the point too, W = W₀ + Δ, then u is the minimiser for W₀ and b + 2Δu, and |h − h₀| ≤ max |uᵀΔu|.

The law computes u by Newton's method. Its u is assumed to differ by at most FORWARD · |u| from the minimiser for a b
that differs by at most BACKWARD (|b| + |2Wu| + w). At the centre of each box, the optimality conditions verify this;
boxes where they fail have no bounds.

Sources: Rockafellar, Convex Analysis, 1970, § 23, 26 (conjugates); Bauschke, Combettes, Convex Analysis and Monotone
Operator Theory in Hilbert Spaces, 2017, § 4 (firmly nonexpansive maps).
"""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lyapnet.base.linear_algebra import apply
from lyapnet.prover import taylor
from lyapnet.prover.branches import relu
from lyapnet.prover.closed_minima import TIE, closed_minimum
from lyapnet.prover.elementary_functions import Elementary, square
from lyapnet.prover.taylor import EPSILON, TINY, TaylorForm
from lyapnet.task.ball import ControlBall
from lyapnet.task.cost.control_costs import AbsoluteCost, ControlCosts, SeparableCost
from lyapnet.task.cost.minimum import LEAST, Known, find_registered, least_over
from lyapnet.task.sets import ControlSet, Unbounded

Vectors = Float[Tensor, "boxes m"]
Matrices = Float[Tensor, "boxes m m"]
FORWARD, BACKWARD = 1e-10, 1e-9  # see above; rounding of 1e-16 gives 1e-11 where W has the condition number 1e5
ROOM = 1e-9  # relative widening of computed bounds, far above their rounding errors


class _Program(NamedTuple):
    """The problems min over u ∈ U of uᵀWu + bᵀu + s(u) with |b − middle| ≤ reach, for each box."""

    costs: ControlCosts | None  # s
    controls: ControlSet  # U
    W: Matrices
    middle: Vectors
    reach: Vectors
    size: Vectors  # a bound of |uᵢ|

    @property
    def is_radial(self) -> bool:
        """Whether s and U depend on ‖u‖ alone; false for a single control, which has kinks and limits."""
        ball = isinstance(self.controls, ControlBall) or (self.costs is not None and bool(self.costs.norms))
        return ball and self.middle.shape[-1] > 1

    @property
    def kinks(self) -> Tensor:
        """w, (m,), of s = w‖u‖ + … or s = Σ wᵢ|uᵢ| + …"""
        kinked = [] if self.costs is None else self.costs.kinked
        return sum((cost.weight for cost in kinked), self.middle.new_zeros(self.middle.shape[-1]))

    @property
    def smooth(self) -> list[SeparableCost]:
        """The other costs of each control."""
        return [] if self.costs is None else [c for c in self.costs.separable if not isinstance(c, AbsoluteCost)]

    @property
    def limits(self) -> tuple[Tensor, Tensor]:
        """(lower, upper), (m,), of the smallest box around U."""
        low, high = self.controls.limits or (torch.tensor(-torch.inf), torch.tensor(torch.inf))
        return low.to(self.middle).expand(len(self.middle[0])), high.to(self.middle).expand(len(self.middle[0]))

    @property
    def is_diagonal(self) -> bool:
        """Whether W is diagonal on all boxes."""
        return not bool((self.W - torch.diag_embed(self.W.diagonal(dim1=-2, dim2=-1))).any())

    @property
    def forces(self) -> Vectors:
        """A bound of |b| + |2Wu| + w, the terms whose sum is 0 at a minimum inside U."""
        return 2 * apply(self.W.abs(), self.size) + self.middle.abs() + self.reach + self.kinks

    def slope(self, u: Vectors, side: int) -> Vectors:
        """The one-sided derivative of Σ σᵢ(uᵢ), to the left (side −1) or right (1) of u; ±∞ at a limit."""
        low, high = self.limits
        total = self.kinks * torch.where(side * u >= 0, side, -side)
        for cost in self.smooth:
            total = total + _inside(cost, "slope", u, u.sign() * torch.inf)
        return torch.where(u >= high, torch.inf, total) if side > 0 else torch.where(u <= low, -torch.inf, total)


def _inside(cost: SeparableCost, name: str, u: Vectors, beyond: Any) -> Vectors:
    """A method of a cost, as `slope`, at u; `beyond` where |u| reaches the open limit of the cost, if it has one."""
    end = cost.open_limit
    if end is None:
        return getattr(cost, name)(u)
    inside = u.abs() < end
    return torch.where(inside, getattr(cost, name)(torch.where(inside, u, 0.0)), beyond)


def least(W: Any, b: Any, named: str) -> TaylorForm:
    """Bounds of (u, h), (m + 1,), for the s and U that `named` describes.

    Args:
        W: (m, m), a form or constant.
        b: (m,), a form or constant.
    """
    b = b if isinstance(b, TaylorForm) else taylor.constant_form(b, W)
    costs, controls = find_registered(named, b.radius.device)
    if isinstance(W, Tensor):
        try:
            u, h = closed_minimum(_ByForms(), Known(costs, controls), W, _numbers(b))
        except NotImplementedError:
            pass
        else:
            return b.with_parts(
                torch.stack([x.terms for x in (*u, h)], -1), torch.stack([x.radius for x in (*u, h)], -1)
            )
    low, high = b.interval()
    known = (low.isfinite() & high.isfinite()).all(-1, keepdim=True)
    middle = torch.where(known, b.center, 0.0)
    reach = torch.where(known, torch.maximum(high - middle, middle - low), 1.0)
    W, spread, definite = _matrices(W, b)
    program = _Program(costs, controls, W, middle, reach, _bound_sizes(controls, W, spread, middle.abs() + reach))
    u, value = least_over(costs, controls, W, middle)
    forces = program.forces
    found = _is_minimum(program, u, BACKWARD * forces)
    off = 2 * BACKWARD * forces + 2 * (1 + ROOM) * apply(spread, program.size)
    far, near = reach + off, FORWARD * program.size
    D, doubt = _bound_slopes(program._replace(reach=far))
    y = b.with_parts(torch.cat([torch.zeros_like(b.terms[:1]), b.terms[1:]]), b.radius)
    Dy = _linear(D, y)
    radius = Dy.radius + apply(D.abs(), off) + apply(doubt, far) + 2 * near + _tie_errors(program)
    law = Dy.with_parts(torch.cat([u[None], Dy.terms[1:]]), radius * (1 + ROOM)).with_rounding()
    curved, straight = taylor.multiply(y, Dy), y.with_parts(y.terms * u, y.radius * u.abs()).with_rounding()
    h = taylor.add(straight, curved.with_parts(curved.terms / 2, curved.radius / 2)).with_rounding(len(u[0]))
    error = far * apply(doubt, far) / 2 + program.size * apply(spread, program.size)
    error = error + 4 * BACKWARD * forces * apply(D.abs() + doubt, far) + 2 * (near + TIE * program.size) * forces
    terms, radius = h.terms.sum(-1, keepdim=True), (h.radius + error * (1 + ROOM)).sum(-1, keepdim=True)
    h = h.with_parts(torch.cat([terms[:1] + value[:, None], terms[1:]]), radius).with_rounding()
    terms, radius = torch.cat([law.terms, h.terms], -1), torch.cat([law.radius, h.radius], -1)
    certain = (
        known
        & definite
        & found
        & radius.isfinite().all(-1, keepdim=True)
        & terms.isfinite().all(0).all(-1, keepdim=True)
    )
    return b.with_parts(torch.where(certain, terms, 0.0), torch.where(certain, radius, torch.inf))


def _numbers(b: TaylorForm) -> list[TaylorForm]:
    return [b.with_parts(terms, radius) for terms, radius in zip(b.terms.unbind(-1), b.radius.unbind(-1), strict=True)]


class _ByForms:
    """The operations of closed forms, on Taylor forms of single numbers."""

    def combine(
        self, summands: Iterable[tuple[float, TaylorForm]], offset: float = 0.0, operations: int = 1
    ) -> TaylorForm:
        pairs = list(summands)
        terms = torch.stack([weight * x.terms for weight, x in pairs]).sum(0)
        radius = torch.stack([abs(weight) * x.radius for weight, x in pairs]).sum(0)
        moved = torch.cat([(terms[0] + offset)[None], terms[1:]])
        return pairs[0][1].with_parts(moved, radius).with_rounding(operations + len(pairs))

    def multiply(self, x: TaylorForm, y: TaylorForm) -> TaylorForm:
        return taylor.multiply(x, y)

    def square(self, x: TaylorForm) -> TaylorForm:
        return square(x)

    def function(self, name: str, x: TaylorForm) -> TaylorForm:
        return FUNCTIONS[name](x)

    def rounded(self, x: TaylorForm, *limits: float) -> TaylorForm:
        relative, absolute, _ = limits
        room = (relative * x.magnitude * (1 + ROOM) + absolute) * (1 + ROOM)
        return x.with_parts(x.terms, x.radius + room).with_rounding()


def _within_ball(v: Tensor) -> Tensor:
    """v for v ≤ 1, else 2√v − 1."""
    return torch.where(v > 1, 2 * v.clamp_min(1).sqrt() - 1, v)


def _slope_within_ball(v: Tensor) -> Tensor:
    return v.clamp_min(1).rsqrt()


FUNCTIONS = {
    "leaky": relu,
    "within_ball": Elementary(_within_ball, _slope_within_ball, lambda a, lo, hi: [1 / (a * a)]),
    "slope_within_ball": Elementary(
        _slope_within_ball,
        lambda v: torch.where(v > 1, -0.5 * v.clamp_min(1) ** -1.5, 0.0),
        lambda a, lo, hi: [torch.ones_like(a), (4 * a * a) ** (-1 / 3)],
    ),
}
"""Name of a function of closed forms, as in machine code ↦ its rule."""


def is_minimum(
    costs: ControlCosts | None, controls: ControlSet, W: Matrices, b: Vectors, u: Vectors
) -> Bool[Tensor, " boxes"]:
    """Whether u is the minimiser, up to FORWARD and BACKWARD.

    Args:
        costs, controls: s and U; None means s = 0.
        W, b, u: (boxes, m, m), (boxes, m) and (boxes, m).
    """
    program = _Program(
        costs, controls, W, b, torch.zeros_like(b), _bound_sizes(controls, W, torch.zeros_like(W), b.abs())
    )
    return _is_minimum(program, u, BACKWARD * program.forces)[..., 0]


def _matrices(W: Any, like: TaylorForm) -> tuple[Matrices, Matrices, Tensor]:
    """(W₀, a bound of |W − W₀|, whether W is positive definite on the box (boxes, 1)); if not, W₀ is 1."""
    boxes, m = like.radius.shape
    if isinstance(W, TaylorForm):
        center, spread = W.center, W.spread + W.radius + 4 * len(W.terms) * EPSILON * W.magnitude
    else:
        center, spread = W.to(like.radius).expand(boxes, m, m), like.radius.new_zeros(boxes, m, m)
    middle = (center + center.mT) / 2
    spread = torch.maximum(spread, spread.mT) + (center - middle).abs()
    finite = (center.isfinite() & spread.isfinite()).all((-2, -1), keepdim=True)
    one = torch.eye(m).to(middle)
    middle, spread = torch.where(finite, middle, one), torch.where(finite, spread, 0.0)
    definite = finite & (_least_eigenvalue(middle, spread)[..., None] > 0)
    return torch.where(definite, middle, one), torch.where(definite, spread, 0.0), definite[..., 0]


def _least_eigenvalue(W: Matrices, spread: Matrices) -> Float[Tensor, "boxes 1"]:
    """A lower bound of the least eigenvalue of W, (boxes, 1)."""
    size = torch.linalg.matrix_norm(W)
    return (torch.linalg.eigvalsh(W)[..., 0] - 1e-12 * size - torch.linalg.matrix_norm(spread) * (1 + ROOM))[:, None]


def _bound_sizes(controls: ControlSet, W: Matrices, spread: Matrices, b: Vectors) -> Vectors:
    """A bound of |uᵢ|, from its limits and, if U contains 0, from ‖u‖ ≤ ‖b‖/(2λ) with the least eigenvalue λ of W.

    Args:
        b: a bound of |b|.
    """
    free = b.norm(dim=-1, keepdim=True) * (1 + ROOM) / (2 * _least_eigenvalue(W, spread))
    diagonal = W.diagonal(dim1=-2, dim2=-1)
    if not bool((W - torch.diag_embed(diagonal)).any()) and not bool(spread.any()):
        free = b * (1 + ROOM) / (2 * diagonal)  # |uᵢ| without limits; a ball makes it smaller
    if controls.limits is None:
        return free.expand_as(b)
    low, high = (side.to(b) for side in controls.limits)
    if bool((low > 0).any() | (high < 0).any()):
        free = torch.full_like(free, torch.inf)
    return torch.minimum(free, torch.maximum(low.abs(), high.abs())).expand_as(b)


def _linear(D: Matrices, y: TaylorForm) -> TaylorForm:
    """D y with one matrix D for each box."""
    y = y.with_rounding(2 * D.shape[-1])  # as in taylor.matrix_product
    return y.with_parts(apply(D, y.terms), apply(D.abs(), y.radius) + TINY)


def _is_minimum(program: _Program, u: Vectors, tolerance: Vectors) -> Tensor:
    """Whether u is the minimiser for b = middle, up to FORWARD · |u| in u and `tolerance` in b, (boxes, 1)."""
    near, slope = FORWARD * program.size, 2 * apply(program.W, u) + program.middle
    if not program.is_radial:
        bend = 2 * program.W.diagonal(dim1=-2, dim2=-1) * near
        above, below = slope + bend + program.slope(u + near, 1), slope - bend + program.slope(u - near, -1)
        (low, high) = program.limits
        holds = (above >= -tolerance) & (below <= tolerance) & (u >= low - near) & (u <= high + near)
        return holds.all(-1, keepdim=True)
    w, radius, near = program.kinks[0], program.limits[1][0], near.amax(-1, keepdim=True)
    size, most = u.norm(dim=-1, keepdim=True), tolerance.amax(-1, keepdim=True)
    still = size <= near
    pull = w / torch.where(still, 1.0, size)
    rim = (-(slope * u).sum(-1, keepdim=True) / torch.where(still, 1.0, size * size)).maximum(pull)
    rest = slope + torch.where(size >= radius - near, rim, pull) * u
    moving = (rest.norm(dim=-1, keepdim=True) <= most) & (size <= radius + near)
    return torch.where(still, program.middle.norm(dim=-1, keepdim=True) <= w + most, moving)


def _tie_errors(program: _Program) -> Vectors:
    """The error of u, for costs Σ wᵢ|uᵢ|, from orthants with nearly equal minima: see lyapnet.prover.closed_minima."""
    if program.is_radial or len(program.kinks) == 1 or not bool(program.kinks.any()):
        return torch.zeros_like(program.middle)
    hidden = TIE * (program.size * program.forces).sum(-1, keepdim=True)
    return (torch.linalg.inv(program.W).diagonal(dim1=-2, dim2=-1).clamp_min(0) * hidden).sqrt() * (1 + ROOM)


def _bound_slopes(program: _Program) -> tuple[Matrices, Matrices]:
    """(D, a bound of |u_b − D|) for all b of the box, (boxes, m, m) each."""
    W, diagonal = program.W, program.W.diagonal(dim1=-2, dim2=-1)
    if program.is_diagonal:
        G = torch.diag_embed(1 / (2 * diagonal))
    else:
        G = torch.linalg.inv(2 * W)
        G = (G + G.mT) / 2
    root = G.diagonal(dim1=-2, dim2=-1).clamp_min(0).sqrt()
    across = root[..., :, None] * root[..., None, :]
    low, high = -(G + across) / 2, (across - G) / 2
    closer = None
    if program.is_diagonal and not program.is_radial:
        closer = tuple(map(torch.diag_embed, _bound_slopes_of_each(program, 2 * diagonal)))
    elif program.is_diagonal and not bool((diagonal != diagonal[..., :1]).any()):
        closer = _bound_slopes_of_radius(program, 2 * diagonal[..., 0])
    if closer is not None:
        low, high = torch.maximum(low, closer[0]), torch.minimum(high, closer[1])
    room = ROOM * across
    return (low + high) / 2, (high - low) / 2 + room


def _bound_slopes_of_each(program: _Program, bend: Vectors) -> tuple[Vectors, Vectors]:
    """The range of ∂uᵢ/∂bᵢ = −1/(rᵢ + σᵢ''(uᵢ)) for a diagonal W, (boxes, m) each.

    Args:
        bend: r = 2Wᵢᵢ.
    """
    b_low, b_high = program.middle - program.reach, program.middle + program.reach
    low, high = program.limits
    u = least_over(program.costs, program.controls, program.W, program.middle).u
    step = program.reach / bend * (1 + ROOM) + FORWARD * program.size
    u_low, u_high = (u - step).clamp(low, high), (u + step).clamp(low, high)
    most = torch.maximum(u_low.abs(), u_high.abs())
    least = torch.where((u_low <= 0) & (u_high >= 0), 0.0, torch.minimum(u_low.abs(), u_high.abs()))
    flat, sharp = torch.zeros_like(bend), torch.zeros_like(bend)
    for cost in program.smooth:  # the curvature of each of them is monotone in |u|
        ends = torch.stack([_inside(cost, "curvature", end, torch.inf) for end in (least, most)])
        flat, sharp = flat + ends.amin(0), sharp + ends.amax(0)
    steep, mild = -1 / (bend + flat), -1 / (bend + sharp)
    still, may_be = torch.zeros_like(bend, dtype=torch.bool), torch.zeros_like(bend, dtype=torch.bool)
    w = program.kinks
    for start, end in ((-w, w), *_intervals_at_limits(program, bend)):  # u is constant for b in these intervals
        room = ROOM * torch.maximum(start.abs().nan_to_num(0, 0, 0), end.abs().nan_to_num(0, 0, 0))
        still = still | ((b_low >= start + room) & (b_high <= end - room) & (end > start))
        may_be = may_be | ((b_low <= end + room) & (b_high >= start - room) & (end > start))
    return torch.where(still, 0.0, steep), torch.where(may_be, 0.0, mild)


def _intervals_at_limits(program: _Program, bend: Vectors) -> list[tuple[Vectors, Vectors]]:
    """The intervals of b on which u is at its upper and at its lower limit, as (start, end), (boxes, m) each."""
    low, high = program.limits
    free = program._replace(controls=Unbounded())
    infinity = torch.full_like(bend, torch.inf)
    upper, lower = high.expand_as(bend), low.expand_as(bend)
    at_upper = torch.where(upper.isfinite(), -(bend * upper + free.slope(upper, -1)), -torch.inf)
    at_lower = torch.where(lower.isfinite(), -(bend * lower + free.slope(lower, 1)), torch.inf)
    return [(-infinity, at_upper), (at_lower, infinity)]


def _bound_slopes_of_radius(program: _Program, bend: Float[Tensor, " boxes"]) -> tuple[Matrices, Matrices]:
    """The range of u_b for u = −b a(β)/β, β = ‖b‖, a = min(max(β − w, 0)/r, radius), (boxes, m, m) each:

        u_b = −a/β + (a/β − a') n nᵀ,     n = b/β.

    Args:
        bend: r; W is r/2 times the identity.
    """
    w, radius = program.kinks[0], program.limits[1][0]
    b_low, b_high = program.middle - program.reach, program.middle + program.reach
    most = torch.maximum(b_low.abs(), b_high.abs())
    least = torch.where((b_low <= 0) & (b_high >= 0), 0.0, torch.minimum(b_low.abs(), b_high.abs()))
    near, far = least.norm(dim=-1) * (1 - ROOM), most.norm(dim=-1) * (1 + ROOM) + TINY
    full = (w + bend * radius).clamp(max=1e300)  # ‖b‖ from which ‖u‖ is the radius of the ball

    def share(beta: Tensor) -> Tensor:
        return torch.minimum((beta - w).clamp_min(0) / bend, radius) / beta.clamp_min(TINY)

    ends = torch.stack([share(near), share(far)])
    ends = torch.where(w == 0, torch.where(near == 0, torch.stack([1 / bend, ends[1]]), ends), ends)
    peak = torch.where((near <= full) & (far >= full), share(full), ends.amax(0))
    turn = ends.amin(0) * (1 - ROOM), torch.maximum(peak, ends.amax(0)) * (1 + ROOM)
    active, may_be = (near >= w) & (far <= full * (1 - ROOM)), (far >= w) & (near <= full * (1 + ROOM))
    grow = torch.where(active, 1 / bend, 0.0), torch.where(may_be, 1 / bend, 0.0)
    # nᵢ falls with |b_j|, and its sign is that of bᵢ
    others = ((least**2).sum(-1, keepdim=True) - least**2).clamp_min(0), (most**2).sum(-1, keepdim=True) - most**2
    n_high = torch.where(b_high >= 0, _direction(b_high, others[0]), _direction(b_high, others[1]))
    n_low = torch.where(b_low <= 0, _direction(b_low, others[0]), _direction(b_low, others[1]))
    n = (n_low - ROOM).clamp(-1, 1), (n_high + ROOM).clamp(-1, 1)
    nn = _products((n[0][..., :, None], n[1][..., :, None]), (n[0][..., None, :], n[1][..., None, :]))
    square = torch.eye(len(b_low[0]), dtype=torch.bool).to(b_low.device)
    crosses = (n[0] <= 0) & (n[1] >= 0)
    nn = torch.where(square & ~crosses[..., None], nn[0], torch.where(square, 0.0, nn[0])), nn[1]
    gap = turn[0] - grow[1], turn[1] - grow[0]
    equal = active & (w == 0)  # then a/β = a'
    low, high = _products(tuple(torch.where(equal, 0.0, side)[:, None, None] for side in gap), nn)
    one = square.to(b_low)
    return low - turn[1][:, None, None] * one, high - turn[0][:, None, None] * one


def _direction(b: Vectors, others: Vectors) -> Vectors:
    """bᵢ/√(bᵢ² + others), a component of b/‖b‖, where others is Σ_{j≠i} b_j²."""
    return b / (b * b + others).sqrt().clamp_min(TINY)


def _products(x: Sequence[Tensor], y: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """The range of products of two intervals."""
    ends = torch.stack([a * b for a in x for b in y])
    return ends.amin(0), ends.amax(0)


MINIMA = {LEAST: least}
"""Operator ↦ its rule."""

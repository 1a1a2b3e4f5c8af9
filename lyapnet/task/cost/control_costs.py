"""Convex costs of controls beside uᵀRu: fuel |u|, thrust ‖u‖, losses |u|ᵖ, and costs that are infinite at a limit."""

import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lyapnet.base.errors import UsageError
from lyapnet.base.linear_algebra import apply, has_values, norm
from lyapnet.base.types import Control, ControlMatrix, PerState
from lyapnet.task.ball import LEAST_NUMBER, ControlBall, minimise_in_ball, positive_number
from lyapnet.task.polytope import ControlPolytope
from lyapnet.task.sets import ControlBox, ControlSet, Unbounded

NEWTON_STEPS = 12  # number of steps of the minimiser with smooth costs, in traces
SCALAR_STEPS = 12  # number of steps for a single control
SCALAR_STEPS_FROM_AFAR = 40  # the same, if a smooth cost has no `inverse_slope` that bounds the control
MOST_NEWTON_STEPS = 60  # largest number of steps outside of traces, where convergence can be tested
LEAST_EXPONENT = 1.2  # for smaller p the minimum is lost in rounding
CONVERGED = 1e-14  # relative change of u below which it has converged
STEP_SIZES = (1.0, 0.5, 0.125, 0.0156, 0.001)  # step sizes of its line search
LEAST_SHARE = 1e-9  # |uᵢ|, relative to max |uⱼ|, that replaces 0 in curvatures that are infinite there
LAST_STEPS = 2  # number of last Newton steps without a line search, which the rounding of the cost would end too early
ROOM_LEFT = 0.05  # least share of the distance to an open limit that remains after a step
LEAST_ROOM = 1e-12  # least distance from an open limit, relative to it


class ControlCost(nn.Module, ABC):
    """A convex cost of controls per second beside uᵀR(x)u, with its least value 0 at u = 0; see ControlCosts."""

    weight: Float[Tensor, "*m"]  # w, a factor of the cost

    @abstractmethod
    def forward(self, u: Control) -> PerState:
        """s(u), (*batch,)."""


class SeparableCost(ControlCost, ABC):
    """s(u) = Σᵢ wᵢσ(uᵢ) with σ(u) = |u|, or a smooth even function: a sum of costs of single controls.

    A subclass of your own has `forward`, a smooth function; the other methods differentiate it.

    Args:
        weight: w > 0, a number or one for each control; for the absolute cost some may be 0.
    """

    least_weight: ClassVar[float] = LEAST_NUMBER

    def __init__(self, weight: float | Sequence[float] | Tensor):
        super().__init__()
        self.register_buffer("weight", _weights(weight, least=self.least_weight), persistent=False)

    def slope(self, u: Control) -> Control:
        """The derivative by each control."""
        return self._derivative(self.forward, u)

    def curvature(self, u: Control) -> Control:
        """The second derivative, which may be infinite at 0."""
        return self._derivative(self.slope, u)

    @staticmethod
    def _derivative(function: Callable[[Control], Tensor], u: Control) -> Control:
        recording = torch.is_grad_enabled() and u.requires_grad
        with torch.enable_grad():
            u = u if recording else u.detach().requires_grad_()
            derivative = torch.autograd.grad(function(u).sum(), u, create_graph=True, materialize_grads=True)[0]
        return derivative if recording else derivative.detach()

    def inverse_slope(self, b: Control) -> Control:
        """|u| at which the slope is |b|; infinite if the slope is always smaller."""
        return torch.full_like(b, math.inf)

    @property
    def open_limit(self) -> Tensor | None:
        """|u| at which the cost is infinite, () or (m,), if there is one."""
        return None


class AbsoluteCost(SeparableCost):
    """s(u) = Σ wᵢ|uᵢ|: the fuel of thrusters, for example."""

    least_weight: ClassVar[float] = 0.0

    def forward(self, u: Control) -> PerState:
        return (self.weight * u.abs()).sum(-1)

    def slope(self, u: Control) -> Control:
        return self.weight * u.sign()

    def curvature(self, u: Control) -> Control:
        return torch.zeros_like(u)


class PseudoHuberControlCost(SeparableCost):
    """s(u) = Σ wᵢ(√(uᵢ² + δ²) − δ): a smooth |u| that is quadratic below δ.

    Args:
        weight: w, a number or one for each control.
        width: δ > 0, in the unit of the controls.
    """

    width: float

    def __init__(self, weight: float | Sequence[float] | Tensor, width: float):
        super().__init__(weight)
        self.width = positive_number("width", width)

    def forward(self, u: Control) -> PerState:
        return (self.weight * u * u / (torch.sqrt(u * u + self.width**2) + self.width)).sum(-1)

    def slope(self, u: Control) -> Control:
        return self.weight * u / torch.sqrt(u * u + self.width**2)

    def curvature(self, u: Control) -> Control:
        return self.weight * self.width**2 / (u * u + self.width**2) ** 1.5

    def inverse_slope(self, b: Control) -> Control:
        share = b.abs() / self.weight
        return torch.where(share < 1, self.width * share / torch.sqrt((1 - share * share).clamp_min(1e-300)), math.inf)


class PowerCost(SeparableCost):
    """s(u) = Σ wᵢ|uᵢ|ᵖ: the losses of motors, for example, with p = 1.5.

    Args:
        weight: w, a number or one for each control.
        exponent: p ≥ LEAST_EXPONENT.
    """

    exponent: float

    def __init__(self, weight: float | Sequence[float] | Tensor, exponent: float):
        super().__init__(weight)
        self.exponent = positive_number("exponent", exponent)
        if self.exponent < LEAST_EXPONENT:
            raise ValueError(
                f"Expected exponent ≥ {LEAST_EXPONENT:g}, got {exponent:g}; closer to 1 take the absolute cost."
            )

    def forward(self, u: Control) -> PerState:
        return (self.weight * u.abs() ** self.exponent).sum(-1)

    def slope(self, u: Control) -> Control:
        return self.weight * self.exponent * u.sign() * u.abs() ** (self.exponent - 1)

    def curvature(self, u: Control) -> Control:
        return self.weight * self.exponent * (self.exponent - 1) * u.abs() ** (self.exponent - 2)

    def inverse_slope(self, b: Control) -> Control:
        return (b.abs() / (self.weight * self.exponent)) ** (1 / (self.exponent - 1))


class SoftLimitCost(SeparableCost, ABC):
    """A cost of each control that is wᵢuᵢ² for small controls, and keeps laws from reaching |uᵢ| = a.

    Args:
        weight: w > 0, a number or one for each control.
        limit: a, a number or one for each control.
    """

    limit: Float[Tensor, "*m"]

    def __init__(self, weight: float | Sequence[float] | Tensor, limit: float | Sequence[float] | Tensor):
        super().__init__(weight)
        self.register_buffer("limit", _weights(limit, "limit"), persistent=False)

    @property
    def open_limit(self) -> Tensor:
        return self.limit


class LogCosCost(SoftLimitCost):
    """s(u) = −Σ wᵢ (8a²/π²) ln cos(πuᵢ/(2a)): wᵢuᵢ² for small u, and infinite at |uᵢ| = a, which no law reaches.

    Source: Lutter, Mannor, Peters, Fox, Garg, "Value iteration in continuous actions, states and time", ICML 2021.
    """

    def forward(self, u: Control) -> PerState:
        half = math.pi / 2 / self.limit
        inside = u.abs() < self.limit
        sine = torch.sin(half * torch.where(inside, u, 0.0) / 2)
        barrier = torch.where(inside, -torch.log1p(-2 * sine * sine), math.inf)  # −ln cos, exactly near 0 too
        return (self.weight * 2 / half**2 * barrier).sum(-1)

    def slope(self, u: Control) -> Control:
        half = math.pi / 2 / self.limit
        return 2 * self.weight / half * torch.tan(half * u)

    def curvature(self, u: Control) -> Control:
        return 2 * self.weight / torch.cos(math.pi / 2 / self.limit * u) ** 2

    def inverse_slope(self, b: Control) -> Control:
        half = math.pi / 2 / self.limit
        return torch.atan(b.abs() * half / (2 * self.weight)) / half


class EntropyCost(SoftLimitCost):
    """s(u) = Σ wᵢa²((1 − v)ln(1 − v) + (1 + v)ln(1 + v)), v = uᵢ/a, with an infinite slope at |uᵢ| = a."""

    def forward(self, u: Control) -> PerState:
        v = u / self.limit
        inside = v.abs() < 1
        v = torch.where(inside, v, 0.0)
        cost = (1 - v) * torch.log1p(-v) + (1 + v) * torch.log1p(v)
        return (self.weight * self.limit**2 * torch.where(inside, cost, math.inf)).sum(-1)

    def slope(self, u: Control) -> Control:
        v = u / self.limit
        return self.weight * self.limit * (torch.log1p(v) - torch.log1p(-v))

    def curvature(self, u: Control) -> Control:
        v = u / self.limit
        return 2 * self.weight / ((1 - v) * (1 + v))

    def inverse_slope(self, b: Control) -> Control:
        return self.limit * torch.tanh(b.abs() / (2 * self.weight * self.limit))


class NormCost(ControlCost):
    """s(u) = w‖u‖, the fuel of a thrust in any direction.

    Args:
        weight: w > 0.
    """

    weight: Float[Tensor, ""]

    def __init__(self, weight: float):
        super().__init__()
        self.register_buffer("weight", _weights(weight), persistent=False)
        if self.weight.ndim:
            raise ValueError(
                f"Expected one weight of the norm, got {weight!r}; it is a factor of the norm of all controls."
            )

    def forward(self, u: Control) -> PerState:
        return self.weight * norm(u)


class ControlCosts(nn.Module):
    """s(u), the sum of some costs of controls, plus ρ‖u‖² while a search smooths kinks.

    The minimiser is known for separable costs in a box or without limits, and for norms in a ball or without limits.
    Costs |u| are linear in each of the 2ᵐ orthants, and the least of the minima over these is the minimum. Smooth costs
    are minimised by Newton's method with a line search. The derivative is that of the minimiser.

    Args:
        costs: the costs.

    Source: Nocedal, Wright, Numerical Optimization, 2006, ch. 3 (Newton's method with line search).
    """

    costs: nn.ModuleList
    softness: Float[Tensor, ""]  # ρ, zero in the task

    def __init__(self, costs: Sequence[ControlCost]):
        super().__init__()
        self.costs = nn.ModuleList(costs)
        self.register_buffer("softness", torch.zeros((), dtype=torch.get_default_dtype()), persistent=False)

    @property
    def separable(self) -> list[SeparableCost]:
        """The separable costs."""
        return [cost for cost in self.costs if isinstance(cost, SeparableCost)]

    @property
    def norms(self) -> list[NormCost]:
        """The costs of ‖u‖."""
        return [cost for cost in self.costs if isinstance(cost, NormCost)]

    @property
    def kinked(self) -> list[ControlCost]:
        """The costs whose slope jumps at u = 0."""
        return [*self.norms, *(cost for cost in self.separable if isinstance(cost, AbsoluteCost))]

    @property
    def open_limits(self) -> list[Tensor]:
        """|u| at which costs are infinite."""
        return _open_limits(self.separable)

    def forward(self, u: Control) -> PerState:
        value = self.softness * (u * u).sum(-1)
        for cost in self.costs:
            value = value + cost(u)
        return value

    def distinguishing_controls(self, m: int) -> Control:
        """Controls (2m, m) at which different sums have different costs: single controls at two sizes."""
        each = torch.eye(m, dtype=torch.float64)
        for end in self.open_limits:
            each = each * (0.9 * end.double().expand(m)).clamp_max(1.0)
        return torch.cat([each, 0.3 * each])

    def require_minimiser(self, controls: ControlSet, m: int) -> None:
        """Check that the minimiser of these costs over a set of m controls is implemented.

        Raises:
            UsageError: it is not.
        """
        ball, box = type(controls) in (ControlBall, Unbounded), type(controls) in (ControlBox, Unbounded)
        one_kind = not self.norms or not self.separable
        if len(self.norms) + len(self.separable) == len(self.costs) and (
            (m == 1 and (ball or box)) or (one_kind and (ball if self.norms else box))
        ):
            return
        names = " and ".join(type(cost).__name__ for cost in self.costs)
        raise UsageError(
            f"Expected costs of controls with a known minimiser in {type(controls).__name__}, got {names}; with limits "
            "take costs of each control, in a ball the norm alone."
        )

    def minimise(self, controls: ControlSet, R: ControlMatrix, b: Control) -> Control:
        """argmin over u ∈ U of uᵀRu + bᵀu + s(u), (*batch, m).

        Args:
            controls: U.
            R: (*batch, m, m), symmetric positive definite.
            b: (*batch, m).

        Raises:
            UsageError: it is not implemented for this U.
        """
        m = b.shape[-1]
        self.require_minimiser(controls, m)
        R = R + self.softness * torch.eye(m).to(R)
        if self.norms and m > 1:
            radius = controls.radius if isinstance(controls, ControlBall) else None
            weight = sum((cost.weight for cost in self.norms), b.new_zeros(()))
            return controls.project(minimise_in_ball(R, b, radius, weight))
        kinked = self.kinked
        smooth = [cost for cost in self.separable if not isinstance(cost, AbsoluteCost)]
        kinks = sum((cost.weight for cost in kinked), b.new_zeros(m)) if kinked else None
        if not smooth:
            return _minimise_with_kinks(controls, R, b, kinks)
        if m == 1:
            return controls.project(_minimise_one(smooth, kinks, 2 * R[..., 0].double(), b.double()).to(b))
        return _SmoothProgram(controls, smooth, kinks, R.double(), b.double()).minimum().to(b)


def _minimise_one(smooth: Sequence[SeparableCost], kinks: Tensor | None, bend: Tensor, b: Control) -> Control:
    """argmin of ½ru² + bu + c|u| + smooth costs of one control, without limits, which clip it as the sum is convex.

    All costs are even, so that u has the sign of −b, and a = |u| is where ra + s'(a) = |b| − c: by Newton's method,
    with bisection where a step leaves the bracket.

    Args:
        bend: r, (*batch, 1).
    """

    def slope_and_curvature(a: Tensor) -> tuple[Tensor, Tensor]:
        slopes, curvatures = zip(*((cost.slope(a), cost.curvature(a)) for cost in smooth), strict=True)
        return bend * a - pull + sum(slopes), bend + sum(curvatures)

    pull = b.abs() if kinks is None else (b.abs() - kinks.to(b)).clamp_min(0)
    with torch.no_grad():
        high = pull / bend
        for cost in smooth:
            high = high.minimum(cost.inverse_slope(pull))
        for end in _open_limits(smooth):
            high = high.minimum((1 - LEAST_ROOM) * end)
        low, a = torch.zeros_like(high), high
        known = all(type(cost).inverse_slope is not SeparableCost.inverse_slope for cost in smooth)
        for _ in range(SCALAR_STEPS if known else SCALAR_STEPS_FROM_AFAR):
            slope, curvature = slope_and_curvature(a)
            low, high = torch.where(slope < 0, a, low), torch.where(slope > 0, a, high)
            to = a - slope / curvature
            before, a = a, torch.where((to >= low) & (to <= high), to, (low + high) / 2)
            if has_values(a) and bool(((a - before).abs() <= CONVERGED * a).all()):
                break
    slope, curvature = slope_and_curvature(a)
    a = torch.where(curvature.isfinite(), a - slope / curvature.detach(), 0.0)
    for end in _open_limits(smooth):
        a = a.minimum((1 - LEAST_ROOM) * end)
    return -b.sign() * a


class _SmoothProgram:
    """The search for the minimum over u ∈ U of uᵀRu + bᵀu + Σ cᵢ|uᵢ| + smooth costs of each control."""

    def __init__(
        self, controls: ControlSet, smooth: Sequence[SeparableCost], kinks: Tensor | None, R: ControlMatrix, b: Control
    ):
        self.controls, self.smooth, self.kinks, self.R, self.b = controls, smooth, kinks, R, b
        self.ends = _open_limits(smooth)

    def minimum(self) -> Control:
        with torch.no_grad():
            u, k = self._start(), 0
            while k < (MOST_NEWTON_STEPS if has_values(u) else NEWTON_STEPS):
                before, u, k = u, self._descend(u), k + 1
                if has_values(u) and bool(((u - before).abs() <= CONVERGED * u.abs()).all()):
                    break
            for _ in range(LAST_STEPS):
                u = self._newton(u)
        return self._newton(u)

    def _start(self) -> Control:
        """The minimum without the smooth costs, with each |uᵢ| cut to where the slope of one of these is |bᵢ|."""
        u = _minimise_with_kinks(self.controls, self.R, self.b, self.kinks)
        for cost in self.smooth:
            size = cost.inverse_slope(self.b)
            u = torch.where(u.abs() <= size, u, u.sign() * size)
        for end in self.ends:
            u = u.clamp(-(1 - ROOM_LEFT) * end, (1 - ROOM_LEFT) * end)
        return self.controls.project(u)

    def _newton(self, u: Control, cautious: bool = False) -> Control:
        """The minimum with the quadratic model of the smooth costs at u, inside the open limits.

        Args:
            cautious: whether the curvature is at least that of the even parabola with the slope of the cost at uᵢ.
                This parabola is nowhere below |u|ᵖ with p < 2 and the pseudo-Huber cost, so that the step is safe.
        """
        u = u.detach()
        least = LEAST_SHARE * u.abs().amax(-1, keepdim=True).clamp_min(LEAST_SHARE)
        safe = torch.where(u.abs() < least, least, u)
        zero = torch.zeros_like(u)
        bend = sum((cost.curvature(safe) for cost in self.smooth), zero)
        if cautious:
            bend = torch.maximum(bend, sum((cost.slope(safe) for cost in self.smooth), zero) / safe)
        slope = sum((cost.slope(u) for cost in self.smooth), -bend * u)
        to = _minimise_with_kinks(self.controls, self.R + torch.diag_embed(bend) / 2, self.b + slope, self.kinks)
        for end in self.ends:
            most = (1 - LEAST_ROOM) * end
            to = torch.maximum(
                torch.minimum(to, (u + (1 - ROOM_LEFT) * (end - u)).minimum(most)),
                (u - (1 - ROOM_LEFT) * (end + u)).maximum(-most),
            )
        return to

    def _descend(self, u: Control) -> Control:
        """The Newton step; where it is no better than u, the best of u, of a line search, and of the cautious step."""
        to = self._newton(u)
        step, least, best = to - u, self._value(u), u
        if has_values(u) and bool((self._value(to) < least).all()):
            return to
        for tried in [*(u + size * step for size in STEP_SIZES), self._newton(u, cautious=True)]:
            value = self._value(tried)
            better = value < least
            best, least = torch.where(better[..., None], tried, best), torch.where(better, value, least)
        return best

    def _value(self, u: Control) -> PerState:
        value = ((apply(self.R, u) + self.b) * u).sum(-1) + sum(cost(u) for cost in self.smooth)
        return value if self.kinks is None else value + (self.kinks * u.abs()).sum(-1)


def local_shape(
    cost: ControlCosts | None, controls: ControlSet, u: Control, slope: Control
) -> tuple[Tensor, Tensor | None]:
    """(P, S), (*batch, m, m) each, for the derivative of the minimiser u of a quadratic cost and s over U.

    P projects onto the directions in which u can move: not across a limit, and not out of a kink of s. S is the
    curvature of s, and of a curved border of U, in these directions; None: zero.

    Args:
        cost: s; None: zero.
        controls: U.
        u: the minimiser (*batch, m).
        slope: that of the quadratic cost there.
    """
    one = u.shape[-1] == 1  # a ball is a box, and a norm is |u|
    if not one and (isinstance(controls, ControlBall) or _norm_of(cost) is not None):
        return _shape_in_ball(cost, controls, u, slope)
    if isinstance(controls, ControlPolytope):  # no other cost goes with it
        return controls.tangents(u), None
    parts = [] if cost is None else cost.separable
    whole = slope + sum((part.slope(u) for part in parts), torch.zeros_like(u))
    if (weight := _norm_of(cost)) is not None:
        whole = whole + weight * u.sign()
    further = controls.project(u - whole.sign() * (1 + u.abs()))
    moves = (further != u) | (whole == 0)
    if cost is not None and cost.kinked:
        moves = moves & (u != 0)
    if cost is None:
        return torch.diag_embed(moves.to(u)), None
    bend = sum((part.curvature(u) for part in parts), 2 * cost.softness * torch.ones_like(u))
    moves = moves & bend.isfinite()
    return torch.diag_embed(moves.to(u)), torch.diag_embed(bend.where(moves, 0.0))


def _norm_of(cost: ControlCosts | None) -> Tensor | None:
    """w of costs w‖u‖; None: there are none."""
    norms = [] if cost is None else cost.norms
    return sum((part.weight for part in norms[1:]), norms[0].weight) if norms else None


def _shape_in_ball(
    cost: ControlCosts | None, controls: ControlSet, u: Control, slope: Control
) -> tuple[Tensor, Tensor | None]:
    """local_shape for w‖u‖ and a ball: on its sphere u turns, and (pull/‖u‖)(1 − ûûᵀ) is the curvature of both."""
    size, one, weight = norm(u)[..., None], torch.eye(u.shape[-1]).to(u), _norm_of(cost)
    direction = u / torch.where(size > 0, size, 1.0)
    across = one - direction[..., :, None] * direction[..., None, :]
    pull = -(slope * direction).sum(-1, keepdim=True)  # λ‖u‖: that of the norm, and of the border
    w = pull.new_zeros(()) if weight is None else weight.to(pull)
    turns = (controls.project(u * (1 + 1e-6)) - u * (1 + 1e-6)).abs().amax(-1, keepdim=True) > 0
    turns = turns & (pull > w)
    P = torch.where(turns[..., None], across, one)
    if weight is not None:
        P = torch.where((size > 0)[..., None], P, 0.0)
    strength = torch.where(turns, pull, w) / torch.where(size > 0, size, 1.0)
    soft = cost.softness * one if cost is not None else 0.0
    return P, strength[..., None] * across + soft


def _minimise_with_kinks(controls: ControlSet, R: ControlMatrix, b: Control, kinks: Tensor | None) -> Control:
    """argmin over u ∈ U of uᵀRu + bᵀu + Σ cᵢ|uᵢ|; U is a box, all of ℝᵐ, or for a single control a ball."""
    m = b.shape[-1]
    if kinks is None:
        return controls.minimise(R, b)
    kinks = kinks.to(b).expand(m)
    if m == 1:
        return controls.project(-(b - torch.maximum(torch.minimum(b, kinks), -kinks)) / (2 * R[..., 0]))
    box = controls if isinstance(controls, ControlBox) else ControlBox(-math.inf, math.inf).to(b)
    found = []
    for signs in itertools.product((1.0, -1.0), repeat=m):
        sign = torch.tensor(signs).to(b)
        found.append(box.minimise_in_orthant(R, b + kinks * sign, sign))
    u = torch.stack(found).double()
    value = ((apply(R.double(), u) + b.double()) * u).sum(-1) + (kinks * u.abs()).sum(-1)
    best = value.where(value.isfinite(), math.inf).argmin(0)
    return u.gather(0, best[None, ..., None].expand(1, *b.shape))[0].to(b)


def _open_limits(costs: Sequence[SeparableCost]) -> list[Tensor]:
    """|u| at which costs are infinite, of those that have such a limit."""
    ends = [cost.open_limit for cost in costs]
    return [end for end in ends if end is not None]


def _weights(weight: float | Sequence[float] | Tensor, name: str = "weight", least: float | None = None) -> Tensor:
    """Weights of controls as a tensor, each between `least` and the inverse of LEAST_NUMBER."""
    least = LEAST_NUMBER if least is None else least
    entries = weight if isinstance(weight, list | tuple) else [weight]
    try:
        if not isinstance(weight, Tensor) and not all(type(entry) in (int, float) for entry in entries):
            raise TypeError("no numbers")
        given = torch.as_tensor(weight, dtype=torch.get_default_dtype()).clone()
    except (TypeError, ValueError, OverflowError):
        given = torch.empty(0)
    inside = given.isfinite() & (given >= least) & (given <= 1 / LEAST_NUMBER)
    if given.ndim > 1 or not given.numel() or not bool(inside.all()) or not bool((given > 0).any()):
        raise ValueError(f"Expected {name} as a number > 0, or one for each control, got {weight!r}; correct it.")
    return given


CONTROL_COSTS: dict[str, type[ControlCost]] = {
    "absolute": AbsoluteCost, "norm": NormCost, "power": PowerCost, "pseudo_huber": PseudoHuberControlCost,
    "log_cos": LogCosCost, "entropy": EntropyCost,
}  # fmt: skip

"""Sets of states and of controls."""

import copy
import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from lyapnet.base.linear_algebra import apply, has_values, solve
from lyapnet.base.operators import are_operators, operator
from lyapnet.base.types import Control, ControlMatrix, State


class Box(nn.Module):
    """The box {x : lower ≤ x ≤ upper}, componentwise; a component with lower = upper is fixed.

    Args:
        lower: (n,) lower bounds, in the units of the state.
        upper: (n,) upper bounds.

    Raises:
        ValueError: bounds of different or no length, not finite, or reversed.
    """

    lower: Float[Tensor, " n"]
    upper: Float[Tensor, " n"]

    def __init__(self, lower: Sequence[float] | Tensor, upper: Sequence[float] | Tensor):
        super().__init__()
        low, high = torch.as_tensor(lower), torch.as_tensor(upper)
        if low.ndim != 1 or low.shape != high.shape or not len(low):
            raise ValueError(
                f"Expected lower and upper of the same shape (n,), got {tuple(low.shape)} and {tuple(high.shape)}; "
                "give one bound for each state."
            )
        dtype = torch.promote_types(torch.promote_types(low.dtype, high.dtype), torch.get_default_dtype())
        low, high = low.to(dtype), high.to(dtype)
        if not (torch.isfinite(low).all() and torch.isfinite(high).all()):
            raise ValueError(
                f"Expected finite bounds, got lower {low.tolist()} and upper {high.tolist()}; choose a bounded set."
            )
        reversed_at = torch.nonzero(low > high).flatten().tolist()
        if reversed_at:
            i = reversed_at[0]
            raise ValueError(f"Expected lower ≤ upper, got {low[i]} > {high[i]} at index {i}; swap the two bounds.")
        self.register_buffer("lower", low, persistent=False)
        self.register_buffer("upper", high, persistent=False)

    @property
    def dimension(self) -> int:
        """n."""
        return len(self.lower)

    @property
    def center(self) -> Float[Tensor, " n"]:
        """The midpoint (lower + upper) / 2."""
        return (self.lower + self.upper) / 2

    @property
    def widths(self) -> Float[Tensor, " n"]:
        """Side lengths upper − lower; zero where a component is fixed."""
        return self.upper - self.lower

    @property
    def magnitude(self) -> Float[Tensor, " n"]:
        """max |x_i| over the box, for each component."""
        return self.reach_from(torch.zeros_like(self.lower))

    def reach_from(self, point: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        """max |x_i − point_i| over the box, for each component."""
        return torch.maximum((self.lower - point).abs(), (self.upper - point).abs())

    def corners(self, axes: int = 12) -> State:
        """The corners along the first `axes` free axes; further components are at the centre."""
        free = torch.nonzero(self.widths > 0).flatten()[:axes]
        found = self.center.repeat(2 ** len(free), 1)
        for k, i in enumerate(free):
            upper = torch.arange(len(found), device=found.device).bitwise_right_shift(k) % 2 == 1
            found[:, i] = torch.where(upper, self.upper[i], self.lower[i])
        return found

    def ends(self, count: int) -> State:
        """`count` corners, repeated if the box has fewer."""
        corners = self.corners(max(1, count.bit_length() - 1))
        return corners[torch.arange(count) % len(corners)]

    def extra_repr(self) -> str:
        return f"{self.lower.tolist()}, {self.upper.tolist()}"

    def sample(self, count: int, generator: torch.Generator | None = None) -> State:
        """`count` independent uniform states, drawn on the CPU so that a seed gives the same states on every device."""
        unit = torch.rand(count, self.dimension, generator=generator, dtype=torch.float64)
        x = self.lower + self.widths * unit.to(self.lower)
        return torch.minimum(x, self.upper)  # rounding may exceed the upper bound, never the lower one

    def contains(self, x: State) -> Bool[Tensor, "*batch"]:
        """Whether each state lies in the closed box."""
        return ((self.lower <= x) & (x <= self.upper)).all(-1)


class ControlSet(nn.Module, ABC):
    """U ⊂ ℝᵐ, the admissible controls, a closed convex set.

    A subclass implements three methods with torch operations on tensors of any leading shape. Its parameters are
    buffers, so that they follow the problem's precision and device, and identify the set in caches.
    """

    rounding: float = torch.finfo(torch.float64).eps  # of the coarsest precision that its buffers have had

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "ControlSet":
        super()._apply(fn, recurse)
        units = [torch.finfo(each.dtype).eps for each in self.buffers() if each.is_floating_point()]
        self.rounding = max(self.rounding, *units, 0.0)
        return self

    def rounded_for(self, dtype: torch.dtype) -> "ControlSet":
        """This set for arithmetic in another precision, in which `applied` does not leave it; by default the set."""
        return self

    @property
    def limited(self) -> bool:
        """Whether U is smaller than ℝᵐ."""
        return True

    @property
    def limits(self) -> tuple[Tensor, Tensor] | None:
        """(lower, upper), each () or (m,), of the smallest box around U, as oracles and the initial V need it.

        None if it is not known; oracles and the initial V then refuse U.
        """
        return None

    @property
    def is_box(self) -> bool:
        """Whether U is all of the box of its `limits`."""
        return True

    @property
    def fixed_limits(self) -> tuple[Tensor, Tensor] | None:
        """The `limits` of the controls themselves, if they are the same at every state."""
        return self.limits

    def limits_at(self, x: State) -> tuple[Tensor, Tensor] | None:
        """(lower, upper) of the controls that act at x, each () or (*batch, m); None if they are not known."""
        return self.limits

    def applied(self, x: State, u: Control) -> Control:
        """The control that acts at x for an element u of U: u, except for sets with shares or coarser rounding."""
        return u

    def moved(self, x: State, u: Control) -> Control:
        """The same for an element of ℝᵐ, without rounding; affine in u."""
        return u

    def asked(self, x: State, u: Control) -> Control:
        """The element of ℝᵐ that corresponds to a control at x: the inverse of `moved`."""
        return u

    @property
    def shares(self) -> "ControlSet":
        """A set of lyapnet's own with the same elements, minimiser and projection; by default the set itself."""
        return self

    def excess(self, u: Control) -> Tensor | None:
        """Smooth functions (*batch, k) of u that are ≤ 0 in U, beside its `limits`; None if there are none."""
        return None

    def at_border(self, u: Control) -> Bool[Tensor, "*batch"] | None:
        """Whether each control is on the border that its `excess` describes; None if there is none."""
        excess = self.excess(u)
        return None if excess is None else (excess >= -NEAR_BORDER).any(-1)

    @abstractmethod
    def minimise(self, R: ControlMatrix, b: Control) -> Control:
        """argmin over u ∈ U of uᵀRu + bᵀu, (*batch, m): the control law, with b = gᵀV_x.

        Args:
            R: (*batch, m, m), symmetric positive definite.
            b: (*batch, m).
        """

    @abstractmethod
    def contains(self, u: Control) -> Bool[Tensor, "*batch"]:
        """Whether each control lies in U."""

    @abstractmethod
    def project(self, u: Control) -> Control:
        """The point of U closest to each control."""


AnySet = TypeVar("AnySet", bound=ControlSet)


def passed_through(controls: AnySet, dtype: torch.dtype) -> AnySet:
    """A copy of a set with the rounding of another precision, in the precision of the set."""
    own = next(each.dtype for each in controls.buffers() if each.is_floating_point())
    return copy.deepcopy(controls).to(dtype).to(own)


def finite_numbers(name: str, given: Any) -> Tensor:
    """Finite numbers in float64, from nested lists of them.

    Raises:
        ValueError: the lists contain something else; names them.
    """
    try:
        numbers = torch.tensor(given, dtype=torch.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"Expected {name} as a list of numbers, got {given!r}; write it so.") from error
    if not numbers.numel() or not bool(numbers.isfinite().all()):
        raise ValueError(f"Expected finite numbers as {name}, got {given!r}; correct them.")
    return numbers


def about_control(R: ControlMatrix, b: Control, center: Tensor | None) -> Control:
    """b − 2Rū, so that uᵀRu + (b − 2Rū)ᵀu equals (u − ū)ᵀR(u − ū) + bᵀu up to a constant; None: ū = 0."""
    return b if center is None else b - 2 * apply(R, center)


class Unbounded(ControlSet):
    """U = ℝᵐ."""

    @property
    def limited(self) -> bool:
        return type(self) is not Unbounded  # a subclass may be smaller

    @property
    def limits(self) -> tuple[Tensor, Tensor] | None:
        return None if self.limited else (torch.tensor(-math.inf), torch.tensor(math.inf))

    def minimise(self, R: ControlMatrix, b: Control) -> Control:
        return -0.5 * solve(R, b[..., None])[..., 0]

    def contains(self, u: Control) -> Bool[Tensor, "*batch"]:
        return torch.isfinite(u).all(-1)

    def project(self, u: Control) -> Control:
        return u


class ControlBox(ControlSet):
    """U = {u : lower ≤ u ≤ upper}, componentwise: limits of actuators.

    The minimiser of uᵀRu + bᵀu is exact for every R:

    * 1 control: −b/(2R), clipped. 2 controls: clipped twice.
    * 3 or 4 controls: each combination of controls at a limit leaves a linear system for the others; all 3ᵐ systems
      are solved as one batch.
    * More controls: an active-set method, a single operator in traces.
    * From 3 controls on, outside of traces and gradients: a primal-dual active-set method whose number of rounds
      depends on the values.

    Args:
        lower, upper: in the units of the controls; a single number is the limit of every control, ∓∞ means no limit.

    Raises:
        ValueError: limits of different lengths, equal, reversed, or not numbers.

    Source: Nocedal, Wright, Numerical Optimization, 2006, § 16.5 (primal active-set methods for convex programs).
    """

    lower: Float[Tensor, "*m"]
    upper: Float[Tensor, "*m"]

    def __init__(self, lower: float | Sequence[float] | Tensor, upper: float | Sequence[float] | Tensor):
        super().__init__()
        low, high = (torch.as_tensor(side, dtype=torch.get_default_dtype()) for side in (lower, upper))
        if low.ndim > 1 or low.shape != high.shape:
            raise ValueError(
                f"Expected lower and upper as two numbers, or one for each control, got {low.tolist()} and "
                f"{high.tolist()}; write ∓inf where there is no limit."
            )
        if not bool((low < high).all()):
            remedy = "swap the two" if bool((low > high).any()) else "a control that cannot move belongs into f"
            raise ValueError(f"Expected lower < upper, got {low.tolist()} and {high.tolist()}; {remedy}.")
        self.register_buffer("lower", low, persistent=False)
        self.register_buffer("upper", high, persistent=False)
        self._limited = bool(low.isfinite().any() | high.isfinite().any())

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "ControlBox":
        """In another precision limits are rounded inwards, so that no control exceeds the given limits."""
        given = self.lower, self.upper
        super()._apply(fn, recurse)
        nearest, far = (self.lower, self.upper), self.lower.new_tensor(math.inf)
        low, high = (
            torch.where((side * (old - new.to(old)) > 0).to(new.device), new.nextafter(side * far), new)
            for side, old, new in zip((1, -1), given, nearest, strict=True)
        )
        crossed = low > high  # limits that are equal in this precision
        self.lower, self.upper = torch.where(crossed, nearest[0], low), torch.where(crossed, nearest[1], high)
        return self

    @property
    def limited(self) -> bool:
        return self._limited

    @property
    def limits(self) -> tuple[Tensor, Tensor]:
        return self.lower, self.upper

    def minimise(self, R: ControlMatrix, b: Control) -> Control:
        m = b.shape[-1]
        if self.lower.numel() not in (1, m):
            raise ValueError(f"Expected limits of {m} controls, got {self.lower.numel()}; give one for each.")
        if m == 1:
            return self.project(-b / (2 * R[..., 0]))
        return self._minimise_between(R, b, self.lower, self.upper)

    def minimise_in_orthant(self, R: ControlMatrix, b: Control, signs: Float[Tensor, " m"]) -> Control:
        """argmin of uᵀRu + bᵀu over the controls of U with some signs (m,), each 1 or −1.

        A control that U does not let have its sign is at its limit on the other side.
        """
        low = torch.minimum(torch.where(signs > 0, self.lower.clamp_min(0), self.lower), self.upper)
        high = torch.maximum(torch.where(signs < 0, self.upper.clamp_max(0), self.upper), low)
        return self._minimise_between(R, b, low, high)

    def _minimise_between(self, R: ControlMatrix, b: Control, low: Tensor, high: Tensor) -> Control:
        """argmin of uᵀRu + bᵀu over low ≤ u ≤ high, for more than one control."""
        # in double precision, because the cost differences may be too small for single precision
        m, given = b.shape[-1], b
        R, b, low, high = R.double(), b.double(), low.double().expand(m), high.double().expand(m)
        if m == 2:
            return self._minimise_two(R, b, low, high).to(given)
        few = m <= ENUMERATED_CONTROLS and not are_operators()
        minimise = (
            self._minimise_values
            if _have_values(R, b)
            else self._minimise_by_enumeration
            if few
            else self._minimise_by_active_set
        )
        u = minimise(R, b, low, high).clamp(low, high)
        known = R.isfinite().all((-2, -1)) & b.isfinite().all(-1)
        return torch.where(known[..., None], u, torch.nan).to(given)  # NaN remains NaN

    def _minimise_values(self, R: Tensor, b: Control, low: Tensor, high: Tensor) -> Control:
        """Minimise by rounds, and by the active-set method where these have not converged."""
        m, shape = b.shape[-1], b.shape
        R, b = R.expand(*shape, m).reshape(-1, m, m), b.reshape(-1, m)
        u, settled = _minimise_by_rounds(R, b, low, high)
        if not bool(settled.all()):
            u[~settled] = self._minimise_by_active_set(R[~settled], b[~settled], low, high)
        return u.reshape(shape)

    @staticmethod
    def _minimise_two(R: Tensor, b: Control, low: Tensor, high: Tensor) -> Control:
        """u₂ is where the slope of min over u₁ vanishes, the middle of three roots; then u₁ follows."""
        finite = (side.clamp(-FINITE_LIMIT, FINITE_LIMIT) for side in (low, high))
        roots = [
            -(b[..., 1] + 2 * R[..., 0, 1] * side[0]) / (2 * R[..., 1, 1]) for side in finite
        ]  # with u₁ at a limit
        determinant = R[..., 0, 0] * R[..., 1, 1] - R[..., 0, 1] * R[..., 0, 1]
        free = (R[..., 0, 1] * b[..., 0] - R[..., 0, 0] * b[..., 1]) / (2 * determinant)
        # clamp has no derivative by equal bounds, which the roots are for a diagonal R
        middle = torch.minimum(torch.maximum(free, torch.minimum(*roots)), torch.maximum(*roots))
        second = middle.clamp(low[1], high[1])
        first = (-(b[..., 0] + 2 * R[..., 0, 1] * second) / (2 * R[..., 0, 0])).clamp(low[0], high[0])
        return torch.stack([first, second], -1)

    @staticmethod
    def _minimise_by_enumeration(R: Tensor, b: Control, low: Tensor, high: Tensor) -> Control:
        """The cheapest feasible solution over all combinations of controls at a limit."""
        m = b.shape[-1]
        held = torch.tensor(list(itertools.product((-1.0, 0.0, 1.0), repeat=m))).to(b)  # at lower, free, at upper
        sides = torch.where(held < 0, low, torch.where(held > 0, high, 0.0))
        exists = sides.isfinite().all(-1)
        u_held, free = sides.where(sides.isfinite(), 0), (held == 0).to(b)
        each = (slice(None), *(None,) * (b.ndim - 1))  # the first axis has the combinations
        u_held, free = u_held[each], free[each]
        A = free[..., :, None] * R * free[..., None, :] + torch.diag_embed(1 - free)
        rest = free * (-b / 2 - apply(R, u_held)) + u_held
        u = torch.where(free == 0, u_held, solve(A, rest[..., None])[..., 0])
        fits = exists[each] & ((u >= low) & (u <= high) | (free == 0)).all(-1)
        cost = ((apply(R, u) + b) * u).sum(-1)
        best = cost.where(fits & cost.isfinite(), torch.inf).argmin(0)
        return u.gather(0, best[None, ..., None].expand(1, *b.shape))[0]

    @staticmethod
    def _minimise_by_active_set(R: Tensor, b: Control, low: Tensor, high: Tensor) -> Control:
        """The minimum over the controls that are free at it, with the others at their limits."""
        shape = torch.broadcast_shapes(R.shape[:-1], b.shape)
        side = active_set(b.detach().expand(shape), R.detach(), low, high)
        held = torch.where(side < 0, low, torch.where(side > 0, high, 0.0))  # finite, where side is not 0
        return torch.where(side == 0, _minimum_beside(R, b, held, side), held)

    def contains(self, u: Control) -> Bool[Tensor, "*batch"]:
        return ((self.lower <= u) & (u <= self.upper)).all(-1)

    def project(self, u: Control) -> Control:
        return u.clamp(self.lower, self.upper)


def _minimum_beside(R: Tensor, b: Control, held: Control, side: Control) -> Control:
    """argmin of uᵀRu + bᵀu over the controls with side 0, with the others held; only the former are valid."""
    free = (side == 0).to(b)
    A = free[..., :, None] * R * free[..., None, :] + torch.diag_embed(1 - free)
    return solve(A, (free * (-b / 2 - apply(R, held)))[..., None])[..., 0]


def _minimise_by_rounds(R: Tensor, b: Control, low: Tensor, high: Tensor) -> tuple[Control, Tensor]:
    """The minima of a batch (k, m), and which rows have converged: their set of controls at limits has not changed.

    In each round all controls change sides at once that the slope demands. This may cycle in rare cases; after
    SIMULTANEOUS_ROUNDS rounds only the control with the least index changes, which terminates.

    Source: Bergounioux, Ito, Kunisch, "Primal-dual strategy for constrained optimal control problems", SIAM Journal on
    Control and Optimization 1999; Murty, "Note on a Bard-type scheme for solving the complementarity problem", Opsearch
    1974 (the least index).
    """
    m, each = b.shape[-1], torch.arange(b.shape[-1])
    diagonal = 2 * R.diagonal(dim1=-2, dim2=-1)
    u, before = (-b / diagonal).clamp(low, high), torch.full_like(b, 2.0)
    rows, minimum = torch.arange(len(b)), u.clone()
    for k in range(SIMULTANEOUS_ROUNDS * (1 + m)):
        towards = u - (2 * (R @ u[..., None])[..., 0] + b) / diagonal
        side = (towards >= high).to(b) - (towards <= low).to(b)
        changes = side != before
        going = changes.any(-1)
        if not bool(going.all()):
            minimum[rows[~going]] = u[~going]
            parts = (rows, R, b, diagonal, side, before, changes)
            rows, R, b, diagonal, side, before, changes = (part[going] for part in parts)
            if not len(rows):
                break
        if k >= SIMULTANEOUS_ROUNDS:
            first = changes.to(torch.uint8).argmax(-1, keepdim=True)
            side = torch.where(each == first, torch.where(before == 0, side, 0.0), before)
        free = (side == 0).to(b)
        held = torch.where(side < 0, low, torch.where(side > 0, high, 0.0))
        A = free[..., :, None] * R * free[..., None, :] + torch.diag_embed(1 - free)
        rest = free * (-b / 2 - (R @ held[..., None])[..., 0]) + held
        u, before = torch.linalg.solve_ex(A, rest[..., None])[0][..., 0], side
    settled = torch.ones(len(minimum), dtype=torch.bool)
    settled[rows] = False
    return minimum, settled


@operator
def active_set(b: Control, R: ControlMatrix, low: Tensor, high: Tensor) -> Control:
    """Which controls are at a limit at the minimum: −1 at the lower, 1 at the upper, 0 at none.

    Each round moves from a control in the box towards the minimum over the free controls. If a limit is reached first,
    that control is held from there on. Otherwise, of the held controls, the one is released that lowers the cost most.
    The cost decreases in each round; at the minimum no release lowers it. On random R and b with up to 8 controls and a
    condition of R up to 1e6 this took at most 2.3m rounds; ACTIVE_SET_ROUNDS · m are made.
    """
    m, scale = b.shape[-1], R.diagonal(dim1=-2, dim2=-1).sqrt()
    each = torch.arange(m, device=b.device)
    u = (-b / (2 * scale**2)).clamp(low, high)
    side = (u >= high).to(b) - (u <= low).to(b)
    for _ in range(ACTIVE_SET_ROUNDS * m):
        step = torch.where(side == 0, _minimum_beside(R, b, torch.where(side == 0, 0.0, u), side) - u, 0.0)
        room = torch.where(step > 0, high - u, low - u) / torch.where(step == 0, 1.0, step)
        share, first = torch.where(step == 0, torch.inf, room).min(-1, keepdim=True)
        arrived = share >= 1
        side = torch.where((each == first) & ~arrived, step.sign(), side)
        u = torch.where(side < 0, low, torch.where(side > 0, high, u + share.clamp_max(1) * step))
        gain, which = (side * (2 * apply(R, u) + b) / scale).max(-1, keepdim=True)
        side = torch.where((each == which) & arrived & (gain > 0), 0.0, side)
    return side


def _have_values(*tensors: Tensor) -> bool:
    """Whether tensors have values, so that control flow may depend on them, and need no gradient."""
    return all(has_values(each) and not (torch.is_grad_enabled() and each.requires_grad) for each in tensors)


ENUMERATED_CONTROLS = 4  # up to this number all combinations are tried: 3⁴ = 81 systems compile faster than many rounds
ACTIVE_SET_ROUNDS = 4  # rounds of the active-set method for each control
SIMULTANEOUS_ROUNDS = 8  # rounds in which all controls may change at once; then as many rounds for each control follow
NEAR_BORDER = 1e-5  # excess below which a control is inside; on a border it is 0 up to rounding, also in float32
FINITE_LIMIT = 1e150  # replaces an infinite limit in products

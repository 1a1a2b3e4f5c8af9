"""Limits of controls that depend on the state: motors whose torque falls with speed, thrust that falls with height.

A task with such limits is solved in shares v of the range between them, −1 ≤ v ≤ 1, with u = c(x) + h(x)v, where c is
the middle of the range and h half its width. It is then a task between constant limits:

    f + gu = (f + gc) + (gh)v,   (u − u*)ᵀR(u − u*) = (v − v*)ᵀ hRh (v − v*),   v*(x) = (u* − c(x))/h(x).

So everything that differentiates dynamics and costs in x, and everything that minimises over constant limits, knows how
the limits move.
"""

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from lyapnet.base.contracts import check_function
from lyapnet.base.errors import ExportError, UsageError
from lyapnet.base.linear_algebra import apply
from lyapnet.base.types import Control, ControlMatrix, InputMatrix, State
from lyapnet.task.cost import Cost, MadeOfAnother
from lyapnet.task.extended_system import ExtendedSystem
from lyapnet.task.sets import ControlBox
from lyapnet.task.systems import ControlSystem

TRIED = 64  # states at which a user's function is tested
ROUNDING = 16  # units of rounding by which limits from a table are inside of it, relative to the sizes that it adds up


class VaryingLimits(ControlBox, ABC):
    """U(x) = {u : lower(x) ≤ u ≤ upper(x)}; as a set that knows no state, the shares v with −1 ≤ v ≤ 1.

    A subclass implements `limits_at` with torch operations on tensors of any leading shape. Where a slope of the limits
    jumps, derivatives are those that torch computes there, and second derivatives do not see the jump.
    """

    def __init__(self):
        super().__init__(-1.0, 1.0)

    @property
    def fixed_limits(self) -> None:
        return None

    @abstractmethod
    def limits_at(self, x: State) -> tuple[Control, Control]:
        """(lower, upper), each (*batch, m), finite and lower < upper."""

    def of(self, system: ControlSystem) -> "VaryingLimits":
        """These limits for a system, whose states they may know by name."""
        return self

    def rounded_for(self, dtype: torch.dtype) -> "VaryingLimits":
        """These limits for arithmetic in another precision, in which they are not passed; in that of their buffers.

        Raises:
            ExportError: they are not known to be rounded inwards.
        """
        if dtype == self.lower.dtype:
            return self
        raise ExportError(
            f"Expected limits of controls from a table, or the precision of the controller, got "
            f"{type(self).__name__}: in another precision u may pass its limits; take --dtype of the controller."
        )

    def middle_and_half(self, x: State) -> tuple[Control, Control]:
        """c and h with u = c + hv, each (*batch, m)."""
        lower, upper = self.limits_at(x)
        return (lower + upper) / 2, (upper - lower) / 2

    def applied(self, x: State, u: Control) -> Control:
        lower, upper = self.limits_at(x)
        share = (1 + u) / 2
        near_upper, near_lower = upper - (1 - share) * (upper - lower), lower + share * (upper - lower)
        return torch.maximum(torch.minimum(torch.where(u > 0, near_upper, near_lower), upper), lower)

    def asked(self, x: State, u: Control) -> Control:
        middle, half = self.middle_and_half(x)
        return (u - middle) / half

    def check(self, x: State, m: int) -> None:
        """Check the limits of m controls at states (b, n).

        Raises:
            UsageError: the function breaks its contract, or limits are not finite, reversed or equal.
        """
        name = type(self).__name__
        for k in (0, 1):
            check_function(f"{name}.limits_at(x)[{k}]", lambda x, k=k: self.limits_at(x)[k], [x[:TRIED]], (m,))
        lower, upper = self.limits_at(x)
        bad = torch.nonzero(~((lower < upper) & lower.isfinite() & upper.isfinite()).all(-1)).flatten()
        if len(bad):
            i = int(bad[0])
            raise UsageError(
                f"Expected finite limits with lower < upper, got {lower[i].tolist()} and {upper[i].tolist()} of {name} "
                f"at x = {x[i].tolist()}; leave every control some room at every state."
            )

    def extra_repr(self) -> str:
        return "limits that depend on the state"


class LimitTable(VaryingLimits):
    """Limits that are straight between the entries of a table over one state, and constant beyond its ends.

    At an entry, where the slope jumps, the derivative is the slope before it. Limits are rounded inwards: those
    computed in float32 never exceed those of the table as it is written.

    Args:
        state: the name of the state.
        at: its values x₀ < … < x_k, in its unit.
        upper: the greatest controls there: k + 1 numbers, or rows of one for each control.
        lower: the least controls there, likewise; None: −upper.

    Raises:
        ValueError: a table of another form, values that do not increase, or lower ≥ upper.
    """

    nodes: Float[Tensor, " k"]  # x₀ to x_{k−1}, where a slope begins
    last: Float[Tensor, "1"]  # x_k
    first: Float[Tensor, "2 m"]  # the limits at x₀, lower ones first
    bends: Float[Tensor, "2 m k"]  # changes of their slopes at the nodes
    sizes: Float[Tensor, "2 m"]  # of the numbers that are added up

    def __init__(
        self,
        state: str,
        at: Sequence[float],
        upper: Sequence[Any],
        lower: Sequence[Any] | None = None,
    ):
        super().__init__()
        self.state = state
        self.index: int | None = None  # of the state in the system
        self.count = 1  # number of controls
        self.rounding = torch.finfo(torch.float64).eps  # unit of rounding of the coarsest precision it has had
        nodes, top = _numbers("at", at), _numbers("upper", upper)
        bottom = -top if lower is None else _numbers("lower", lower)
        if nodes.ndim != 1 or len(nodes) < 2 or not bool((nodes.diff() > 0).all()):
            raise ValueError(f"Expected at least two increasing numbers as at, got {at!r}; give those of the table.")
        top, bottom = (side[:, None] if side.ndim == 1 else side for side in (top, bottom))
        if top.ndim != 2 or top.shape != bottom.shape or len(top) != len(nodes):
            raise ValueError(
                f"Expected upper and lower with {len(nodes)} entries each, as many as at has, and as many controls in "
                f"each, got {tuple(top.shape)} and {tuple(bottom.shape)}; give a limit for each value of the state."
            )
        if not bool((bottom < top).all()):
            raise ValueError(f"Expected lower < upper at every entry, got {lower!r} and {upper!r}; correct the table.")
        values = torch.stack([bottom, top]).mT  # (2, m, k + 1)
        slopes = values.diff() / nodes.diff()
        bends = torch.cat([slopes[..., :1], slopes.diff()], -1)
        sizes = values[..., 0].abs() + bends.abs().sum(-1) * (nodes.abs().max() + nodes[-1] - nodes[0])
        for name, table in {
            "nodes": nodes[:-1], "last": nodes[-1:], "first": values[..., 0], "bends": bends, "sizes": sizes,
        }.items():  # fmt: skip
            self.register_buffer(name, table.clone(), persistent=False)
        self.to(torch.get_default_dtype())

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "LimitTable":
        super()._apply(fn, recurse)
        self.rounding = max(self.rounding, torch.finfo(self.first.dtype).eps)
        return self

    def of(self, system: ControlSystem) -> "LimitTable":
        names = [*system.state_names]
        if self.state not in names:
            raise UsageError(
                f"Expected the state of the limits among {', '.join(names)}, got {self.state!r}; name one of them."
            )
        if self.first.shape[1] not in (1, system.m):
            raise UsageError(
                f"Expected limits of {system.m} controls ({', '.join(system.control_names)}) at each entry, got "
                f"{self.first.shape[1]}; give one number, or one for each."
            )
        if self.index == names.index(self.state) and self.count == system.m:
            return self
        bound = copy.deepcopy(self)
        bound.index, bound.count = names.index(self.state), system.m
        return bound

    def rounded_for(self, dtype: torch.dtype) -> "LimitTable":
        return copy.deepcopy(self).to(dtype).to(self.lower.dtype)

    def limits_at(self, x: State) -> tuple[Control, Control]:
        assert self.index is not None  # a problem binds it to its system
        ramps = torch.relu(x[..., self.index, None].clamp(max=self.last) - self.nodes)
        low, high = (self.first[k] + (ramps[..., None, :] * self.bends[k]).sum(-1) for k in (0, 1))
        room, shape = ROUNDING * self.rounding * self.sizes, (*x.shape[:-1], self.count)
        return (low + room[0]).expand(shape), (high - room[1]).expand(shape)

    def extra_repr(self) -> str:
        return f"a table over {self.state}"


def _numbers(name: str, given: Any) -> Tensor:
    try:
        numbers = torch.tensor(given, dtype=torch.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"Expected {name} as a list of numbers, got {given!r}; write it so.") from error
    if not bool(numbers.isfinite().all()):
        raise ValueError(f"Expected finite numbers as {name}, got {given!r}; a table has no others.")
    return numbers


class SystemOfShares(ExtendedSystem):
    """ẋ = f + g(c(x) + h(x)v), a system with the shares v of the range between its limits as controls.

    Args:
        system: f and g, or ẋ as a function of u.
        limits: of u.
    """

    def __init__(self, system: ControlSystem, limits: VaryingLimits):
        super().__init__(system, [], [])
        self.range = limits

    @property
    def title(self) -> str:
        return self.system.title

    def f(self, x: State) -> State:
        return self.system.f(x) + apply(self.system.g(x), self.range.middle_and_half(x)[0])

    def g(self, x: State) -> InputMatrix:
        return self.system.g(x) * self.range.middle_and_half(x)[1][..., None, :]

    def dynamics(self, x: State, u: Control) -> State:
        middle, half = self.range.middle_and_half(x)
        return self.system.dynamics(x, middle + half * u)


class CostOfShares(MadeOfAnother):
    """Another cost as a function of the shares: q(x) + (v − v*(x))ᵀ hRh (v − v*(x)).

    Args:
        cost: q, R, u* and φ.
        limits: of u.
        goal: the state (n,) whose v* is the control at rest.

    Raises:
        UsageError: the cost has costs of controls beside uᵀRu, or methods of its own.
    """

    words: str = "between limits that depend on the state"

    def __init__(self, cost: Cost, limits: VaryingLimits, goal: State):
        super().__init__(cost)
        if cost.nonquadratic is not None or cost.has_methods_of_its_own:
            raise UsageError(
                f"Expected controls that cost uᵀRu alone with limits that depend on the state, got more in "
                f"{type(cost).__name__}; leave out cost.control_costs, or take limits that do not."
            )
        self.range = limits
        self.R_constant = self.R_inverse = None
        self.rest = self.rest_at(goal).detach()

    def R(self, x: State) -> ControlMatrix:
        half = self.range.middle_and_half(x)[1]
        return half[..., :, None] * self.cost.R(x) * half[..., None, :]

    def rest_at(self, x: State) -> Tensor:
        rest, (middle, half) = self.cost.rest_at(x), self.range.middle_and_half(x)
        return -middle / half if rest is None else (rest - middle) / half


def written_system(system: ControlSystem) -> ControlSystem:
    """The system that was given to a problem whose limits depend on the state; else the system itself."""
    return system.system if isinstance(system, SystemOfShares) else system


def in_shares(system: ControlSystem, cost: Cost, limits: VaryingLimits, goal: State) -> tuple[ControlSystem, Cost]:
    """A system and a cost as functions of the shares; those that are already so stay as they are.

    Args:
        goal: a typical state (n,), where the cost has no goal.
    """
    if not isinstance(system, SystemOfShares):
        system = SystemOfShares(system, limits)
    inner = cost
    while isinstance(inner, MadeOfAnother) and not isinstance(inner, CostOfShares):
        inner = inner.cost
    if not isinstance(inner, CostOfShares):
        cost = CostOfShares(cost, limits, goal if cost.goal is None else cost.goal.to(goal))
    return system, cost


def written_cost(cost: Cost) -> Cost:
    """The cost as a function of u that was given to a problem with limits that depend on the state; else the cost."""
    if isinstance(cost, CostOfShares):
        return cost.cost
    if not isinstance(cost, MadeOfAnother) or (inner := written_cost(cost.cost)) is cost.cost:
        return cost
    cost = copy.copy(cost)  # shares its tensors
    cost._modules = {**cost._modules, "cost": inner}
    cost._buffers = {**cost._buffers, **{name: getattr(inner, name) for name in ("rest", "R_constant", "R_inverse")}}
    return cost

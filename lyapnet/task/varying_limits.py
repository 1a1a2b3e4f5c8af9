"""Limits of controls that depend on the state, such as those of a motor whose torque falls with its speed."""

import copy
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from lyapnet.base.contracts import check_function
from lyapnet.base.errors import ExportError, UsageError
from lyapnet.base.types import Control, State
from lyapnet.task.mapped_controls import MappedControls
from lyapnet.task.sets import ControlBox, finite_numbers, passed_through
from lyapnet.task.systems import ControlSystem

TEST_STATES = 64  # number of states at which a user's function is tested
ROUNDING = 16  # units of rounding by which limits are moved inside those of the table, relative to the sum of sizes


class VaryingLimits(MappedControls, ControlBox):
    """U(x) = {u : lower(x) ≤ u ≤ upper(x)}, with shares −1 ≤ v ≤ 1.

    A subclass implements `limits_at` with torch operations on tensors of any leading shape. Where the slope of a limit
    jumps, first derivatives are those of torch, and second derivatives ignore the jump.
    """

    words: str = "limits that depend on the state"

    def __init__(self):
        super().__init__(-1.0, 1.0)

    @property
    def fixed_limits(self) -> None:
        return None

    @abstractmethod
    def limits_at(self, x: State) -> tuple[Control, Control]:
        """(lower, upper), each (*batch, m), finite and lower < upper."""

    def rounded_for(self, dtype: torch.dtype) -> "VaryingLimits":
        """See ControlSet.rounded_for.

        Raises:
            ExportError: the rounding of `limits_at` is not known.
        """
        raise ExportError(
            f"Expected limits of controls from a table, or the precision of the controller, got "
            f"{type(self).__name__}: in another precision u may exceed them; take --dtype of the controller."
        )

    def moved(self, x: State, u: Control) -> Control:
        lower, upper = self.limits_at(x)
        return (lower + upper) / 2 + (upper - lower) / 2 * u

    def stretched(self, x: State, rows: Tensor) -> Tensor:
        lower, upper = self.limits_at(x)
        return rows * ((upper - lower) / 2)[..., None, :]

    def applied(self, x: State, u: Control) -> Control:
        lower, upper = self.limits_at(x)
        share = (1 + u) / 2
        near_upper, near_lower = upper - (1 - share) * (upper - lower), lower + share * (upper - lower)
        return torch.maximum(torch.minimum(torch.where(u > 0, near_upper, near_lower), upper), lower)

    def asked(self, x: State, u: Control) -> Control:
        lower, upper = self.limits_at(x)
        return (2 * u - lower - upper) / (upper - lower)

    def check(self, x: State, m: int) -> None:
        """Check the limits of m controls at states (b, n).

        Raises:
            UsageError: the function breaks its contract, or limits are not finite, reversed or equal.
        """
        name = type(self).__name__
        for k in (0, 1):
            check_function(f"{name}.limits_at(x)[{k}]", lambda x, k=k: self.limits_at(x)[k], [x[:TEST_STATES]], (m,))
        lower, upper = self.limits_at(x)
        bad = torch.nonzero(~((lower < upper) & lower.isfinite() & upper.isfinite()).all(-1)).flatten()
        if len(bad):
            i = int(bad[0])
            raise UsageError(
                f"Expected finite limits with lower < upper, got {lower[i].tolist()} and {upper[i].tolist()} of {name} "
                f"at x = {x[i].tolist()}; leave an interval for every control at every state."
            )

    def extra_repr(self) -> str:
        return "limits that depend on the state"


class LimitTable(VaryingLimits):
    """Limits by linear interpolation in a table over one state, constant beyond its ends.

    At an entry, where the slope jumps, the derivative is the slope before it. Limits are rounded inwards: those
    computed in float32 never exceed those of the table as it is written.

    Args:
        state: the name of the state.
        at: its values x₀ < … < x_k, in its unit.
        upper: the greatest controls there: k + 1 numbers, or rows of one for each control.
        lower: the least controls there, in the same form; None: −upper.

    Raises:
        ValueError: a table of another form, values that do not increase, or lower ≥ upper.
    """

    nodes: Float[Tensor, " k"]  # x₀ to x_{k−1}, where a slope begins
    last: Float[Tensor, "1"]  # x_k
    first: Float[Tensor, "2 m"]  # (lower, upper) at x₀
    bends: Float[Tensor, "2 m k"]  # changes of their slopes at the nodes
    sizes: Float[Tensor, "2 m"]  # bound of the sum of sizes of the terms of a limit

    def __init__(
        self,
        state: str,
        at: Sequence[float],
        upper: Sequence[Any],
        lower: Sequence[Any] | None = None,
    ):
        super().__init__()
        self.state = state
        self.index: int | None = None  # index of the state in the system
        self.count = 1  # number of controls
        nodes, top = finite_numbers("at", at), finite_numbers("upper", upper)
        bottom = -top if lower is None else finite_numbers("lower", lower)
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
        return passed_through(self, dtype)

    def limits_at(self, x: State) -> tuple[Control, Control]:
        assert self.index is not None  # set by `of`
        ramps = torch.relu(x[..., self.index, None].clamp(max=self.last) - self.nodes)
        low, high = (self.first[k] + (ramps[..., None, :] * self.bends[k]).sum(-1) for k in (0, 1))
        room, shape = ROUNDING * self.rounding * self.sizes, (*x.shape[:-1], self.count)
        return (low + room[0]).expand(shape), (high - room[1]).expand(shape)

    def extra_repr(self) -> str:
        return f"a table over {self.state}"

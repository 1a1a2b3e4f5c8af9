"""argmin and min over u ∈ U of uᵀWu + bᵀu + s(u), and an operator for them in traces, which bounds can recognise."""

import copy
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import _disable_current_modes

from lyapnet.base.linear_algebra import apply
from lyapnet.base.operators import MINIMA, are_operators, is_transformed
from lyapnet.base.types import Control, ControlMatrix, PerState
from lyapnet.task.ball import ControlBall
from lyapnet.task.cost.control_costs import CONTROL_COSTS, ControlCosts
from lyapnet.task.polytope import ControlPolytope
from lyapnet.task.sets import ControlBox, ControlSet, Unbounded


class Minimum(NamedTuple):
    """The minimiser and the minimum."""

    u: Control
    value: PerState  # uᵀWu + bᵀu + s(u), (*batch,)


def best_control(costs: ControlCosts | None, controls: ControlSet, W: ControlMatrix, b: Control) -> Control:
    """argmin over u ∈ U of uᵀWu + bᵀu + s(u), (*batch, m); None as costs: s = 0."""
    return controls.minimise(W, b) if costs is None else costs.minimise(controls, W, b)


def least_over(costs: ControlCosts | None, controls: ControlSet, W: ControlMatrix, b: Control) -> Minimum:
    """The minimiser, as in `best_control`, and the minimum."""
    u = best_control(costs, controls, W, b)
    value = ((apply(W, u) + b) * u).sum(-1)
    return Minimum(u, value if costs is None else value + costs(u))


def is_quadratic_between_limits(costs: ControlCosts | None, controls: ControlSet) -> bool:
    """Whether s = 0 and U is neither ball nor polytope; then bounds need no operator for the best control."""
    return costs is None and not isinstance(controls, ControlBall | ControlPolytope)


class Known(NamedTuple):
    """s and U of an operator in a trace, in float64."""

    costs: ControlCosts | None
    controls: ControlSet

    def to(self, device: torch.device) -> "Known":
        """A copy on a device."""
        costs, controls = (None if part is None else copy.deepcopy(part).double().to(device) for part in self)
        assert isinstance(controls, ControlSet)
        return Known(costs if isinstance(costs, ControlCosts) else None, controls)


def description(costs: ControlCosts | None, controls: ControlSet) -> str | None:
    """A text that defines s and U completely; None for other classes than those that the operator supports."""
    parts, controls = [] if costs is None else [*costs.costs], controls.shares
    own = {*CONTROL_COSTS.values()}.issuperset(map(type, parts)) and type(costs) in (ControlCosts, type(None))
    if not own or type(controls) not in (ControlBall, ControlBox, Unbounded) or (costs and float(costs.softness)):
        return None
    return "; ".join(f"{type(part).__name__}({', '.join(_numbers(part))})" for part in (*parts, controls))


def _numbers(part: nn.Module) -> Iterator[str]:
    for name, value in part.named_buffers():
        yield f"{name}={value.double().tolist()}"
    for name in ("exponent", "width"):
        if hasattr(part, name):
            yield f"{name}={getattr(part, name)!r}"


def traced_minimum(costs: ControlCosts | None, controls: ControlSet, W: ControlMatrix, b: Control) -> Minimum | None:
    """The minimum by the operator; None outside of traces with this operator, or if it does not support s and U."""
    if not are_operators(MINIMA) or is_quadratic_between_limits(costs, controls) or is_transformed(b):
        return None
    with torch._C.DisableTorchFunction(), _disable_current_modes():  # numbers, not operations of the trace
        named = register_minimum(costs, controls)
    if named is None:
        return None
    both = LEAST(W, b, named)
    return Minimum(both[..., :-1], both[..., -1])


_CPU = torch.device("cpu")
_known = dict[str, dict[torch.device, Known]]()


def register_minimum(costs: ControlCosts | None, controls: ControlSet) -> str | None:
    """Store s and U for the operator in this process; return their description, or None if they have none."""
    named = description(costs, controls)
    if named is not None and named not in _known:
        _known[named] = {_CPU: Known(costs, controls.shares).to(_CPU)}
    return named


def find_registered(named: str, device: torch.device) -> Known:
    """s and U by the description that `register_minimum` returned in this process."""
    copies = _known[named]
    if device not in copies:
        copies[device] = copies[_CPU].to(device)
    return copies[device]


@torch.library.custom_op("lyapnet::least", mutates_args=())
def _least(W: Tensor, b: Tensor, named: str) -> Tensor:
    u, value = least_over(*find_registered(named, b.device), W, b)
    return torch.cat([u, value[..., None]], -1)


@_least.register_fake
def _(W: Tensor, b: Tensor, named: str) -> Tensor:
    return b.new_empty(*b.shape[:-1], b.shape[-1] + 1)


LEAST = torch.ops.lyapnet.least.default

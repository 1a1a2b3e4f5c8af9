"""Builds the costs of controls beside uᵀRu that a config lists."""

import itertools
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from lyapnet.base.contracts import check_function, require_initialised
from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly.classes import check_parameters, float64_defaults, resolve, section
from lyapnet.experiment.config import CostConfig
from lyapnet.task.cost.control_costs import CONTROL_COSTS, AbsoluteCost, ControlCost, ControlCosts, SeparableCost
from lyapnet.task.sets import ControlBox, ControlSet, Unbounded

KEY = "cost.control_costs"
REACHED_SHARE = 1 - 1e-6  # share of an open limit that controls may reach; the cost is still finite there


def control_costs_of(config: CostConfig, m: int) -> ControlCosts | None:
    """The sum of the costs of m controls that a config lists; None if it lists none.

    Raises:
        UsageError: a cost has no name, an unknown one, or parameters that do not fit; names the key.
    """
    if not config.control_costs:
        return None
    return ControlCosts([_control_cost(f"{KEY}[{k}]", given, m) for k, given in enumerate(config.control_costs)])


def _control_cost(key: str, given: Any, m: int) -> ControlCost:
    if not isinstance(given, Mapping) or not isinstance(given.get("name"), str):
        raise UsageError(f"Expected {key} as {{name: …, weight: …}}, got {given!r}; name a cost of controls.")
    cls = resolve(given["name"], CONTROL_COSTS, f"{key}.name", ControlCost)
    parameters = {name: value for name, value in given.items() if name != "name"}
    check_parameters(cls, given["name"], parameters, key)
    with float64_defaults(), section(key):
        cost = require_initialised(cls(**parameters))
    for name, numbers in cost.named_buffers():
        if numbers.numel() not in (1, m):
            raise UsageError(f"Expected one {name} of {key}, or {m} of them, got {numbers.numel()}; give one for each.")
    if given["name"] not in CONTROL_COSTS:
        _require_contract(key, cost, m)
    return cost


def _require_contract(key: str, cost: ControlCost, m: int) -> None:
    """Check a cost of a user's own: one number for each u, 0 at u = 0, even, convex, and smooth at 0.

    Raises:
        UsageError: a property is missing; names it.
    """
    name = type(cost).__name__
    if not isinstance(cost, SeparableCost) or isinstance(cost, AbsoluteCost):
        raise UsageError(f"Expected {key} as a smooth SeparableCost of your own, got {name}; derive it from that.")
    u = ControlCosts([cost]).distinguishing_controls(m)
    check_function(f"{name}.forward(u)", cost, [u], ())
    s, zero = cost(u), torch.zeros(1, m, dtype=u.dtype)
    slopes = [cost.slope(share * u).sum(-1) for share in (1e-6, 0.3, 0.6, 1.0)]
    wrong = (
        "s(0) = 0" if float(cost(zero).abs()) > 0 else "s(−u) = s(u)" if not torch.allclose(cost(-u), s)
        else "a convex s" if any(bool((b < a - 1e-12).any()) for a, b in itertools.pairwise(slopes))
        else "a slope of 0 at u = 0" if bool((slopes[0] > 0.1 * slopes[-1]).any()) else ""
    )  # fmt: skip
    if wrong:
        raise UsageError(f"Expected {wrong} of {name}, got another function; correct its forward(u).")


def within_open_limits(controls: ControlSet, costs: ControlCosts | None, m: int) -> ControlSet:
    """The controls of a box at which their costs are finite.

    Raises:
        UsageError: there are none.
    """
    ends: list[Tensor] = [] if costs is None else costs.open_limits
    if not ends or type(controls) not in (Unbounded, ControlBox):
        return controls
    with float64_defaults():
        least = ends[0].double().expand(m)
        for end in ends[1:]:
            least = least.minimum(end.double())
        lower, upper = -REACHED_SHARE * least, REACHED_SHARE * least
        if isinstance(controls, ControlBox):
            lower, upper = lower.maximum(controls.lower.double()), upper.minimum(controls.upper.double())
        if not bool((lower < upper).all()):
            raise UsageError(f"Expected {KEY} that are finite between the limits of controls, got others; widen them.")
        return ControlBox(lower, upper)

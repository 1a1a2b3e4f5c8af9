"""Builds the costs of controls beside uᵀRu that a config lists."""

from collections.abc import Mapping
from typing import Any

from torch import Tensor

from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly.classes import check_parameters, float64_defaults, resolve, section
from lyapnet.experiment.config import CostConfig
from lyapnet.task.cost.control_costs import CONTROL_COSTS, ControlCost, ControlCosts
from lyapnet.task.sets import ControlBox, ControlSet, Unbounded

KEY = "cost.control_costs"
OF_OPEN_LIMIT = 1 - 1e-6  # share of it that controls reach: the cost is still finite there


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
        cost = cls(**parameters)
    for name, numbers in cost.named_buffers():
        if numbers.numel() not in (1, m):
            raise UsageError(f"Expected one {name} of {key}, or {m} of them, got {numbers.numel()}; give one for each.")
    return cost


def within_open_limits(controls: ControlSet, costs: ControlCosts | None, m: int) -> ControlSet:
    """The controls between the limits at which a cost of theirs is infinite, where no others are given."""
    if costs is None or type(controls) is not Unbounded:
        return controls
    ends: list[Tensor] = costs.open_limits
    if not ends:
        return controls
    with float64_defaults():
        least = ends[0].double().expand(m)
        for end in ends[1:]:
            least = least.minimum(end.double())
        return ControlBox(-OF_OPEN_LIMIT * least, OF_OPEN_LIMIT * least)

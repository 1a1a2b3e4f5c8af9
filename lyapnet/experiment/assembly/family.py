"""Builds the system, cost and initial states of a family from a config."""

import copy
import dataclasses
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import torch

from lyapnet.base.errors import UsageError, did_you_mean
from lyapnet.base.names import with_underscores
from lyapnet.base.types import ControlMatrix, State
from lyapnet.experiment.assembly.classes import Parts, section
from lyapnet.experiment.assembly.target_family import cost_and_targets, target_of_member
from lyapnet.experiment.assembly.weights import named, weighted_matrices, weights_among, weights_of, with_weights
from lyapnet.experiment.config import Config
from lyapnet.task.cost import Cost, CostWrapper, innermost
from lyapnet.task.family import PREFIX, FamilyCost, FamilySystem, check_members, with_attributes
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box, ControlSet
from lyapnet.task.systems import ControlSystem

RESERVED_NAMES = ("t", "x", "x0", "steps")  # other arguments of a controller's methods
TEST_STATES = 8  # random (x, p) at which members are compared with newly constructed systems


def family_of(
    config: Config,
    system: ControlSystem,
    cost: Cost,
    controls: ControlSet,
    initial_states: Box,
    own_cost: bool = False,
) -> tuple[FamilySystem, FamilyCost, Box]:
    """The system, the cost and the box X₀ × P of a family in z = (x, p).

    Args:
        own_cost: whether the cost is an object of the user's instead of that of the config.

    Raises:
        UsageError: a name is neither a parameter of the system, nor target_STATE, nor a weight of the cost; a range is
            invalid, a member breaks the contract of FamilySystem, or no control holds the target of a member.
    """
    if isinstance(cost, CostWrapper) and innermost(cost).goal is not None:
        raise UsageError("Expected a cost about the origin for a family, got one about a goal of its own.")
    weights = weights_among(config.family, system)
    ranges = named(checked_ranges(config.family, "family"), system)
    for name in weights:
        if not ranges[name][0] > 0:
            raise UsageError(f"Expected family.{name} > 0, got {ranges[name]}; V is a function of its logarithm.")
        if config.horizon.stationary and weights[name].matrix == "Q_T":
            raise UsageError(
                f"Expected no weight of Q_T in a family with horizon.stationary, got {name}; φ is the regulator's: "
                "remove it."
            )
    moved = _find_target_parameters(ranges, system)
    units = [""] * len(ranges)
    for i, k in moved.items():
        units[k] = system.state_units[i]
    family, box = members_of(config, system, ranges, units, initial_states, weights=weights)
    least = [ranges[name][0] for name in weights]
    matrices = weighted_matrices(config.cost, cost, weights, least, own_cost) if weights else None
    cost, targets = cost_and_targets(config, cost, family, controls, box, moved)
    logarithms, R = [family.names.index(name) for name in weights], _weight_of_members(cost, family)
    return family, FamilyCost(cost, targets, box.center[system.n :], system.n, R, matrices, logarithms), box


def members_of(
    config: Config,
    system: ControlSystem,
    ranges: Mapping[str, Sequence[float]],
    units: Sequence[str],
    initial_states: Box,
    key: str = "a family",
    weights: Collection[str] = (),
) -> tuple[FamilySystem, Box]:
    """The family of a system with parameters in some ranges [least, greatest], and the box X₀ × P.

    Args:
        weights: names of the parameters that are weights of the cost.

    Raises:
        UsageError: a member breaks the contract of FamilySystem.
    """
    family = FamilySystem(system, list(ranges), units, weights)
    sides = (initial_states.lower, initial_states.upper)
    ends = ({name: bounds[k] for name, bounds in ranges.items()} for k in (0, 1))
    box = Box(*(family.joined(side.double(), end) for side, end in zip(sides, ends, strict=True)))
    _check_members(config, family, box, key)
    return family, box


def member(
    config: Config, parts: Parts, problem: Problem, parameters: Mapping[str, Any]
) -> tuple[Config, Parts, list[float]]:
    """The config of a family's member, the user's parts for it, and its p in the order of the family.

    Args:
        problem: of the family.

    Raises:
        UsageError: a parameter is missing, unknown, no number, or outside the range that V was trained for.
    """
    family = problem.system
    assert isinstance(family, FamilySystem)
    ranges, given = ranges_of(config, family), named(parameters, family.system)
    if given.keys() != ranges.keys():
        names = ", ".join(parameters) or "none"
        raise UsageError(f"Expected values for {', '.join(ranges)}, got {names}; give each.")
    values = dict[str, float]()
    for name, ends in ranges.items():
        try:
            values[name] = float(given[name])
        except (TypeError, ValueError, RuntimeError) as error:
            raise UsageError(f"Expected {name} as one number, got {given[name]!r}; name one member.") from error
        if not is_in_range(ends, values[name]):
            raise UsageError(f"Expected {name} in {ends}, for which V was trained, got {values[name]:g}.")
    numbers = {name: values[name] for name in family.parameters_in_f}
    system = dataclasses.replace(config.system, parameters={**config.system.parameters, **numbers})
    weights = {weights_of(family.system)[name]: values[name] for name in family.weights}
    cost = dataclasses.replace(config.cost, **with_weights(config.cost, weights, family.system))
    p = [math.log10(value) if name in family.weights else value for name, value in values.items()]
    target = target_of_member(config, problem, _find_target_parameters(values, family.system), p)
    own = dataclasses.replace(copy.deepcopy(config), system=system, cost=cost, target=target, family={})
    return own, dataclasses.replace(parts, system=with_attributes(family.system, numbers)), p


def ranges_of(config: Config, family: FamilySystem) -> dict[str, list[float]]:
    """The range [least, greatest] of each parameter of a family, by its name in the family."""
    return dict(zip(family.names, config.family.values(), strict=True))


def is_in_range(ends: Sequence[float], value: float) -> bool:
    """Whether a value is in the range of a family's parameter, up to rounding."""
    least, greatest = ends
    room = 1e-9 * max(abs(least), abs(greatest))
    return least - room <= value <= greatest + room


def checked_ranges(ranges: Mapping[str, list[float]], key: str) -> dict[str, list[float]]:
    """The ranges [least, greatest] of the parameters of a section, by name.

    Raises:
        UsageError: a name is reserved, or a range is invalid.
    """
    for name, bounds in ranges.items():
        if name in RESERVED_NAMES:
            raise UsageError(
                f"Expected parameters in {key} other than {', '.join(RESERVED_NAMES)}, got {name}; rename it."
            )
        if len(bounds) != 2 or not -math.inf < bounds[0] <= bounds[1] < math.inf:
            raise UsageError(
                f"Expected {key}.{name} as [least, greatest], got {bounds}; give two finite numbers, the least first."
            )
    return dict(ranges)


def _find_target_parameters(names: Collection[str], system: ControlSystem) -> dict[int, int]:
    """Index of a state ↦ index of the parameter target_STATE that is its target."""
    known = {PREFIX + with_underscores(name): i for i, name in enumerate(system.state_names)}
    moved = dict[int, int]()
    for k, name in enumerate(names):
        if not name.startswith(PREFIX):
            continue
        if name not in known:
            hint = did_you_mean(name, known, "name a state of the system.", "family.")
            raise UsageError(f"Expected family.{name} among {', '.join(known)}, got no such state; {hint}")
        moved[known[name]] = k
    return moved


def _check_members(config: Config, family: FamilySystem, box: Box, key: str) -> None:
    """Compare members with newly constructed systems, see `check_members`."""
    if not family.parameters_in_f:
        return
    cls, given = type(family.system), config.system.parameters

    def build(values: Mapping[str, float]) -> ControlSystem:
        with section(key.removeprefix("a ")):
            return cls(**{**given, **values})

    inside = box.sample(TEST_STATES, torch.Generator().manual_seed(0))
    states = torch.cat([box.lower[None], box.upper[None], inside])
    check_members(family, build, states, f"parameters of {key}")


def _weight_of_members(cost: Cost, family: FamilySystem) -> Callable[[State], ControlMatrix] | None:
    """R(x; p), if R is the inverse mass of the system; None if it is the same for all members."""
    R = getattr(innermost(cost), "R_of_state", None)
    of_system = getattr(R, "__self__", None) is family.system and getattr(R, "__name__", "") == "inverse_mass"
    return family.inverse_mass if of_system and family.parameters_in_f else None

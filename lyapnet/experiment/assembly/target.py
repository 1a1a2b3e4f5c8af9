"""The cost with a target, and the control that holds the target."""

import functools
import logging
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lyapnet.base.errors import UsageError
from lyapnet.base.names import with_underscores
from lyapnet.experiment.assembly.entries import by_state, repeated, require_length
from lyapnet.experiment.config import Config, ConstraintsConfig
from lyapnet.task.cost import Cost, TargetCost
from lyapnet.task.operating_points import OperatingPoint, OperatingPoints
from lyapnet.task.sets import Box, ControlSet
from lyapnet.task.systems import ControlSystem

LISTED_POINTS = 4  # largest number of further operating points in a note
CONTROL_ADVICE = "give the control u* about which the cost is zero, as in target_control: [0]"


class Trim(NamedTuple):
    """The operating point of a target, and its alternatives."""

    point: OperatingPoint
    others: list[OperatingPoint]
    note: str  # how it was found; empty if the given target is held exactly


def with_target(config: Config, cost: Cost, system: ControlSystem, controls: ControlSet, initial_states: Box) -> Cost:
    """The cost with the target of a config, if there is one; a note reports components that were solved for."""
    if config.target_control is not None:
        return with_written_target(config, cost, system, controls)
    if config.target is None:
        return cost
    (x, u, *_), _, note = trim(config, system, controls, initial_states)
    log_once(note)
    return TargetCost(cost, x, u)


def with_written_target(config: Config, cost: Cost, system: ControlSystem, controls: ControlSet) -> Cost:
    """The cost with exactly the given x* and u*."""
    if config.target is None:
        raise UsageError("Expected target with target_control, got none; name the state that it holds.")
    x, u = _written_target(config, system), _written_control(config, system)
    if not bool(controls.contains(u)):
        raise _not_admitted_error(system, controls, u)
    return TargetCost(cost, x, u)


def trim(config: Config, system: ControlSystem, controls: ControlSet, initial_states: Box) -> Trim:
    """The operating point of a config's target, f(x*) + g(x*)u* = 0, solved for all components that are not given.

    Raises:
        UsageError: the target is invalid, or no admissible control holds it.
    """
    given = named_entries(config.target, system)
    search = OperatingPoints(system, controls, initial_states, state_limits(config.constraints, system))
    if len(given) == system.n:
        point = search.held_by(torch.tensor([given[i] for i in range(system.n)], dtype=torch.float64))
        if not point.held:
            point, note = _move_to_nearest(search, given, point)
            return Trim(_require_admitted(search, point), [], note)
        return Trim(_require_admitted(search, point), [], "")
    points = search.find(given)
    if not points:
        raise UsageError(
            f"Expected a target near which f and g are finite, got {_format_entries(given, system)} and none in X₀; "
            "choose another."
        )
    point, *others = points
    if not point.held:
        point, note = _move_to_nearest(search, given, point)
        return Trim(_require_admitted(search, point), [], note)
    note = f"{_format_entries(given, system)}; solved for {_format_point(point, system, given)}"
    if others:
        further = "; ".join(
            _format_point(other, system, given) + ("" if other.admitted else ", beyond limits")
            for other in others[:LISTED_POINTS]
        )
        more = f" and {len(others) - LISTED_POINTS} more" if len(others) > LISTED_POINTS else ""
        note += f", the nearest to X₀'s centre of {len(points)}; also {further}{more}"
    return Trim(_require_admitted(search, point), others, f"target: {note}.")


def named_entries(target: Any, system: ControlSystem) -> dict[int, float]:
    """Index ↦ value of a target that is a list for all states, a number for every state, or a mapping by name.

    Raises:
        UsageError: the target has another form.
    """
    if not isinstance(target, Mapping):
        entries = repeated(target, system.n)
        if not isinstance(entries, list | tuple):
            raise UsageError(
                f"Expected target as a number or a list of them, or as {{{system.state_names[0]}: …}}, got {target!r}; "
                "write one of these."
            )
        require_length("target", len(entries), system.state_names)
        named = dict(zip(system.state_names, entries, strict=True))
    else:
        named = dict(target)
    found = dict[int, float]()
    for i, number in by_state({str(name): number for name, number in named.items()}, "target", system).items():
        name = system.state_names[i]
        if type(number) not in (int, float) or not math.isfinite(number):
            raise UsageError(
                f"Expected target of finite numbers, got {number!r} for {name}; correct it, or leave it out of a "
                f"mapping as in {{{system.state_names[0]}: 1}}, and it is solved for."
            )
        found[i] = float(number)
    if not found:
        raise UsageError(f"Expected target with a state, got none; name one of {', '.join(system.state_names)}.")
    return found


def _written_target(config: Config, system: ControlSystem) -> Tensor:
    """The target of a config, which has to give every state.

    Raises:
        UsageError: a state is missing.
    """
    given = named_entries(config.target, system)
    missing = [name for i, name in enumerate(system.state_names) if i not in given]
    if missing:
        raise UsageError(
            f"Expected target with every state with target_control, got none for {', '.join(missing)}; give them."
        )
    return torch.tensor([given[i] for i in range(system.n)], dtype=torch.float64)


def _written_control(config: Config, system: ControlSystem) -> Tensor:
    given = repeated(config.target_control, system.m)
    require_length("target_control", len(given), system.control_names)
    if not all(math.isfinite(number) for number in given):
        raise UsageError(f"Expected target_control of finite numbers, got {given}; correct it.")
    return torch.tensor(given, dtype=torch.float64)


def _move_to_nearest(
    search: OperatingPoints, given: Mapping[int, float], point: OperatingPoint
) -> tuple[OperatingPoint, str]:
    """Move a target that is not held to the nearest operating point, if it is only rounded; else raise UsageError."""
    system, to_move = search.system, search.to_move(point.x, given)
    near = search.nearest(point.x, to_move) if to_move else None
    if near is not None and search.is_rounding(given, near.x):
        moves = [
            f"{system.state_names[i]} by {float(near.x[i]) - number:.3g} to {float(near.x[i]):.9g}"
            for i, number in given.items()
            if float(near.x[i]) != number
        ]
        solved = _format_point(near, system, given)
        return near, f"target: moved onto the nearest operating point, {', '.join(moves)}; {solved}."
    advice = f"choose another, or {CONTROL_ADVICE}"
    if near is not None and near.admitted:
        advice = f"choose another, such as {_round_to_six_digits(near.x)}, or {CONTROL_ADVICE}"
    raise not_held_error(system, point.x, advice)


def not_held_error(system: ControlSystem, x: Tensor, advice: str) -> UsageError:
    """The error for a target that no control holds."""
    left = system.holding_control(x)[1]
    worst = int(left.abs().nan_to_num(torch.inf).argmax())
    return UsageError(
        f"Expected a target that some control holds, f(x*) + g(x*)u* = 0, got {float(left[worst]):.3g} for the rate of "
        f"{system.state_names[worst]} at {_round_to_six_digits(x)}; {advice}."
    )


def _require_admitted(search: OperatingPoints, point: OperatingPoint) -> OperatingPoint:
    if not point.admitted:
        raise _not_admitted_error(search.system, search.controls, point.u)
    return point


def _not_admitted_error(system: ControlSystem, controls: ControlSet, u: Tensor) -> UsageError:
    got = [f"{label} = {value:.4g}" for label, value in zip(system.control_labels, u.tolist(), strict=True)]
    if controls.limits is not None:
        low, high = (side.expand(system.m).tolist() for side in controls.limits)
        got = [f"{each} of {a:g} to {b:g}" for each, a, b in zip(got, low, high, strict=True)]
    return UsageError(
        f"Expected the control at the target within its limits, got {', '.join(got)}; widen controls, or choose "
        "another target."
    )


def state_limits(config: ConstraintsConfig, system: ControlSystem) -> tuple[Tensor, Tensor]:
    """The state limits of a config, within which points are preferred; their names are checked elsewhere."""
    low, high = (
        torch.tensor(
            [float(named.get(with_underscores(name), none)) for name in system.state_names], dtype=torch.float64
        )
        for side, none in ((config.lower, -math.inf), (config.upper, math.inf))
        for named in ({with_underscores(name): limit for name, limit in side.items()},)
    )
    return low, high


def _format_entries(given: Mapping[int, float], system: ControlSystem) -> str:
    return ", ".join(f"{system.state_names[i]} = {number:.9g}" for i, number in given.items())


def _format_point(point: OperatingPoint, system: ControlSystem, given: Mapping[int, float] | None = None) -> str:
    """Format the solved components in nine digits: "current = 0.454124583, held by duty = 0.339388328"."""
    states = {i: float(point.x[i]) for i in range(system.n) if given is None or i not in given}
    controls = [f"{name} = {u:.9g}" for name, u in zip(system.control_names, point.u.tolist(), strict=True)]
    return ", ".join([*([_format_entries(states, system)] if states else []), f"held by {controls[0]}", *controls[1:]])


def _round_to_six_digits(x: Tensor) -> list[float]:
    return [float(f"{number:.6g}") for number in x.tolist()]


@functools.cache
def log_once(note: str) -> None:
    """Log a note only once in a process, even if the problem is built several times."""
    if note:
        logging.getLogger(__name__).warning("note: %s", note)

"""Builds the state constraints of a config."""

from collections.abc import Mapping
from typing import Any

import torch

from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly.classes import instance_of, section
from lyapnet.experiment.assembly.entries import by_state, index_of
from lyapnet.experiment.config import ConstraintsConfig
from lyapnet.task.constraints import CONSTRAINTS, AllOf, Ball, Constraints, OfFirstStates, StateLimits
from lyapnet.task.domain import size_of
from lyapnet.task.family import FamilySystem
from lyapnet.task.problem import Problem
from lyapnet.task.systems import ControlSystem
from lyapnet.value.derivatives import jacobian

SMALL_MARGIN = 0.002  # margin of h if u acts on h directly (relative degree one)
LARGE_MARGIN = 0.02  # margin of h if u acts on h through other states
TEST_STATES, ROUNDING = 64, 1e-9  # random states; largest |h_x g| relative to |h_x| |g| that counts as zero


def build_constraints(config: ConstraintsConfig, problem: Problem, own: Constraints | None) -> Constraints | None:
    """The constraints of a config for a problem without constraints, listed ones first; None if there are none.

    Args:
        own: the user's constraints, which replace the class that the config names.

    Raises:
        UsageError: an entry does not fit the system.
    """
    system = problem.system
    with section("constraints"):
        parts: list[Constraints] = [*_limits(config, problem), *_balls(config, system)]
        if config.name in CONSTRAINTS and config.parameters:
            raise UsageError(
                f"Expected no constraints.parameters without a class in constraints.name, got {config.parameters}; "
                "name your class, or leave them out."
            )
        if own is None and config.name not in CONSTRAINTS:
            own = instance_of(config, "constraints")
        if own is not None:
            own = own.double()
            parts.append(OfFirstStates(own, system.system.n) if isinstance(system, FamilySystem) else own)
        if not parts:
            return None
        constraints = parts[0] if len(parts) == 1 else AllOf(parts)
        constraints.margin = LARGE_MARGIN if config.margin is None else config.margin
        return constraints


@torch.no_grad()
def choose_margins(problem: Problem, constraints: Constraints) -> list[float]:
    """The margin of each h_j: SMALL_MARGIN if its relative degree is one (h_x g ≠ 0 at most states), else LARGE_MARGIN.

    If u acts directly on h_j, one step is sufficient to avoid a violation, and a small margin costs less. If u acts
    through other states, as a force on a position, the law has to react earlier.
    """
    box, draws = problem.initial_states, torch.Generator().manual_seed(0)
    x = box.sample(TEST_STATES, draws)
    # components that X₀ fixes are varied too, because the slope of h may vanish there
    x = x + 0.1 * size_of(box) * (box.lower == box.upper) * torch.randn(x.shape, generator=draws, dtype=x.dtype)
    with torch.enable_grad():
        x.requires_grad_()
        slopes = jacobian(constraints(x), x)
    g = problem.system.affine_model(x, problem.nominal_at(x))[1]
    moved, most = (slopes @ g).abs().amax(-1), (slopes.abs() @ g.abs()).amax(-1)
    at_once = (moved > ROUNDING * most).double().mean(0) > 0.5
    return [SMALL_MARGIN if each else LARGE_MARGIN for each in at_once.tolist()]


def _limits(config: ConstraintsConfig, problem: Problem) -> list[StateLimits]:
    """The limits of states as one part, or an empty list. The unit of each limit is its distance from the goal.

    For a limit at the goal, and in a task without a goal, the unit is the distance of X₀'s far end from the limit.
    """
    system, goal, box, columns = problem.system, problem.goal, problem.initial_states, []
    for key, side, given in (("lower", -1.0, config.lower), ("upper", 1.0, config.upper)):
        for i, limit in by_state(given, f"constraints.{key}", system).items():
            reach = float(box.reach_from(torch.full_like(goal, limit))[i])
            far = (problem.has_goal and abs(limit - float(goal[i]))) or reach or 1.0
            sign, unit = "≤" if side > 0 else "≥", system.state_units[i]
            columns.append((i, limit, side, far, f"{system.state_names[i]} {sign} {limit:g} {unit}".strip()))
    return [StateLimits(*zip(*columns, strict=True))] if columns else []


def _balls(config: ConstraintsConfig, system: ControlSystem) -> list[Constraints]:
    balls: list[Constraints] = []
    for key in ("outside", "inside"):
        for k, given in enumerate(getattr(config, key)):
            center, radius = ball_of(given, f"constraints.{key}", {"center", "radius"}, system)
            states = [index_of(name, f"constraints.{key}[{k}].center", system) for name in center]
            where = ", ".join(f"{name} = {value:g}" for name, value in center.items())
            balls.append(Ball(states, [*center.values()], radius, key == "inside", f"{key} {radius:g} around {where}"))
    return balls


def ball_of(
    given: Mapping[str, Any], key: str, keys: set[str], system: ControlSystem
) -> tuple[dict[str, float], float]:
    """The centre, by names of states, and the radius of an entry with given keys.

    Raises:
        UsageError: the entry has other keys or values; says what is expected.
    """
    center = given.get("center")
    numbers = [*center.values()] if isinstance(center, Mapping) else []
    others = [given.get(name) for name in sorted(keys - {"center"})]
    admitted = all(type(number) in (int, float) for number in [*others, *numbers])
    if given.keys() != keys or not numbers or not admitted:
        shown = "".join(f", {name}: {value}" for name, value in {"radius": 0.3, "weight": 9}.items() if name in keys)
        raise UsageError(
            f"Expected {key}, each as {{center: {{{system.state_names[0]}: 1}}{shown}}}, got {given}; give all of them."
        )
    return {str(name): float(value) for name, value in (center or {}).items()}, float(given["radius"])

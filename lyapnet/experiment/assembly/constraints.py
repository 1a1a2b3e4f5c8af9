"""From a config to its state constraints."""

from collections.abc import Mapping
from typing import Any

import torch

from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly.classes import instance_of, section
from lyapnet.experiment.assembly.entries import index_of
from lyapnet.experiment.config import ConstraintsConfig
from lyapnet.task.constraints import CONSTRAINTS, AllOf, Ball, Constraints, OfFirstStates, StateLimits
from lyapnet.task.domain import size_of
from lyapnet.task.family import FamilySystem
from lyapnet.task.problem import Problem
from lyapnet.task.systems import ControlAffineSystem
from lyapnet.value.derivatives import jacobian

NEAR, FAR = 0.002, 0.02  # where u acts on h at once, and where it acts by way of other states
STATES, ROUNDING = 64, 1e-9  # tried; share of |h_x| |g| up to which h_x g is taken for zero


def build_constraints(config: ConstraintsConfig, problem: Problem, own: Constraints | None) -> Constraints | None:
    """The constraints of a config in a problem that has none yet, those that it lists first; None for none at all.

    Args:
        own: the user's, in the place of those that the config names.

    Raises:
        UsageError: an entry does not fit the system.
    """
    system = problem.system
    with section("constraints"):
        parts: list[Constraints] = [*_limits(config, problem), *_balls(config, system)]
        if own is None and config.name not in CONSTRAINTS:
            own = instance_of(config, "constraints")
        if own is not None:
            own = own.double()
            parts.append(OfFirstStates(own, system.system.n) if isinstance(system, FamilySystem) else own)
        if not parts:
            return None
        constraints = parts[0] if len(parts) == 1 else AllOf(parts)
        constraints.margin = FAR if config.margin is None else config.margin
        return constraints


@torch.no_grad()
def choose_margins(problem: Problem, constraints: Constraints) -> list[float]:
    """Of each h_j, NEAR where its relative degree is one, that is where h_x g ≠ 0 at most states; else FAR.

    Where u acts on h_j at once, one step is enough to keep off, and a margin that is small costs less. Where u acts on
    it by way of other states, as on a position by a force, the law has to see the constraint coming.
    """
    box, draws = problem.initial_states, torch.Generator().manual_seed(0)
    x = box.sample(STATES, draws)
    # states that X₀ fixes are moved, as h may have no slope there
    x = x + 0.1 * size_of(box) * (box.lower == box.upper) * torch.randn(x.shape, generator=draws, dtype=x.dtype)
    with torch.enable_grad():
        x.requires_grad_()
        slopes = jacobian(constraints(x), x)
    g = problem.system.g(x)
    moved, most = (slopes @ g).abs().amax(-1), (slopes.abs() @ g.abs()).amax(-1)
    at_once = (moved > ROUNDING * most).double().mean(0) > 0.5
    return [NEAR if each else FAR for each in at_once.tolist()]


def _limits(config: ConstraintsConfig, problem: Problem) -> list[StateLimits]:
    """The limits of states as one part, if there are some; what counts as 1 is how far they are from the goal.

    For a limit that the goal is at, and in a task without a goal, it is how far X₀ reaches from the limit.
    """
    system, goal, box, columns = problem.system, problem.goal, problem.initial_states, []
    for key, side, given in (("lower", -1.0, config.lower), ("upper", 1.0, config.upper)):
        for name, limit in given.items():
            i = index_of(name, f"constraints.{key}", system)
            reach = float(box.reach_from(torch.full_like(goal, limit))[i])
            far = (problem.has_goal and abs(limit - float(goal[i]))) or reach or 1.0
            sign, unit = "≤" if side > 0 else "≥", system.state_units[i]
            columns.append((i, limit, side, far, f"{name} {sign} {limit:g} {unit}".strip()))
    return [StateLimits(*zip(*columns, strict=True))] if columns else []


def _balls(config: ConstraintsConfig, system: ControlAffineSystem) -> list[Constraints]:
    balls: list[Constraints] = []
    for key in ("outside", "inside"):
        for k, given in enumerate(getattr(config, key)):
            center, radius = ball_of(given, f"constraints.{key}", {"center", "radius"}, system)
            states = [index_of(name, f"constraints.{key}[{k}].center", system) for name in center]
            where = ", ".join(f"{name} = {value:g}" for name, value in center.items())
            balls.append(Ball(states, [*center.values()], radius, key == "inside", f"{key} {radius:g} around {where}"))
    return balls


def ball_of(
    given: Mapping[str, Any], key: str, keys: set[str], system: ControlAffineSystem
) -> tuple[dict[str, float], float]:
    """The centre, by names of states, and the radius of an entry that has these keys, all of whose others are numbers.

    Raises:
        UsageError: it is another one; says how it should be.
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

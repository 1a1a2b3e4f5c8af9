"""The four reference tasks of conf/ as data, so that environments can be made by name in an installed lyapnet."""

from collections.abc import Sequence
from math import pi
from pathlib import Path
from typing import Any, NamedTuple

from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import config_from_plain, load_config
from lyapnet.task.mapped_controls import MappedControls
from lyapnet.task.problem import Problem

# Sections of a config, and the physical control at the end of the normalised action box: the next round number above
# the largest |u*| from 1000 states of X₀ (4.9 N, 16.0 N, 23.6 N, 2.0 N·m and 0.9 N·m), so that no optimum is cut.
TASKS: dict[str, dict[str, Any]] = {
    "double_integrator": {
        "system": {"name": "double_integrator"},
        "cost": {"Q": [10, 0.1], "R": "inverse_mass", "Q_T": [10, 0.1]},
        "initial_states": {"lower": [-1, -0.7], "upper": [1, 0.7]},
        "horizon": {"steps": 400, "dt": 0.01},
    },
    "cartpole_balancing": {
        "system": {
            "name": "cartpole",
            "parameters": {"cart_mass": 1, "pole_mass": 0.1, "length": 0.3, "cart_damping": 0.1, "pole_damping": 0.1},
        },
        "cost": {"Q": [0, 25, 0.5, 0.1], "R": "inverse_mass", "Q_T": [0, 25, 0.5, 0.1]},
        "initial_states": {"lower": [-0.6, -0.6, -0.2, -0.2], "upper": [0.6, 0.6, 0.2, 0.2]},
        "horizon": {"steps": 79, "dt": 0.01},
    },
    "cartpole_swingup": {
        "system": {
            "name": "cartpole",
            "parameters": {"cart_mass": 1, "pole_mass": 1, "length": 1, "cart_damping": 0, "pole_damping": 0.1},
        },
        "cost": {"Q": [0, 0, 0, 0], "R": "inverse_mass", "Q_T": [80, 600, 0.8, 4.5]},
        "initial_states": {"lower": [0, pi - 0.3, 0, 0], "upper": [0, pi + 0.3, 0, 0]},
        "horizon": {"steps": 171, "dt": 0.01},
    },
    "reacher": {
        "system": {"name": "reacher"},
        "cost": {"Q": [1, 1, 0, 0], "R": "inverse_mass", "Q_T": [100, 100, 1, 1]},
        "initial_states": {"lower": [-3, -3, 0, 0], "upper": [3, 3, 0, 0]},
        "horizon": {"steps": 170, "dt": 0.01},
    },
}
CONTROL_SCALES: dict[str, Sequence[float]] = {
    "double_integrator": (6.0,),  # N
    "cartpole_balancing": (20.0,),  # N
    "cartpole_swingup": (30.0,),  # N
    "reacher": (3.0, 1.5),  # N·m, shoulder and elbow
}


class BoundedProblem(NamedTuple):
    """A task, and the physical control at the end of the action box of its environment."""

    problem: Problem
    control_scale: Sequence[float]


def bounded_problem(
    task: str | Path | Problem | None = None, control_scale: float | Sequence[float] | None = None
) -> BoundedProblem:
    """A reference task by name, the task of a config file, or a task.

    Args:
        control_scale: max |u_i| in the units of the control, one for each; known for the reference tasks.

    Raises:
        UsageError: no such task or file, none, or one with state constraints, or with noise and a risk; or no scale,
            one of another length, or one that is not positive.
    """
    given = [control_scale] if isinstance(control_scale, int | float) else control_scale
    scale = CONTROL_SCALES.get(str(task)) if given is None else given
    built = task if isinstance(task, Problem) else _build(task)
    if built.constraints is not None:
        raise UsageError(
            "Expected a task without state constraints for an environment, got some; its reward does not know of them: "
            "leave constraints out."
        )
    if built.noise is not None and built.risk:
        raise UsageError(
            f"Expected a task without risk for an environment, got {built.risk:g}; its rewards add up to a cost, of "
            "which learners take the mean: leave risk out."
        )
    m, names = built.system.m, ", ".join(built.system.control_labels)
    if isinstance(built.controls, MappedControls):
        if scale is not None and any(bound != 1 for bound in scale):
            raise UsageError(
                f"Expected no control_scale with {built.controls.words}, got {list(scale)}; an action is the share of "
                "their range: leave it out."
            )
        scale = [1.0] * m
    if scale is None:
        raise UsageError(
            f"Expected control_scale, the largest |u| of {names}, got none; choose it above what the task needs."
        )
    if len(scale) != m or not all(0 < bound < float("inf") for bound in scale):
        raise UsageError(f"Expected control_scale > 0 for each of {names}, got {list(scale)}; give as many.")
    return BoundedProblem(built, tuple(float(bound) for bound in scale))


def _build(task: str | Path | None) -> Problem:
    if task is None:
        raise UsageError(
            "Expected task=…, a name, a config file or a Problem, got none; say which environment to make."
        )
    if str(task) not in TASKS:
        if not str(task).endswith((".yaml", ".yml")):
            raise UsageError(f"Expected a task as one of {', '.join(TASKS)}, or a config file, got {str(task)!r}.")
        return build_problem(load_config(task))
    # environments do not use the other required keys of a config
    trained = {"experiment": str(task), "program": {"name": "value"}, "network": {"name": "fcn"}}
    return build_problem(config_from_plain({**TASKS[str(task)], **trained}))

"""Lines that describe an export in its files: names, units, X₀, limits, target, Δt and the law after T."""

from collections.abc import Iterable, Sequence
from pathlib import Path

from torch import Tensor

from lyapnet import __version__
from lyapnet.base.files import digest_of_file
from lyapnet.controller.controller import Controller
from lyapnet.experiment.checkpoint import ZOO
from lyapnet.task.sets import ControlBox
from lyapnet.value.law_after_horizon import BEYOND


def facts_of(controller: Controller, checkpoint: Path | None) -> dict[str, str]:
    """Key ↦ line; absolute paths of checkpoints are left out."""
    system, problem, T = controller.system, controller.problem, controller.horizon.duration
    constants = sorted(system.constants)
    states = [i for i in range(system.n) if i not in constants]
    beyond, box = controller.law.beyond, controller.initial_states
    facts = {
        "lyapnet": __version__,
        "checkpoint": "none" if checkpoint is None else f"{_title(checkpoint)}, SHA-256 {digest_of_file(checkpoint)}",
        "t": f"s, from 0 to {T:g}; after that {beyond}: {BEYOND[beyond]}",
        "x": _named(system.state_names, system.state_units, states),
        "u": _named(system.control_names, system.control_units, range(system.m)),
    }
    if constants:
        facts["p"] = _named(system.state_names, system.state_units, constants)
    names, units = system.state_names, system.state_units
    facts["X₀"] = _ranges(names, units, box.lower, box.upper, states)
    if constants:
        facts["P"] = _ranges(names, units, box.lower, box.upper, constants)
    facts["limits"] = "none" if not problem.controls.limited else str(problem.controls)
    limits = problem.controls.fixed_limits
    if isinstance(problem.controls, ControlBox) and limits is not None:
        low, high = (side.expand(system.m) for side in limits)
        facts["limits"] = _ranges(system.control_names, system.control_units, low, high, range(system.m))
    if problem.follows_reference:
        facts["target"] = "a reference"
    elif problem.has_goal:
        goal, rest = problem.goal.tolist(), problem.controls.moved(problem.goal, problem.rest).tolist()
        held = _values(system.control_names, system.control_units, rest, range(system.m))
        facts["target"] = f"{_values(names, units, goal, states)}; held by {held}"
    held = "; u is made to be held for it" if controller.law.held else ""
    facts["Δt"] = f"{controller.horizon.dt:g} s{held}"
    return facts


def _title(checkpoint: Path) -> str:
    if checkpoint.parent == ZOO:
        return f"zoo:{checkpoint.stem}"
    return checkpoint.name if checkpoint.is_absolute() else str(checkpoint)


def _named(names: Sequence[str], units: Sequence[str], which: Iterable[int]) -> str:
    return ", ".join(f"{names[i]} ({units[i]})" if units[i] else names[i] for i in which)


def _values(names: Sequence[str], units: Sequence[str], values: Sequence[float], which: Iterable[int]) -> str:
    return ", ".join(f"{names[i]} {values[i]:g} {units[i]}".rstrip() for i in which)


def _ranges(names: Sequence[str], units: Sequence[str], low: Tensor, high: Tensor, which: Iterable[int]) -> str:
    return ", ".join(f"{names[i]} {float(low[i]):g} to {float(high[i]):g} {units[i]}".rstrip() for i in which)

"""Loads a controller from a checkpoint file, without executing code of the file."""

import json
import logging
from pathlib import Path
from typing import Any

import torch
from torch import nn

from lyapnet.base.devices import require_device
from lyapnet.base.errors import CheckpointError, UsageError
from lyapnet.controller.controller import Controller
from lyapnet.controller.origin import Origin
from lyapnet.experiment.assembly import (
    REGISTRIES,
    Parts,
    build_problem,
    build_program,
    build_rollout,
    build_value_function,
    default_of,
    without_unread_settings,
)
from lyapnet.experiment.checkpoint import AFTER_HORIZON, KEY, read_checkpoint
from lyapnet.experiment.config import Config, config_from_plain
from lyapnet.loop.programs import Program
from lyapnet.task.constraints import Constraints
from lyapnet.task.cost import Cost
from lyapnet.task.sets import ControlSet
from lyapnet.task.systems import ControlSystem
from lyapnet.value.after_horizon import REMEDY, from_plain
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.linearisation import smooth_kinks


def load(
    path: str | Path,
    *,
    system: ControlSystem | None = None,
    network: type[ValueFunction] | None = None,
    cost: Cost | None = None,
    controls: ControlSet | None = None,
    constraints: Constraints | None = None,
    program: Program | None = None,
    device: str | torch.device = "cpu",
    beyond: str | None = None,
) -> Controller:
    """Load the controller of a checkpoint. Nothing that the file names is imported or run.

    A note is logged if f, g, the cost, U or the names of the states differ from those of the training.

    Args:
        path: a .ckpt file of a run.
        system, cost, controls, constraints, program: the user's objects, if the run used unregistered ones; or
            replacements.
        network: the class of the network, if it is not one of NETWORKS.
        device: device of the tensors.
        beyond: the law after T: hold, the law at t = T; receding, the law at t = 0; riccati, the linear-quadratic
            regulator at the goal; or error. None: the law that training chose, with a note if none keeps the goal.

    Raises:
        UsageError: no such file or device, or an object of the user that was not passed.
        CheckpointError: the file is truncated, foreign, or does not fit its own config.
    """
    require_device(device, torch.float32)
    content = read_checkpoint(path, device)
    config = config_of(content, path)
    parts = Parts(system, cost, controls, constraints, network, program)
    require_parts(config, parts, path)
    _require_dimension(config, system, path)
    with default_of(config):
        return _controller_of(content, config, parts, path, device, beyond)


def _controller_of(
    content: dict[str, Any], config: Config, parts: Parts, path: str | Path, device: Any, beyond: str | None
) -> Controller:
    """The controller from the content of a checkpoint."""
    problem = build_problem(config, parts)
    V = build_value_function(config, smooth_kinks(problem), parts.network)
    load_value_function(V, content, path)
    problem.check_value_function(V)
    after_horizon = from_plain(content[KEY].get(AFTER_HORIZON))
    if others := problem.differences(content[KEY].get("problem")):
        after_horizon = None  # it was chosen for another problem
        logging.getLogger(__name__).warning(
            "note: %s was trained for a problem with other %s; results are about the problem that is given now.",
            path, ", ".join(others),
        )  # fmt: skip
    problem, V = problem.to(device), V.to(device)
    own = build_program(config) if parts.program is None else parts.program
    if beyond is None and after_horizon is not None and not after_horizon.holds:
        logging.getLogger(__name__).warning("note: %s; %s.", after_horizon, REMEDY)
    rollout = build_rollout(config, problem, V)
    origin = Origin.of(path, content)
    return Controller(problem, V, rollout, own, config, beyond, parts, after_horizon=after_horizon, origin=origin)


def _require_dimension(config: Config, system: ControlSystem | None, path: str | Path) -> None:
    """Raise UsageError if a replaced system has another number of states than the checkpoint's X₀."""
    if system is None or len(lower := config.initial_states.lower) == 1:  # a single bound may hold for every state
        return
    system.check_coordinates()
    if system.n != len(lower):
        raise UsageError(
            f"Expected a system of {len(lower)} states, as {str(path)!r} was trained with, got "
            f"{type(system).__name__} of {system.n} ({', '.join(system.state_names)}); pass the class of its training."
        )


def require_parts(config: Config, parts: Parts, origin: str | Path) -> None:
    """Check that all unregistered parts of a config are passed, because loading never imports them.

    Args:
        origin: the file of the config, for messages.

    Raises:
        UsageError: a part is missing; names it.
    """
    for part, (registry, _) in REGISTRIES.items():
        name = getattr(config, part).name
        if getattr(parts, part) is None and name not in registry:
            raise UsageError(
                f"Expected {part}=… for {str(origin)!r}, got none; it was trained with {name}, and loading a file "
                f"never imports what the file names: pass {part}=… to load, or --{part} to the command."
            )


def config_of(content: dict[str, Any], path: str | Path) -> Config:
    """The config in the content of a checkpoint file.

    Raises:
        CheckpointError: there is no config, or this version cannot read it.
    """
    plain = content[KEY].get("config")
    if plain is None:
        raise CheckpointError(
            f"Expected a checkpoint with a config, got {str(path)!r}, which was trained from Python; read it with "
            "ValueModule.load_from_checkpoint(path, problem=…, V=…, program=…)."
        )
    try:
        if not isinstance(plain, dict):
            raise UsageError(f"Expected a config, got {type(plain).__name__}; use another checkpoint.")
        if "${" in json.dumps(plain, ensure_ascii=False):  # resolving it may read the environment, or call a function
            raise UsageError("Expected plain values, got an interpolation ${…}; use another checkpoint.")
        return without_unread_settings(config_from_plain(plain))
    except UsageError as error:
        raise CheckpointError(
            f"Expected a checkpoint of this version of lyapnet, got {str(path)!r}: {error}"
        ) from error


def load_value_function(V: nn.Module, content: dict, path: str | Path) -> None:
    """Load a checkpoint's weights into V.

    Raises:
        CheckpointError: tensors differ, or the checkpoint has the weights of several seeds.
    """
    if content[KEY].get("config", {}).get("seeds", 1) > 1:
        raise CheckpointError(
            f"Expected the checkpoint of one seed, got {str(path)!r}, which holds several; use "
            "checkpoints/best.ckpt in a seed's folder beside it."
        )
    prefix = "V."
    weights = {key.removeprefix(prefix): w for key, w in content["state_dict"].items() if key.startswith(prefix)}
    own = V.state_dict()
    where = {True: "checkpoint", False: "config"}
    differing = [f"{key} is only in the {where[key in weights]}" for key in own.keys() ^ weights.keys()]
    differing += [
        f"{key} has shape {tuple(weights[key].shape)} in the checkpoint and {tuple(own[key].shape)} in the config"
        for key in own.keys() & weights.keys()
        if own[key].shape != weights[key].shape
    ]
    if differing:
        shown = "; ".join(sorted(differing)[:6]) + (f"; and {len(differing) - 6} more" if len(differing) > 6 else "")
        raise CheckpointError(
            f"Expected the network of {str(path)!r}, got another one: {shown}. Use the checkpoint's network section."
        )
    V.load_state_dict(weights)

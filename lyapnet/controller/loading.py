"""The controller of a checkpoint file, which is read and never run."""

import json
import logging
from pathlib import Path
from typing import Any

import torch
from torch import nn

from lyapnet.base.devices import require_device
from lyapnet.base.errors import CheckpointError, UsageError
from lyapnet.controller.controller import Controller
from lyapnet.experiment.assembly import (
    REGISTRIES,
    Parts,
    build_problem,
    build_program,
    build_rollout,
    build_value_function,
    default_of,
)
from lyapnet.experiment.checkpoint import AFTER_HORIZON, KEY, read_checkpoint
from lyapnet.experiment.config import Config, config_from_plain
from lyapnet.loop.programs import Program
from lyapnet.task.constraints import Constraints
from lyapnet.task.cost import Cost
from lyapnet.task.sets import ControlSet
from lyapnet.task.systems import ControlAffineSystem
from lyapnet.value.after_horizon import REMEDY, from_plain
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.linearisation import rounded


def load(
    path: str | Path,
    *,
    system: ControlAffineSystem | None = None,
    network: type[ValueFunction] | None = None,
    cost: Cost | None = None,
    controls: ControlSet | None = None,
    constraints: Constraints | None = None,
    program: Program | None = None,
    device: str | torch.device = "cpu",
    beyond: str | None = None,
) -> Controller:
    """The controller of a checkpoint. Nothing that the file names is imported or run.

    A note is logged where f, g, the cost, U or the names of the states are others than those that it was trained with.

    Args:
        path: a .ckpt file of a run.
        system, cost, controls, constraints, program: each where the run's own is not a registered one, or replaced.
        network: likewise, the class of a network that is not one of NETWORKS.
        device: where the tensors go.
        beyond: the law after T: hold, that of t = T; receding, that of t = 0; riccati, the linear-quadratic regulator
            of the goal; or error. None: that which training found to hold the goal; where it found none, with a note.

    Raises:
        UsageError: no such file or device; or a part of the user's own that was not passed.
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
    """The controller of what a checkpoint holds."""
    problem = build_problem(config, parts)
    V = build_value_function(config, rounded(problem), parts.network)
    load_value_function(V, content, path)
    problem.check_value_function(V)
    after_horizon = from_plain(content[KEY].get(AFTER_HORIZON))
    if others := problem.differences(content[KEY].get("problem")):
        after_horizon = None  # it was found for another problem
        logging.getLogger(__name__).warning(
            "note: %s was trained for a problem with other %s; what follows is about the one that is given here.",
            path, ", ".join(others),
        )  # fmt: skip
    problem, V = problem.to(device), V.to(device)
    own = build_program(config) if parts.program is None else parts.program
    if beyond is None and after_horizon is not None and not after_horizon.holds:
        logging.getLogger(__name__).warning("note: %s; %s.", after_horizon, REMEDY)
    rollout = build_rollout(config, problem, V)
    return Controller(problem, V, rollout, own, config, beyond, parts, after_horizon=after_horizon)


def _require_dimension(config: Config, system: ControlAffineSystem | None, path: str | Path) -> None:
    """Refuse a system in the place of a checkpoint's that has another number of states than its X₀."""
    if system is None or len(lower := config.initial_states.lower) == 1:  # one bound may be that of every state
        return
    system.check_coordinates()
    if system.n != len(lower):
        raise UsageError(
            f"Expected a system of {len(lower)} states, as {str(path)!r} was trained with, got "
            f"{type(system).__name__} of {system.n} ({', '.join(system.state_names)}); pass the class of its training."
        )


def require_parts(config: Config, parts: Parts, origin: str | Path) -> None:
    """Refuse a config, of a file `origin`, that names a part which is neither registered nor passed: to be imported.

    Raises:
        UsageError: naming the part.
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
        CheckpointError: there is none that this version understands.
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
        if "${" in json.dumps(plain, ensure_ascii=False):  # resolving one may read the environment, or call a function
            raise UsageError("Expected plain values, got an interpolation ${…}; use another checkpoint.")
        return config_from_plain(plain)
    except UsageError as error:
        raise CheckpointError(
            f"Expected a checkpoint of this version of lyapnet, got {str(path)!r}: {error}"
        ) from error


def load_value_function(V: nn.Module, content: dict, path: str | Path) -> None:
    """Put a checkpoint's weights into V.

    Raises:
        CheckpointError: naming the tensors that differ; or it holds the weights of several seeds.
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

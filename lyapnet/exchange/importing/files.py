"""A controller of V(x) and u(x) in ONNX files, and of a config that says what they are about."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import nn

from lyapnet.base.types import State
from lyapnet.controller.controller import Controller
from lyapnet.exchange.importing.law import controller_of, require_one_system, states_around
from lyapnet.exchange.importing.onnx_file import read_onnx, require_same
from lyapnet.exchange.importing.onnx_function import OnnxFunction
from lyapnet.experiment.assembly import build_problem, own_parts, parts_named
from lyapnet.experiment.config import Config, config_from_plain
from lyapnet.experiment.schema import read_yaml
from lyapnet.task.problem import Problem

COUNTS_NOT = {"cost": {"Q": 0, "R": 1, "Q_T": 0}, "horizon": {"steps": 1000, "dt": 0.01}}  # in a config for this
CORNERS = 6  # axes at whose ends corners are tried
SCALES = 10.0 ** -torch.arange(46, dtype=torch.float64)  # down to 1e-45, the smallest number of float32


def imported_controller(
    config: str | Path,
    value: str | Path | nn.Module,
    law: str | Path | nn.Module,
    own: Mapping[str, str] | None = None,
) -> Controller:
    """The controller of V(x) and u(x) that were made elsewhere, on the task of a config.

    Nothing in a file is run; each is held against onnxruntime.

    Args:
        config: a YAML file with `system`, `initial_states` and, where there are limits, `controls`; the cost counts
            only with the goal that it is about, and the horizon only as the unit of the default λ.
        value, law: ONNX files of one input x and one output, V or u; or functions, as of controller_of.
        own: the user's own parts as module:Class, in the place of those of the config.

    Raises:
        UsageError: a file is missing or holds something else.
    """
    resolved = _config_of(Path(config))
    problem = build_problem(resolved, parts_named(resolved, {**own_parts(resolved), **(own or {})}))
    require_one_system(problem)
    (v, told_v, name_v), (k, told_k, name_k) = _function(value, problem, rounds=False), _function(law, problem)
    precision = k.precision if isinstance(k, OnnxFunction) else None
    computed = "real numbers too" if precision is None else f"{precision}, which rounds each operation and x itself"
    origin = (
        f"those of {told_v}, and of {told_k}, read as functions of one state; V is read in real numbers, and u in "
        f"{computed}"
    )
    about = replace(
        resolved,
        network=replace(resolved.network, name=name_v),
        rollout=replace(resolved.rollout, policy=name_k),
    )
    return controller_of(problem, v, k, origin, about, precision)


def _function(given: str | Path | nn.Module, problem: Problem, rounds: bool = True) -> tuple[nn.Module, str, str]:
    """The function of a file, held against onnxruntime, or one from Python; what there is to say of it; its name.

    Args:
        rounds: whether it is run, and so rounds; V is a function of real numbers, which nothing runs.
    """
    if isinstance(given, nn.Module):
        name = type(given).__name__
        return given, f"{name} from Python", name
    path = Path(given)
    model = read_onnx(path)
    function = OnnxFunction(model.proto, problem.system.n, path.name, rounds=True)
    states = torch.cat([states_around(problem), _extreme_states(problem)])
    apart = require_same(function, model.written, states)
    function.rounds = rounds
    files = " with ".join(f"{name} (SHA-256 {digest})" for name, digest in model.digests.items())
    return function, f"{files}, which onnxruntime evaluates within {apart:.1e} of it on {len(states)} states", path.name


def _extreme_states(problem: Problem) -> State:
    """The goal, corners of X₀ and of the wide box, and states ever closer to the goal, down to nothing in float32."""
    goal, box = problem.goal.double(), problem.initial_states
    corners = torch.cat([goal + scale * (box.corners(CORNERS).double() - goal) for scale in (1, 3)])
    x = states_around(problem)[: len(SCALES)]
    return torch.cat([goal[None], corners, goal + SCALES[:, None] * (x - goal)])


def _config_of(path: Path) -> Config:
    """The config of a file that need not say what only training needs."""
    content: dict[str, Any] = read_yaml(path, Config)
    for name, section in COUNTS_NOT.items():
        given = content.get(name)
        if given is None or (isinstance(given, Mapping) and "name" not in given):
            content[name] = {**section, **(given or {})}
    return config_from_plain({"experiment": path.stem, **content})

"""A controller of V(x) and u(x) in ONNX files, on the task of a config."""

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

DEFAULT_SECTIONS = {"cost": {"Q": 0, "R": 1, "Q_T": 0}, "horizon": {"steps": 1000, "dt": 0.01}}
"""Values of sections that a config for imported functions may leave out, since only training needs them."""
CORNERS = 6  # largest number of axes at whose corners functions are tested
SCALES = 10.0 ** -torch.arange(46, dtype=torch.float64)  # down to 1e-45, the smallest number of float32


def imported_controller(
    config: str | Path,
    value: str | Path | nn.Module,
    law: str | Path | nn.Module,
    own: Mapping[str, str] | None = None,
) -> Controller:
    """The controller of V(x) and u(x) of other tools, on the task of a config.

    No code of a file is run; each file is compared with onnxruntime.

    Args:
        config: a YAML file with `system`, `initial_states` and, for limits, `controls`. Of the cost, only the goal is
            used, and of the horizon, only T in the default of λ.
        value, law: ONNX files with one input x and one output, V or u; or functions, as in controller_of.
        own: the user's own parts as module:Class, which replace those of the config.

    Raises:
        UsageError: a file is missing or has another content.
    """
    resolved = _config_of(Path(config))
    problem = build_problem(resolved, parts_named(resolved, {**own_parts(resolved), **(own or {})}))
    require_one_system(problem)
    (v, origin_v, name_v), (k, origin_k, name_k) = _function(value, problem, rounds=False), _function(law, problem)
    precision = k.precision if isinstance(k, OnnxFunction) else None
    computed = "real numbers too" if precision is None else f"{precision}, which rounds each operation and x itself"
    origin = (
        f"those of {origin_v}, and of {origin_k}, read as functions of one state; V is read in real numbers, and u in "
        f"{computed}"
    )
    about = replace(
        resolved,
        network=replace(resolved.network, name=name_v),
        rollout=replace(resolved.rollout, policy=name_k),
    )
    return controller_of(problem, v, k, origin, about, precision)


def _function(given: str | Path | nn.Module, problem: Problem, rounds: bool = True) -> tuple[nn.Module, str, str]:
    """(the function of a file or from Python, its origin in words, its name); a file is compared with onnxruntime.

    Args:
        rounds: whether bounds include rounding, as for u, which runs; V is a function of real numbers.
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
    """The goal, corners of X₀ and of the wide box, and states closer and closer to the goal, down to 0 in float32."""
    goal, box = problem.goal.double(), problem.initial_states
    corners = torch.cat([goal + scale * (box.corners(CORNERS).double() - goal) for scale in (1, 3)])
    x = states_around(problem)[: len(SCALES)]
    return torch.cat([goal[None], corners, goal + SCALES[:, None] * (x - goal)])


def _config_of(path: Path) -> Config:
    """The config of a file, which may leave out the sections in DEFAULT_SECTIONS."""
    content: dict[str, Any] = read_yaml(path, Config)
    for name, section in DEFAULT_SECTIONS.items():
        given = content.get(name)
        if given is None or (isinstance(given, Mapping) and "name" not in given):
            content[name] = {**section, **(given or {})}
    return config_from_plain({"experiment": path.stem, **content})

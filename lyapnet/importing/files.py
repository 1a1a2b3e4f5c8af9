"""A controller of V(x) and u(x) in ONNX files, and of a config that says what they are about."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from torch import nn

from lyapnet.build import build_problem, own_parts, parts_named
from lyapnet.config import Config, config_from_plain
from lyapnet.controller import Controller
from lyapnet.importing.law import STATES, controller_of, require_one_system, states_around
from lyapnet.importing.onnx_function import OnnxFunction, read_onnx, require_same
from lyapnet.problem import Problem
from lyapnet.schema import read_yaml

COUNTS_NOT = {"cost": {"Q": 0, "R": 1, "Q_T": 0}, "horizon": {"steps": 1000, "dt": 0.01}}  # in a config for this


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
    (v, told_v, name_v), (k, told_k, name_k) = (_function(given, problem) for given in (value, law))
    origin = f"those of {told_v}, and of {told_k}, read as functions of one state in real numbers"
    about = replace(
        resolved,
        network=replace(resolved.network, name=name_v),
        rollout=replace(resolved.rollout, policy=name_k),
    )
    return controller_of(problem, v, k, origin, about)


def _function(given: str | Path | nn.Module, problem: Problem) -> tuple[nn.Module, str, str]:
    """The function of a file, held against onnxruntime, or one from Python; what there is to say of it; its name."""
    if isinstance(given, nn.Module):
        name = type(given).__name__
        return given, f"{name} from Python", name
    path = Path(given)
    model = read_onnx(path)
    function = OnnxFunction(model.proto, problem.system.n, path.name)
    apart = require_same(function, model.proto, states_around(problem))
    files = " with ".join(f"{name} (SHA-256 {digest})" for name, digest in model.digests.items())
    return function, f"{files}, which onnxruntime evaluates within {apart:.1e} of it on {STATES} states", path.name


def _config_of(path: Path) -> Config:
    """The config of a file that need not say what only training needs."""
    content: dict[str, Any] = read_yaml(path, Config)
    for name, section in COUNTS_NOT.items():
        given = content.get(name)
        if given is None or (isinstance(given, Mapping) and "name" not in given):
            content[name] = {**section, **(given or {})}
    return config_from_plain({"experiment": path.stem, **content})

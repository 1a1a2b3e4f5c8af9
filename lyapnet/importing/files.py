"""A controller of two ONNX files and a config that says what they are about."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from lyapnet.build import build_problem, own_parts, parts_named
from lyapnet.config import Config, config_from_plain
from lyapnet.controller import Controller
from lyapnet.errors import UsageError
from lyapnet.importing.law import STATES, controller_of, states_around
from lyapnet.importing.onnx_function import OnnxFunction, read_onnx, require_same
from lyapnet.problem import Problem
from lyapnet.schema import read_yaml

COUNTS_NOT = {"cost": {"Q": 1, "R": 1, "Q_T": 1}, "horizon": {"steps": 1000, "dt": 0.01}}  # in a config for this


def controller_of_files(
    config: str | Path, value: str | Path, law: str | Path, own: Mapping[str, str] | None = None
) -> Controller:
    """The controller of V(x) and u(x) in ONNX files. Nothing in these is run; each is held against onnxruntime.

    Args:
        config: a YAML file with `system`, `initial_states` and, where there are limits, `controls`; the cost counts
            only with the goal that it is about, and the horizon only as the unit of the default λ.
        value, law: ONNX files of one input x and one output, V or u.
        own: the user's own parts as module:Class, in the place of those of the config.

    Raises:
        UsageError: a file is missing or holds something else.
    """
    resolved = _config_of(Path(config))
    problem = build_problem(resolved, parts_named(resolved, {**own_parts(resolved), **(own or {})}))
    if problem.system.constants:
        raise UsageError("Expected a config of one system, got a family; V(x) and u(x) are of a single one.")
    (v, told_v), (k, told_k) = (_function(Path(path), problem) for path in (value, law))
    origin = f"those of {told_v}, and of {told_k}, read as functions of one state in real numbers"
    about = replace(
        resolved,
        network=replace(resolved.network, name=Path(value).name),
        rollout=replace(resolved.rollout, policy=Path(law).name),
    )
    return controller_of(problem, v, k, origin, about)


def _function(path: Path, problem: Problem) -> tuple[OnnxFunction, str]:
    """The function of a file, held against onnxruntime, and what there is to say of it."""
    model = read_onnx(path)
    function = OnnxFunction(model.proto, problem.system.n, path.name)
    apart = require_same(function, model.proto, states_around(problem))
    files = " with ".join(f"{name} (SHA-256 {digest})" for name, digest in model.digests.items())
    return function, f"{files}, which onnxruntime evaluates within {apart:.1e} of it on {STATES} states"


def _config_of(path: Path) -> Config:
    """The config of a file that need not say what only training needs."""
    content: dict[str, Any] = read_yaml(path, Config)
    for name, section in COUNTS_NOT.items():
        given = content.get(name)
        if given is None or (isinstance(given, Mapping) and "name" not in given):
            content[name] = {**section, **(given or {})}
    return config_from_plain({"experiment": path.stem, **content})

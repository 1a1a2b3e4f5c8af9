"""The tasks without a goal: which there are, lyapnet's problem of each, and the optima that are kept of it."""

import contextlib
import json
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lyapnet.experiment.assembly import build_problem, parts_of
from lyapnet.experiment.config import load_config
from lyapnet.task.problem import Problem

HERE = Path(__file__).parent
WORKING = ("advertising", "chemotherapy", "battery", "rocket", "glider")
KEPT = ("growth", "pest", "heating", "secreted_protein", "orbit")  # not trained on before the end


@contextlib.contextmanager
def inside(folder: Path) -> Iterator[None]:
    """Work in a task's folder, whose module is called system as that of every other."""
    here, places = Path.cwd(), sys.path[:]
    os.chdir(folder)
    sys.modules.pop("system", None)
    sys.path.insert(0, str(folder.resolve()))
    try:
        yield
    finally:
        os.chdir(here)
        sys.path[:] = places
        sys.modules.pop("system", None)


def problem_in(folder: Path, *overrides: str) -> Problem:
    """The problem that task.yaml of a folder describes, in float64."""
    with inside(folder):
        config = load_config(Path("task.yaml"), list(overrides))
        return build_problem(config, parts_of(config)).double()


def problem_of(name: str) -> Problem:
    """The problem of a task without a goal."""
    return problem_in(HERE / name)


def optima_of(name: str) -> dict[str, Any]:
    """What optima.py found: `states`, `optima` (J*) and `controls` of the first states."""
    return json.loads((HERE / name / "optima.json").read_text(encoding="utf-8"))


class Closed(NamedTuple):
    """What a law does from some states (b, n)."""

    J: Tensor
    h: Tensor  # the greatest h on the way, (b,); −∞ without constraints
    u: Tensor  # (b, steps, m)


@torch.no_grad()
def simulate(problem: Problem, states: Any, law: Callable[[int, Tensor], Tensor]) -> Closed:
    """Follow a law (k, x) ↦ u by the steps of a problem, in its precision; costs are summed in float64."""
    x = torch.as_tensor(states).to(problem.initial_states.lower)
    J, h, controls = x.new_zeros(len(x), dtype=torch.float64), x.new_full((len(x),), -torch.inf), list[Tensor]()
    for k in range(problem.horizon.steps):
        controls.append(law(k, x))
        x, cost = problem.step(x, controls[-1])
        J = J + cost.double()
        if problem.constraints is not None:
            h = h.maximum(problem.constraints(x).amax(-1))
    return Closed(J + problem.cost.terminal(x).double(), h, torch.stack(controls, 1))


def replay(problem: Problem, states: Any, controls: Any) -> Closed:
    """What controls (b, steps, m) do."""
    u = torch.as_tensor(controls).to(problem.initial_states.lower)
    return simulate(problem, states, lambda k, x: u[:, k])

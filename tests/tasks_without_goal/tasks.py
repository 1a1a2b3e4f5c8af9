"""The tasks without a goal: which there are, lyapnet's problem of each, and the optima that are kept of it."""

import contextlib
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from lyapnet.build import build_problem, parts_of
from lyapnet.config import load_config
from lyapnet.problem import Problem

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


def problem_of(name: str) -> Problem:
    """The problem that a task's file describes, in float64."""
    with inside(HERE / name):
        config = load_config(Path("task.yaml"), [])
        return build_problem(config, parts_of(config)).double()


def optima_of(name: str) -> dict[str, Any]:
    """What optima.py found: `states`, `optima` (J*) and `controls` of the first states."""
    return json.loads((HERE / name / "optima.json").read_text(encoding="utf-8"))

"""Train on the CasADi models and robots, each once with seed 0, and print how near the controllers come to the optimum.

    python -m tests.task.models.train_casadi_models [NAME…] [--folder FOLDER]

Each name gets a YAML of four sections and a model's file in the folder, is looked at by `lyapnet check`, trained by
`lyapnet train`, with Runge-Kutta steps where the check advises them, and measured on 128 states of X₀ that the training
did not see, against the optimum of each. Seconds are those of CPU, for start, training and measuring. Names that have a
result are not trained again.
"""

import argparse
import json
import math
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

import yaml

from lyapnet.task.models.reading import read_model
from lyapnet.task.models.systems import casadi_system
from lyapnet.task.systems.equations import defined
from tests.task.models.casadi_models import MODELS
from tests.task.models.robot_files import ROBOTS

RK4 = "rk4"
HEADER = (
    f"{'name':18} {'n':>2} {'m':>2} {'affine':6} {'steps':5} {'mean':>8} {'worst':>8} {'LQR':>8} {'limits':>6} "
    f"{'V error':>8} {'seconds':>7}"
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"some of {', '.join([*MODELS, *ROBOTS])}; none: all")
    parser.add_argument("--folder", type=Path, default=Path("casadi_models"))
    given = parser.parse_args()
    if unknown := {*given.names} - {*MODELS, *ROBOTS}:
        parser.error(f"Expected names of {', '.join([*MODELS, *ROBOTS])}, got {', '.join(unknown)}; correct them.")
    given.folder.mkdir(parents=True, exist_ok=True)
    print(HEADER, flush=True)
    for name in given.names or [*MODELS, *ROBOTS]:
        print(_row(name, given.folder), flush=True)


def _row(name: str, folder: Path) -> str:
    found = folder / f"{name}.json"
    if not found.exists():
        write_task(name, folder)
        log = folder / f"{name}.log"
        log.unlink(missing_ok=True)
        done = _lyapnet(["check", f"{name}.yaml"], folder, log)
        advice = [f"rollout.method={RK4}"] if f"rollout.method={RK4}" in log.read_text(encoding="utf-8") else []
        arguments = ["train", "--config", f"{name}.yaml", "evaluation.test_states=128", *advice]
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        done = done or _lyapnet(arguments, folder, log)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        runs = sorted((folder / "logs" / name).glob("version_*/evaluation.json"))
        if done or not runs:
            return f"{name:18} failed: {log}"
        result = {**json.loads(runs[-1].read_text(encoding="utf-8")), "seconds": seconds, "rk4": bool(advice)}
        found.write_text(json.dumps(result), encoding="utf-8")
    result = json.loads(found.read_text(encoding="utf-8"))
    n, m, affine = _size(name, folder)
    met = max((each["states"] for each in result.get("at_limits", {}).values()), default=0)
    return (
        f"{name:18} {n:2} {m:2} {'yes' if affine else 'no':6} {RK4 if result['rk4'] else 'euler':5} "
        f"{result['cost_ratio']:8.4f} {result['worst_ratio']:8.4f} {result.get('lqr_cost_ratio', math.nan):8.3f} "
        f"{met:6.0%} {result['value_error']:8.2%} {result['seconds']:7.0f}"
    )


def _lyapnet(arguments: list[str], folder: Path, log: Path) -> int:
    """The exit status of a command, whose output is added to a file."""
    with log.open("a", encoding="utf-8") as file:
        command = [sys.executable, "-m", "lyapnet", *arguments]
        return subprocess.run(command, cwd=folder, stdout=file, stderr=subprocess.STDOUT, check=False).returncode


def write_task(name: str, folder: Path) -> Path:
    """The YAML of a task, with the model's file beside it."""
    if name in ROBOTS:
        kind, text, sections = ROBOTS[name]
        file = f"{name}.{'urdf' if kind == 'urdf' else 'xml'}"
        (folder / file).write_text(text, encoding="utf-8")
    else:
        kind, file = "casadi", f"{name}.casadi"
        function, _, sections = MODELS[name]()
        function.save(str(folder / file))
    task: dict[str, Any] = {**sections, "system": {"name": kind, "file": file, **sections.get("system", {})}}
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(task, sort_keys=False, allow_unicode=True, default_flow_style=None, width=118))
    return path


def _size(name: str, folder: Path) -> tuple[int, int, bool]:
    """n, m, and whether the system is affine."""
    if name in MODELS:
        function, _, sections = MODELS[name]()
        system = casadi_system(function, **sections.get("system", {}).get("parameters", {}))
        return system.n, system.m, system.affine
    kind, file = ROBOTS[name][0], f"{name}.{'urdf' if ROBOTS[name][0] == 'urdf' else 'xml'}"
    model = read_model(folder / file, kind, {"states": [], "controls": []})
    names = (dict.fromkeys(model["states"], ""), dict.fromkeys(model["controls"], ""))
    system = defined(model["equations"], *names)()
    return system.n, system.m, system.affine


if __name__ == "__main__":
    main()

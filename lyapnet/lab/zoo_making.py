"""Makes controllers of the zoo: python -m lyapnet.lab.zoo_making [NAME …], in the folder that holds conf/.

Each is one training with seed 0, then measured, certified and exported. `--from CKPT` takes a checkpoint that is
trained already, of the same command.
"""

import argparse
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from lyapnet.base.errors import UsageError
from lyapnet.base.files import read_json, write_json
from lyapnet.base.threads import use_threads
from lyapnet.claims.certify import certify
from lyapnet.claims.kinds import Statistical
from lyapnet.controller.controller import Controller
from lyapnet.controller.loading import load
from lyapnet.evaluation.measurement import evaluation
from lyapnet.exchange.export import export
from lyapnet.experiment.checkpoint import AFTER_HORIZON, KEY, ZOO, note_in_checkpoint, read_checkpoint, write_checkpoint
from lyapnet.value.after_horizon import LOOPS, MULTIPLE, distance_to_goal, is_held

ALONE = (
    "bryson_denham", "cartpole_balancing", "cartpole_family", "cartpole_swingup", "double_integrator",
    "landing", "pendulum_limited", "pendulum_periodic", "pendulum_swingup", "planar_quadrotor", "quadrotor", "reacher",
    "reacher_family", "satellite", "three_link_arm",
)  # fmt: skip
TASKS: dict[str, list[str]] = {  # name ↦ arguments of lyapnet train --config
    **{name: [f"conf/{name}.yaml"] for name in ALONE},
    "cartpole_limited": ["conf/cartpole_swingup.yaml", "controls={lower: -20, upper: 20}"],
    "reacher_limited": ["conf/reacher.yaml", "controls={lower: [-1.03, -0.37], upper: [1.03, 0.37]}"],
}
MULTIPLES = (1, 5, 20)  # multiples of T at which the distance to the goal is recorded
SAMPLES, KEPT = 256, 32  # numbers of states in the evaluation, and of those whose optima are recorded
PACKAGES = ("lyapnet", "torch", "lightning", "python")
PRECISIONS = ("float64", "float32")
EXPORTS = {"c": "law", "torch": "law.pt2", "onnx": "law.onnx"}
EVALUATED = ("cost_mean", "optimal_cost_mean", "cost_ratio", "value_error", "samples", "violated_fraction")


def make(name: str, trained: Path, folder: Path = ZOO) -> dict[str, Any]:
    """Put a trained checkpoint into the zoo: its weights and config as NAME.ckpt, what it reaches as NAME.json.

    Raises:
        UsageError: there are no optima to compare with.
    """
    began, content = time.monotonic(), read_checkpoint(trained)
    config = {**content[KEY]["config"], "experiment": name, "logs": "logs"}
    known = {key: content[KEY][key] for key in ("problem", "version", "penalty") if key in content[KEY]}
    kept, checkpoint = {**known, "config": config}, folder / f"{name}.ckpt"
    slim = {"state_dict": content["state_dict"], "global_step": content["global_step"], KEY: kept}
    write_checkpoint(slim, checkpoint)
    after_horizon = choose_law_after(checkpoint)
    record = {
        "command": shlex.join(["lyapnet", "train", "--config", *TASKS[name]]),
        "seed": config["seed"],
        **_origin(trained),
        **_measurements(load(checkpoint), checkpoint),
        "afterwards": after_horizon,
        "seconds": round(time.monotonic() - began),
    }
    write_json(folder / f"{name}.json", record)
    return record


def _origin(trained: Path) -> dict[str, Any]:
    """Versions and commit of a training, from its run.json."""
    run = read_json(trained.parents[1] / "run.json", "give a checkpoint in the folder of its run")
    return {"versions": {package: run[package] for package in PACKAGES}, "commit": run["commit"]}


def _measurements(controller: Controller, checkpoint: Path) -> dict[str, Any]:
    measured = evaluation(controller, SAMPLES)
    optima = measured.table.optimal_cost
    if optima is None or not (known := optima.isfinite()).any():
        raise UsageError(f"Expected optima to compare with, got none ({measured.notes[0]}); install lyapnet[oracle].")
    result = measured.result()
    certificate = certify(controller, Statistical()).result
    return {
        "evaluation": {key: result[key] for key in EVALUATED if key in result},
        "worst_ratio": float((measured.table.cost / optima)[known].max()),
        "certificate": certificate,
        "export": {precision: _agreements(checkpoint, precision) for precision in PRECISIONS},
        "states": measured.table.x0[known][:KEPT].tolist(),
        "optima": optima[known][:KEPT].tolist(),
    }


def choose_law_after(checkpoint: Path) -> dict[str, Any]:
    """Choose the law after T, and note it in the checkpoint.

    Returns the choice, the number of other closed loops that it holds at the goal, and their mean distance to the goal
    at MULTIPLES of T.
    """
    note_in_checkpoint(checkpoint, **{AFTER_HORIZON: None})  # removes an earlier result
    controller = load(checkpoint)
    found, problem = controller.after_horizon(), controller.problem
    note_in_checkpoint(checkpoint, **{AFTER_HORIZON: found._asdict()})
    x0 = problem.initial_states.sample(LOOPS, torch.Generator().manual_seed(1))
    N, other = problem.horizon.steps, controller.continued(found.beyond)
    x = other.rollout(x0, max(MULTIPLES) * N).x
    held, distance = int(is_held(problem, x[: MULTIPLE * N + 1]).sum()), distance_to_goal(problem, x).mean(1)
    return {**found._replace(held=held)._asdict(), "distance": {str(k): float(distance[k * N]) for k in MULTIPLES}}


def _agreements(checkpoint: Path, precision: str) -> dict[str, dict[str, float]]:
    """Export ↦ its differences from the controller with weights rounded to the given precision."""
    content, kind = read_checkpoint(checkpoint), getattr(torch, precision)
    content[KEY]["config"]["training"]["precision"] = precision
    weights = content["state_dict"].items()
    content["state_dict"] = {key: w.to(kind) if w.is_floating_point() else w for key, w in weights}
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        rounded = Path(folder, "rounded.ckpt")
        write_checkpoint(content, rounded)
        controller = load(rounded)
        for to, file in EXPORTS.items():
            _, agreement = export(controller, Path(folder, file), to, rounded)
            found[to] = {key: value for key, value in agreement._asdict().items() if key != "loop"}
    return found


def train(name: str, logs: Path) -> Path:
    """The best checkpoint of a new training."""
    command = [sys.executable, "-m", "lyapnet", "train", "--config", *TASKS[name]]
    subprocess.run([*command, f"experiment={name}", f"logs={logs}"], check=True)
    return logs / name / "version_0" / "checkpoints" / "best.ckpt"


def main(arguments: Sequence[str] | None = None) -> None:
    """Make the named controllers, or all."""
    parser = argparse.ArgumentParser(prog="python -m lyapnet.lab.zoo_making", description=__doc__)
    parser.add_argument("names", nargs="*", choices=[*TASKS, []], metavar="NAME", help=", ".join(TASKS))
    parser.add_argument("--from", dest="trained", type=Path, metavar="CKPT", help="a checkpoint; of one NAME")
    parser.add_argument("--out", type=Path, default=ZOO, help="the folder")
    parser.add_argument("--after", action="store_true", help="only find again what follows T, without training")
    given = parser.parse_args(arguments)
    use_threads(1)
    for name in given.names or TASKS:
        if given.after:
            path = given.out / f"{name}.json"
            after_horizon = choose_law_after(given.out / f"{name}.ckpt")
            write_json(path, {**read_json(path, "make it first"), "afterwards": after_horizon})
            continue
        with tempfile.TemporaryDirectory() as logs:
            record = make(name, given.trained or train(name, Path(logs)), given.out)
        found = record["evaluation"]
        print(f"{name}: cost / optimum {found['cost_ratio']:.4f}, value error {found['value_error']:.4f}")


if __name__ == "__main__":
    main()

"""One task without a goal, trained by the default recipe and measured: python -m THIS NAME [--seed S] [--limit SECONDS]

The folder is copied, `lyapnet train --config task.yaml` runs in the copy until it ends or has used its CPU seconds, and
the controller of best.ckpt is rolled out from the states of optima.json, which no training saw. Other folders of tasks
give their own states and optima.
"""

import argparse
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import psutil
import torch

import lyapnet
from lyapnet.controller import Controller
from lyapnet.experiment.assembly import parts_of
from lyapnet.experiment.config import load_config
from tests.tasks_without_goal.tasks import HERE, KEPT, WORKING, inside, optima_of, simulate

LIMIT = 300.0  # CPU seconds
GRACE_ITERATIONS = 60.0  # seconds, to keep what was found after the limit


def cpu_seconds(process: psutil.Process) -> float:
    """Of a process and those that it started, as long as they run."""
    total = 0.0
    for each in (process, *process.children(recursive=True)):
        try:
            times = each.cpu_times()
        except psutil.NoSuchProcess:
            continue
        total += times.user + times.system + times.children_user + times.children_system
    return total


def train(folder: Path, seed: int, limit: float, changes: Sequence[str] = ()) -> dict[str, Any]:
    """Train in a folder; the terminal goes to train.out there."""
    command = [sys.executable, "-m", "lyapnet", "train", "--config", "task.yaml", f"seed={seed}", *changes]
    used, started, stopped = 0.0, time.monotonic(), False
    with (folder / "train.out").open("w", encoding="utf-8") as out:
        process = psutil.Popen(command, cwd=folder, stdout=out, stderr=subprocess.STDOUT)
        while process.poll() is None:
            time.sleep(0.5)
            try:
                used = max(used, cpu_seconds(process))
            except psutil.NoSuchProcess:
                break
            if used > limit and not stopped:
                stopped = True
                process.send_signal(signal.SIGINT)
            if used > limit + GRACE_ITERATIONS:
                process.kill()
        status = process.wait()
    return {"status": status, "cpu": used, "wall": time.monotonic() - started, "stopped": stopped}


class Task(NamedTuple):
    """A folder with system.py and task.yaml, and what is known of its optima."""

    folder: Path
    states: Sequence[Sequence[float]]
    optima: Sequence[float]  # J*
    changes: Sequence[str] = ()  # to the file, as key=value


def task_of(name: str) -> Task:
    """A task without a goal."""
    kept = optima_of(name)
    return Task(HERE / name, kept["states"], kept["optima"])


def load(folder: Path, changes: Sequence[str]) -> Controller:
    """The controller of the newest best.ckpt in a folder.

    Raises:
        FileNotFoundError: there is none.
    """
    checkpoints = sorted(folder.glob("logs/**/best.ckpt"), key=lambda path: path.stat().st_mtime)
    if not checkpoints:
        raise FileNotFoundError(f"Expected best.ckpt under {folder / 'logs'}, got none; read train.out there.")
    with inside(folder):
        parts = parts_of(load_config(Path("task.yaml"), list(changes)))
        return lyapnet.load(checkpoints[-1], system=parts.system, cost=parts.cost)


def measure(folder: Path, task: Task) -> dict[str, float]:
    """Regret, ratio, violation and how far controls exceed their limits, of the newest best.ckpt in a folder.

    Raises:
        FileNotFoundError: there is none.
    """
    controller = load(folder, task.changes)
    problem, optima = controller.problem, torch.tensor(task.optima, dtype=torch.float64)
    J, h, u = simulate(problem, task.states, lambda k, x: controller.policy(k * problem.horizon.dt, x))
    low, high = problem.controls.limits
    return {
        "J": float(J.mean()),
        "regret": float((J - optima).mean() / optima.std(correction=0)),
        "largest": float((J - optima).max() / optima.std(correction=0)),
        "ratio": float(J.mean() / optima.mean()) if bool((optima > 0).all()) else torch.nan,
        "h": float(h.max()),
        "violated": float((h > 0).double().mean()),
        "beyond": float((low - u).maximum(u - high).max().clamp_min(0)),
    }


def train_and_measure(task: Task, seed: int, limit: float = LIMIT) -> tuple[dict[str, Any], dict[str, float]]:
    """Train a task in a copy of its folder, print what the terminal showed, and measure what came of it."""
    with tempfile.TemporaryDirectory(prefix=f"{task.folder.name}_") as place:
        folder = Path(place)
        for file in ("system.py", "task.yaml"):
            shutil.copy(task.folder / file, folder)
        run = train(folder, seed, limit, task.changes)
        print((folder / "train.out").read_text(encoding="utf-8"))
        return run, measure(folder, task)


def main(names: Sequence[str], task_of: Callable[[str], Task], description: str | None) -> None:
    """Train and measure the task that the command line names, and print what came of it."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("name", choices=names)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--limit", type=float, default=LIMIT, help="CPU seconds")
    given = parser.parse_args()
    run, found = train_and_measure(task_of(given.name), given.seed, given.limit)
    stopped = f", stopped at the limit of {given.limit:g}" if run["stopped"] else ""
    print(f"{given.name}, seed {given.seed}: status {run['status']}, {run['cpu']:.0f} CPU s{stopped}, "
          f"{run['wall']:.0f} s in all")  # fmt: skip
    ratio = f"cost / optimum {found['ratio']:.4f}, " if found["ratio"] == found["ratio"] else ""
    kept = f"largest h {found['h']:.2e}, violated from {found['violated']:.1%} of the states; "
    print(f"regret {found['regret']:.3%} of the spread of J*, {found['largest']:.2%} at most; {ratio}mean J "
          f"{found['J']:.6g}; {kept if found['h'] > -torch.inf else ''}"
          f"controls beyond their limits by {found['beyond']:.1e}")  # fmt: skip


if __name__ == "__main__":
    main((*WORKING, *KEPT), task_of, __doc__)

"""One task without a goal, trained by the default recipe and measured: python -m THIS NAME [--seed S] [--limit SECONDS]

The folder is copied, `lyapnet train --config task.yaml` runs in the copy until it ends or has used its CPU seconds, and
the controller of best.ckpt is rolled out from the states of optima.json, which no training saw.
"""

import argparse
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import psutil
import torch

import lyapnet
from lyapnet.build import parts_of
from lyapnet.config import load_config
from tests.tasks_without_goal.tasks import HERE, KEPT, WORKING, inside, optima_of

LIMIT = 300.0  # CPU seconds
GRACE = 60.0  # seconds, to keep what was found after the limit


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


def train(folder: Path, seed: int, limit: float) -> dict[str, Any]:
    """Train in a folder; the terminal goes to train.out there."""
    command = [sys.executable, "-m", "lyapnet", "train", "--config", "task.yaml", f"seed={seed}"]
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
            if used > limit + GRACE:
                process.kill()
        status = process.wait()
    return {"status": status, "cpu": used, "wall": time.monotonic() - started, "stopped": stopped}


@torch.no_grad()
def measure(folder: Path, name: str) -> dict[str, float]:
    """Regret, ratio, violation and how far controls exceed their limits, of the newest best.ckpt in a folder.

    Raises:
        FileNotFoundError: there is none.
    """
    checkpoints = sorted(folder.glob("logs/**/best.ckpt"), key=lambda path: path.stat().st_mtime)
    if not checkpoints:
        raise FileNotFoundError(f"Expected best.ckpt under {folder / 'logs'}, got none; read train.out there.")
    with inside(folder):
        parts = parts_of(load_config(Path("task.yaml"), []))
        controller = lyapnet.load(checkpoints[-1], system=parts.system, cost=parts.cost)
    problem, kept = controller.problem, optima_of(name)
    like = problem.initial_states.lower
    x, optima = torch.tensor(kept["states"]).to(like), torch.tensor(kept["optima"], dtype=torch.float64)
    J, h, beyond = 0.0, torch.full_like(optima, -torch.inf), torch.zeros_like(optima)
    low, high = problem.controls.limits
    for k in range(problem.horizon.steps):
        u = controller.policy(k * problem.horizon.dt, x)
        beyond = beyond.maximum((low - u).maximum(u - high).amax(-1).double())
        x, cost = problem.step(x, u)
        J = J + cost.double()
        if problem.constraints is not None:
            h = h.maximum(problem.constraints(x).amax(-1).double())
    J = J + problem.cost.terminal(x).double()
    return {
        "J": float(J.mean()),
        "regret": float((J - optima).mean() / optima.std(correction=0)),
        "largest": float((J - optima).max() / optima.std(correction=0)),
        "ratio": float(J.mean() / optima.mean()) if bool((optima > 0).all()) else torch.nan,
        "h": float(h.max()),
        "violated": float((h > 0).double().mean()),
        "beyond": float(beyond.max()),
    }


def main() -> None:
    """Train and measure one task, and print what came of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", choices=(*WORKING, *KEPT))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--limit", type=float, default=LIMIT, help="CPU seconds")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix=f"{given.name}_") as place:
        folder = Path(place)
        for file in ("system.py", "task.yaml"):
            shutil.copy(HERE / given.name / file, folder)
        run = train(folder, given.seed, given.limit)
        print((folder / "train.out").read_text(encoding="utf-8"))
        stopped = f", stopped at the limit of {given.limit:g}" if run["stopped"] else ""
        print(f"{given.name}, seed {given.seed}: status {run['status']}, {run['cpu']:.0f} CPU s{stopped}, "
              f"{run['wall']:.0f} s in all")  # fmt: skip
        found = measure(folder, given.name)
    ratio = f"cost / optimum {found['ratio']:.4f}, " if found["ratio"] == found["ratio"] else ""
    kept = f"largest h {found['h']:.2e}, violated from {found['violated']:.1%} of the states; "
    print(f"regret {found['regret']:.3%} of the spread of J*, {found['largest']:.2%} at most; {ratio}mean J "
          f"{found['J']:.6g}; {kept if found['h'] > -torch.inf else ''}"
          f"controls beyond their limits by {found['beyond']:.1e}")  # fmt: skip


if __name__ == "__main__":
    main()

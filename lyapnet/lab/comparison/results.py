"""Results of jobs of a comparison: the cost of a method on a task, and its training."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lyapnet.base.files import read_file, write_json

OURS = "lyapnet"
LEARNED = (OURS, "ppo_paper", "ppo_tuned", "sac_paper", "sac_tuned")
WITH_VALUE = "mpc_V_"  # prefix of MPC with a number of steps and the V of lyapnet's first seed as terminal cost
PLANNED = (  # laws from the model, without their own training; numbers of MPC without V are % of T
    "rest", "lqr", "ilqr", "mpc_10", "mpc_25", "mpc_100", f"{WITH_VALUE}5", f"{WITH_VALUE}10",
)  # fmt: skip
METHODS = (*LEARNED, *PLANNED)  # the order of tables and figures


@dataclass(frozen=True)
class Measurement:
    """One validation during a training."""

    environment_steps: int  # Euler steps of single trajectories so far
    seconds: float  # CPU time of training so far, compilation included; without validations, figures, checkpoints
    cost: float  # mean J_N of the validation states
    cost_ratio: float | None  # to their optimum, where there is an oracle
    constraint_loss: float | None  # where the program is a lyapnet program


@dataclass(frozen=True)
class ControlTimes:
    """Milliseconds for one control, for one state at a time on one thread."""

    median: float
    most: float  # the 99.9th percentile
    first: float | None = None  # at t = 0, median over the states, where that is when a plan is made

    @staticmethod
    def of(seconds: Sequence[float], first: Sequence[float] = ()) -> "ControlTimes":
        """The latency of some controls, and of the first ones of several closed loops."""
        median, most = np.quantile(seconds, (0.5, 0.999)).tolist()
        return ControlTimes(1e3 * median, 1e3 * most, 1e3 * float(np.median(first)) if len(first) else None)


@dataclass(frozen=True)
class Result:
    """A finished job. `costs`, `sums` and `optima` belong to the same evaluation states, in the same order."""

    task: str
    method: str
    seed: int
    environment_steps: int
    seconds: float  # of training, as in Measurement
    compilation_seconds: float  # which `seconds` holds
    costs: Sequence[float]  # J_N = Δt Σℓ_n + φ, of the best checkpoint
    sums: Sequence[float]  # Σℓ_n + φ, as the paper's tables have it
    optima: Sequence[float] | None  # J*, where there is an oracle; NaN where it found none
    constraint_loss: float | None  # mean over the evaluation states, of a lyapnet program
    clipped_fraction: float | None  # share of controls at the bounds of the action box
    horizon_steps: int
    checkpoint: str
    curve: Sequence[Measurement]  # empty without training
    times: ControlTimes | None = None
    unsolved_fraction: float | None = None  # of the optimisations of a planner, that did not converge
    path_costs: Sequence[Sequence[float]] | None = None  # J_N of each path of noise (paths, states); `costs` are means

    def write(self, path: Path) -> None:
        """Write the result as JSON, completely or not at all; a job with this file is finished."""
        write_json(path, asdict(self))

    @staticmethod
    def read(path: Path) -> "Result":
        """Read the result that `write` wrote."""
        content: dict[str, Any] = json.loads(read_file(path))
        curve, times = [Measurement(**point) for point in content["curve"]], content.get("times")
        return Result(**{**content, "curve": curve, "times": times and ControlTimes(**times)})


def with_cold_compilation(results: Sequence[Result]) -> list[Result]:
    """The results as if each job had been the first one of its task and method on its machine.

    Machine code is kept, so that only one of several seeds takes the time to compile; each is charged with it.
    """
    cold: dict[tuple[str, str], float] = {}
    for result in results:
        key = (result.task, result.method)
        cold[key] = max(cold.get(key, 0.0), result.compilation_seconds)
    return [_later(result, cold[result.task, result.method]) for result in results]


def _later(result: Result, compilation: float) -> Result:
    more = compilation - result.compilation_seconds
    points = [replace(p, seconds=p.seconds + more if p.environment_steps else p.seconds) for p in result.curve]
    return replace(result, seconds=result.seconds + more, compilation_seconds=compilation, curve=points)


def with_common_optima(results: Sequence[Result]) -> list[Result]:
    """The results with the least optimum of each state that any job knew, or its method reached.

    The oracle keeps the best local minimum that it has met; a method that costs less has found a better one. Where none
    was found, none is known, whatever methods reach. With noise costs are means over paths, which may be below the
    optimum by chance: results stay as they are.
    """
    known: dict[str, torch.Tensor] = {}
    for result in results:
        if result.path_costs is not None:
            continue
        if result.optima is not None:
            optima = torch.tensor(result.optima, dtype=torch.float64)
            known[result.task] = torch.fmin(known.get(result.task, optima), optima)
    for result in results:
        if (optima := known.get(result.task)) is not None and len(optima) == len(result.costs):
            reached = torch.fmin(optima, torch.tensor(result.costs, dtype=torch.float64))
            known[result.task] = reached.where(optima.isfinite(), optima)
    return [replace(r, optima=known[r.task].tolist()) if r.task in known else r for r in results]

"""A sweep: trains each point in its own process, none twice, and collects measures for each seed."""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lyapnet.base.files import read_file
from lyapnet.base.tables import csv_text
from lyapnet.experiment.config import load_config
from lyapnet.lab.comparison.workers import run_jobs
from lyapnet.lab.sweep.points import Point
from lyapnet.training.runs import EVALUATION, TrainingRun

MEASURES = (
    "cost_mean", "optimal_cost_mean", "cost_ratio", "value_error", "value_to_cost", "constraint_loss",
    "satisfied_fraction", "decreasing_fraction", "terminal_error",
)  # fmt: skip
NEAR = 0.02  # optimality gap that counts as near


@dataclass(frozen=True)
class SweepRow:
    """The measures of one seed of one run."""

    config: str  # the experiment's name without the value
    key: str | None
    value: str | None
    seed: int
    measures: dict[str, float | None]  # MEASURES, as in `lyapnet evaluate`
    seconds_to_near: float | None  # until the validation states cost within 2 % of the optimum; None: never, or unknown
    training_seconds: float  # all seeds of the run together
    peak_bytes: int  # the process of the run, all its seeds together
    checkpoint: Path


def sweep(points: Sequence[Point], workers: int, say: Callable[[str], Any], ray: str | None = None) -> list[SweepRow]:
    """Train the points that are not trained yet, `workers` at a time; a row for each seed of each finished run.

    Args:
        say: called with the folder of each run, or the reason of its failure.
        ray: the address of a Ray cluster that trains instead of this machine.

    Raises:
        UsageError: Ray is not installed, or there is no cluster at the address.
    """

    def tell(point: Point) -> None:
        run = point.run()
        say(f"{point.name}: {run.folder if run else point.folder}")

    missing = []
    for point in points:
        if point.finished:
            tell(point)
        else:
            missing.append(point)
    if missing:
        for outcome in run_jobs(missing, workers, ray):
            if outcome.failure:
                say(f"failed: {outcome.job.path} {' '.join(outcome.job.settings)}: {outcome.failure}")
            else:
                tell(outcome.job)
    runs = [(point, point.run()) for point in points]
    return [row for point, run in runs if run is not None and run.finished for row in rows_of(point, run)]


def rows_of(point: Point, run: TrainingRun) -> Iterator[SweepRow]:
    """The rows of a finished run."""
    config, name = point.config, load_config(point.path, point.overrides).experiment
    result = json.loads(read_file(run.folder / EVALUATION))
    record = run.record()
    for one, member in zip(result.get("seeds", [result]), run.members(config), strict=True):
        measures = {key: one.get(key) for key in MEASURES}
        seconds, peak = record["training_seconds"], record["peak_bytes"]
        near = _seconds_to_near(member.folder)
        yield SweepRow(name, point.key, point.value, one["seed"], measures, near, seconds, peak, member.best)


def _seconds_to_near(folder: Path) -> float | None:
    """Seconds from the first validation, before the first step, to the first one within NEAR of the optimum."""
    from lyapnet.training.metrics_file import STEP, WALL_TIME, read_curves  # Lightning takes seconds to import

    gaps = read_curves(folder, "optimality_gap/val", WALL_TIME, STEP)
    if not gaps or gaps[0][2] != 0:  # started by version 0.1, which wrote no such file
        return None
    return next((round(seconds - gaps[0][1], 1) for gap, seconds, _ in gaps if gap <= NEAR), None)


def sweep_csv(rows: Sequence[SweepRow]) -> str:
    """The rows as comma-separated values."""
    flat = [asdict(row) for row in rows]
    return csv_text([{**row, **row.pop("measures")} for row in flat])

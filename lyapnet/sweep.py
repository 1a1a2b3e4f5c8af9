"""Several runs of one or more configs, one key varied, side by side: each in a process of its own, none twice."""

import csv
import json
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from lyapnet.config import Config, differing_keys, load_config
from lyapnet.errors import LyapnetError, UsageError
from lyapnet.run import CONFIG, EVALUATION, Run, runs_of

MEASURES = (
    "cost_mean", "optimal_cost_mean", "cost_ratio", "value_error", "value_to_cost", "constraint_loss",
    "satisfied_fraction", "decreasing_fraction", "terminal_error",
)  # fmt: skip
NEAR = 0.02  # optimality gap


@dataclass(frozen=True)
class Point:
    """One run of a sweep: a config with a value of the key that is varied."""

    path: Path
    overrides: Sequence[str]
    key: str | None = None
    value: str | None = None

    @property
    def settings(self) -> list[str]:
        """All overrides; the experiment's name tells the value, so that its runs have a folder of their own."""
        if self.key is None:
            return [*self.overrides]
        varied = [*self.overrides, f"{self.key}={self.value}"]
        name = load_config(self.path, varied).experiment
        return [*varied, f"experiment={name}/{self.key}={self.value}"]

    @property
    def config(self) -> Config:
        """The resolved config."""
        return load_config(self.path, self.settings)

    def run(self) -> Run | None:
        """The newest run of this very config from fresh weights, finished or not."""
        config = self.config
        for run in reversed(runs_of(config)):
            written = run.folder / CONFIG
            if not written.is_file() or run.finetuned_from:  # stopped before it wrote its config, or another start
                continue
            if not [key for key in differing_keys(config, load_config(written)) if key != "logs"]:
                return run
        return None

    def train(self) -> Run:
        """Train it to its end, from where a stopped run was; a finished one is taken as it is.

        Raises:
            LyapnetError: the training fails; with its last words.
        """
        run = self.run()
        if run is not None and run.finished:
            return run
        command = [sys.executable, "-m", "lyapnet", "train", "--config", str(self.path), *self.settings]
        if run is not None and run.last.is_file():
            command += ["--resume", str(run.last)]
        ended = subprocess.run(command, capture_output=True, text=True)
        run = self.run()
        if ended.returncode or run is None or not run.finished:
            words = (ended.stderr.strip() or ended.stdout.strip()).splitlines()
            raise LyapnetError(f"{self.path} {' '.join(self.settings)}: {words[-1] if words else 'stopped'}")
        return run


@dataclass(frozen=True)
class Row:
    """One seed of one run, as the table of a sweep has it."""

    config: str  # the experiment's name without the value
    key: str | None
    value: str | None
    seed: int
    measures: dict[str, float | None]  # of MEASURES, as `lyapnet evaluate` has them
    seconds_to_near: float | None  # until the validation states cost within 2 % of the optimum; None: never, or unknown
    training_seconds: float  # of the run, all its seeds together
    peak_bytes: int  # likewise, of its process
    checkpoint: Path


def points_of(configs: Sequence[Path], vary: str | None, overrides: Sequence[str]) -> list[Point]:
    """The runs that a sweep consists of.

    Raises:
        UsageError: `vary` is not key=value,value,…; one of the configs does not hold; or two of them share a folder.
    """
    key, _, values = (vary or "").partition("=")
    if vary is not None and not (key and values):
        raise UsageError(f"Expected --vary key=value,value,…, got {vary!r}; for example horizon.steps=100,200,400.")
    if not configs:
        raise UsageError("Expected --config PATH at least once, got none; for example conf/double_integrator.yaml.")
    varied = [(key, value.strip()) for value in values.split(",")] if vary else [(None, None)]
    points = [Point(path, overrides, *one) for path in configs for one in varied]
    experiments = [point.config.experiment for point in points]  # all are refused before any is trained
    for experiment in experiments:
        if experiments.count(experiment) > 1:
            raise UsageError(f"Expected runs of different experiments, got {experiment} twice; leave one of them out.")
    return points


def sweep(points: Sequence[Point], workers: int, say: Callable[[str], Any]) -> list[Row]:
    """Train what is not trained yet, `workers` at a time; a row for each seed of each run that came to its end.

    Args:
        say: hears where each run is, or why it failed.
    """

    def train(point: Point) -> list[Row]:
        try:
            run = point.train()
        except LyapnetError as error:
            say(f"failed: {error}")
            return []
        say(f"{point.config.experiment}: {run.folder}")
        return list(rows_of(point, run))

    pool = ThreadPoolExecutor(workers)
    try:
        return [row for rows in pool.map(train, points) for row in rows]
    finally:  # also when the user interrupts: nothing more is started
        pool.shutdown(cancel_futures=True)


def rows_of(point: Point, run: Run) -> Iterator[Row]:
    """A finished run's rows."""
    config, name = point.config, load_config(point.path, point.overrides).experiment
    result = json.loads((run.folder / EVALUATION).read_text(encoding="utf-8"))
    record = run.record()
    for one, member in zip(result.get("seeds", [result]), run.members(config), strict=True):
        measures = {key: one[key] for key in MEASURES}
        seconds, peak = record["training_seconds"], record["peak_bytes"]
        near = _seconds_to_near(member.folder)
        yield Row(name, point.key, point.value, one["seed"], measures, near, seconds, peak, member.best)


def _seconds_to_near(folder: Path) -> float | None:
    """Seconds from the first validation, before the first step, to the first one within NEAR of the optimum."""
    from lyapnet.event_files import curve  # with TensorBoard, which figures of a sweep do without

    gaps = curve(folder, "optimality_gap/val")
    return next((round(seconds - gaps[0][0], 1) for seconds, _, gap in gaps if gap <= NEAR), None)


def write_csv(rows: Sequence[Row], path: Path) -> None:
    """The rows as comma-separated values."""
    names = [field.name for field in fields(Row) if field.name != "measures"]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([*names, *MEASURES])
        for row in rows:
            content = asdict(row)
            writer.writerow([*(content[name] for name in names), *(row.measures[key] for key in MEASURES)])

"""The points of a sweep: a config with a value of the varied key, its run, and the command for it."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from lyapnet.base.errors import UsageError
from lyapnet.experiment.config import Config, differing_keys, load_config
from lyapnet.lab.comparison.workers import Runnable
from lyapnet.training.runs import CONFIG, TrainingRun, runs_of


@dataclass(frozen=True)
class Point(Runnable):
    """One run of a sweep: a config with a value of the varied key."""

    path: Path
    overrides: Sequence[str]
    key: str | None = None
    value: str | None = None

    @cached_property
    def settings(self) -> list[str]:
        """All overrides; the experiment's name contains the value, so that each point has its own folder."""
        if self.key is None:
            return [*self.overrides]
        varied = [*self.overrides, f"{self.key}={self.value}"]
        name = load_config(self.path, varied).experiment
        return [*varied, f"experiment={name}/{self.key}={self.value}"]

    @cached_property
    def config(self) -> Config:
        """The resolved config."""
        return load_config(self.path, self.settings)

    def run(self) -> TrainingRun | None:
        """The newest run of exactly this config from fresh weights, finished or not."""
        config = self.config
        for run in reversed(runs_of(config)):
            written = run.folder / CONFIG
            if not written.is_file() or run.finetuned_from:  # it ended before it wrote its config, or was fine-tuned
                continue
            if not [key for key in differing_keys(config, load_config(written)) if key != "logs"]:
                return run
        return None

    @property
    def name(self) -> str:
        """The name of the experiment."""
        return self.config.experiment

    @property
    def folder(self) -> Path:
        """The folder of its runs."""
        return Path(self.config.logs) / self.config.experiment

    @property
    def finished(self) -> bool:
        """Whether its training is complete."""
        run = self.run()
        return run is not None and run.finished

    @property
    def command(self) -> list[str]:
        """The command that trains it, or resumes its run."""
        run = self.run()
        resume = [] if run is None or not run.last.is_file() else ["--resume", str(run.last)]
        return [sys.executable, "-m", "lyapnet", "train", "--config", str(self.path), *self.settings, *resume]


def points_of(configs: Sequence[Path], vary: str | None, overrides: Sequence[str]) -> list[Point]:
    """The points of a sweep.

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
    experiments = [point.config.experiment for point in points]  # loads, and thereby checks, all configs
    for experiment in experiments:
        if experiments.count(experiment) > 1:
            raise UsageError(f"Expected runs of different experiments, got {experiment} twice; leave one of them out.")
    return points

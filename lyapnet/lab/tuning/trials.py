"""The trainings of a search: each has a process, a folder, and measures of its validations."""

import shlex
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from statistics import fmean
from typing import Any

import optuna
from optuna.trial import TrialState

from lyapnet.base.errors import UsageError
from lyapnet.experiment.checkpoint import read_checkpoint
from lyapnet.experiment.config import Config, load_config
from lyapnet.lab.comparison.workers import Runnable
from lyapnet.lab.tuning.space import Dimension
from lyapnet.training.metrics_file import STEP, read_curves
from lyapnet.training.run_lock import RunLock
from lyapnet.training.runs import TrainingRun, runs_of

# overrides for trials, which are measured by their validations: no figures, and no test states
BRIEF = ("loggers=[csv]", "evaluation.animate=false", "evaluation.test_states=1", "evaluation.certify_every=0")


@dataclass(frozen=True)
class Task:
    """The task of a search: a config, the keys to vary, and a folder."""

    path: Path
    overrides: Sequence[str]
    space: Sequence[Dimension]
    folder: Path
    seed: int
    compared: bool  # whether the measure is the gap to the optimum, instead of the cost

    @property
    def measure(self) -> str:
        """The name of the measure that the search minimises."""
        return "gap" if self.compared else "cost"

    def config(self, settings: Sequence[str] = ()) -> Config:
        """The resolved config with some settings."""
        return load_config(self.path, [*self.overrides, *settings])

    def settings(self, params: dict[str, Any]) -> list[str]:
        """The values of a trial as overrides."""
        return [f"{one.key}={one.text(params[one.key])}" for one in self.space if one.key in params]


class Training(Runnable):
    """One `lyapnet train` in the folder of a search.

    Args:
        begins_with: a checkpoint with its first weights; None: it searches for a start itself.
    """

    def __init__(self, task: Task, name: str, settings: Sequence[str], begins_with: Path | None = None):
        self.task, self._name, self.own, self.begins_with = task, name, settings, begins_with

    @property
    def name(self) -> str:
        return self._name

    @property
    def folder(self) -> Path:
        return self.task.folder / self.name

    @property
    def settings(self) -> list[str]:
        """All overrides."""
        return [*self.task.overrides, *self.own, f"logs={self.task.folder}", f"experiment={self.name}"]

    @cached_property
    def config(self) -> Config:
        """The resolved config."""
        return load_config(self.task.path, self.settings)

    @property
    def run(self) -> TrainingRun | None:
        """Its newest run; None before the first."""
        return next(reversed(runs_of(self.config)), None)

    @property
    def finished(self) -> bool:
        return (run := self.run) is not None and run.finished

    @property
    def command(self) -> list[str]:
        begun = self.run is not None
        first = [] if self.begins_with is None else ["--finetune", str(self.begins_with)]
        further = ["--resume", "last"] if begun else first
        return [sys.executable, "-m", "lyapnet", "train", "--config", str(self.task.path), *self.settings, *further]

    def wait_for_others(self, say: Callable[[str], Any]) -> None:
        """Wait until no other process trains it, such as one that has outlived a killed search."""
        told = False
        while (run := self.run) is not None:
            try:
                with RunLock(run.folder):
                    return
            except UsageError:
                if not told:
                    say(f"{self.name}: still trained by a process of an earlier search, which is waited for")
                told = True
                time.sleep(1)


class Trial(Training):
    """A training with settings that a study proposes when it starts.

    Args:
        begun: an unfinished trial of an earlier process, to continue.
        starts: settings that a start depends on ↦ its checkpoint.
    """

    asking = threading.Lock()

    def __init__(self, task: Task, study: optuna.Study, starts: dict[tuple[str, ...], Path], begun: Any = None):
        super().__init__(task, "", ())
        self.study, self.starts, self.pruned, self._reported = study, starts, False, 0
        self.trial: Any = begun
        if begun is not None:
            self._take()

    def ask(self) -> None:
        """Get settings from the study, by a sampler with a seed for this trial: so a search that was killed and is
        continued proposes the same settings."""
        if self.trial is None:
            with self.asking:
                count = sum(one.state != TrialState.WAITING for one in self.study.get_trials(deepcopy=False))
                self.study.sampler = sampler_of(self.task.seed + count)
                self.trial = self.study.ask({one.key: one.distribution for one in self.task.space})
            self._take()

    def _take(self) -> None:
        settings = self.task.settings(self.trial.params)
        self._name, self.own = f"trial_{self.trial.number}", [*settings, *BRIEF]
        self.begins_with = self.starts.get(start_settings(settings))
        known = self.study.get_trials(deepcopy=False)[self.trial.number].intermediate_values
        self._reported = max(known, default=0)

    @property
    def given_up(self) -> bool:
        """Whether the study prunes it, because its validations are worse than most others at the same step."""
        for step, value in self._news():
            self._report(step, value)
            if step < self.config.training.iterations and self.trial.should_prune():
                self.pruned = True
                break
        return self.pruned

    def end(self, failure: str) -> None:
        """Report the result to the study.

        Args:
            failure: the last message of its process; empty if it was successful.
        """
        for step, value in [] if failure else self._news():
            self._report(step, value)
        value = None if failure else self._value()
        if (run := self.run) is not None:
            self.trial.set_user_attr("seconds", run.record()["training_seconds"])
        if value is not None:
            self.study.tell(self.trial, value)
        elif self.pruned:
            self.study.tell(self.trial, state=TrialState.PRUNED)
        else:
            self.trial.set_user_attr("failure", failure or "no optimum of a validation state is known")
            self.study.tell(self.trial, state=TrialState.FAIL)

    def _news(self) -> list[tuple[int, float]]:
        """(step, measure) of validations that are not reported yet, without the one before the first step."""
        return [(step, value) for step, value in sorted(self._measured().items()) if step > self._reported]

    def _report(self, step: int, value: float) -> None:
        self.trial.report(value, step)
        self._reported = step

    def _value(self) -> float | None:
        """The measure at the best checkpoint, mean over the seeds."""
        assert self.run is not None
        members = self.run.members(self.config)
        steps = [int(read_checkpoint(member.best)["global_step"]) for member in members]
        values = [self._curve(member.folder).get(step) for member, step in zip(members, steps, strict=True)]
        known = [value for value in values if value is not None]
        return fmean(known) if len(known) == len(members) else None

    def _measured(self) -> dict[int, float]:
        """Step of a validation ↦ the measure, mean over the seeds."""
        if (run := self.run) is None:
            return {}
        curves = [self._curve(member.folder) for member in run.members(self.config)]
        common = set(curves[0]).intersection(*curves)
        return {step: fmean(curve[step] for curve in curves) for step in common}

    def _curve(self, folder: Path) -> dict[int, float]:
        """Step ↦ measure: optimality gap + r, or mean cost · (1 + r), with r the share of closed loops that violate
        constraints, plus that of loops that violate the condition of the program lyapunov."""
        names = ("trajectory_cost/val", STEP, "optimality_gap/val", "violated_fraction/val", "satisfied_fraction/val")
        promised, found = self.config.program.name == "lyapunov", dict[int, float]()
        for cost, step, gap, violated, satisfied in read_curves(folder, *names):
            broken = (violated or 0.0) + (1 - satisfied if promised else 0.0)
            value = cost * (1 + broken) if not self.task.compared else None if gap is None else gap + broken
            if value is not None:
                found[int(step)] = value
        return found


def sampler_of(seed: int) -> optuna.samplers.BaseSampler:
    """A sampler of Optuna, which proposes the settings of one trial."""
    return optuna.samplers.TPESampler(seed=seed, n_startup_trials=5)


def start_settings(settings: Sequence[str]) -> tuple[str, ...]:
    """The settings that the start of a training depends on: all but those of its optimisation."""
    apart = ("training.", "program.", "pointwise.", "trainer.")
    return tuple(one for one in settings if not one.startswith(apart) or one.startswith("training.precision="))


def command_of(path: Path) -> str:
    """The command that trains a config."""
    return shlex.join(["lyapnet", "train", "--config", str(path)])

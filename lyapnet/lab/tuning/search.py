"""A search for better settings: runs the trials of an Optuna study, and writes the best config."""

import itertools
import json
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import optuna
from omegaconf import OmegaConf
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, TrialState

from lyapnet.base.errors import LyapnetError, OracleError, UsageError
from lyapnet.base.files import write_atomically
from lyapnet.evaluation.oracles import oracle_of
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import Config, config_from_plain, differing_keys, load_config, to_plain
from lyapnet.experiment.schema import differences, read_yaml
from lyapnet.lab.comparison.workers import run_locally
from lyapnet.lab.tuning.space import Choice, given_values, space_of
from lyapnet.lab.tuning.trials import BRIEF, Task, Training, Trial, command_of, start_settings
from lyapnet.training.build import build_module

STUDY, BEST = "study.journal", "best.yaml"
WITHOUT_PRUNING, WARM = 4, 3  # not pruned: this number of first trials, and the first 1/WARM of a training
STARTS = 8  # largest number of starts that trials share
ONE_STEP = ("training.iterations=1", "training.warmup=0", "training.learning_rate=1e-12")  # leaves the start as it is

Say = Callable[[str], Any]


def task_of(
    path: Path, overrides: Sequence[str], vary: Sequence[str], folder: Path | None, seed: int, say: Say
) -> Task:
    """The task of a search, after a check that configs with the extreme values of each key are valid.

    Raises:
        UsageError: a config is not valid, or a key cannot be varied.
    """
    config = load_config(path, overrides)
    problem, compared = build_problem(config), config.evaluation.optimum
    try:
        oracle_of(problem, config.rollout.method)
    except OracleError as error:
        compared = False
        say(f"mean costs instead of optimality gaps: {error}")
    place = folder or Path(config.logs) / config.experiment / "tune"
    task = Task(path, overrides, space_of(config, vary), place, seed, compared)
    for one in task.space:
        for text in one.extremes:
            build_module(task.config([f"{one.key}={text}"]))
    return task


def open_study(task: Task, say: Say) -> optuna.Study:
    """The study in the folder of a search, which is continued, or a new one.

    Raises:
        UsageError: the study there belongs to another task.
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    task.folder.mkdir(parents=True, exist_ok=True)
    config = task.config()
    iterations = config.training.iterations
    study = optuna.create_study(
        storage=JournalStorage(JournalFileBackend(str(task.folder / STUDY))),
        study_name=config.experiment,
        pruner=optuna.pruners.MedianPruner(WITHOUT_PRUNING, n_warmup_steps=iterations // WARM),
        load_if_exists=True,
    )
    record = {"config": to_plain(config), "space": [str(one) for one in task.space], "seed": task.seed}
    record = json.loads(json.dumps({**record, "compared": task.compared}))
    kept = study.user_attrs.get("task")
    if kept is None:
        if (given := given_values(config, task.space)) is not None:
            study.enqueue_trial(given, user_attrs={"given": True})
        else:
            say(f"{task.path}: its own settings are not among those that are varied, and not tried")
        study.set_user_attr("task", record)
    elif changes := differences(kept, record):
        raise UsageError(
            f"Expected the search of {str(task.folder)!r} as it was begun, got another {', '.join(changes)}; undo the "
            "change, or choose another folder with --out."
        )
    return study


def search(task: Task, study: optuna.Study, trials: int, workers: int, say: Say) -> None:
    """Run trials until `trials` have ended, `workers` at a time; print a line for each.

    Raises:
        LyapnetError: a shared start cannot be made.
    """
    known = study.get_trials(deepcopy=False)
    running = [one for one in known if one.state == TrialState.RUNNING]
    missing = trials - sum(one.state.is_finished() for one in known)
    if missing <= 0:
        return
    starts = shared_starts(task, workers, say)
    jobs = [Trial(task, study, starts, optuna.trial.Trial(study, one._trial_id)) for one in running]
    for job in jobs:
        job.wait_for_others(say)
    jobs += [Trial(task, study, starts) for _ in range(missing - len(running))]
    with closing(run_locally(jobs, workers, Trial.ask)) as outcomes:
        for outcome in outcomes:
            outcome.job.end(outcome.failure)
            trial = study.get_trials(deepcopy=False)[outcome.job.trial.number]
            say(f"{outcome.job.name}  {' '.join(task.settings(trial.params))}  {verdict(trial, task)}")
            write_best(task, study)


def shared_starts(task: Task, workers: int, say: Say) -> dict[tuple[str, ...], Path]:
    """Settings that a start depends on ↦ a checkpoint with this start; empty if there are more than STARTS.

    The start does not depend on the settings of the optimisation, and takes most of the time of a short training.
    """
    varied = [one for one in task.space if start_settings([f"{one.key}=0"])]
    choices = [[f"{one.key}={text}" for text in one.values] for one in varied if isinstance(one, Choice)]
    combinations = list(itertools.product(*choices))
    if len(choices) < len(varied) or len(combinations) > STARTS or task.config().seeds > 1:
        return {}
    seeking = [each for each in combinations if task.config(each).network.name == "expansion"]
    found = {each: Training(task, f"start_{k}", [*each, *BRIEF, *ONE_STEP]) for k, each in enumerate(seeking)}
    missing = [training for training in found.values() if not training.finished]
    if missing:
        say(f"seeking what the trials start from, once for {' and for '.join(' '.join(e) or 'all' for e in found)}")
        _train(missing, workers, say)
    return {each: training.run.best for each, training in found.items() if training.run is not None}


def verdict(trial: FrozenTrial, task: Task) -> str:
    """The result of a trial in words."""
    if trial.state == TrialState.COMPLETE:
        return f"{task.measure} {trial.value:.4g}"
    if trial.state == TrialState.PRUNED:
        return f"pruned after step {max(trial.intermediate_values)}"
    return f"failed: {trial.user_attrs.get('failure', '')}" if trial.state == TrialState.FAIL else "not finished"


def best_of(study: optuna.Study) -> FrozenTrial | None:
    """The complete trial with the least measure; None if there is none."""
    complete = study.get_trials(deepcopy=False, states=[TrialState.COMPLETE])
    return min(complete, key=lambda trial: trial.value or 0.0, default=None)


def write_best(task: Task, study: optuna.Study) -> Path | None:
    """Write the best config so far, with its command in the first line; return its path, None if there is none."""
    best = best_of(study)
    if best is None:
        return None
    path, settings = task.folder / BEST, task.settings(best.params)
    config = task.config([*settings, f"experiment={task.config().experiment}_tuned"])
    text = OmegaConf.to_yaml(OmegaConf.create(_brief(task, config, settings)))
    write_atomically(path, f"# {command_of(path)}\n{text}".encode())
    return path


def _brief(task: Task, config: Config, settings: Sequence[str]) -> Any:
    """The content of a YAML file for a config: that of the given file with the changes, if it means the same; else all
    settings."""
    changes = [*task.overrides, *settings, f"experiment={config.experiment}"]
    layers = OmegaConf.create(read_yaml(task.path, Config)), OmegaConf.from_dotlist(changes)
    content: Any = OmegaConf.to_container(OmegaConf.merge(*layers))
    return content if not differing_keys(config_from_plain(content), config) else to_plain(config)


def train_anew(task: Task, best: FrozenTrial, say: Say) -> Training:
    """Train the best settings from another seed, and evaluate them on states that no trial used.

    Raises:
        LyapnetError: that training failed.
    """
    config = task.config()
    seed = config.seed + config.seeds
    training = Training(task, f"final_{best.number}", [*task.settings(best.params), f"seed={seed}"])
    if not training.finished:
        say(f"training trial_{best.number} once more, with seed {seed}")
        _train([training], 1, say)
    return training


def _train(trainings: Sequence[Training], workers: int, say: Say) -> None:
    """Run trainings until all have ended.

    Raises:
        LyapnetError: one failed.
    """
    for training in trainings:
        training.wait_for_others(say)
    with closing(run_locally(trainings, workers, lambda job: None)) as outcomes:
        for outcome in outcomes:
            if outcome.failure:
                raise LyapnetError(
                    f"Expected {outcome.job.folder} to train to its end, got: {outcome.failure.rstrip('.')}; the same "
                    "command tries again."
                )

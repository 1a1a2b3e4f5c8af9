"""Plans a training: a new run, a resumed run, or a new run with the weights of another."""

import copy
import logging
import math
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np

from lyapnet.base.errors import LyapnetError, UsageError
from lyapnet.base.sizes import check_training_sizes
from lyapnet.base.threads import use_threads
from lyapnet.controller.loading import config_of, load_value_function, require_parts
from lyapnet.experiment.assembly import REGISTRIES, Parts, parts_of, without_unread_settings
from lyapnet.experiment.assembly.target import named_entries
from lyapnet.experiment.checkpoint import KEY, read_checkpoint
from lyapnet.experiment.config import Config, differing_keys, load_config
from lyapnet.task.problem import Problem
from lyapnet.training.build import build_callbacks, build_module
from lyapnet.training.loggers import require_libraries
from lyapnet.training.modules import TrainingModule
from lyapnet.training.run_lock import RunLock
from lyapnet.training.runs import CONFIG, LAST, TrainingRun, is_further_process, last_run, new_run
from lyapnet.training.settling import end_of_training
from lyapnet.training.trainer_options import check_trainer_options

CHANGEABLE_ON_RESUME = (
    "training.iterations", "training.least_gain", "trainer", "logs", "evaluation.figures_every", "evaluation.optimum",
    "evaluation.certify_every", "evaluation.certified_states", "evaluation.confidence", "loggers", "callbacks",
)  # fmt: skip


@dataclass(frozen=True)
class Plan:
    """The module to train, the user's callbacks, the run's folder, and the first step."""

    config: Config
    parts: Parts  # the user's objects
    module: TrainingModule
    callbacks: list[L.Callback]
    run: TrainingRun
    resume_from: Path | None = None  # checkpoint to resume
    step: int = 0  # step of this checkpoint
    end: float = math.inf  # last step of a training that has settled
    anew: bool = False  # whether the run was stopped before its first checkpoint and starts again
    lock: RunLock | None = None  # lock of the folder, held until `fit` returns; only the first process has one

    def __post_init__(self) -> None:
        if self.resume_from is not None and self.config.training.iterations < self.step:
            raise UsageError(
                f"Expected training.iterations ≥ {self.step}, which {str(self.resume_from)!r} has behind it, got "
                f"{self.config.training.iterations}; raise it, or start a new run."
            )

    @property
    def finished(self) -> bool:
        """Whether the run is already finished, so that there is nothing to train."""
        last = min(self.config.training.iterations, self.end)
        return self.resume_from is not None and self.run.finished and self.step >= last

    @property
    def to_train_longer(self) -> str:
        """The change with which a finished run can be trained longer, for messages."""
        return "Set training.least_gain=0" if math.isfinite(self.end) else "Raise training.iterations"


def plan_run(
    config: Config, resume: str | None = None, finetune: Path | None = None, parts: Parts | None = None
) -> Plan:
    """Build everything that a config names and, for a new run, its folder.

    Args:
        resume: "last", or the path of a checkpoint: continue that run.
        finetune: a checkpoint with the initial weights of a new run.
        parts: as for `train`.

    Raises:
        UsageError: config and checkpoint contradict each other, or there is nothing to resume.
        CheckpointError: a checkpoint cannot be read, or its weights do not fit.
        LyapnetError: the folder of a new run cannot be made.
    """
    if resume and finetune:
        raise UsageError(
            "Expected --resume or --finetune, got both; resume continues a run, finetune starts a new one."
        )
    check_training_sizes(config)
    check_trainer_options(config)
    require_libraries(config.loggers)
    callbacks = build_callbacks(config)
    use_threads(config.training.threads)
    parts = parts_of(config) if parts is None else parts
    require_parts(config, parts, config.experiment)
    module = build_module(config, parts)
    if not resume:
        _load_initial_weights(config, parts, module, finetune)
        run, lock = new_run(config, finetune)
        return Plan(config, parts, module, callbacks, run, lock=lock)
    run = last_run(config) if resume == LAST else TrainingRun(Path(resume).resolve().parent.parent)
    checkpoint = run.last if resume == LAST else Path(resume)
    if not run.exists:
        read_checkpoint(checkpoint)
        raise UsageError(f"Expected a checkpoint in its run's folder, got {resume!r}; start a new run with --finetune.")
    with ExitStack() as stack:
        lock = None if is_further_process() else stack.enter_context(RunLock(run.folder))
        if resume == LAST and not run.begun:
            _restart(run, config, parts, module)
            plan = Plan(config, parts, module, callbacks, run, anew=True, lock=lock)
        else:
            content = _read_to_resume(checkpoint, run)
            stored = config_of(content, checkpoint)
            if config.rollout.choose_policy and stored.rollout.policy != config.rollout.policy:
                config.rollout.policy = stored.rollout.policy
                module = build_module(config, parts)
            _require_same_experiment(config, stored, checkpoint)
            end = end_of_training(content, config)
            plan = Plan(config, parts, module, callbacks, run, checkpoint, int(content["global_step"]), end, lock=lock)
        if not plan.finished:
            stack.pop_all()
        return plan


def with_policy(plan: Plan, policy: str) -> Plan:
    """The same plan with another control law and the same V."""
    config = copy.deepcopy(plan.config)
    config.rollout.policy = policy
    module = build_module(config, plan.parts)
    for member, before in zip(module.members, plan.module.members, strict=True):
        member.V.load_state_dict(before.V.state_dict())
    return replace(plan, config=config, module=module)


def _warn_of_other_target(target: Any, problem: Problem, checkpoint: Path) -> None:
    """Warn if V was trained for another goal."""
    goal = problem.goal.tolist()
    if target is None and problem.cost.rest is None:
        return
    before = named_entries([0.0] if target is None else target, problem.system)
    if not np.allclose([*before.values()], [goal[i] for i in before], rtol=1e-6):
        logging.getLogger(__name__).warning(
            "note: %s was trained about x* = %s, and V begins there; this run is about %s. Unless they are close, "
            "start anew without --finetune.", checkpoint, target or "the origin", goal,
        )  # fmt: skip


def _read_to_resume(checkpoint: Path, run: TrainingRun) -> dict[str, Any]:
    """Read a checkpoint to resume; if the last one is unreadable, the error message names the best one."""
    try:
        return read_checkpoint(checkpoint)
    except LyapnetError as error:
        if checkpoint != run.last or not run.best.is_file():
            raise
        raise type(error)(f"{error} The best one is readable: continue from it with --resume {run.best}.") from error


def _restart(run: TrainingRun, config: Config, parts: Parts, module: TrainingModule) -> None:
    """Start a run again that was stopped before its first checkpoint."""
    written = run.folder / CONFIG
    if written.exists():
        _require_same_experiment(config, load_config(written), written)
    _load_initial_weights(config, parts, module, run.finetuned_from)


def _load_initial_weights(config: Config, parts: Parts, module: TrainingModule, checkpoint: Path | None) -> None:
    """Load the weights of a checkpoint into every member, if one is given."""
    if checkpoint is not None:
        content = read_checkpoint(checkpoint)
        if content[KEY].get("config") is not None:
            given = config_of(content, checkpoint)  # raises if this version cannot read it
            _require_own_classes(given, parts, config, checkpoint)
            if [*given.family] != [*config.family]:  # V identifies parameters by their order
                names, own = (", ".join(family) or "none" for family in (given.family, config.family))
                raise UsageError(
                    f"Expected a family in {names}, as of {str(checkpoint)!r}, got one in {own}; give the same names "
                    "in the same order, or start anew without --finetune."
                )
            noisy = module.members[0].problem.noise is not None
            if noisy and "σσᵀ" not in content[KEY].get("problem", {}):  # its V may be 0 at the goal by construction
                raise UsageError(
                    f"Expected a task without noise, as of {str(checkpoint)!r}, got noise, which costs something at "
                    "the goal too; start anew without --finetune."
                )
            if given.horizon.stationary != config.horizon.stationary:
                its, own = ("V(x)" if each.horizon.stationary else "V(t, x)" for each in (given, config))
                raise UsageError(
                    f"Expected horizon.stationary as of {str(checkpoint)!r}, which has {its}, got a task of {own}; "
                    "start anew without --finetune."
                )
            if not config.family:
                _warn_of_other_target(given.target, module.members[0].problem, checkpoint)
        for member in module.members:
            load_value_function(member.V, content, checkpoint)


def _require_own_classes(given: Config, parts: Parts, config: Config, checkpoint: Path) -> None:
    """Raise UsageError where V was trained with a user's system or network, and the config names one of lyapnet's.

    Another cost, program or set is allowed: the meaning of the states and of the weights does not depend on them.
    """
    for part in ("system", "network"):
        name, own = getattr(given, part).name, getattr(config, part).name
        if name not in REGISTRIES[part][0] and getattr(parts, part) is None:
            raise UsageError(
                f"Expected {part}.name as module:Class for {str(checkpoint)!r}, which was trained with {name}, got "
                f"{own}; name your own class, or start anew without --finetune: a file's class is never imported."
            )


def _require_same_experiment(config: Config, stored: Config, origin: Path) -> None:
    read = without_unread_settings(config), without_unread_settings(stored)
    changed = [key for key in differing_keys(*read) if not key.startswith(CHANGEABLE_ON_RESUME)]
    if {config.training.threads, stored.training.threads} == {None, 1}:  # torch computes on one thread in both
        changed.remove("training.threads")
    if [*config.family] != [*stored.family]:
        changed = changed or ["order in family"]
    if changed:
        raise UsageError(
            f"Expected the config of {str(origin)!r}, got another {', '.join(changed)}; resuming continues the "
            "same run: give what it was started with, or start a new run with --finetune."
        )

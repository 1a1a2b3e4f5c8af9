"""Runs one experiment, from its config to the evaluation of the trained controller."""

import statistics
import time
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import lightning as L
import torch
from rich.console import Console
from rich.text import Text

from lyapnet.base.errors import DivergenceError, Interrupted, LyapnetError
from lyapnet.base.files import write_atomically, write_json
from lyapnet.base.machine import peak_memory
from lyapnet.controller.loading import load
from lyapnet.evaluation import evaluate
from lyapnet.experiment.assembly import Parts, default_of
from lyapnet.experiment.checkpoint import AFTER_HORIZON, note_in_checkpoint
from lyapnet.experiment.config import Config, config_from_plain, configs_of_seeds, load_config, to_plain, to_yaml
from lyapnet.training.build import build_data
from lyapnet.training.candidates import Start
from lyapnet.training.compilation import Compilation
from lyapnet.training.curves import loggers_of_each
from lyapnet.training.limit_facts import limit_facts
from lyapnet.training.loggers import drop_logs_after, log_result, without_writer_tracebacks
from lyapnet.training.penalty_weight import find_penalty_weight
from lyapnet.training.plan import Plan, plan_run, with_policy
from lyapnet.training.recovery import Returns
from lyapnet.training.runs import CONFIG, EVALUATION, TrainingRun
from lyapnet.training.stage_messages import PATIENCE, StageMessages, silent
from lyapnet.training.start import STEP_ERROR_REMEDY, has_place_for_start
from lyapnet.training.start_cache import load_or_choose_start
from lyapnet.training.task_facts import jump_facts, kink_facts
from lyapnet.training.trainer import build_trainer
from lyapnet.value.networks import WithPenalty

NO_START_MESSAGE = (
    "start: a random V, without anything known of the task; the first steps cost far more than the optimum"
)


def train(
    config: str | Path | Mapping[str, Any] | Config,
    overrides: Sequence[str] = (),
    *,
    resume: str | None = None,
    finetune: str | Path | None = None,
    console: Console | None = None,
    parts: Parts | None = None,
) -> TrainingRun:
    """Train one experiment, as `lyapnet train` does, and return its run, with `folder`, `best` and `evaluation`.

    Args:
        config: a YAML file, its content as nested dictionaries, or a Config.
        overrides: changes to the config, as key.sub=value.
        resume: "last", or the path of a checkpoint: continue that run. A finished run is not changed.
        finetune: a checkpoint with the initial weights of a new run.
        console: shows the progress; None: the terminal, or in a notebook the output of the cell, as plain text.
        parts: the user's objects, used instead of those that the config names; these are then not imported.

    Raises:
        LyapnetError: as plan_run and fit.
    """
    if isinstance(config, str | Path):
        resolved = load_config(config, overrides)
        changes = f", {[*overrides]!r}" if overrides else ""
        again = f"lyapnet.train({str(config)!r}{changes}, resume='last')"
    else:
        content = to_plain(config) if isinstance(config, Config) else config
        resolved, again = config_from_plain(content, overrides), "lyapnet.train(…, resume='last')"
    with default_of(resolved):
        plan = plan_run(resolved, resume, None if finetune is None else Path(finetune), parts)
        if not plan.finished:
            fit(plan, console or _default_console(), again)
    return plan.run


def _default_console() -> Console:
    """The terminal; in a notebook one without HTML, whose lines stay together in one output."""
    console = Console(highlight=False, markup=False)
    if not console.is_jupyter:
        return console
    return Console(highlight=False, markup=False, force_jupyter=False, force_terminal=False, color_system=None)


def fit(plan: Plan, console: Console, again: str) -> dict[str, Any]:
    """Train all iterations of the config and return the evaluation of the best checkpoint.

    Args:
        again: the command that resumes the run, for messages.

    Raises:
        Interrupted: Ctrl-C or SIGTERM, after saving; says how to continue.
        DivergenceError: a rollout, term or gradient is not finite; names the last good checkpoint.
        LyapnetError: a file of the run cannot be read or written.
    """
    with plan.lock or nullcontext(), without_writer_tracebacks():
        try:
            return _fit(plan, console)
        except Interrupted as stop:
            raise Interrupted(f"{stop} Continue with: {again}", stop.exit_status) from None
        except Exception as error:
            if plan.run.exists:
                raise
            raise LyapnetError(
                f"Expected the folder of the run that trains, got none at {str(plan.run.folder)!r}, which was removed "
                "meanwhile; what it held is lost: start again."
            ) from error


def _fit(plan: Plan, console: Console) -> dict[str, Any]:
    config, run = plan.config, plan.run
    trainer = build_trainer(plan, console)
    if trainer.is_global_zero:
        _prepare_folder(plan)
        console.print(Text(config.experiment, "bold").append(f"  {run.folder}", "not bold"), soft_wrap=True)
        if plan.anew:
            console.print("stopped before its first checkpoint: training starts anew from step 0", soft_wrap=True)
        if plan.resume_from is not None:
            console.print(
                f"resuming from step {plan.step} of {config.training.iterations} ({plan.resume_from})", soft_wrap=True
            )
        else:
            problem = plan.module.members[0].problem
            advised = (fact for fact in limit_facts(problem) if fact.advice)
            for fact in (*jump_facts(problem), *kink_facts(problem), *advised):
                console.print(f"note: {'; '.join(filter(None, fact[1:]))}.", soft_wrap=True)
    started = time.perf_counter()
    try:
        if plan.module.penalty is not None and plan.resume_from is None:
            _set_constraint_penalty(plan, console, trainer.is_global_zero)
        start = _choose_start(plan, trainer, console) if _needs_start(plan) else None
        if start is not None and start.should_look_ahead and config.rollout.choose_policy:
            plan = _switch_to_lookahead(plan, console, trainer.is_global_zero)
            trainer = build_trainer(plan, console)
        trainer = _train(plan, trainer, console, start)
    except DivergenceError as error:
        kept = f" Kept: {run.last}." if run.last.exists() else ""
        raise DivergenceError(f"{error}{kept}") from error
    finally:
        if trainer.is_global_zero and run.exists:
            _record_resources(run, time.perf_counter() - started)
    return _finish(trainer, plan, console) if trainer.is_global_zero else {}


def _train(plan: Plan, trainer: L.Trainer, console: Console, start: Start | None) -> L.Trainer:
    """Train all iterations, returning to a checkpoint after a divergence; returns the trainer that finished."""
    returns, module = Returns(plan, console, start), plan.module
    while True:
        torch.manual_seed(plan.config.seed)  # for users' networks; lyapnet draws from streams of its own
        data = build_data(plan.config, module.members[0].problem)
        try:
            trainer.fit(module, data, ckpt_path=plan.resume_from, weights_only=True)
            return trainer
        except DivergenceError as error:
            plan = returns.go_back(error, trainer)
            trainer = build_trainer(plan, console)


def _needs_start(plan: Plan) -> bool:
    return plan.resume_from is None and plan.run.finetuned_from is None


def _set_constraint_penalty(plan: Plan, console: Console, is_first_process: bool) -> None:
    """Choose the weight of the constraint penalty and report how many optima then keep the constraints."""
    with StageMessages(console, "constraints") if is_first_process else nullcontext(silent) as report:
        relaxation = find_penalty_weight(plan.module.members[0].problem, report)
    assert plan.module.penalty is not None
    plan.module.penalty.weight.fill_(relaxation.weight)
    for member in plan.module.members:
        if isinstance(member.V, WithPenalty):
            member.V.weight.fill_(relaxation.weight)
    if is_first_process:
        plan.run.note(relaxation=relaxation.as_json())
        console.print(str(relaxation), soft_wrap=True)


def _choose_start(plan: Plan, trainer: L.Trainer, console: Console) -> Start | None:
    """Initialise the networks with the best known V, where they can represent it, and report the choice."""
    is_first_process, callbacks = trainer.is_global_zero, trainer.callbacks  # pyright: ignore[reportAttributeAccessIssue]
    with StageMessages(console, "start") if is_first_process else nullcontext(silent) as report:
        if has_place_for_start(list(plan.module.members)):
            for compilation in (callback for callback in callbacks if isinstance(callback, Compilation)):
                compilation.before_start(trainer, plan.module, report)
        start = load_or_choose_start(
            list(plan.module.members), report, may_look_ahead=plan.config.rollout.choose_policy
        )
    if is_first_process and start is not None:
        plan.run.note(start=start.as_json())
        console.print(str(start), soft_wrap=True)
        if start.steps_miss:
            console.print(f"steps: {start.steps_miss}; {STEP_ERROR_REMEDY}", soft_wrap=True)
        if start.should_look_ahead:
            console.print(f"law: {start.about_law}", soft_wrap=True)
    if is_first_process and start is None:
        console.print(NO_START_MESSAGE, soft_wrap=True)
    return start


def _switch_to_lookahead(plan: Plan, console: Console, is_first_process: bool) -> Plan:
    """The plan with the lookahead law, which is also written into the config of the run's folder."""
    plan = with_policy(plan, "lookahead")
    if is_first_process:
        write_atomically(plan.run.folder / CONFIG, to_yaml(plan.config).encode())
        console.print(
            "law: training continues with lookahead; rollout.policy=sampled keeps the other law", soft_wrap=True
        )
    return plan


def _prepare_folder(plan: Plan) -> None:
    """Write the config; remove logs and results later than the step from which the run continues."""
    folder = plan.run.folder
    (folder / EVALUATION).unlink(missing_ok=True)
    write_atomically(folder / CONFIG, to_yaml(plan.config).encode())
    for run in plan.run.members(plan.config):
        drop_logs_after(run, plan.step if plan.resume_from else None)


def _record_resources(run: TrainingRun, seconds: float) -> None:
    """Add the seconds and the peak memory of this process to the run's record."""
    record = run.record()
    total = record["training_seconds"] + seconds
    run.note(training_seconds=round(total, 2), peak_bytes=max(record["peak_bytes"], peak_memory()))


def _finish(trainer: L.Trainer, plan: Plan, console: Console) -> dict[str, Any]:
    """Evaluate each best checkpoint, log the result as final metrics, and mark the run as finished."""
    config, options = plan.config, plan.config.evaluation
    results = []
    runs, loggers = plan.run.members(config), loggers_of_each(trainer, plan.module)
    with StageMessages(console, "evaluation", PATIENCE) as report:
        members = zip(configs_of_seeds(config), runs, loggers, plan.module.members, strict=True)
        for one, run, own, member in members:
            report(f"what follows T, for seed {one.seed}")
            controller = load(run.best, **vars(plan.parts))
            found = "optima" if controller.problem.noise is None else "paths of the noise"
            progress = partial(report, f"{found} for seed {one.seed}")
            controller.share_code_of(member.rollout)
            note_in_checkpoint(run.best, **{AFTER_HORIZON: controller.after_horizon()._asdict()})
            report(f"the best checkpoint of seed {one.seed}, on {options.test_states} states of X₀")
            results.append(evaluate(controller, options.test_states, one.seed, options.optimum, progress))
            log_result(own, one, results[-1], trainer.global_step)
    result = results[0] if config.seeds == 1 else summarise_seeds(results)
    write_json(plan.run.folder / EVALUATION, result)
    return result


def summarise_seeds(results: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The evaluations of several seeds, with mean and standard deviation of each measure that all seeds have."""
    measures = [key for key in results[0] if all(isinstance(result[key], float) for result in results)]
    columns = {key: [result[key] for result in results] for key in measures}
    return {
        "mean": {key: statistics.fmean(values) for key, values in columns.items()},
        "spread": {key: statistics.stdev(values) for key, values in columns.items()},
        "seeds": list(results),
    }

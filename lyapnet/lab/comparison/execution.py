"""Runs a job in this process: continues its training, and measures the result like that of all other jobs."""

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock
from rich.console import Console

from lyapnet.base.errors import LyapnetError, UsageError
from lyapnet.base.files import read_file, write_json
from lyapnet.base.random_streams import TEST, stream
from lyapnet.base.threads import use_threads
from lyapnet.base.types import State
from lyapnet.controller.controller import Controller
from lyapnet.controller.loading import load
from lyapnet.evaluation.states import measure
from lyapnet.experiment.assembly import parts_of
from lyapnet.experiment.config import ControlsConfig, CostConfig, config_from_plain, to_plain
from lyapnet.experiment.schema import differences
from lyapnet.lab.comparison.baselines.training import BaselineTraining, best_policy
from lyapnet.lab.comparison.controller_policy import ControllerPolicy
from lyapnet.lab.comparison.plan import RESULT, Job
from lyapnet.lab.comparison.planners import PlannerPolicy, planner_of
from lyapnet.lab.comparison.results import OURS, PLANNED, WITH_VALUE, ControlTimes, Measurement, Result
from lyapnet.lab.comparison.scoring import Costs, PathIncrements, costs_of, increments_of, optima_of
from lyapnet.lab.comparison.timing import times_of_controller, times_of_policy
from lyapnet.lab.sweep.points import Point
from lyapnet.training.runs import TrainingRun

RECORD, LOCK = "job.json", "lock"


def run_job(job: Job, console: Console) -> Result:
    """Complete the training of a job, measure it, and write the result.

    Raises:
        UsageError: the folder holds another job of that name.
        LyapnetError: the training fails.
    """
    job.folder.mkdir(parents=True, exist_ok=True)
    # another process may still run this job: one that outlived its parent
    with FileLock(job.folder / LOCK, fallback_to_soft=False):  # a soft lock would remain if the process is killed
        require_same(job)
        if (done := job.result) is not None:
            return done
        write_json(job.folder / RECORD, _description(job))
        use_threads(1)  # jobs run side by side
        make = _lyapnet if job.method == OURS else _planner if job.method in PLANNED else _baseline
        result = make(job, console)
        result.write(job.folder / RESULT)
        return result


def require_same(job: Job) -> None:
    """Check that the folder of a job belongs to the same job.

    Raises:
        UsageError: the folder belongs to another job.
    """
    record = job.folder / RECORD
    if not record.is_file():
        return
    wanted = json.loads(json.dumps(_description(job)))
    kept = _with_defaults(json.loads(read_file(record)))
    changes = [
        text if len(text := f"{name} = {now} instead of {then}") < 80 else f"another {name}"
        for name, (then, now) in differences(kept, wanted).items()
    ]
    if changes:
        raise UsageError(
            f"Expected {job.name} as it was begun, got {', '.join(changes)}; undo the change, remove "
            f"{str(job.folder)!r}, or give the comparison another name."
        )


def _description(job: Job) -> dict[str, Any]:
    """Everything that the result depends on."""
    evaluation = [job.comparison.evaluation_states, job.comparison.evaluation_seed]
    config, bounded = to_plain(job.config), job.bounded
    scale = bounded.control_scale
    if bounded.problem.noise is not None:
        evaluation.append(job.comparison.evaluation_paths)
    if job.method == OURS:
        return {"evaluation": evaluation, "control_scale": scale, "config": {**config, "logs": ""}}
    task = [config[key] for key in ("system", "cost", "controls", "initial_states", "horizon", "noise")]
    method = {} if job.method in PLANNED else job.baseline.description
    return {"evaluation": evaluation, "control_scale": scale, "task": task, **method}


def _with_defaults(kept: dict[str, Any]) -> dict[str, Any]:
    """A record with defaults for keys that were added after version 0.1."""
    if "config" in kept:
        return {**kept, "config": {**to_plain(config_from_plain(kept["config"])), "logs": ""}}
    if len(kept["task"]) == 4:
        system, cost, initial_states, horizon = kept["task"]
        task = [system, {**asdict(CostConfig()), **cost}, asdict(ControlsConfig()), initial_states, horizon]
        kept = {**kept, "task": task}
    return {**kept, "task": [*kept["task"], {}]} if len(kept["task"]) == 5 else kept  # which was without noise


def _lyapnet(job: Job, console: Console) -> Result:
    from lyapnet.training.experiment import (
        train,
    )  # imported here because Lightning takes seconds, and baselines do not need it

    config, bounded, states, increments = job.config, job.bounded, *_states(job)
    point = Point(Path(job.compared.config), job.settings)
    run = point.run()
    if run is None or not run.finished:
        last = None if run is None or not run.last.is_file() else str(run.last)
        run = train(point.path, point.settings, resume=last, console=console)
    controller = _controller(job, run.best)
    costs = costs_of(ControllerPolicy(controller, bounded.control_scale), bounded, True, states, increments)
    with torch.no_grad():
        loops = controller.rollout(states, noise=None if increments is None else increments[:, 0])
        constraint_loss = measure(controller.problem, controller.program, loops).constraint_loss
    record = run.record()
    compilation, start = record.get("compilation_seconds", 0.0), record.get("start", {}).get("seconds", {})
    before = compilation + max(start.values(), default=0.0)
    validations = _validations(run, config.training.batch_size * config.horizon.steps, before)
    return _result(
        job, states, costs, str(run.best), validations, compilation,
        constraint_loss=float(constraint_loss.mean()), times=times_of_controller(controller, states),
    )  # fmt: skip


def _controller(job: Job, checkpoint: Path) -> Controller:
    return load(checkpoint, **vars(parts_of(job.config)))


def controllers_of(jobs: Sequence[Job]) -> dict[str, Controller]:
    """Task ↦ the controller of its first finished lyapnet job."""
    found: dict[str, Controller] = {}
    for job in jobs:
        if job.method == OURS and job.task not in found and (result := job.result) is not None:
            checkpoint = Path(result.checkpoint)
            if checkpoint.is_file():  # a user may have kept only the results
                found[job.task] = _controller(job, checkpoint)
    return found


def _validations(run: TrainingRun, steps: int, before: float) -> list[Measurement]:
    """The validations of a run, from its metrics.csv.

    Args:
        steps: environment steps in an iteration.
        before: seconds of work before the first iteration.

    Raises:
        LyapnetError: the file has no validations.
    """
    from lyapnet.training.metrics_file import METRICS, STEP, read_curves  # imported here because it imports Lightning

    names = ("trajectory_cost/val", STEP, "training_seconds", "optimality_gap/val", "constraint_loss/val")
    validations = [
        Measurement(int(iteration) * steps, before + seconds, cost, None if gap is None else 1 + gap, loss)
        for cost, iteration, seconds, gap, loss in read_curves(run.folder, *names)
    ]
    if not validations:
        raise LyapnetError(
            f"Expected the validations of {str(run.folder)!r} in its {METRICS}, got none; lyapnet 0.1 did not write "
            "that file: remove the run, and the same command trains it again."
        )
    return validations


def _baseline(job: Job, console: Console) -> Result:
    baseline, states, increments = job.baseline, *_states(job)
    training = BaselineTraining(baseline, job.folder)

    def report(point: Measurement) -> None:
        ratio = "" if point.cost_ratio is None else f"  cost/optimum {point.cost_ratio:.4g}"
        console.print(f"{point.environment_steps}/{baseline.steps}  cost {point.cost:.4g}{ratio}", soft_wrap=True)

    training.run(report)
    path, policy = best_policy(baseline, job.folder)
    costs = costs_of(policy, job.bounded, baseline.setting.observe_time, states, increments)
    times = times_of_policy(policy, job.bounded, baseline.setting.observe_time, states)
    return _result(job, states, costs, str(path), training.curve, times=times)


def _planner(job: Job, console: Console) -> Result:
    bounded, states, increments = job.bounded, *_states(job)
    controller = None
    if job.method.startswith(WITH_VALUE):  # V is that of another job, which run_job completes first
        trained = run_job(replace(job, method=OURS, seed=0), console)
        controller = _controller(job, Path(trained.checkpoint))
    began = time.process_time()
    policy = PlannerPolicy(planner_of(job.method, bounded.problem, controller), bounded)
    prepared = time.process_time() - began
    costs = costs_of(policy, bounded, True, states, increments)
    console.print(f"{job.name}: mean cost {float(costs.cost.mean()):.4g}", soft_wrap=True)
    return _result(
        job, states, costs, "", [], seconds=prepared, times=policy.times, unsolved_fraction=policy.unsolved_fraction
    )


def _states(job: Job) -> tuple[State, PathIncrements | None]:
    """The evaluation states, and paths of noise from each: the same for every method and seed."""
    comparison, bounded = job.comparison, job.bounded
    seed = comparison.evaluation_seed
    states = bounded.problem.initial_states.sample(comparison.evaluation_states, stream(seed, TEST))
    return states, increments_of(bounded, states, comparison.evaluation_paths, seed, TEST)


def _result(
    job: Job,
    states: State,
    costs: Costs,
    checkpoint: str,
    validations: Sequence[Measurement],
    compilation: float = 0.0,
    seconds: float | None = None,
    constraint_loss: float | None = None,
    times: ControlTimes | None = None,
    unsolved_fraction: float | None = None,
) -> Result:
    optima = optima_of(job.bounded, states)
    return Result(
        task=job.task,
        method=job.method,
        seed=job.seed,
        environment_steps=validations[-1].environment_steps if validations else 0,
        seconds=validations[-1].seconds if seconds is None else seconds,
        compilation_seconds=compilation,
        costs=costs.cost.tolist(),
        sums=costs.sum.tolist(),
        optima=None if optima is None else optima.tolist(),
        constraint_loss=constraint_loss,
        clipped_fraction=costs.clipped_fraction,
        horizon_steps=job.bounded.problem.horizon.steps,
        checkpoint=checkpoint,
        curve=validations,
        times=times,
        unsolved_fraction=unsolved_fraction,
        path_costs=None if costs.paths is None else costs.paths.tolist(),
    )

"""Rows of all results and validations of a comparison, and lines for missing results."""

from collections.abc import Iterable
from dataclasses import asdict
from math import isfinite
from statistics import stdev
from typing import Any

import torch

from lyapnet.evaluation.intervals import half_width_of_mean
from lyapnet.lab.comparison.report.names import method_name, name_of
from lyapnet.lab.comparison.results import METHODS, Result
from lyapnet.lab.comparison.statistics import (
    CONVERGED,
    NEAR,
    TASKS,
    Comparison,
    cost_ratio,
    first_within,
    in_order,
    optimum,
    spread,
)


def missing(comparison: Comparison, planned: Iterable[tuple[str, str, int]] = ()) -> list[str]:
    """A line for each method on a task without all of its seeds: "reacher, PPO (tuned): 3 of 5 seeds".

    Args:
        planned: (task, method, seed) of every job. Without it, each method is expected on each task that there is, with
            all the seeds that it has on any.
    """
    jobs = list(planned) or _expected(comparison)
    tasks = in_order([*comparison.tasks, *(task for task, _, _ in jobs)], TASKS)
    methods = in_order([*comparison.methods, *(method for _, method, _ in jobs)], METHODS)
    optima = {task: [group.optimum for group in comparison.of_task(task)] for task in comparison.tasks}
    return [
        *(line for task in tasks for method in methods if (line := _lacking(comparison, task, method, jobs))),
        *(
            f"{name_of(task)}: J*, which no job knew; new ones find it with lyapnet[oracle]"
            for task, known in optima.items()
            if known.count(None) == len(known) and not any(group.under_noise for group in comparison.of_task(task))
        ),
    ]


def _lacking(comparison: Comparison, task: str, method: str, jobs: Iterable[tuple[str, str, int]]) -> str | None:
    """A line for the missing results of one method on one task."""
    wanted, group = {seed for *pair, seed in jobs if pair == [task, method]}, comparison.of(task, method)
    there = wanted & set(group.seeds if group else ())
    if there == wanted:
        return None
    lacking = ", ".join(map(str, sorted(wanted - there)))
    return f"{name_of(task)}, {method_name(method)}: {len(there)} of {len(wanted)} seeds; missing: {lacking}"


def _expected(comparison: Comparison) -> list[tuple[str, str, int]]:
    seeds: dict[str, set[int]] = {}
    for (_, method), group in comparison.groups.items():
        seeds.setdefault(method, set()).update(group.seeds)
    return [(task, method, seed) for task in comparison.tasks for method in seeds for seed in seeds[method]]


def result_rows(comparison: Comparison) -> list[dict[str, Any]]:
    """A row for each task, method and seed, with all numbers that the other tables use."""
    groups = [group for task in comparison.tasks for group in comparison.of_task(task)]
    return [_result_row(result) for group in groups for result in group.results]


def _result_row(result: Result) -> dict[str, Any]:
    costs, sums = spread([result.costs]), spread([result.sums])
    row = {
        "task": result.task,
        "method": result.method,
        "seed": result.seed,
        "states": len(result.costs),
        "cost_mean": costs.mean,
        "cost_std": stdev(result.costs) if len(result.costs) > 1 and isfinite(costs.mean) else None,
        "cost_iqm": costs.iqm,
        "paths": result.path_costs and len(result.path_costs),
        "cost_half_width": result.path_costs and half_width_of_mean(torch.tensor(result.path_costs)),
        "sum_mean": sums.mean,
        "sum_iqm": sums.iqm,
        "optimum_mean": optimum(result),
        "cost_ratio": cost_ratio(result),
        "environment_steps": result.environment_steps,
        "seconds": result.seconds,
        "compilation_seconds": result.compilation_seconds,
    }
    for name, ratio in (("to_10", NEAR), ("to_2", CONVERGED)):
        first = first_within(result, ratio)
        row |= {f"{name}_steps": first and first.environment_steps, f"{name}_seconds": first and first.seconds}
    return row | {
        "constraint_loss": result.constraint_loss,
        "clipped_fraction": result.clipped_fraction,
        "horizon_steps": result.horizon_steps,
        "checkpoint": result.checkpoint,
    }


def curve_rows(comparison: Comparison) -> list[dict[str, Any]]:
    """A row for each validation of each result."""
    groups = [group for task in comparison.tasks for group in comparison.of_task(task)]
    return [
        {"task": result.task, "method": result.method, "seed": result.seed, **asdict(point)}
        for group in groups
        for result in group.results
        for point in result.curve
    ]

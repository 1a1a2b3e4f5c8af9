"""The tables of a comparison: the paper's Table I in both forms of the cost, the details, and every result in a row."""

from collections.abc import Iterable
from dataclasses import asdict, replace
from math import isfinite
from statistics import fmean, stdev
from typing import Any, NamedTuple

from lyapnet.comparison.layout import (
    Column,
    Table,
    cost,
    factor,
    mean_and_std,
    number,
    share,
    steps,
    with_interval,
)
from lyapnet.comparison.results import METHODS, OURS, Result
from lyapnet.comparison.statistics import (
    CONVERGED,
    NEAR,
    TASKS,
    AtStep,
    Comparison,
    Group,
    Reach,
    cost_ratio,
    first_within,
    in_order,
    optimum,
    spread,
)

ALGORITHMS = {"ppo": "PPO", "sac": "SAC"}
SETTINGS = ("paper", "tuned")
FORMS = {
    "cost": "J_N = Δt Σℓₙ + φ",
    "sum": "the paper's form, Σℓₙ + φ",
}
OVERVIEW = (
    "task", "method", "seeds", "cost / J*", "at our convergence: cost / J*", "there / ours", "steps to 2 %",
    "steps to 10 %", "seconds to 10 %", "seconds / ours", "/ ours without compilation", "trained for",
    "× our steps to 2 %",
)  # fmt: skip


class Printed(NamedTuple):
    """A row of the paper's Table I: mean and std over seeds, of the sum form."""

    constraint: tuple[float, float]
    ours: tuple[float, float]
    ppo: tuple[float, float]
    sac: tuple[float, float]
    horizon: int


# Layeghi, Tonneau, Mistry, "Neural Lyapunov and Optimal Control", arXiv 2305.15244, Table I. Its factors are left out:
# they do not follow from its own costs in the swing-up's row (144.47 printed, 33147.12 / 3568.74 = 9.3).
PAPER = {
    "double_integrator": Printed((0.03, 0.03), (178.92, 77.63), (359.81, 128.76), (13311.58, 7681.00), 400),
    "cartpole_balancing": Printed(
        (0.07, 0.12), (3868.80, 1012.27), (93109.16, 15629.57), (2360774.63, 1098978.99), 79
    ),
    "cartpole_swingup": Printed(
        (24.65, 16.29), (3568.74, 887.16), (33147.12, 16041.53), (255854.68, 81662.83), 171
    ),
    "reacher": Printed((33.61, 20.25), (2086.24, 419.84), (15514.49, 4465.52), (3831267.56, 471973.23), 170),
}  # fmt: skip

NOTES = (
    "Every method is scored by one evaluator on the same evaluation states of X₀, which no training saw, with its "
    "best checkpoint: a baseline's of least validation cost, ours of least validation loss, in which the cost is a "
    "term.",
    "Environment steps are Euler steps of single trajectories: steps times batch. Validations are not counted. A "
    "baseline's budget is also given as a multiple of our steps in all and to 2 %, and of our seconds in all.",
    "Seconds are CPU time of training alone, on one thread, which is wall-clock time on a core of its own: "
    "validations, figures and checkpoints are left out. Compilation is not: every seed of ours is charged with the "
    "longest that a seed took, although machine code is kept from one to the next.",
    "Validations: the fewest of any seed. Steps and seconds to 10 % and 2 % are those of a validation, and so upper "
    "bounds.",
    "Best validation: of least cost; median over the seeds of its environment steps. At 0 it is the untrained "
    "network. Of ours it is not what is scored. Last validation: what a training without kept checkpoints would have "
    "ended with; mean over the seeds. The best of many noisy validations is also a lucky one: on the evaluation "
    "states it may cost more.",
    "mean ± std: over the seeds, of their means over the states, with n − 1. IQM: mean of the middle half of all "
    "seeds × states, with its 95 % percentile bootstrap interval by resampling seeds (2,000 times, generator seed 0); "
    "of three seeds that is about their range. It leaves out the costliest states of X₀ and so can lie below the mean "
    "optimum; that of J/J*, state by state, does not. Agarwal et al., NeurIPS 2021.",
    "cost / J*: mean cost over mean optimum of the states whose optimum is known. The optimum is that of J_N; of the "
    "sum form it is not computed.",
    "To 10 % and 2 %: the first validation whose cost on the validation states is within that of their optimum; later "
    "ones may be worse again. Median over all the seeds, known where more than half of them got there.",
    "Our convergence: the median over our seeds of the environment steps to 2 %; their mean there may be above. "
    "There, or where its training ended if that was sooner, a method counts with the least cost / optimum so far of "
    "each seed's validation states, a baseline also with its next validation; / ours: over ours at the same step. "
    "Nothing is extrapolated.",
    "Seconds / ours: a baseline's seconds to 10 % over ours. >: too few of its seeds got there within their budget; "
    "one that did not counts with all its training, which bounds the factor from below; a bound below 1 says nothing.",
    "diverged: in some state of so many seeds the closed loop left the finite numbers; inf in the CSV files, ∞ as a "
    "factor.",
    "The sum form weighs the running cost 1/Δt times as much as J_N, which every method here minimises: it stands "
    "beside the paper's numbers and ranks nothing.",
    "Clipped: share of controls at the bounds of the action box, in the evaluation.",
    "The paper's rows are those of its Table I (arXiv 2305.15244), their factors computed from its costs. Absolute "
    "costs do not compare with ours: its model and terminal cost differ where its sources do.",
)


def name_of(task: str) -> str:
    """A task for readers."""
    return task.replace("_", " ")


def method_name(method: str) -> str:
    """A method for readers: PPO (tuned)."""
    algorithm, _, setting = method.partition("_")
    return f"{ALGORITHMS[algorithm]} ({setting})" if algorithm in ALGORITHMS and setting else method


# Table I


def table1(comparison: Comparison) -> list[Table]:
    """The paper's Table I in J_N and in its sum form, each in every setting that there is; ours is the same in all."""
    settings = [s for s in SETTINGS if any(m.partition("_")[2] == s for m in comparison.methods)] or [SETTINGS[0]]
    return [_table1(comparison, form, setting) for form in FORMS for setting in settings]


def _table1(comparison: Comparison, form: str, setting: str) -> Table:
    rows = []
    for task in comparison.tasks:
        rows.append(_measured(comparison, task, form, setting))
        if form == "sum" and task in PAPER and PAPER[task].horizon == rows[-1]["horizon"]:
            rows.append(_printed(task, setting))
    origin = [Column("", ("source",))] if form == "sum" else []
    columns = [
        Column("task", ("task",), name_of), *origin, _spread_column("constraint loss", "constraint"),
        _spread_column("ours", OURS), *(_spread_column(label, name) for name, label in ALGORITHMS.items()),
        *(Column(f"{label}/ours", (f"{name}_factor",), factor) for name, label in ALGORITHMS.items()),
        Column("N", ("horizon",)),
    ]  # fmt: skip
    title = f"Cost in {FORMS[form]}; setting of the baselines: {setting}"
    return Table(title, columns, rows, "task" if form == "sum" else None)


def _spread_column(heading: str, name: str) -> Column:
    keys = [f"{name}_{key}" for key in ("mean", "std", "diverged", "seeds")]
    return Column(heading, [*keys, "source"], _measured_or_printed)


def _measured_or_printed(mean: float, std: float | None, diverged: int | None, seeds: int | None, source: str) -> str:
    """The paper's numbers with the decimals that it prints; of how many seeds they are is not known here."""
    if source == "paper":
        return f"{mean:,.2f} ± {std:,.2f}"
    return mean_and_std(mean, std, diverged or 0, seeds or 0)


def _measured(comparison: Comparison, task: str, form: str, setting: str) -> dict[str, Any]:
    """A row of what was measured."""
    ours = comparison.of(task, OURS)
    row = {"form": form, "setting": setting, "task": task, "source": "measured"}
    loss = ours.constraint_loss if ours else None
    row |= _spread_fields("constraint", loss)
    for name, method in ((OURS, OURS), *((name, f"{name}_{setting}") for name in ALGORITHMS)):
        group = comparison.of(task, method)
        row |= _spread_fields(name, getattr(group, form) if group else None)
    row |= {f"{name}_factor": comparison.improvement(task, f"{name}_{setting}", form) for name in ALGORITHMS}
    return row | {"horizon": comparison.of_task(task)[0].results[0].horizon_steps}


def _printed(task: str, setting: str) -> dict[str, Any]:
    """The paper's row, with the factors that follow from its costs."""
    printed = PAPER[task]
    row = {"form": "sum", "setting": setting, "task": task, "source": "paper"}
    for name, (mean, std) in (
        ("constraint", printed.constraint), (OURS, printed.ours), ("ppo", printed.ppo), ("sac", printed.sac),
    ):  # fmt: skip
        row |= {f"{name}_mean": mean, f"{name}_std": std, f"{name}_diverged": None, f"{name}_seeds": None}
    row |= {f"{name}_factor": getattr(printed, name)[0] / printed.ours[0] for name in ALGORITHMS}
    return row | {"horizon": printed.horizon}


def _spread_fields(name: str, measured: Any) -> dict[str, Any]:
    keys = ("mean", "std", "diverged", "seeds")
    return {f"{name}_{key}": getattr(measured, key) if measured else None for key in keys}


# Details


def tasks_table(comparison: Comparison) -> Table:
    """What belongs to a task rather than to a method."""
    rows = []
    for task in comparison.tasks:
        groups = comparison.of_task(task)
        ours = comparison.of(task, OURS)
        reach = ours.within(CONVERGED) if ours else None
        rows.append(
            {
                "task": task,
                "horizon": groups[0].results[0].horizon_steps,
                "states": len(groups[0].results[0].costs),
                "optimum": next((group.optimum for group in groups if group.optimum is not None), None),
                "compilation": max((r.compilation_seconds for r in ours.results), default=0.0) if ours else None,
                **_reach_fields("to_2", reach),
            }
        )
    columns = [
        Column("task", ("task",), name_of), Column("N", ("horizon",)), Column("evaluation states", ("states",)),
        Column("optimum J*, mean", ("optimum",), number),
        Column("our convergence (steps)", ("to_2_reached", "to_2_seeds", "to_2_steps"), _reached_steps),
        Column("(s)", ("to_2_reached", "to_2_seconds"), _reached_seconds),
        Column("of which compilation (s)", ("compilation",), number),
    ]  # fmt: skip
    return Table("Tasks", columns, rows)


def details(comparison: Comparison) -> Table:
    """A row for each method on each task."""
    rows = [_detail(comparison, group) for task in comparison.tasks for group in comparison.of_task(task)]
    columns = [
        Column("task", ("task",), name_of), Column("method", ("method",), method_name), Column("seeds", ("seeds",)),
        Column("trained for", ("steps_least", "steps_most"), _range),
        Column("× our steps", ("budget_of_all",), factor),
        Column("× our steps to 2 %", ("budget_of_convergence",), factor),
        Column("× our seconds", ("budget_of_seconds",), factor),
        Column("IQM of J_N [95 %]", ("iqm", "iqm_low", "iqm_high"), with_interval), Column("J*", ("optimum",), number),
        Column("cost / J*", ("cost_ratio",), _ratio),
        Column("validations", ("validations",)), Column("best validation at", ("best_steps",), steps),
        Column("last validation: cost / J*", ("last_cost",), _ratio),
        Column("IQM of J/J* [95 %]", ("relative_iqm", "relative_iqm_low", "relative_iqm_high"), with_interval),
        Column("at our convergence: cost / J*", ("at_cost", "at_ended", "at_steps"), _at_step),
        Column("there / ours", ("at_factor",), factor),
        Column("steps to 10 %", ("to_10_reached", "to_10_seeds", "to_10_steps"), _reached_steps),
        Column("seconds to 10 %", ("to_10_reached", "to_10_seconds"), _reached_seconds),
        Column("seconds / ours", ("speedup", "speedup_at_least"), factor),
        Column("/ ours without compilation", ("speedup_compiled", "speedup_compiled_at_least"), factor),
        Column("steps to 2 %", ("to_2_reached", "to_2_seeds", "to_2_steps"), _reached_steps),
        Column("clipped", ("clipped_fraction",), share),
    ]  # fmt: skip
    return Table("Details, in J_N", columns, rows, "task")


def overview(comparison: Comparison) -> Table:
    """What of the details is asked first."""
    full = details(comparison)
    named = {column.heading: column for column in full.columns}
    return replace(full, title="Cost against the optimum", columns=[named[heading] for heading in OVERVIEW])


def summary(comparison: Comparison) -> Table:
    """What of the details fits into a terminal."""
    columns = [
        Column("task", ("task",), name_of), Column("method", ("method",), method_name),
        Column("cost/J*", ("mean", "cost_ratio"), _ratio_or_cost), Column("/ours*", ("at_factor",), factor),
        Column("to 10 %", ("to_10_reached", "to_10_seeds"), lambda reached, seeds: f"{reached} of {seeds}"),
        Column("k steps", ("to_10_steps",), lambda value: number(value / 1000)),
        Column("s", ("to_10_seconds",), number), Column("speedup", ("speedup", "speedup_at_least"), factor),
    ]  # fmt: skip
    title = "Cost against the optimum\n* where ours has converged; to 10 %: how many seeds, steps, seconds"
    return replace(details(comparison), title=title, columns=columns)


def _detail(comparison: Comparison, group: Group) -> dict[str, Any]:
    task, method = group.task, group.method
    at, baseline = comparison.at_convergence(task, method), method != OURS
    speedup, compiled = comparison.speedup(task, method), comparison.speedup(task, method, compiled=True)
    budgets = [result.environment_steps for result in group.results]
    relative = group.relative_cost
    return {
        "task": task,
        "method": method,
        "seeds": " ".join(map(str, group.seeds)),
        "steps_least": min(budgets),
        "steps_most": max(budgets),
        "seconds_mean": fmean(result.seconds for result in group.results),
        **_full_spread("", group.cost),
        **_full_spread("sum_", group.sum),
        "optimum": group.optimum,
        "cost_ratio": group.cost_ratio,
        "validations": min(len(result.curve) - 1 for result in group.results),
        "best_steps": group.best_steps,
        "last_cost": group.last_cost,
        "relative_iqm": relative and relative.iqm,
        "relative_iqm_low": relative and relative.low,
        "relative_iqm_high": relative and relative.high,
        "factor": comparison.improvement(task, method) if baseline else None,
        "sum_factor": comparison.improvement(task, method, "sum") if baseline else None,
        **_at_fields(at, baseline),
        **_budget_fields(comparison, group),
        **_reach_fields("to_10", group.within(NEAR)),
        **_reach_fields("to_2", group.within(CONVERGED)),
        "speedup": speedup.factor if speedup and baseline else None,
        "speedup_compiled": compiled.factor if compiled and baseline else None,
        "speedup_at_least": speedup.at_least if speedup and baseline else None,
        "speedup_compiled_at_least": compiled.at_least if compiled and baseline else None,
        "clipped_fraction": group.clipped_fraction,
    }


def _full_spread(prefix: str, measured: Any) -> dict[str, Any]:
    keys = {"mean": "mean", "std": "std", "iqm": "iqm", "iqm_low": "low", "iqm_high": "high", "diverged": "diverged"}
    return {f"{prefix}{name}": getattr(measured, key) for name, key in keys.items()}


def _reach_fields(name: str, reach: Reach | None) -> dict[str, Any]:
    return {f"{name}_{key}": getattr(reach, key) if reach else None for key in ("reached", "seeds", "steps", "seconds")}


def _at_fields(at: AtStep | None, baseline: bool) -> dict[str, Any]:
    fields = {f"at_{key}": getattr(at, key) if at else None for key in ("steps", "ended", "cost", "ours")}
    return {**fields, "at_factor": at.factor if at and baseline else None}


def _budget_fields(comparison: Comparison, group: Group) -> dict[str, Any]:
    """What a baseline was given, in multiples of what ours took in all, and to its convergence."""
    ours, names = comparison.of(group.task, OURS), ("all", "convergence", "seconds")
    if ours is None or group.method == OURS:
        return {f"budget_of_{name}": None for name in names}
    steps = min(result.environment_steps for result in group.results)
    converged = comparison.convergence_step(group.task)
    of_all = steps / max(result.environment_steps for result in ours.results)
    seconds = [fmean(result.seconds for result in one.results) for one in (group, ours)]
    return dict(
        zip((f"budget_of_{name}" for name in names), (of_all, converged and steps / converged, seconds[0] / seconds[1]),
            strict=True)
    )  # fmt: skip


def _at_step(value: float, ended: bool, at: float) -> str:
    """A relative cost, and where its training ended if that was too soon."""
    return _ratio(value) + (f" (ended at {steps(at)})" if ended else "")


def _reached_steps(reached: int, seeds: int, value: float | None) -> str:
    shown = "not reached" if value is None else steps(value)
    return shown if reached == seeds else f"{shown} ({reached} of {seeds})"


def _reached_seconds(reached: int, value: float | None) -> str:
    return "not reached" if value is None else number(value)


def _ratio(value: float) -> str:
    return f"{value:.4f}" if value < 10 else cost(value)


def _ratio_or_cost(mean: float, ratio: float | None) -> str:
    """A cost where its optimum is not known."""
    return f"J_N {cost(mean)}" if ratio is None else _ratio(ratio)


def _range(low: float, high: float) -> str:
    return steps(low) if low == high else f"{steps(low)} to {steps(high)}"


# What is there, in full


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
            if known.count(None) == len(known)
        ),
    ]


def _lacking(comparison: Comparison, task: str, method: str, jobs: Iterable[tuple[str, str, int]]) -> str | None:
    """What is not there yet of one method on one task."""
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
    """A row for each task, method and seed, with everything that the other tables are made of."""
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

"""The details of a comparison: its tasks, and a row for each method on each, in full and in part."""

from dataclasses import replace
from statistics import fmean
from typing import Any

from lyapnet.base.tables import Column, Table, cost, factor, number, ratio, share, steps, with_interval
from lyapnet.lab.comparison.report.names import method_name, name_of
from lyapnet.lab.comparison.results import OURS
from lyapnet.lab.comparison.statistics import CONVERGED, NEAR, AtStep, Comparison, Group, Reach, Spread

OVERVIEW = (
    "task", "method", "seeds", "cost / J*", "at our convergence: cost / J*", "there / ours", "steps to 2 %",
    "steps to 10 %", "seconds to 10 %", "seconds / ours", "/ ours without compilation", "trained for",
    "× our steps to 2 %",
)  # fmt: skip


def tasks_table(comparison: Comparison) -> Table:
    """The properties of each task that do not depend on a method."""
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
        Column("cost / J*", ("cost_ratio",), ratio),
        Column("validations", ("validations",)), Column("best validation at", ("best_steps",), steps),
        Column("last validation: cost / J*", ("last_cost",), ratio),
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
    """The most important columns of the details."""
    full = details(comparison)
    named = {column.heading: column for column in full.columns}
    return replace(full, title="Cost against the optimum", columns=[named[heading] for heading in OVERVIEW])


def summary(comparison: Comparison) -> Table:
    """The columns of the details that fit into a terminal."""
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


def _full_spread(prefix: str, measured: Spread) -> dict[str, Any]:
    keys = {"mean": "mean", "std": "std", "iqm": "iqm", "iqm_low": "low", "iqm_high": "high", "diverged": "diverged"}
    return {f"{prefix}{name}": getattr(measured, key) for name, key in keys.items()}


def _reach_fields(name: str, reach: Reach | None) -> dict[str, Any]:
    return {f"{name}_{key}": getattr(reach, key) if reach else None for key in ("reached", "seeds", "steps", "seconds")}


def _at_fields(at: AtStep | None, baseline: bool) -> dict[str, Any]:
    fields = {f"at_{key}": getattr(at, key) if at else None for key in ("steps", "ended", "cost", "ours")}
    return {**fields, "at_factor": at.factor if at and baseline else None}


def _budget_fields(comparison: Comparison, group: Group) -> dict[str, Any]:
    """The budget of a baseline, relative to ours in total and until convergence."""
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
    """A relative cost, with the step at which its training ended if it ended before our convergence."""
    return ratio(value) + (f" (ended at {steps(at)})" if ended else "")


def _reached_steps(reached: int, seeds: int, value: float | None) -> str:
    shown = "not reached" if value is None else steps(value)
    return shown if reached == seeds else f"{shown} ({reached} of {seeds})"


def _reached_seconds(reached: int, value: float | None) -> str:
    return "not reached" if value is None else number(value)


def _ratio_or_cost(mean: float, relative: float | None) -> str:
    """The cost relative to the optimum; the cost itself if the optimum is not known."""
    return f"J_N {cost(mean)}" if relative is None else ratio(relative)


def _range(low: float, high: float) -> str:
    return steps(low) if low == high else f"{steps(low)} to {steps(high)}"

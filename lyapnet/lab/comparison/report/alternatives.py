"""The alternatives: every method on every task, learned or planned, with its cost and computation time."""

from dataclasses import replace
from statistics import fmean
from typing import Any

from lyapnet.base.tables import Column, Table, number, ratio, share
from lyapnet.lab.comparison.report.names import method_name, name_of
from lyapnet.lab.comparison.statistics import Comparison, Group, relative_costs

FAILED = 2.0  # cost relative to the optimum above which a closed loop counts as failed


def alternatives(comparison: Comparison) -> Table:
    """A row for each method on each task."""
    rows = [_row(group) for task in comparison.tasks for group in comparison.of_task(task)]
    columns = [
        Column("task", ("task",), name_of), Column("method", ("method",), method_name), Column("seeds", ("seeds",)),
        Column("cost / J*", ("cost_ratio",), ratio), Column("worst state", ("worst",), ratio),
        Column("fail", ("failed",), share), Column("before use (s)", ("seconds",), number),
        Column("first control (ms)", ("first",), number), Column("a control (ms): median", ("median",), number),
        Column("99.9 %", ("most",), number), Column("not solved", ("unsolved",), share),
    ]  # fmt: skip
    return Table("What each costs, and what it takes", columns, rows, "task")


def brief_alternatives(comparison: Comparison) -> Table:
    """The columns that fit into a terminal."""
    full = alternatives(comparison)
    columns = [
        Column("task", ("task",), name_of), Column("method", ("method",), _short_name),
        Column("cost/J*", ("cost_ratio",), ratio), Column("worst", ("worst",), ratio),
        Column("fail", ("failed",), share), Column("s", ("seconds",), _short), Column("ms", ("median",), _short),
        Column("99.9 %", ("most",), _short),
    ]  # fmt: skip
    title = f"{full.title}\ns: before the first control; ms: each control, median and 99.9 %"
    return replace(full, title=title, columns=columns)


def _row(group: Group) -> dict[str, Any]:
    """Means over the seeds; the worst state of any of them."""
    relative = [one for result in group.results for one in relative_costs(result) or ()]
    times = [result.times for result in group.results if result.times is not None]
    first = [one.first for one in times if one.first is not None]
    unsolved = [result.unsolved_fraction for result in group.results if result.unsolved_fraction is not None]
    return {
        "task": group.task,
        "method": group.method,
        "seeds": " ".join(map(str, group.seeds)),
        "cost_ratio": group.cost_ratio,
        "worst": max(relative, default=None),
        "failed": fmean(not one <= FAILED for one in relative) if relative else None,
        "seconds": fmean(result.seconds for result in group.results),
        "first": _mean(first),
        "median": _mean([one.median for one in times]),
        "most": _mean([one.most for one in times]),
        "unsolved": _mean(unsolved),
    }


def _mean(values: list[float]) -> float | None:
    return fmean(values) if values else None


def _short_name(method: str) -> str:
    return method_name(method).replace(" of T", "")


def _short(value: float) -> str:
    if value < 1e-3:
        return "<0.001"
    return f"{value:.2g}" if value < 10 else f"{value:,.0f}"

"""The mean cost of each method under noise, and its excess over the method with the least cost."""

from collections.abc import Sequence
from math import isinf
from typing import Any

from lyapnet.base.tables import DIVERGED, Column, Table, mean_and_std
from lyapnet.lab.comparison.report.names import method_name, name_of
from lyapnet.lab.comparison.statistics import Comparison, Group


def mean_costs(comparison: Comparison) -> Table | None:
    """A row for each method on each task with noise; None if no task has any."""
    rows = [row for task in comparison.tasks for row in _rows(comparison.of_task(task))]
    columns = [
        Column("task", ("task",), name_of), Column("method", ("method",), method_name), Column("paths", ("paths",)),
        Column("E J ± 95 %", ("mean", "half_width"), _with_half_width),
        Column("above the least", ("excess", "excess_half_width"), _with_half_width),
    ]  # fmt: skip
    return Table("Mean cost under noise", columns, rows, "task") if rows else None


def _rows(groups: Sequence[Group]) -> list[dict[str, Any]]:
    """The rows of one task; empty without noise."""
    noisy = [group for group in groups if group.under_noise]
    least = min(noisy, key=lambda group: group.cost.mean, default=None)
    rows = []
    for group in noisy:
        excess, half_width = (None, None) if least is None or group is least else group.cost_above(least)
        rows.append(
            {
                "task": group.task,
                "method": group.method,
                "seeds": " ".join(map(str, group.seeds)),
                "paths": len(group.results[0].path_costs or ()),
                "mean": group.cost.mean,
                "half_width": group.half_width,
                "excess": excess,
                "excess_half_width": half_width,
            }
        )
    return rows


def _with_half_width(mean: float, half_width: float) -> str:
    return DIVERGED if isinf(mean) else mean_and_std(mean, half_width)

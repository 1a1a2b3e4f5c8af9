"""The paper's Table I in both forms of the cost, measured and as printed."""

from typing import Any, NamedTuple

from lyapnet.base.tables import Column, Table, factor, mean_and_std
from lyapnet.lab.comparison.report.names import ALGORITHMS, name_of
from lyapnet.lab.comparison.results import OURS
from lyapnet.lab.comparison.statistics import Comparison, Spread

SETTINGS = ("paper", "tuned")
FORMS = {
    "cost": "J_N = Δt Σℓₙ + φ",
    "sum": "the paper's form, Σℓₙ + φ",
}


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
    """The paper's numbers with the decimals that it prints; the number of its seeds is not known here."""
    if source == "paper":
        return f"{mean:,.2f} ± {std:,.2f}"
    return mean_and_std(mean, std, diverged or 0, seeds or 0)


def _measured(comparison: Comparison, task: str, form: str, setting: str) -> dict[str, Any]:
    """A row of measured numbers."""
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


def _spread_fields(name: str, measured: Spread | None) -> dict[str, Any]:
    keys = ("mean", "std", "diverged", "seeds")
    return {f"{name}_{key}": getattr(measured, key) if measured else None for key in keys}

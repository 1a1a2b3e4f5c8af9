"""The tables of lyapnet bench for the terminal."""

from collections.abc import Sequence
from typing import Any

from rich.table import Column, Table

from lyapnet.evaluation.oracles.multistart import SAME
from lyapnet.lab.bench.latency import Latency
from lyapnet.lab.bench.optima import OptimaTiming
from lyapnet.lab.bench.proofs import Attempt
from lyapnet.lab.bench.routes import BASELINE
from lyapnet.lab.bench.tightness import Tightness


def bench_table(case: Any, rows: list[Any], repeats: int, threads: int) -> Table:
    """Time, memory and error of each route for one task."""
    parameters, horizon = sum(p.numel() for p in case.V.parameters()), case.problem.horizon
    columns = [Column(name, justify="right") for name in ("batch", "seconds", "×", "% of\npeak", "MB", "error")]
    table = Table("route", "com-\npiled", *columns)
    table.title = (
        f"{case.name}: one loss and its gradient\n{horizon.steps} steps, {parameters} parameters, "
        f"{rows[0].dtype}, {threads} thread{'s' * (threads > 1)}, median of {repeats}"
    )
    table.caption = f"×: times faster than {BASELINE}; % of peak: of multiply-adds per second; MB: most memory"
    baseline = {row.batch: row.seconds for row in rows if row.route == BASELINE}
    for row, following in zip(rows, [*rows[1:], None], strict=True):
        table.add_row(
            row.route, "yes" if row.compiled else "no", str(row.batch), f"{row.seconds:.3g}",
            f"{baseline[row.batch] / row.seconds:.2g}" if row.batch in baseline else "–",
            f"{100 * row.peak_share:.2g}",
            "–" if row.peak_bytes is None else f"{row.peak_bytes / 1e6:.1f}",
            "–" if row.relative_error is None else f"{row.relative_error:.0e}",
            end_section=following is not None and following.batch != row.batch,
        )  # fmt: skip
    return table


def tightness_table(rows: Sequence[Tightness], boxes: int) -> Table:
    """The width of each enclosure relative to the range."""
    columns = [Column(f"{side:g}", justify="right") for side in rows[0].sides]
    table = Table("enclosure", *columns, Column("order", justify="right"), Column("boxes\nper s", justify="right"))
    table.title = f"{rows[0].case}\nwidth of the enclosure / width of the range, by side of the box"
    table.caption = f"medians of {boxes} boxes; order: of the excess width in the side, its sides as shares of the axes"
    for row in rows:
        factors = (f"{factor:.3g}" for factor in row.factors)
        table.add_row(row.enclosure, *factors, f"{row.order:.2f}", f"{row.boxes_per_second:,.0f}")
    return table


def proofs_table(rows: Sequence[Attempt], seconds: float) -> Table:
    """The verdict of each method on c ≤ 0, and its work."""
    columns = [Column(name, justify="right") for name in ("boxes", "seconds")]
    table = Table("n", "c ≤ 0", "method", "verdict", *columns)
    table.title = f"Riccati V on chains of n integrators, {seconds:g} s for each proof"
    for row, following in zip(rows, [*rows[1:], None], strict=True):
        table.add_row(
            str(row.states), "true" if row.holds else "false", row.method, row.verdict, f"{row.boxes:,}",
            f"{row.seconds:.3g}", end_section=following is not None and following.states != row.states,
        )  # fmt: skip
    return table


def latency_table(rows: Sequence[Latency], title: str) -> Table:
    """Microseconds of one control in each way."""
    table = Table("", *(Column(name, justify="right") for name in ("calls", "median", "99.9 %", "worst")))
    table.title = f"{title}\nmicroseconds of u(t, x), 1 kHz"
    for row in rows:
        table.add_row(row.way, f"{row.calls:,}", *(f"{value:,.1f}" for value in (row.median, row.most, row.worst)))
    return table


def optima_table(rows: Sequence[OptimaTiming]) -> Table:
    """Seconds for the optima of each task, and their costs beside the oracle's."""
    names = ("optima", "seconds", "compared", "excess", "saving", "as low")
    table = Table("task", *(Column(name, justify="right") for name in names))
    table.title = "optima from which a training starts, one thread"
    table.caption = (
        "excess and saving: the largest, relative to the oracle's cost; as low: the share of states with an excess of "
        f"at most {SAME:.0e}"
    )
    for row in rows:
        beside = ("–", "–", "–")
        if row.compared:
            numbers = (max(number, 0.0) for number in (row.largest_excess, row.largest_saving))
            beside = (*(f"{number:.0e}" for number in numbers), f"{row.as_low:.1%}")
        table.add_row(row.task, str(row.found), f"{row.seconds:.1f}", str(row.compared), *beside)
    return table

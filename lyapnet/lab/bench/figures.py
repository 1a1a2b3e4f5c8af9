"""The figures of lyapnet bench."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from lyapnet.base.drawing import BLUE, GREEN, GREY, ORANGE, PURPLE, SKY, VERMILION, legend_below
from lyapnet.lab.bench.accuracy import Accuracy
from lyapnet.lab.bench.enclosures import MEAN_VALUE
from lyapnet.lab.bench.measurement import BenchRow
from lyapnet.lab.bench.proofs import CERTIFIER, Attempt
from lyapnet.lab.bench.tightness import Tightness

ENCLOSURE_STYLES = {
    CERTIFIER: (GREY, "*", "-."),
    "quadratic": (PURPLE, "D", "-"),
    "affine": (BLUE, "o", "-"),
    "interval": (VERMILION, "s", "--"),
    MEAN_VALUE: (GREEN, "^", ":"),
}
ROUTE_STYLES = {
    "rollout": (GREY, "o"), "adjoint": (ORANGE, "s"), "adjoint-autograd": (VERMILION, "D"), "backprop": (GREEN, "^"),
    "discrete": (BLUE, "o"), "jax": (PURPLE, "v"), "jax-checkpoint": (PURPLE, "x"), "jax-rollout": (SKY, "v"),
}  # fmt: skip
METHOD_LINES = {"euler": "-", "midpoint": ":", "rk4": "--", "dopri5": "-."}


def certify_bench(bounds: Sequence[Tightness], proofs: Sequence[Attempt]) -> Figure:
    """Left: width of each enclosure relative to the range, by side. Right: seconds to a verdict, by dimension."""
    figure = Figure(figsize=(9, 4.1), layout="constrained")
    left, right = figure.subplots(1, 2)
    _draw_tightness(left, bounds)
    _draw_proofs(right, proofs)
    for panel in (left, right):
        panel.grid(color=GREY, alpha=0.25, linewidth=0.5)
        panel.tick_params(labelsize=8)
        panel.legend(fontsize=8, frameon=False)
    return figure


def _draw_tightness(axes: Axes, rows: Sequence[Tightness]) -> None:
    for row in (row for row in rows if row.enclosure in ENCLOSURE_STYLES):
        color, marker, line = ENCLOSURE_STYLES[row.enclosure]
        label = f"{row.enclosure}: excess ∝ side^{row.order:.2f}"
        axes.loglog(row.sides, row.factors, line, color=color, marker=marker, markersize=5, label=label)
    axes.axhline(1, color=GREY, linewidth=1, label="exact")
    axes.set_xticks(rows[0].sides, [f"{side:g}" for side in rows[0].sides])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xlabel("side of the box, share of each axis of [0, T] × X₀", fontsize=9)
    axes.set_ylabel("width of the enclosure / width of the range", fontsize=9)
    axes.set_title(f"tightness: {rows[0].case}", fontsize=9)


def _draw_proofs(axes: Axes, rows: Sequence[Attempt]) -> None:
    """Lines join proofs; an open marker is a spent budget without a verdict."""
    for method in dict.fromkeys(row.method for row in rows):
        color, marker, line = ENCLOSURE_STYLES[method]
        tried = [row for row in rows if row.method == method and row.holds]
        n, seconds = [row.states for row in tried], [row.seconds for row in tried]
        label = f"{method}, by {'remainder' if method == CERTIFIER else 'widest axis'}"
        axes.semilogy(n, seconds, line, color=color, marker=marker, markersize=5, label=label)
        for row in (row for row in tried if row.verdict == "unknown"):
            axes.plot(row.states, row.seconds, marker, color=color, markerfacecolor="white", markersize=5)
    twins = [row for row in rows if not row.holds and row.verdict == "falsified"]
    axes.plot(
        [row.states for row in twins], [row.seconds for row in twins], "x", color="black", label="twin, falsified"
    )
    if any(row.verdict == "unknown" for row in rows):
        axes.plot([], [], "o", color=GREY, markerfacecolor="white", label="budget spent: unknown")
    axes.set_xticks(sorted({row.states for row in rows}))
    axes.set_xlabel("integrators n", fontsize=9)
    axes.set_ylabel("time to a verdict on c ≤ 0, with tracing (s)", fontsize=9)
    axes.set_title("growth: Riccati V on chains of integrators", fontsize=9)


def gradient_time(rows: Sequence[BenchRow]) -> Figure:
    """Seconds for a loss and its gradient, and environment steps per second, by batch; a column for each task."""
    tasks = list(dict.fromkeys(row.task for row in rows))
    figure = Figure(figsize=(max(3.4 * len(tasks), 5.6), 6.4), layout="constrained")
    grid = figure.subplots(2, len(tasks), sharex="col", sharey="row", squeeze=False)
    for column, task in zip(grid.T, tasks, strict=True):
        of_task = [row for row in rows if row.task == task]
        for panel, field in zip(column, ("seconds", "steps_per_second"), strict=True):
            _draw_routes(panel, of_task, "batch", field)
        column[0].set_title(f"{task}, {of_task[0].dtype}", fontsize=9)
        column[1].set_xlabel("batch (initial states)")
    grid[0, 0].set_ylabel("seconds per loss and gradient (s)")
    grid[1, 0].set_ylabel("environment steps per second (1/s)")
    legend_below(figure, grid[0, 0])
    return figure


def steps_per_second_against_n(rows: Sequence[BenchRow]) -> Figure:
    """Environment steps per second, by number of states; a panel for each batch."""
    batches = sorted({row.batch for row in rows})
    figure = Figure(figsize=(max(3.4 * len(batches), 5.6), 3.9), layout="constrained")
    panels = figure.subplots(1, len(batches), sharey=True, squeeze=False)[0]
    for panel, batch in zip(panels, batches, strict=True):
        _draw_routes(panel, [row for row in rows if row.batch == batch], "states", "steps_per_second")
        panel.set_title(f"batch {batch}, {rows[0].dtype}", fontsize=9)
        panel.set_xlabel("states n")
    panels[0].set_ylabel("environment steps per second (1/s)")
    legend_below(figure, panels[0])
    return figure


def gradient_error(points: Sequence[Accuracy], title: str) -> Figure:
    """Error of each route's gradient by its work: relative to that of the same steps, and to continuous time."""
    figure = Figure(figsize=(9, 4.6), layout="constrained")
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    fields = {
        "discretisation_error": "against backprop through the same steps (itself 0):\nis it the gradient of this loss?",
        "continuous_error": "against the gradient as Δt → 0:\nwhat the steps themselves cost",
    }
    for panel, (field, heading) in zip(panels, fields.items(), strict=True):
        for route, method in dict.fromkeys((point.route, point.method) for point in points):
            chosen = [point for point in points if (point.route, point.method) == (route, method)]
            shown = [(point.evaluations, getattr(point, field)) for point in chosen if getattr(point, field)]
            color, marker = ROUTE_STYLES[route]
            panel.loglog(
                [x for x, _ in shown], [y for _, y in shown], METHOD_LINES[method], color=color, marker=marker,
                markersize=4, linewidth=1.1, label=f"{route}, {method}",
            )  # fmt: skip
        panel.set_title(heading, fontsize=9)
        panel.set_xlabel("evaluations of f + gu per trajectory, forward and backward", fontsize=8)
        panel.grid(color=GREY, alpha=0.25, linewidth=0.5)
        panel.tick_params(labelsize=8)
    panels[0].set_ylabel("relative error of the gradient of J", fontsize=8)
    figure.suptitle(title, fontsize=9)
    legend_below(figure, panels[1])
    return figure


def _draw_routes(axes: Axes, rows: Sequence[BenchRow], x: str, y: str) -> None:
    """A line for each route; solid if it is compiled, else dashed."""
    for route, compiled in dict.fromkeys((row.route, row.compiled) for row in rows):
        chosen = sorted((getattr(r, x), getattr(r, y)) for r in rows if (r.route, r.compiled) == (route, compiled))
        color, marker = ROUTE_STYLES[route]
        label = f"{route}, compiled" if compiled else route
        style = "-" if compiled else "--"
        axes.loglog(
            *zip(*chosen, strict=True), style, color=color, marker=marker, markersize=4, linewidth=1.1, label=label
        )
    ticks = sorted({getattr(row, x) for row in rows})
    axes.set_xticks(ticks if len(ticks) < 8 else ticks[::2], minor=False)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.xaxis.set_minor_locator(NullLocator())
    axes.grid(color=GREY, alpha=0.25, linewidth=0.5)

"""The figure of lyapnet bench certify."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from lyapnet.bench.enclosures import MEAN_VALUE
from lyapnet.bench.proofs import CERTIFIER, Attempt
from lyapnet.bench.tightness import Tightness
from lyapnet.figures import BLUE, GREEN, GREY, PURPLE, VERMILION

STYLES = {
    CERTIFIER: (GREY, "*", "-."),
    "quadratic": (PURPLE, "D", "-"),
    "affine": (BLUE, "o", "-"),
    "interval": (VERMILION, "s", "--"),
    MEAN_VALUE: (GREEN, "^", ":"),
}


def certify_bench(bounds: Sequence[Tightness], proofs: Sequence[Attempt]) -> Figure:
    """Left: how many times too wide each enclosure is, by side. Right: seconds to a verdict, by dimension."""
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
    for row in rows:
        color, marker, line = STYLES[row.enclosure]
        label = f"{row.enclosure}: excess ∝ side^{row.order:.2f}"
        axes.loglog(row.sides, row.factors, line, color=color, marker=marker, markersize=5, label=label)
    axes.axhline(1, color=GREY, linewidth=1, label="exact")
    axes.set_xticks(rows[0].sides, [f"{side:g}" for side in rows[0].sides])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xlabel("side of the box, share of each axis of [0, T] × X₀", fontsize=9)
    axes.set_ylabel("width of the enclosure / width of the range", fontsize=9)
    axes.set_title(f"tightness: {rows[0].case}", fontsize=9)


def _draw_proofs(axes: Axes, rows: Sequence[Attempt]) -> None:
    """Lines join proofs; an open marker is a budget spent without a verdict."""
    for method in dict.fromkeys(row.method for row in rows):
        color, marker, line = STYLES[method]
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

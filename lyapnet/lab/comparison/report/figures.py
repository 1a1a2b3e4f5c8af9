"""The figures of a comparison: the paper's Fig. 3, the final costs, and its Figs. 1 and 4 of controllers."""

import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from lyapnet.base.drawing import BLUE, CYCLE, GREEN, GREY, ORANGE, PURPLE, VERMILION, legend_below
from lyapnet.base.errors import DivergenceError
from lyapnet.base.random_streams import FIGURES, stream
from lyapnet.controller.controller import Controller
from lyapnet.evaluation.figures import certified_region, trajectories
from lyapnet.lab.comparison.report.names import method_name, name_of
from lyapnet.lab.comparison.results import OURS, Measurement, Result
from lyapnet.lab.comparison.statistics import (
    NEAR,
    Comparison,
    Group,
    interquartile_mean,
    relative_costs,
    spread,
)

WIDTH = 7.2  # inches: two columns of a paper, in which all letters are above 7 pt
SMALL, LARGE = 7, 8
LEAST_LOSS, LEAST_GAP = 1e-6, 1e-5  # least values in figures: in cost, and relative to the optimum


class Look(NamedTuple):
    """The style of a method's lines; dashes and markers differ too, so that no colour is needed."""

    color: str
    dashes: Any  # as matplotlib's linestyle
    marker: str


LOOKS = {
    OURS: Look(BLUE, "-", "o"),
    "ppo_paper": Look(ORANGE, "--", "s"),
    "ppo_tuned": Look(VERMILION, "-.", "D"),
    "sac_paper": Look(GREEN, ":", "^"),
    "sac_tuned": Look(PURPLE, (0, (5, 1, 1, 1, 1, 1)), "v"),
}
GAP = "The gap is cost / optimum − 1 on each seed's validation states. "
CAPTIONS = {
    "figure3": "Against environment steps, Euler steps of single trajectories: rows of constraint loss (ours), {cost} "
    "of ours, that of the baselines with ours again in grey. {gap}Lines are means over the seeds, bands their least "
    "and greatest, both by each seed's last validation and only where all of them were validated and none has stopped; "
    "losses below 1e-6 and gaps below 1e-5 are drawn there. Vertical: where ours first came within 2 % of the optimum, "
    "median over the seeds.",
    "final": "J(x₀) / J*(x₀) − 1, or J_N itself without a known optimum, of the best checkpoints on the evaluation "
    "states: a dot for each seed's interquartile mean over the states; the marker is that over all seeds and states, "
    "the bar its 95 % bootstrap interval. Dashed: 10 % above the optimum.",
    "certified_region": "{task}, ours, its first finished seed (as the paper's Fig. 1): where the Lyapunov condition "
    "holds along closed loops from a grid over a slice of X₀. Sampled, not proved.",
    "trajectories": "{task}, ours, its first finished seed (as the paper's Fig. 4): closed loops from 12 states of X₀, "
    "and V along them with the cost still to come. Controls are as the controller asks, not cut to the action box.",
}


class Band(NamedTuple):
    """Mean, least and greatest over the seeds at environment steps that all of them cover."""

    steps: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray


def band(results: Sequence[Result], measure: Callable[[Measurement], float | None]) -> Band | None:
    """A measure over the seeds, on the union of their validation steps.

    Between validations a seed keeps its last one: costs lie orders of magnitude apart, or diverged, and a line between
    two of them would show what nobody measured. Step 0 is left out, which a logarithmic axis does not have.
    """
    curves = [[(p.environment_steps, value) for p in r.curve if (value := measure(p)) is not None] for r in results]
    if not curves or not all(curves):
        return None
    first, last = max(curve[0][0] for curve in curves), min(curve[-1][0] for curve in curves)
    steps = np.array(sorted({step for curve in curves for step, _ in curve if max(first, 1) <= step <= last}))
    if not len(steps):
        return None
    values = np.array([_held(curve, steps) for curve in curves])
    return Band(steps, values.mean(0), values.min(0), values.max(0))


def _held(curve: Sequence[tuple[int, float]], steps: np.ndarray) -> np.ndarray:
    """The last value at or before each step."""
    at, values = np.array([step for step, _ in curve]), np.array([value for _, value in curve], dtype=float)
    return values[np.searchsorted(at, steps, side="right") - 1]


def is_relative(comparison: Comparison) -> bool:
    """Whether the ratio to the optimum is known for all validations; their states differ between seeds."""
    results = [result for group in comparison.groups.values() for result in group.results]
    return all(point.cost_ratio is not None for result in results for point in result.curve)


def caption(name: str, comparison: Comparison) -> str:
    """The caption of a figure of a report by its name; names of figures of closed loops end with the task."""
    relative = is_relative(comparison)
    words = {"cost": "optimality gap", "gap": GAP} if relative else {"cost": "J_N", "gap": ""}
    kind = next(kind for kind in CAPTIONS if name.startswith(kind))
    return CAPTIONS[kind].format(task=name_of(name.removeprefix(f"{kind}_")).capitalize(), **words)


# Fig. 3


def figure3(comparison: Comparison) -> Figure:
    """Constraint loss, our cost and the baselines' cost against environment steps; a column for each task."""
    tasks, relative = comparison.tasks, is_relative(comparison)
    figure = Figure(figsize=(WIDTH * max(len(tasks), 2) / 4, 5.2), layout="constrained")
    grid = figure.subplots(3, len(tasks), sharex="col", squeeze=False)
    for column, task in zip(grid.T.tolist(), tasks, strict=True):
        _draw_task(column, comparison, task, relative)
        column[0].set_title(name_of(task), fontsize=LARGE)
        column[-1].set_xlabel("environment steps", fontsize=LARGE)
    cost = "optimality gap" if relative else "$J_N$ (cost)"
    labels = ("constraint loss\n(cost)", f"ours:\n{cost}", f"baselines:\n{cost}")
    for axes, label in zip(grid[:, 0], labels, strict=True):
        axes.set_ylabel(label, fontsize=LARGE)
    figure.align_ylabels(grid[:, 0])
    legend_below(figure, list(_handles(comparison)), _columns(figure, 1.4))
    return figure


def _columns(figure: Figure, inches: float) -> int:
    """The number of columns of a given width that fit."""
    return int(figure.get_size_inches()[0] / inches)


def _draw_task(column: Sequence[Axes], comparison: Comparison, task: str, relative: bool) -> None:
    loss, ours, theirs = column
    step, cost = comparison.convergence_step(task), _shown_gap if relative else attrgetter("cost")
    for group in comparison.of_task(task):
        if group.method == OURS:
            _draw_band(loss, group, _shown_loss)
            _draw_band(ours, group, cost)
            _draw_band(theirs, group, cost, Look(GREY, "-", ""))
        else:
            _draw_band(theirs, group, cost)
    for axes in column:
        axes.set(xscale="log", yscale="log")
        if axes is not loss and relative:
            axes.axhline(NEAR - 1, color="black", linewidth=0.8, dashes=(4, 2))
        if step:
            axes.axvline(step, color=GREY, linewidth=0.8, linestyle=":")
        _plain(axes)
        name_decades(axes.yaxis)
        axes.xaxis.set_minor_formatter(NullFormatter())


def _shown_gap(point: Measurement) -> float | None:
    return None if point.cost_ratio is None else _gap(point.cost_ratio)


def _shown_loss(point: Measurement) -> float | None:
    """The constraint loss, at least LEAST_LOSS, because it may be 0 and the axis is logarithmic."""
    return None if point.constraint_loss is None else max(point.constraint_loss, LEAST_LOSS)


def _draw_band(
    axes: Axes, group: Group, measure: Callable[[Measurement], float | None], look: Look | None = None
) -> None:
    drawn = band(group.results, measure)
    if drawn is None:
        return
    color, dashes, marker = look or look_of(group.method)
    finite = np.isfinite(drawn.mean)
    every = max(1, len(drawn.steps) // 5)
    axes.plot(
        drawn.steps, np.where(finite, drawn.mean, np.nan), linestyle=dashes, color=color, marker=marker, markersize=3,
        markevery=every, linewidth=1.1,
    )  # fmt: skip
    axes.fill_between(drawn.steps, drawn.low, drawn.high, where=finite.tolist(), color=color, alpha=0.2, linewidth=0)
    top = np.full((~finite).sum(), 0.97)
    axes.plot(drawn.steps[~finite], top, "x", color=color, markersize=3, transform=axes.get_xaxis_transform())


def look_of(method: str) -> Look:
    """The style of a method, also of an unknown one."""
    return LOOKS.get(method, Look(CYCLE[sum(map(ord, method)) % len(CYCLE)], (0, (1, 3)), "P"))


def _handles(comparison: Comparison) -> Iterator[Line2D]:
    for method in comparison.methods:
        color, dashes, marker = look_of(method)
        label = "ours" if method == OURS else method_name(method)
        yield Line2D([], [], color=color, linestyle=dashes, marker=marker, markersize=3, linewidth=1.1, label=label)
    if OURS in comparison.methods and len(comparison.methods) > 1:
        yield Line2D([], [], color=GREY, linewidth=1.1, label="ours, again")
    if is_relative(comparison):
        yield Line2D([], [], color="black", linewidth=0.8, dashes=(4, 2), label="10 % above the optimum")
    if any(comparison.convergence_step(task) for task in comparison.tasks):
        yield Line2D([], [], color=GREY, linewidth=0.8, linestyle=":", label="ours first within 2 %")
    if any(math.isinf(p.cost) for group in comparison.groups.values() for r in group.results for p in r.curve):
        yield Line2D([], [], color="black", marker="x", markersize=3, linestyle="", label="a seed diverges")


def _plain(axes: Axes) -> None:
    axes.tick_params(which="both", labelsize=SMALL)
    axes.tick_params(which="minor", length=1.5)
    axes.grid(color=GREY, alpha=0.25, linewidth=0.5)


def name_decades(axis: Axis, most: int = 7) -> None:
    """Powers of ten where a logarithmic axis has at least two, else numbers between them as well; so many at most."""
    low, high = axis.get_view_interval()
    powers = math.floor(math.log10(high)) - math.ceil(math.log10(low)) + 1
    between = (1, 2, 5) if high < 30 * low else (1, 3)
    axis.set_major_locator(LogLocator(subs=(1,) if powers > 1 else between, numticks=most))
    axis.set_major_formatter(FuncFormatter(lambda value, _: _decimal(value)))
    axis.set_minor_formatter(NullFormatter())


def _decimal(value: float) -> str:
    """0.02, 1000, and powers of ten beyond."""
    if 1e-3 <= value < 1e4:
        return f"{value:g}"
    exponent = math.floor(math.log10(value) + 1e-9)
    digit = round(value / 10**exponent)
    return f"$10^{{{exponent}}}$" if digit == 1 else f"${digit}{{\\cdot}}10^{{{exponent}}}$"


# Final costs


def final(comparison: Comparison) -> Figure:
    """Cost over optimum of each method: its seeds, their interquartile mean and its interval; a panel for each task."""
    tasks, methods = comparison.tasks, comparison.methods
    size = (WIDTH * max(len(tasks), 2) / 4, 1.1 + 0.28 * len(methods))
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(1, len(tasks), sharey=True, squeeze=False)[0]
    for axes, task in zip(panels, tasks, strict=True):
        relative = all(group.relative_cost for group in comparison.of_task(task))
        for group in comparison.of_task(task):
            _draw_seeds(axes, group, methods.index(group.method), relative)
        _draw_scale(axes, relative)
        axes.set_title(name_of(task), fontsize=LARGE)
    labels = ["ours" if method == OURS else method_name(method) for method in methods]
    panels[0].set_yticks(range(len(methods)), labels, fontsize=SMALL)
    panels[0].set_ylim(len(methods) - 0.5, -0.5)
    meanings = {"a seed": ("o", "", 2.5), "all seeds, with 95 % interval": ("s", "-", 5)}
    handles = [
        Line2D([], [], color=GREY, marker=marker, linestyle=line, markersize=size, label=f"interquartile mean: {label}")
        for label, (marker, line, size) in meanings.items()
    ]
    legend_below(figure, handles, _columns(figure, 3))
    return figure


def _draw_seeds(axes: Axes, group: Group, row: int, relative: bool) -> None:
    measured = (relative_costs(result) if relative else result.costs for result in group.results)
    table = [np.asarray(one, dtype=float) for one in measured if one is not None]
    color, _, marker = look_of(group.method)
    _, _, middle, low, high, *_ = spread(table)
    shown = _gap if relative else float
    for seed in map(interquartile_mean, table):
        _draw_dot(axes, shown(seed), row + 0.22, "o", color, 2.5)
    if low is not None and high is not None and math.isfinite(high):
        axes.plot([shown(low), shown(high)], [row, row], color=color, linewidth=1.4)
    _draw_dot(axes, shown(middle), row, marker, color, 5)


def _gap(ratio: float) -> float:
    return max(ratio - 1, LEAST_GAP)


def _draw_dot(axes: Axes, x: float, y: float, marker: str, color: str, size: float) -> None:
    """Draw a point at its place, or an arrowhead at the right edge if it diverged."""
    if math.isfinite(x):
        axes.plot(x, y, marker, color=color, markersize=size, markeredgewidth=0)
    else:
        axes.plot(0.97, y, ">", color=color, markersize=size, transform=axes.get_yaxis_transform())


def _draw_scale(axes: Axes, relative: bool) -> None:
    axes.set_xscale("log")
    axes.set_xlabel("$J/J^* - 1$" if relative else "$J_N$ (cost)", fontsize=LARGE)
    if relative:
        axes.axvline(NEAR - 1, color="black", linewidth=0.8, dashes=(4, 2))
    _plain(axes)
    name_decades(axes.xaxis, 4)


# Figs. 1 and 4


def pictures(controllers: Mapping[str, Controller]) -> dict[str, Figure]:
    """Name ↦ figure of learned controllers, task ↦ controller: trajectories with V (as the paper's Fig. 4).

    Where the program is to satisfy the Lyapunov condition, also where that holds (Fig. 1).
    """
    drawn = {}
    for task, controller in controllers.items():
        try:
            drawn |= {f"{name}_{task}": figure for name, figure in _closed_loops(controller).items()}
        except DivergenceError as error:  # from a corner of X₀: the tables and the other figures are still worth seeing
            warnings.warn(f"No figures of closed loops on {task}: {error}", stacklevel=1)
    return drawn


def _closed_loops(controller: Controller) -> dict[str, Figure]:
    figures = {}
    if controller.program.tolerances().decrease is not None:
        region = certified_region(controller.rollout, controller.problem)
        figures["certified_region"] = region
    x0 = controller.initial_states.sample(12, stream(controller.config.seed, FIGURES))
    return {**figures, "trajectories": trajectories(controller.rollout(x0), controller.problem)}

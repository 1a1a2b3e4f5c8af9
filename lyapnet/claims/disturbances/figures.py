"""Figures of regions under disturbances of several sizes: certified volume over w, and level lines."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from lyapnet.base.drawing import BLUE, GREEN, VERMILION, legend_below, to_numpy
from lyapnet.base.types import State, Value
from lyapnet.claims.region import ProvedRegion
from lyapnet.task.sets import Box

GRID = 301  # points along each axis
ULTIMATE = "{V(0, x) ≤ c}, at most: entered, then not left"


def regions(
    disturbances: Sequence[float],
    claims: Sequence[ProvedRegion],
    V: Value,
    initial_states: Box,
    goal: State,
    labels: Sequence[str],
    disturbed: str,
) -> Figure:
    """Certified volume over w; for regions of two states, also {V ≤ ρ} and {V ≤ c} for each w.

    Args:
        disturbances: w of each claim, in increasing order.
        labels: names of the states with their units.
        disturbed: the label of the disturbed state.
    """
    seen = [i for i in range(len(labels)) if i not in claims[0].left_out]
    figure = Figure(figsize=(9.6, 4.6) if len(seen) == 2 else (5.2, 4.2), layout="constrained")
    panels = figure.subplots(1, 2 if len(seen) == 2 else 1, squeeze=False)[0]
    _draw_volumes(panels[0], disturbances, claims, [labels[i] for i in seen], disturbed)
    if len(seen) == 2:
        handles = _draw_levels(panels[1], disturbances, claims, V, initial_states, goal, labels, disturbed)
        legend_below(figure, handles, columns=4)
    return figure


def _draw_volumes(
    panel: Axes, disturbances: Sequence[float], claims: Sequence[ProvedRegion], labels: Sequence[str], disturbed: str
) -> None:
    volumes = [claim.volume for claim in claims]
    ends = [claim.ultimate_volume if claim.is_practical else 0.0 for claim in claims]  # nan is not drawn
    style: dict[str, Any] = {"drawstyle": "steps-pre", "linewidth": 1}  # a claim about w covers smaller disturbances
    panel.plot(disturbances, volumes, "-", color=BLUE, **style, label="{V(0, x) ≤ ρ}, at least: not left")
    panel.plot(disturbances, ends, "s--", color=VERMILION, markersize=4, **style, label=ULTIMATE)
    for w, claim in zip(disturbances, claims, strict=True):
        panel.plot(w, claim.volume, "o" if claim.rho > -math.inf else "x", color=BLUE)
        if claim.rho == -math.inf:
            panel.annotate("none proved", (w, 0), (0, 7), textcoords="offset points", fontsize=7, ha="center")
    name, unit = _parts(disturbed)
    panel.set_xlabel(f"largest disturbance of d({name})/dt, w_max ({_per_second(unit)})")
    panel.set_ylabel(f"certified volume ({' · '.join(_parts(label)[1] for label in labels)})")
    panel.set_ylim(0, 1.25 * max(*volumes, 1e-12))
    panel.margins(x=0.12)
    panel.legend(fontsize=7, frameon=False, loc="upper right")


def _draw_levels(
    panel: Axes, disturbances: Sequence[float], claims: Sequence[ProvedRegion], V: Value, initial_states: Box,
    goal: State, labels: Sequence[str], disturbed: str,
) -> list[Line2D]:  # fmt: skip
    """Draw {V ≤ ρ} as lines, and {V ≤ c} filled with dashed lines; return the handles of the legend."""
    D, unit = claims[0].states, _per_second(_parts(disturbed)[1])
    i, j = (k for k in range(len(labels)) if k not in claims[0].left_out)
    axes = [torch.linspace(float(D.lower[k]), float(D.upper[k]), GRID).to(goal) for k in (i, j)]
    states = goal.repeat(GRID, GRID, 1)
    states[..., i], states[..., j] = torch.meshgrid(*axes, indexing="ij")
    with torch.no_grad():
        value = to_numpy(V(states.new_zeros(GRID, GRID), states)).T
    x, y, handles = to_numpy(axes[0]), to_numpy(axes[1]), []
    colours = colormaps["viridis"](torch.linspace(0.0, 0.85, len(disturbances)).tolist())
    for w, claim, colour in zip(disturbances, claims, colours, strict=True):
        if claim.rho == -math.inf:
            continue
        handles.append(Line2D([], [], color=colour, label=f"w_max = {w:g} {unit}"))
        if value.min() < claim.rho < value.max():
            panel.contour(x, y, value, levels=[claim.rho], colors=[colour], linewidths=1.4)
        if claim.is_practical and value.min() < claim.hole:
            panel.contourf(x, y, value, levels=[value.min() - 1, claim.hole], colors=[colour], alpha=0.15)
            panel.contour(x, y, value, levels=[claim.hole], colors=[colour], linewidths=1.2, linestyles="--")
    panel.plot(*goal[[i, j]].tolist(), "*", color=GREEN, markersize=7)
    corner, widths = initial_states.lower[[i, j]].tolist(), initial_states.widths[[i, j]].tolist()
    panel.add_patch(Rectangle(tuple(corner), *widths, fill=False, edgecolor="black", linestyle=":", linewidth=1))
    panel.set(xlim=x[[0, -1]], ylim=y[[0, -1]], xlabel=labels[i], ylabel=labels[j])
    return [
        *handles,
        Line2D([], [], color="black", label="V(0, x) = ρ: not left"),
        Line2D([], [], color="black", linestyle="--", label="V(0, x) = c: entered, then not left"),
        Line2D([], [], color="black", linestyle=":", label="X₀"),
        Line2D([], [], color=GREEN, marker="*", linestyle="none", label="goal"),
    ]


def _parts(label: str) -> tuple[str, str]:
    """The name and the unit of a label; the unit is 1 if it has none."""
    name, _, unit = label.partition(" (")
    return name, unit.removesuffix(")") or "1"


def _per_second(unit: str) -> str:
    """The unit of the time derivative."""
    return f"{unit}²" if unit.endswith("/s") else f"{unit}/s"

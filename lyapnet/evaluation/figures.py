"""Matplotlib figures of a controller: trajectories, slices of V, the region where its condition holds."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import MaxNLocator
from torch import Tensor

from lyapnet.base.drawing import BLUE, GREEN, GREY, ORANGE, VERMILION, legend_below, to_numpy
from lyapnet.base.types import State, Value
from lyapnet.evaluation.states import StateTable
from lyapnet.loop.programs.terms import hinge, satisfied
from lyapnet.loop.rollout import Trajectory
from lyapnet.task.constraints import StateLimits, parts_of
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box
from lyapnet.task.systems import ControlSystem, moving_states

MOST_PANELS = 12  # largest number of states, and of controls, with a panel in a figure over time
MOST_NAMED = 4  # largest number of other states whose values are written under a slice


class Slice(NamedTuple):
    """A grid in X₀ over its widest components; the other components are at the centre."""

    axes: Sequence[int]  # one or two state indices
    grid: Sequence[Tensor]  # the coordinates along each axis
    states: State  # (b, n), with the last axis varying fastest


def widest_slice(initial_states: Box, points: int) -> Slice:
    """The slice through the centre of X₀ along its two widest components, or along the only free one."""
    axes, widths = widest_axes(initial_states), initial_states.widths
    # midpoints of equal cells: the share of cells equals the share of X₀
    middles = (torch.arange(points).to(widths) + 0.5) / points
    grid = [initial_states.lower[i] + widths[i] * middles for i in axes]
    mesh = torch.meshgrid(*grid, indexing="ij")
    states = initial_states.center.repeat(mesh[0].numel(), 1)
    states[:, axes] = torch.stack([component.flatten() for component in mesh], -1)
    return Slice(axes, grid, states)


def widest_axes(initial_states: Box) -> list[int]:
    """The two widest components of X₀, or the only free one; the first if all are fixed."""
    widths = initial_states.widths
    return sorted(int(i) for i in widths.argsort(descending=True, stable=True)[:2] if widths[i] > 0) or [0]


def certified_region(rollout: Callable[[State], Trajectory], problem: Problem, tolerance: float = 1e-2) -> Figure:
    """The initial states in a slice of X₀ that satisfy the Lyapunov condition along their whole closed loop.

    The condition is that of the paper, at the nodes: Σ_n max(V_{n+1} − V_n + Δt ℓ_n, 0) ≤ tolerance · V(0, x₀). Level
    sets of V(0, ·) and some closed loops are drawn over it. With one free component the sum itself is drawn.
    """
    system, initial_states = problem.system, problem.initial_states
    region = widest_slice(initial_states, 31 if _free_components(initial_states) > 1 else 101)
    with torch.no_grad():
        trajectory = rollout(region.states)
    values = trajectory.require_value()
    violation = hinge(values, trajectory.step_cost)
    holds = satisfied(violation, values[0], tolerance)
    share = float(holds.double().mean())
    figure = Figure(figsize=(5.6, 4.4), layout="constrained")
    axes = figure.subplots()
    axes.set_title(
        f"holds on {share:.1%} of {len(holds)} states: Σₙ max(ΔVₙ + Δt ℓₙ, 0) ≤ {tolerance:.0%} of V(0, x₀)",
        fontsize=8,
    )
    if len(region.axes) == 1:
        _draw_line_region(figure, axes, region, system, violation, values[0], tolerance)
    else:
        _draw_plane_region(figure, axes, region, problem, holds, values[0], trajectory)
    return figure


def _draw_plane_region(
    figure: Figure,
    axes: Axes,
    region: Slice,
    problem: Problem,
    holds: Tensor,
    V0: Tensor,
    trajectory: Trajectory,
) -> None:
    system, initial_states = problem.system, problem.initial_states
    first, second = (to_numpy(g) for g in region.grid)
    shape = (len(first), len(second))
    levels = ["#E8A06A", "#CFE6F3"]  # distinct in greyscale too
    axes.pcolormesh(
        first, second, to_numpy(holds).reshape(shape).T.astype(float), cmap=ListedColormap(levels), vmin=0, vmax=1,
        shading="nearest", rasterized=True,
    )  # fmt: skip
    contour = axes.contour(first, second, to_numpy(V0).reshape(shape).T, levels=8, colors=GREY, linewidths=0.8)
    axes.clabel(
        contour, list(contour.levels)[::2], fontsize=7, fmt="%.3g"
    )  # every second level: labels of neighbours overlap
    axes.use_sticky_edges = False  # keep a margin between X₀ and the frame
    i, j = region.axes
    corners = _spread(region)
    paths = to_numpy(trajectory.x[:, corners])
    axes.plot(paths[..., i], paths[..., j], color=BLUE, linewidth=1)
    axes.plot(paths[0, :, i], paths[0, :, j], "o", color=BLUE, markersize=3)
    if problem.has_goal:
        axes.plot(*problem.goal[[i, j]].tolist(), "*", color=VERMILION, markersize=10)
    (left, bottom), (width, height) = (
        side[region.axes].tolist() for side in (initial_states.lower, initial_states.widths)
    )
    outline = axes.add_patch(
        Rectangle((left, bottom), width, height, fill=False, edgecolor="black", linewidth=0.8, label="X₀")
    )
    axes.set_xlabel(system.state_labels[i])
    axes.set_ylabel(system.state_labels[j])
    axes.set_title(_others_at_center(system, initial_states, region.axes), fontsize=7, loc="right", y=-0.2, color=GREY)
    handles: list[Artist] = [
        outline,
        Patch(color=levels[1], label="holds"),
        Patch(color=levels[0], label="does not hold"),
    ]
    handles += axes.plot([], [], color=GREY, linewidth=0.8, label="level sets of V(0, x)")
    handles += axes.plot([], [], color=BLUE, linewidth=1, label="closed loop")
    handles += axes.plot([], [], "*", color=VERMILION, label="goal")
    legend_below(figure, handles, columns=6)


def _draw_line_region(
    figure: Figure,
    axes: Axes,
    region: Slice,
    system: ControlSystem,
    violation: Tensor,
    V0: Tensor,
    tolerance: float,
) -> None:
    x = to_numpy(region.grid[0])
    relative = torch.where(V0 > 0, violation / V0, torch.inf)
    axes.semilogy(x, np.clip(to_numpy(relative), 1e-9, 1e9), color=BLUE, label="summed violation / V(0, x₀)")
    axes.axhline(tolerance, color=VERMILION, linestyle="--", linewidth=1, label="tolerance")
    axes.set_xlabel(system.state_labels[region.axes[0]])
    axes.set_ylabel("summed violation / V(0, x₀)", color=BLUE)
    twin = axes.twinx()
    twin.plot(x, to_numpy(V0), color=ORANGE, linestyle="-.", label="V(0, x₀)")
    twin.set_ylabel("V(0, x₀) (cost)", color=ORANGE)
    legend_below(figure, [*axes.get_legend_handles_labels()[0], *twin.get_legend_handles_labels()[0]], columns=3)


def states_and_controls_to_draw(system: ControlSystem) -> tuple[list[int], list[int]]:
    """The indices of the first MOST_PANELS states that move, and of the first MOST_PANELS controls."""
    return moving_states(system)[:MOST_PANELS], list(range(system.m))[:MOST_PANELS]


def name_panels_left_out(figure: Figure, system: ControlSystem) -> None:
    """Write above a figure how many states and controls there are, if some have no panel."""
    states = len(moving_states(system))
    if max(states, system.m) > MOST_PANELS:
        figure.suptitle(f"at most {MOST_PANELS} of {states} states and of {system.m} controls", fontsize=9)


def trajectories(trajectory: Trajectory, problem: Problem) -> Figure:
    """States, controls and their limits, V and the cost to go over time, for a batch (b,) of closed loops.

    Dotted lines are the goals, or references, and the controls at rest. Parameters of a family have no panel.
    """
    system, to_go = problem.system, trajectory.cost - trajectory.running_cost
    t = to_numpy(trajectory.t)
    drawn, controls = states_and_controls_to_draw(system)
    goals, rests = trajectory.x - problem.cost.from_goal(trajectory.x), problem.rest_at(trajectory.x[:-1])
    rests = problem.controls.moved(trajectory.x[:-1], rests)
    wanted = [to_numpy(goals[..., i]) if problem.has_goal else None for i in drawn]
    wanted += [to_numpy(rests[..., i]) for i in controls]
    curves = [(system.state_labels[i], to_numpy(trajectory.x[..., i]), BLUE) for i in drawn]
    curves += [(system.control_labels[i], to_numpy(trajectory.u[..., i]), GREEN) for i in controls]
    columns = _columns(len(curves) + 1)
    rows = -(-(len(curves) + 1) // columns)
    figure = Figure(figsize=(3.6 * columns, 1.3 * rows + 0.4), layout="constrained")  # fits a page without scaling
    grid = figure.subplots(rows, columns, sharex=True, squeeze=False)
    panels = list(grid.flatten(order="F"))
    for panel, (label, values_over_time, color), goal in zip(panels, curves, wanted, strict=False):
        panel.plot(t[: len(values_over_time)], values_over_time, color=color, linewidth=0.9)
        if goal is not None and np.ptp(goal) <= 1e-9 * (1 + abs(goal).max()):
            panel.axhline(goal.flat[0], color=GREY, linewidth=0.6, linestyle=":")
        elif goal is not None:  # each member of a family has its own, and a reference moves
            panel.plot(t[: len(goal)], goal, color=GREY, linewidth=0.6, linestyle=":")
        panel.set_ylabel(label.replace(" (", "\n("), fontsize=8)
    for part in parts_of(problem.constraints):
        if isinstance(part, StateLimits):
            for i, height in zip(part.states.tolist(), part.limits.tolist(), strict=True):
                if i in drawn:
                    panels[drawn.index(i)].axhline(height, color=VERMILION, linewidth=0.9, linestyle="--")
    for limit in problem.controls.limits_at(trajectory.x[:-1]) or ():
        paths = to_numpy(limit.expand(*limit.shape[:-1], system.m)[..., controls])
        for k, panel in enumerate(panels[len(drawn) : len(curves)]):
            if paths.ndim > 1:  # limits that depend on the state
                panel.plot(t[:-1], paths[..., k], color=GREY, linewidth=0.5, linestyle="--")
            elif math.isfinite(paths[k]):
                panel.axhline(paths[k], color=GREY, linewidth=0.9, linestyle="--")
    last = panels[len(curves)]
    for name, paths, style in (
        ("cost to go", to_go, {"color": ORANGE}),
        ("V(t, x)", trajectory.require_value(), {"color": BLUE, "ls": "--"}),
    ):
        lines = last.plot(t, to_numpy(paths), linewidth=0.9, **style)
        lines[0].set_label(name)
    last.set_ylabel("cost", fontsize=8)
    last.legend(fontsize=7, frameon=False)
    for spare in panels[len(curves) + 1 :]:
        spare.set_visible(False)
    for panel in panels:
        panel.tick_params(labelsize=7)
    name_panels_left_out(figure, system)
    for column in grid.T:
        lowest = [panel for panel in column if panel.get_visible()][-1]
        lowest.set_xlabel("time (s)", fontsize=8)
        lowest.tick_params(labelbottom=True)
    return figure


def _columns(panels: int) -> int:
    """The number of columns: 1 for a few panels; else 2 or 3, whichever leaves fewer empty places."""
    return 1 if panels < 5 else min((2, 3), key=lambda columns: (-panels % columns, abs(columns - panels / 4)))


def value_slices(V: Value, problem: Problem) -> Figure:
    """V(t, ·) on a slice of X₀ at the start, the middle and near the end of the horizon; a stationary V once.

    Each time has its own colour scale, because V may change by orders of magnitude.
    """
    system, initial_states, duration = problem.system, problem.initial_states, problem.horizon.duration
    region = widest_slice(initial_states, 61)
    stationary = problem.horizon.stationary
    times = [0.0] if stationary else [0.0, duration / 2, 0.95 * duration]
    with torch.no_grad():
        values = [V(torch.tensor(t).to(region.states), region.states) for t in times]
    figure = Figure(figsize=(4.2 if stationary else 10.5, 3.1), layout="constrained")
    if len(region.axes) == 1:
        axes = figure.subplots()
        for t, value, color in zip(times, values, (BLUE, ORANGE, GREEN)[: len(times)], strict=True):
            axes.plot(to_numpy(region.grid[0]), to_numpy(value), color=color, label=f"t = {t:.2f} s")
        axes.set_xlabel(system.state_labels[region.axes[0]])
        axes.set_ylabel(f"{'V(x)' if stationary else 'V(t, x)'} (cost)")
        if not stationary:
            axes.legend(frameon=False)
        return figure
    first, second = (to_numpy(g) for g in region.grid)
    panels = figure.subplots(1, len(times), sharey=True, squeeze=False)[0]
    surfaces = [to_numpy(value).reshape(len(first), len(second)).T for value in values]
    for panel, t, surface in zip(panels, times, surfaces, strict=True):
        filled = panel.contourf(first, second, surface, levels=_levels(surface), cmap="cividis")
        figure.colorbar(filled, ax=panel, label="V (cost)" if panel is panels[-1] else "")
        panel.set_title("V(x)" if stationary else f"V(t, x) at t = {t:.2f} s", fontsize=9)
        panel.set_xlabel(system.state_labels[region.axes[0]])
    panels[0].set_ylabel(system.state_labels[region.axes[1]])
    return figure


def _levels(values: np.ndarray) -> list[float]:
    """About 20 round levels between the smallest and the largest finite value."""
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    return list(MaxNLocator(20).tick_values(low, high if high > low else low + 1.0))


def optimality(table: StateTable) -> Figure:
    """Cost and V(0, x₀) of each initial state over its optimal cost, with the line of equality."""
    assert table.optimal_cost is not None
    known = torch.isfinite(table.optimal_cost)
    optimal = to_numpy(table.optimal_cost[known])
    figure = Figure(figsize=(8.6, 4.3), layout="constrained")
    panels = figure.subplots(1, 2)
    measured = (("J(x₀), closed loop (cost)", table.cost, BLUE, "o"), ("V(0, x₀) (cost)", table.value, VERMILION, "^"))
    for panel, (label, values, color, marker) in zip(panels, measured, strict=True):
        y = to_numpy(values[known])
        ends = [min(optimal.min(), y.min()), max(optimal.max(), y.max())]
        panel.plot(ends, ends, color=GREY, linewidth=0.9, label="equal to the optimum")
        panel.plot(optimal, y, marker, color=color, markersize=3.5, alpha=0.6, label="an initial state")
        panel.set_xlabel("optimum J*(x₀) (cost)")
        panel.set_ylabel(label)
        panel.grid(color=GREY, alpha=0.25, linewidth=0.5)
        panel.legend(frameon=False, fontsize=8)
    left_out = f", {len(known) - len(optimal)} without optimum left out" if len(optimal) < len(known) else ""
    summary = table.against_optimum()
    if table.has_goal:
        titles = f"cost / optimum, ratio of the means: {summary['cost_ratio']:.4f}", "mean |V(0, x₀) − J*| / mean J*"
    else:
        titles = f"mean (J − J*) / spread of J*: {summary['regret']:.2%}", "mean |V(0, x₀) − J*| / spread of J*"
    panels[0].set_title(titles[0], fontsize=9)
    panels[1].set_title(f"{titles[1]}: {summary['value_error']:.1%}", fontsize=9)
    figure.suptitle(f"{len(optimal)} initial states{left_out}", fontsize=9)
    return figure


def _others_at_center(system: ControlSystem, initial_states: Box, axes: Sequence[int]) -> str:
    center, others = initial_states.center.tolist(), [i for i in range(system.n) if i not in axes]
    if len(others) > MOST_NAMED:
        return "the other states at the centre of X₀"
    return ", ".join(f"{system.state_names[i]} = {center[i]:.3g}" for i in others)


def _spread(region: Slice) -> list[int]:
    """Flat indices of a few states on the border and in the middle of a slice."""
    a, b = (len(g) - 1 for g in region.grid)
    places = [(0, 0), (0, b), (a, 0), (a, b), (0, b // 2), (a, b // 2), (a // 2, 0), (a // 2, b)]
    return [i * (b + 1) + j for i, j in places]


def _free_components(box: Box) -> int:
    return int((box.widths > 0).sum())

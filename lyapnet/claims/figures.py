"""Certificates drawn as matplotlib figures: sampled states, two bounds, and slices of funnels and regions."""

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from torch import Tensor

from lyapnet.base.drawing import BLUE, GREEN, GREY, ORANGE, PURPLE, SKY, VERMILION, legend_below, to_numpy
from lyapnet.base.types import State, Value
from lyapnet.claims.funnel import ProvedFunnel
from lyapnet.claims.reach import ProvedReach
from lyapnet.claims.region import ProvedRegion
from lyapnet.claims.statistical import CountedSuccesses
from lyapnet.claims.tables import floored
from lyapnet.evaluation.figures import widest_axes
from lyapnet.prover.counterexamples import Counterexample
from lyapnet.task.constraints import Constraints
from lyapnet.task.sets import Box

Sliced = ProvedFunnel | ProvedRegion | ProvedReach  # claims that are drawn in slices

NEAR = 0.02  # distance from a slice, relative to D's widths, up to which a counterexample is drawn as a point of it


# Sampled states


def sampled_states(claim: CountedSuccesses, initial_states: Box, labels: Sequence[str], headline: str) -> Figure:
    """The sampled states of X₀ by their outcome, projected onto the plane of the two widest components of X₀.

    If only one component has a width, they are drawn as a histogram.

    Args:
        labels: names of the states with their units.
        headline: the claim in a few words.
    """
    axes = widest_axes(initial_states)
    figure = Figure(figsize=(5.6, 4.6), layout="constrained")
    panel = figure.subplots()
    parts = _outcomes(claim)
    if len(axes) == 1:
        x = [to_numpy(states[:, axes[0]]) for states, _, _, _ in parts]
        low, high = (float(side[axes[0]]) for side in (initial_states.lower, initial_states.upper))
        colours = [colour for _, _, colour, _ in parts]
        panel.hist(x, 40, range=(low, high) if high > low else None, stacked=True, color=colours)
        panel.set_ylabel("states")
    else:
        size = 2 + 60 / len(claim.states) ** 0.5
        for states, _, colour, marker in parts:
            x, y = (to_numpy(states[:, i]) for i in axes)
            panel.plot(
                x, y, marker, color=colour, markersize=size if marker == "." else 4, markeredgewidth=0.8,
                alpha=0.5 if marker == "." else 0.9, rasterized=True,
            )  # fmt: skip
        panel.add_patch(_rectangle(initial_states, axes, linewidth=0.8))
        panel.set_ylabel(labels[axes[1]])
    panel.set_xlabel(labels[axes[0]])
    shape = "s" if len(axes) == 1 else None
    handles = [
        Line2D([], [], color=colour, marker=shape or marker, linestyle="none", label=f"{name}: {len(states)}")
        for states, name, colour, marker in parts
    ]
    legend_below(figure, handles, columns=2)
    hidden = [_name(labels[i]) for i in range(len(labels)) if initial_states.widths[i] > 0 and i not in axes]
    projected = f"\nprojected along {', '.join(hidden)}" if hidden else ""
    panel.set_title(f"{headline}{projected}", fontsize=8)
    return figure


def _outcomes(claim: CountedSuccesses) -> list[tuple[Tensor, str, str, str]]:
    """(states, outcome, colour, marker) for each outcome; successes come first, so that failures are drawn over them.

    A state that fails in several ways is counted for the first of them.
    """
    decrease, terminal, cost, constraints, success = claim.held.unbind(-1)
    parts, remaining = [(claim.states[success], "success", SKY, ".")], ~success
    limits = claim.tolerances
    failed = (
        ("violates a constraint", GREY, "D"),
        (f"‖x(T)‖ > {limits.radius}", PURPLE, "v"),
        ("V does not fall", ORANGE, "s"),
        (f"J > {1 + limits.cost:g} V(0, x₀)", VERMILION, "x"),
    )
    for style, held in zip(failed, (constraints, terminal, decrease, cost), strict=True):
        parts.append((claim.states[remaining & ~held], *style))
        remaining = remaining & held
    return [part for part in parts if len(part[0])]


# Funnels


def funnel(
    claim: ProvedFunnel,
    V: Value,
    initial_states: Box,
    goal: State,
    labels: Sequence[str],
    constraints: Constraints | None = None,
) -> Figure:
    """The proved funnel {V(t, ·) ≤ ρ + δt} with X₀, D, the counterexample and the undecided boxes.

    A funnel of one state is drawn over time, and one of two states at five times. A funnel of more states is drawn at
    t = 0 and t = T in slices through the goal: one slice for each pair of the four widest states of X₀, with the other
    states at the goal. Ignorable states are not shown.

    Args:
        labels: names of the states with their units.
        constraints: the states that they exclude are hatched.
    """
    seen = _shown_states(claim)
    figure, panels = _panels_of(claim, initial_states)
    handles: dict[str, Artist] = {}
    for panel, pair in panels:
        if len(seen) == 1:
            _draw_over_time(panel, claim, V, initial_states, labels[0], handles)
        else:
            levels = _levels(claim, fine=len(seen) == 2)
            _draw_slice(panel, claim, V, initial_states, goal, labels, pair, levels, handles, constraints)
            _draw_violation(panel, claim, pair, handles)
    legend_below(figure, [*handles.values()], columns=2 if len(panels) == 1 else 4)
    amount = "all" if claim.volume_share == 1 else floored(claim.volume_share)
    share = f"{amount} of X₀ in the funnel" if claim.volume_share else "no funnel proved"
    figure.suptitle(f"{claim.verdict}: {share}, α = {claim.alpha:g}, δ = {claim.delta:.3g}", fontsize=9)
    return figure


# Regions of attraction


def region(
    claim: ProvedRegion,
    V: Value,
    initial_states: Box,
    goal: State,
    labels: Sequence[str],
    constraints: Constraints | None = None,
    paths: Tensor | None = None,
) -> Figure:
    """The proved region {V(0, ·) ≤ ρ} in D with X₀, the counterexample and the undecided boxes.

    More than two states are drawn in slices through the goal, like a funnel.

    Args:
        labels, constraints: as in funnel.
        paths: closed loops that begin in the region, (times, k, n), for a region of two states.
    """
    figure, panels = _panels_of(claim, initial_states)
    handles: dict[str, Artist] = {}
    levels = _levels_of_region(claim)
    for panel, pair in panels:
        if len(_shown_states(claim)) == 1:
            _draw_over_state(panel, claim, V, initial_states, goal, labels, levels, handles)
            continue
        _draw_slice(panel, claim, V, initial_states, goal, labels, pair, levels, handles, constraints)
        if paths is not None:
            x, y = (to_numpy(paths[..., k]) for k in pair)
            name = f"closed loops under u(0, x){', undisturbed' if claim.disturbance is not None else ''}"
            name += "" if claim.plants is None else ", each of another plant"
            line, *_ = panel.plot(x, y, color=GREY, linewidth=0.7, label=name)
            handles.setdefault("closed loops", line)
    legend_below(figure, [*handles.values()], columns=2 if len(panels) == 1 else 4)
    what = "invariant region" if claim.is_practical else "region of attraction"
    what += "" if claim.disturbance is None else " under disturbances"
    what += "" if claim.plants is None else " of each plant"
    share = f"{floored(claim.region_share)} of D, {floored(claim.volume_share)} of X₀ in the {what}"
    proved = claim.rho > -float("inf")
    figure.suptitle(f"{claim.verdict}: {share if proved else 'no region proved'}", fontsize=9)
    return figure


def _draw_over_state(
    panel: Axes, claim: ProvedRegion, V: Value, initial_states: Box, goal: State, labels: Sequence[str],
    levels: Sequence["Level"], handles: dict[str, Artist],
) -> None:  # fmt: skip
    """V(0, ·) over the only state, with levels and X₀."""
    (i,) = _shown_states(claim)
    states = goal.repeat(401, 1)
    states[:, i] = torch.linspace(float(claim.states.lower[i]), float(claim.states.upper[i]), 401).to(goal)
    with torch.no_grad():
        x, value = to_numpy(states[:, i]), to_numpy(V(states.new_zeros(401), states))
    handles["V"] = panel.plot(x, value, color="black", linewidth=1.2, label="V(0, x)")[0]
    for _, level, colour, name, proved in levels:
        handles[name] = panel.axhline(level, color=colour, linestyle="-" if proved else ":", label=name)
        if proved:
            panel.fill_between(x, value, level, where=(value <= level).tolist(), color=colour, alpha=0.25)
    ends = [float(initial_states.lower[i]), float(initial_states.upper[i])]
    handles["X₀"] = panel.plot(ends, [0, 0], color="black", linewidth=4, label="X₀", clip_on=False)[0]
    panel.set(xlim=x[[0, -1]], xlabel=labels[i], ylabel="V(0, x)")


def _levels_of_region(claim: ProvedRegion) -> list["Level"]:
    """The levels to draw: ρ; c of a practical claim; and the level for all of X₀, if it is higher than ρ."""
    name = "V(0, x) ≤ ρ: never left" + ("" if claim.is_practical else ", and attracted")
    proved = [Level(0.0, claim.rho, BLUE, name, proved=True)] if claim.rho > -float("inf") else []
    if proved and claim.is_practical:
        proved += [Level(0.0, claim.hole, ORANGE, "V(0, x) ≤ c: entered, then never left", proved=True)]
    wanted = Level(0.0, claim.wanted, GREY, "V(0, x) ≤ ρ for all of X₀, not proved", proved=False)
    return proved + ([wanted] if claim.rho < claim.wanted < float("inf") else [])


# Targets


def reach(
    claim: ProvedReach,
    V: Value,
    initial_states: Box,
    goal: State,
    labels: Sequence[str],
    constraints: Constraints | None = None,
    paths: Sequence[Tensor] = (),
) -> Figure:
    """{V(0, ·) ≤ ρ} with X₀, the target, the boxes to avoid and closed loops under noise.

    Args:
        labels, constraints: as in funnel.
        paths: closed loops, (times, n) each, until they are in the target.
    """
    figure, panels = _panels_of(claim, initial_states)
    handles: dict[str, Artist] = {}
    proved = claim.rho > -float("inf")
    name = f"V(0, x) ≤ ρ: left before the target with probability ≤ {1 - claim.probability:.3g} from X₀"
    levels = [Level(0.0, claim.rho, BLUE, name if claim.verdict == "certified" else "V(0, x) ≤ ρ", proved=proved)]
    if claim.verdict != "certified":
        wanted = Level(0.0, claim.wanted, GREY, "V(0, x) ≤ ρ for all of X₀, not proved", proved=False)
        levels = [*levels[:proved], wanted]
    for panel, pair in panels:
        for k, path in enumerate(paths):
            x, y = (to_numpy(path[:, i]) for i in pair)
            (line,) = panel.plot(x, y, color=GREY, linewidth=0.7, label="closed loops under noise")
            if not k:
                handles.setdefault("closed loops", line)
        _draw_slice(panel, claim, V, initial_states, goal, labels, pair, levels, handles, constraints)
        style = {"edgecolor": GREEN, "facecolor": GREEN, "alpha": 0.25, "fill": True}
        handles.setdefault("target", panel.add_patch(_rectangle(claim.target, pair, label="target", **style)))
        for box in claim.avoided:
            style = {"edgecolor": VERMILION, "hatch": "////", "label": "to avoid"}
            handles.setdefault("to avoid", panel.add_patch(_rectangle(box, pair, **style)))
    legend_below(figure, [*handles.values()], columns=2 if len(panels) == 1 else 4)
    share = f"the target is reached with probability ≥ {claim.probability!r} from {floored(claim.volume_share)} of X₀"
    figure.suptitle(f"{claim.verdict}: {share if proved else 'no level proved'}", fontsize=9)
    return figure


# Two sides


def two_sided(
    value: Tensor, guaranteed: Tensor | None, least: Tensor, optimum: Tensor | None, headline: str,
    whose: str = "any control",
) -> Figure:  # fmt: skip
    """Both bounds of the cost divided by V(0, x₀), over V(0, x₀), with the optima.

    Args:
        value, guaranteed, least: V(0, x₀) and the two bounds for some states, (k,); None without a bound from above.
        optimum: the optimal costs of the first of these states.
        whose: the controls for which the bound from below holds.
    """
    figure = Figure(figsize=(5.6, 4.2), layout="constrained")
    panel = figure.subplots()
    order = value.argsort()
    order = order[(value > 0)[order] & least.isfinite()[order]]
    V, upper, lower = (to_numpy(y[order]) for y in (value, value if guaranteed is None else guaranteed, least))
    if guaranteed is not None:
        panel.fill_between(V, lower / V, upper / V, color=BLUE, alpha=0.15, linewidth=0)
        panel.plot(V, upper / V, color=BLUE, linewidth=1.2, label="guaranteed: the controller costs at most")
    panel.plot(V, lower / V, color=VERMILION, linewidth=1.2, label=f"least: {whose} costs at least")
    if optimum is not None:
        first = order[order < len(optimum)]
        some, best = to_numpy(value[first]), to_numpy(optimum[first])
        panel.plot(some, best / some, ".", color="black", markersize=3, label="optimum of the steps of Δt")
    panel.axhline(1, color=GREY, linewidth=0.6)
    middle = len(V) // 4  # states of smaller V, where δT and κ dominate the bounds, may lie outside of the picture
    if len(V):
        panel.set_ylim(min(0.9, lower[middle] / V[middle]), max(1.1, upper[middle] / V[middle]))
        panel.set_xlim(0, V[-1])
    panel.set(xlabel="V(0, x₀)", ylabel="cost / V(0, x₀)")
    panel.set_title(headline, fontsize=8)
    legend_below(figure, panel, columns=2)
    return figure


def margins(t: Tensor, c: Tensor, found: Counterexample | None, headline: str) -> Figure:
    """c at random points (t, x) over time, the limit 0, and the counterexample if there is one."""
    figure = Figure(figsize=(5.6, 4.2), layout="constrained")
    panel = figure.subplots()
    panel.plot(to_numpy(t), to_numpy(c), ".", color=BLUE, markersize=2, rasterized=True)
    panel.axhline(0, color=GREY, linewidth=0.8)
    if found is not None:
        panel.plot(found.t, found.condition, "x", color=VERMILION)
    panel.set(xlabel="t (s)", ylabel="c(t, x), at most 0 where the claim holds")
    panel.set_title(headline, fontsize=8)
    return figure


# Sliced


class Level(NamedTuple):
    """A sublevel set of V(t, ·) to draw."""

    t: float
    level: float
    colour: str
    name: str
    proved: bool


def _shown_states(claim: Sliced) -> list[int]:
    """The indices of the states that are not ignorable."""
    return [k for k in range(claim.states.dimension) if k not in claim.left_out]


def _panels_of(claim: Sliced, initial_states: Box) -> tuple[Figure, list[tuple[Axes, tuple[int, int]]]]:
    """A figure with one panel for each pair of states to show."""
    seen = _shown_states(claim)
    pairs = [(seen[0], seen[-1])] if len(seen) <= 2 else list(combinations(_widest_states(initial_states, seen), 2))
    columns = min(3, len(pairs))
    rows = -(-len(pairs) // columns)
    size = (5.6, 5.2) if len(pairs) == 1 else (3.6 * columns, 3.1 * rows + 0.7)
    figure = Figure(figsize=size, layout="constrained")
    return figure, list(zip(figure.subplots(rows, columns, squeeze=False).flat, pairs, strict=True))


def _draw_slice(
    panel: Axes, claim: Sliced, V: Value, initial_states: Box, goal: State, labels: Sequence[str],
    pair: tuple[int, int], levels: Sequence[Level], handles: dict[str, Artist], constraints: Constraints | None,
) -> None:  # fmt: skip
    """Draw one slice, and add new entries to the handles of the legend."""
    i, j = pair
    others = [k for k in range(len(labels)) if k not in (*pair, *claim.left_out)]
    grid = [torch.linspace(float(claim.states.lower[k]), float(claim.states.upper[k]), 201) for k in pair]
    states = goal.repeat(201, 201, 1)
    states[..., i], states[..., j] = torch.meshgrid(*(axis.to(states) for axis in grid), indexing="ij")
    axes = [to_numpy(axis) for axis in grid]
    for t, level, colour, name, proved in levels:
        with torch.no_grad():
            excess = to_numpy(V(states.new_tensor(t).expand(201, 201), states) - level).T
        _draw_sublevel(panel, axes, excess, colour, filled=proved and not t, style="-" if proved else ":")
        handles.setdefault(name, Line2D([], [], color=colour, linestyle="-" if proved else ":", label=name))
    if constraints is not None:
        _draw_excluded(panel, axes, to_numpy(constraints.worst(states)).T, handles)
    through = bool(((initial_states.lower <= goal) & (initial_states.upper >= goal))[others].all())
    name = "X₀" if through else "X₀, projected"
    box = panel.add_patch(_rectangle(initial_states, pair, linestyle="--" if through else ":", label=name))
    handles.setdefault(name, box)
    if len(claim.undecided):
        name = "undecided, some of it" + (" (projected onto the slice)" if others else "")
        x, y = (to_numpy(claim.undecided[:, 1 + k]) for k in pair)
        (points,) = panel.plot(x, y, ".", color=GREY, markersize=2, alpha=0.5, label=name, linestyle="none")
        handles.setdefault(name, points)
    if claim.counterexample is not None:
        _draw_counterexample(panel, claim.counterexample, claim.states, goal, pair, handles)
    (star,) = panel.plot(*goal[[i, j]].tolist(), "*", color=GREEN, markersize=6, label="goal", linestyle="none")
    handles.setdefault("goal", star)
    panel.set(xlim=axes[0][[0, -1]], ylim=axes[1][[0, -1]], xlabel=labels[i], ylabel=labels[j])
    if others:
        panel.set_title(f"slice: {_fixed_values([_name(labels[k]) for k in others], goal[others])}", fontsize=8)


def _draw_excluded(panel: Axes, grid: Sequence[np.ndarray], worst: np.ndarray, handles: dict[str, Artist]) -> None:
    """Hatch {x: some h_j(x) > 0}."""
    if worst.max() > 0:
        levels = [0, max(1.0, 2 * float(worst.max()))]
        panel.contourf(*grid, worst, levels=levels, colors=["none"], hatches=["////"])
        panel.contour(*grid, worst, levels=[0], colors=["black"], linewidths=0.8)
        name = "excluded by a constraint"
        handles.setdefault(name, Patch(facecolor="none", edgecolor="black", hatch="////", label=name))


def _draw_violation(panel: Axes, claim: ProvedFunnel, pair: tuple[int, int], handles: dict[str, Artist]) -> None:
    """Mark the initial state of a closed loop that violates a constraint."""
    if claim.violation is not None:
        name = f"a closed loop from here violates one, t = {claim.violation.t:.3g} s"
        x, y = (claim.violation.x0[k] for k in pair)
        (point,) = panel.plot(x, y, "P", color=VERMILION, markersize=6, label=name, linestyle="none")
        handles.setdefault(name, point)


def _levels(claim: ProvedFunnel, fine: bool) -> list[Level]:
    """The funnel at some times; and the level for all of X₀, if it is higher than ρ."""
    times = zip((0.0, 0.25, 0.5, 0.75, 1.0), (BLUE, SKY, GREEN, ORANGE, PURPLE), strict=True)
    at = [(share * claim.duration, colour) for share, colour in times if fine or share in (0, 1)]
    funnel = [
        Level(t, claim.level(t), colour, f"V(t, ·) ≤ {claim.formula} at t = {t:.3g} s", proved=True) for t, colour in at
    ]
    wanted = Level(0.0, claim.wanted, GREY, "V(0, ·) ≤ ρ for all of X₀, not proved", proved=False)
    return (funnel if claim.volume_share else []) + ([wanted] if claim.rho < claim.wanted < float("inf") else [])


def _draw_sublevel(
    panel: Axes, grid: Sequence[np.ndarray], excess: np.ndarray, colour: str, filled: bool, style: str = "-"
) -> None:
    """Draw the set {excess ≤ 0}."""
    if filled and excess.min() <= 0:
        panel.contourf(*grid, excess, levels=[excess.min() - 1, 0], colors=[colour], alpha=0.25)
    if excess.min() < 0 < excess.max():  # otherwise there is no line, and matplotlib warns
        panel.contour(*grid, excess, levels=[0], colors=[colour], linewidths=1.2, linestyles=style)


def _draw_over_time(
    panel: Axes, claim: ProvedFunnel, V: Value, initial_states: Box, label: str, handles: dict[str, Artist]
) -> None:
    low, high = float(claim.states.lower[0]), float(claim.states.upper[0])
    t, x = (torch.linspace(*ends, 201).to(initial_states.lower) for ends in ((0, claim.duration), (low, high)))
    if claim.volume_share:
        with torch.no_grad():
            levels = t.new_tensor([claim.level(each) for each in t.tolist()])
            excess = V(t[None].expand(201, 201), x[:, None, None].expand(201, 201, 1)) - levels
        _draw_sublevel(panel, [to_numpy(t), to_numpy(x)], to_numpy(excess), BLUE, filled=True)
        handles["funnel"] = Patch(color=BLUE, alpha=0.4, label=f"V(t, ·) ≤ {claim.formula}")
    ends = [float(initial_states.lower[0]), float(initial_states.upper[0])]
    handles["X₀"] = panel.plot([0, 0], ends, color="black", linewidth=4, label="X₀", clip_on=False)[0]
    if (found := claim.counterexample) is not None:
        name = "condition fails"
        handles[name] = panel.plot(found.t, found.x[0], "x", color=VERMILION, label=name, linestyle="none")[0]
    panel.set(xlim=(0, claim.duration), ylim=(low, high), xlabel="time (s)", ylabel=label)


def _fixed_values(names: Sequence[str], values: State) -> str:
    """The values of the states that a slice does not show, such as "a = b = 0" or "a = 1, b = 2"."""
    if not values.any():
        return f"{' = '.join(names)} = 0"
    return ", ".join(f"{name} = {value:.3g}" for name, value in zip(names, values.tolist(), strict=True))


def _draw_counterexample(
    panel: Axes, found: Counterexample, states: Box, goal: State, pair: tuple[int, int], handles: dict[str, Artist]
) -> None:
    """Mark the counterexample: filled near the slice, hollow if only its projection lies in it."""
    widths, distances = states.widths.tolist(), (torch.tensor(found.x).to(goal) - goal).abs().tolist()
    near = all(distance <= NEAR * widths[k] for k, distance in enumerate(distances) if k not in pair)
    name = f"condition fails, t = {found.t:.3g} s" + ("" if near else " (projected onto the slice)")
    style = {"markerfacecolor": VERMILION if near else "none", "color": VERMILION, "markersize": 6}
    (point,) = panel.plot(found.x[pair[0]], found.x[pair[1]], "X", label=name, linestyle="none", **style)
    handles.setdefault(name, point)


def _widest_states(initial_states: Box, seen: Sequence[int]) -> list[int]:
    """The four widest states of X₀ among `seen`, in their order."""
    widest = initial_states.widths.argsort(descending=True, stable=True).tolist()
    return sorted([i for i in widest if i in seen][:4])


def _rectangle(box: Box, axes: Sequence[int], **style) -> Rectangle:
    (left, bottom), (width, height) = (side[list(axes)].tolist() for side in (box.lower, box.widths))
    style = {"fill": False, "edgecolor": GREY if "label" not in style else "black", **style}
    return Rectangle((left, bottom), width, height, **style)


def _name(label: str) -> str:
    """A label without its unit."""
    return label.partition(" (")[0]

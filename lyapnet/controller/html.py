"""The display of a controller in notebooks: a table of its properties, and a small drawing of closed loops.

HTML with an inline SVG, without a script. Text and axes take the colour of the page, so that dark pages show them too.
Names come from users' files, so every text is escaped.
"""

import math
import shlex
import time
from collections.abc import Sequence
from html import escape
from typing import Any, NamedTuple

import numpy as np
import torch

from lyapnet.base.errors import one_line
from lyapnet.controller.origin import number_in
from lyapnet.experiment.assembly import own_parts
from lyapnet.loop.programs import LyapunovProgram
from lyapnet.task.constraints import names_of
from lyapnet.task.systems import moving_states

SECONDS = 1.0  # largest computing time of closed loops that are drawn
MOST_LINES = 8  # largest number of states, and of controls, in the table
MOST_PANELS = 4  # largest number of panels of states, and of controls
COLUMNS, WIDTH, HEIGHT = 4, 190, 130  # panels beside each other; size of a panel in pixels
LEFT, RIGHT, TOP, BOTTOM = 46, 8, 18, 18  # margins of a panel in pixels
MOST_POINTS = 80  # largest number of points of a curve
STATES, CONTROLS, VALUE = "steelblue", "seagreen", "peru"  # legible on white and on black


def controller_as_html(controller: Any) -> str:
    """The table and the drawing of a Controller; where the parts of users fail, a sentence in its place."""
    html = []
    for what, part in (("table", _table_of), ("drawing of closed loops", _drawing)):
        try:
            html.append(part(controller))
        except Exception as error:  # users' code may raise anything, and a display must not fail
            html.append(_note(f"There is no {what}: {type(error).__name__}: {one_line(error)}"))
    return "".join(html)


def loop_as_html(loop: Any) -> str:
    """The table of an OutputFeedback."""
    outputs = loop.outputs
    readings = zip(outputs.names, outputs.units, outputs.noise.tolist(), strict=True)
    rows = [
        ("system", [loop.problem.system.title]),
        ("readings", _first([f"{name} ± {_number(s)} {unit}".rstrip() for name, unit, s in readings])),
        ("estimator", [f"{type(loop.filter).__name__} of {', '.join(loop.problem.system.state_names)}"]),
        ("time", [f"t = {_number(loop.t)} s, a call of step(y) in each {_number(loop.problem.horizon.dt)} s"]),
    ]
    if loop.delay:
        rows.append(("dead time", [f"{loop.delay} steps from readings to the control they lead to"]))
    return _table(type(loop).__name__, rows)


def _table_of(controller: Any) -> str:
    """A table of a controller: system, X₀, controls, horizon, V, and its training."""
    problem, system, horizon = controller.problem, controller.system, controller.horizon
    box, goal = controller.initial_states, controller.cost.goal
    ends = zip(system.state_labels, box.lower.tolist(), box.upper.tolist(), strict=True)
    known = ", ".join(f"{name} = {value}" for name, value in controller.parameters.items())
    rows = [
        ("system", [f"{system.title}: {known}" if known else system.title]),
        ("X₀", _first([f"{label} {_interval(low, high)}" for label, low, high in ends])),
    ]
    if goal is not None and not system.constants:
        entries = zip(system.state_labels, goal.tolist(), strict=True)
        rows.append(("goal", _first([f"{label} = {_number(entry)}" for label, entry in entries])))
    rows += [
        ("controls", _controls(controller)),
        ("horizon", [f"{horizon.steps} steps of {_number(horizon.dt)} s ({controller.method})" + (
            ", then the same law: the task has no end" if horizon.stationary else "")]),
        ("V and law", [f"{type(controller.V).__name__}, {type(controller.closed_loop.policy).__name__}"]),
    ]  # fmt: skip
    if named := [*names_of(problem.constraints)]:
        rows.append(("constraints", _first([str(name) for name in named])))
    if problem.noise is not None:
        rows.append(("noise", [f"{problem.noise.sources} sources; the closed loops below are without noise"]))
    return _table(type(controller).__name__, rows + _history(controller))


def _controls(controller: Any) -> list[str]:
    """A line for each control with its limits."""
    system, controls = controller.system, controller.controls
    limits = controls.fixed_limits
    if limits is None or not controls.is_box:
        inside = f" in {controls}" if controls.limited else " without limits"
        return _first([label + inside for label in system.control_labels])
    lower, upper = (limit.expand(system.m).tolist() for limit in limits)
    return _first([f"{n} {_interval(*ends)}" for n, *ends in zip(system.control_labels, lower, upper, strict=True)])


def _history(controller: Any) -> list[tuple[str, list[str]]]:
    """Rows on training, measured numbers and the page, of a controller from a file."""
    origin = controller.origin
    if origin is None:
        return []
    config, program = controller.config, controller.program
    steps = "" if origin.steps is None else f"{origin.steps} steps, "
    trained = f"{steps}{type(program).__name__}, seed {config.seed}, lyapnet {origin.version or 'unknown'}"
    rows = [("trained", [trained, origin.path])]
    record = origin.evaluation()
    measured = [
        text.format(number)
        for key, text in (
            ("cost_ratio", "cost / optimum {:.4f}"), ("cost_mean", "mean cost {:.4g}"),
            ("value_error", "error of V {:.2%}"), ("satisfied_fraction", "Lyapunov condition on {:.1%}"),
            ("samples", "from {:.0f} states of X₀"),
        )
        if (number := number_in(record, key)) is not None
        and (key != "satisfied_fraction" or isinstance(program, LyapunovProgram))  # other programs do not require it
    ]  # fmt: skip
    if measured:
        rows.append(("measured", [", ".join(measured)]))
    own = own_parts(config)
    if any(name.startswith("__main__:") for name in own.values()):  # defined in a notebook: commands cannot import it
        return rows
    parts = [word for part, name in own.items() for word in (f"--{part}", name)]
    command = shlex.join(["lyapnet", "view", origin.path, *parts, "--out", "page.html"])
    return [*rows, ("page", [command])]


def _table(title: str, rows: Sequence[tuple[str, Sequence[str]]]) -> str:
    cell = 'style="text-align: left; vertical-align: top; padding: 2px 10px 2px 0"'
    lines = [f"<tr><th {cell}>{escape(title)}</th><td></td></tr>"]
    lines += [f"<tr><td {cell}>{escape(k)}</td><td {cell}>{'<br>'.join(map(escape, v))}</td></tr>" for k, v in rows]
    return f'<table style="border-collapse: collapse">{"".join(lines)}</table>'


def _note(text: str) -> str:
    return f"<p><em>{escape(text)}</em></p>"


def _first(lines: list[str]) -> list[str]:
    """The first lines, and the number of further ones."""
    left = len(lines) - MOST_LINES
    return lines if left <= 0 else [*lines[:MOST_LINES], f"and {left} more"]


def _interval(low: float, high: float) -> str:
    if -low == high == math.inf:
        return "without limits"
    return f"= {_number(low)}" if low == high else f"from {_number(low)} to {_number(high)}"


def _number(value: float) -> str:
    return f"{value:.3g}".replace("-", "−")


class _Panel(NamedTuple):
    """Curves over time: values (points, loops), and the heights of dashed lines."""

    label: str
    values: np.ndarray
    color: str
    limits: Sequence[float] = ()


def _drawing(controller: Any) -> str:
    """States, controls and V of some closed loops over time, or a sentence on why there are none."""
    box, system, horizon = controller.initial_states, controller.system, controller.horizon
    x0 = torch.cat([box.center[None], box.corners(2)])
    controller.policy(0.0, x0)  # the first call of a law is slower
    begun = time.thread_time()  # CPU time, which does not depend on other programs
    controller.policy(0.0, x0)
    expected = horizon.steps * (time.thread_time() - begun)
    if expected > SECONDS:
        return _note(
            f"There is no drawing of closed loops: they take about {expected:.0f} s; ask controller.rollout(x0)."
        )
    trajectory = controller.rollout(x0)
    x, u, V = (part.numpy(force=True) for part in (trajectory.x, trajectory.u, trajectory.require_value()))
    lower, upper = controller.controls.fixed_limits or (torch.tensor(-np.inf), torch.tensor(np.inf))
    limits = torch.stack([lower.expand(system.m), upper.expand(system.m)], -1).tolist()
    moving, controls = moving_states(system)[:MOST_PANELS], range(system.m)[:MOST_PANELS]
    panels = [_Panel(system.state_labels[i], x[..., i], STATES) for i in moving]
    panels += [_Panel(system.control_labels[i], u[..., i], CONTROLS, limits[i]) for i in controls]
    panels.append(_Panel("V (cost)", V, VALUE))
    rows = -(-len(panels) // COLUMNS)
    drawn = [
        f'<g transform="translate({k % COLUMNS * WIDTH} {k // COLUMNS * HEIGHT})">{_svg(panel, horizon.duration)}</g>'
        for k, panel in enumerate(panels)
    ]
    width, height = min(len(panels), COLUMNS) * WIDTH, rows * HEIGHT
    size = f'width="{width}" height="{height}" viewBox="0 0 {width} {height}"'
    style = 'style="max-width: 100%; height: auto" font-size="11" font-family="sans-serif" fill="currentColor"'
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" role="img" {size} {style}>'
        f"<title>Closed loops over time</title>{''.join(drawn)}</svg>"
        + _note("Closed loops from the centre of X₀ and from corners of it; dashed lines are limits of controls.")
    )


def _svg(panel: _Panel, duration: float) -> str:
    """One panel: its label, the range of its values, T, limits and curves."""
    every = max(1, -(-len(panel.values) // MOST_POINTS))
    places = np.unique(np.append(np.arange(0, len(panel.values), every), len(panel.values) - 1))
    values = panel.values[places]
    shown = np.append(values[np.isfinite(values)], [limit for limit in panel.limits if np.isfinite(limit)])
    low, high = (float(shown.min()), float(shown.max())) if len(shown) else (0.0, 1.0)
    right, bottom = WIDTH - RIGHT, HEIGHT - BOTTOM
    across = LEFT + (right - LEFT) * places / max(places[-1], 1)

    def height(value: Any) -> Any:
        return bottom - (bottom - TOP - 4) * (value - low) / (high - low or 1.0) - 2

    parts = [
        f'<path d="M{LEFT} {TOP}V{bottom}H{right}" fill="none" stroke="currentColor" stroke-opacity="0.5"/>',
        f'<text x="{LEFT}" y="{TOP - 6}">{escape(panel.label)}</text>',
        f'<text x="{LEFT - 4}" y="{height(high):.1f}" dy="4" text-anchor="end">{_number(high)}</text>',
        f'<text x="{LEFT}" y="{bottom + 12}">0</text>',
        f'<text x="{right}" y="{bottom + 12}" text-anchor="end">{_number(duration)} s</text>',
    ]
    if high > low:
        parts.append(f'<text x="{LEFT - 4}" y="{height(low):.1f}" dy="2" text-anchor="end">{_number(low)}</text>')
    for limit in filter(np.isfinite, panel.limits):
        line = f"M{LEFT} {height(limit):.1f}H{right}"
        parts.append(f'<path d="{line}" stroke="currentColor" stroke-opacity="0.6" stroke-dasharray="4 3"/>')
    for curve in values.T:
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(across, height(curve), strict=True) if np.isfinite(b))
        parts.append(f'<polyline points="{points}" fill="none" stroke="{panel.color}" stroke-width="1.3"/>')
    return "".join(parts)

"""Figures of closed loops in a plane of two states, with disks that they must avoid or stay in."""

from collections.abc import Iterator

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from lyapnet.base.drawing import BLUE, GREY, ORANGE, VERMILION, legend_below, to_numpy
from lyapnet.loop.rollout import Trajectory
from lyapnet.task.constraints import Ball, parts_of
from lyapnet.task.cost import Cost, CostWrapper, ObstacleCost
from lyapnet.task.problem import Problem


def has_plane(problem: Problem) -> bool:
    """Whether a constraint or the cost has a disk in a plane of two states."""
    return _plane(problem) is not None


def paths(trajectory: Trajectory, problem: Problem) -> Figure:
    """A batch (b,) of closed loops in the plane of the first disk of a constraint or of the cost.

    Disks to avoid are filled, disks to stay in are dashed. Obstacles of the cost are dotted; the radius is where the
    obstacle's cost is a seventh of that at its centre.
    """
    plane = _plane(problem)
    assert plane is not None
    i, j = plane
    figure = Figure(figsize=(5.6, 4.8), layout="constrained")
    panel = figure.subplots()
    _draw_disks(panel, problem, plane)
    x = to_numpy(trajectory.x)
    for k, path in enumerate(x.swapaxes(0, 1)):
        panel.plot(path[:, i], path[:, j], color=BLUE, linewidth=0.9, label=None if k else "closed loop")
    panel.plot(x[0, :, i], x[0, :, j], "o", color=BLUE, markersize=3)
    if problem.has_goal:
        panel.plot(*problem.goal[[i, j]].tolist(), "*", color=VERMILION, markersize=10, label="goal", linestyle="none")
    low, size = (side[[i, j]].tolist() for side in (problem.initial_states.lower, problem.initial_states.widths))
    panel.add_patch(Rectangle((low[0], low[1]), *size, fill=False, edgecolor="black", linewidth=0.8, label="X₀"))
    panel.set_xlabel(problem.system.state_labels[i])
    panel.set_ylabel(problem.system.state_labels[j])
    panel.set_aspect("equal", adjustable="datalim")
    legend_below(figure, panel, columns=5)
    return figure


def _draw_disks(panel: Axes, problem: Problem, plane: tuple[int, int]) -> None:
    styles = {
        "outside": {"facecolor": ORANGE, "alpha": 0.45, "edgecolor": "black", "label": "not to be entered"},
        "inside": {"fill": False, "edgecolor": "black", "linestyle": "--", "label": "not to be left"},
        "cost": {"fill": False, "edgecolor": GREY, "linestyle": ":", "label": "obstacle of the cost"},
    }
    for kind, states, center, radius in _disks(problem):
        if states == plane:
            panel.add_patch(Circle((center[0], center[1]), radius, **styles[kind]))
            styles[kind].pop("label", None)  # one entry in the legend


def _plane(problem: Problem) -> tuple[int, int] | None:
    planes = [states for _, states, _, _ in _disks(problem) if len(states) == 2]
    return planes[0] if planes else None


def _disks(problem: Problem) -> Iterator[tuple[str, tuple[int, ...], list[float], float]]:
    """(kind, states, centre, radius) of the balls of the constraints and of the cost."""
    for part in parts_of(problem.constraints):
        if isinstance(part, Ball):
            yield "outside" if part.side > 0 else "inside", (*part.states.tolist(),), part.center.tolist(), part.radius
    cost: Cost = problem.cost
    while isinstance(cost, CostWrapper):
        if isinstance(cost, ObstacleCost):
            yield "cost", (*cost.states.tolist(),), cost.centre.tolist(), cost.radius
        cost = cost.cost

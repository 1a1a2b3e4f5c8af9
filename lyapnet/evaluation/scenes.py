"""Drawing of a system's state in animations and environments: its shapes, or a plane of two states."""

from collections.abc import Sequence

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, FancyArrowPatch
from matplotlib.patches import Polygon as Patch

from lyapnet.base.drawing import BLUE, GREY, ORANGE, VERMILION, pixels, to_numpy
from lyapnet.base.errors import UsageError, one_line
from lyapnet.base.shapes import Arrow, Disk, Line, Polygon, Shape, corners_of
from lyapnet.evaluation.figures import widest_axes
from lyapnet.task.problem import Problem

SIDE = 4.4  # side of the picture in inches


class Picture:
    """A picture of the current state of a trajectory: the system's shapes, and in red those of the goal.

    For a system without shapes it shows the plane of the two widest states of X₀ with the path so far and the goal; for
    a single state, this state over time. The view contains the lower and upper corner of X₀, the goal, and everything
    drawn since `begin`.
    """

    def __init__(self, problem: Problem):
        self.problem = problem
        self.figure = Figure(figsize=(SIDE, SIDE))
        self.panel = self.figure.add_axes((0.15, 0.11, 0.81, 0.81))
        self.path: list[np.ndarray] = []

    def begin(self, x: np.ndarray) -> None:
        """Start a trajectory at x₀ (n,)."""
        box = self.problem.initial_states
        self.path, self.control = [x], np.zeros(self.problem.system.m)
        self._seen = _corners(self.problem, [to_numpy(box.lower), to_numpy(box.upper), x], self.control)

    def go_on(self, x: np.ndarray, u: np.ndarray) -> None:
        """Append the state x (n,) after the control u (m,)."""
        self.path.append(x)
        self.control = u

    def frame(self) -> np.ndarray:
        """The picture as (height, width, 3) bytes.

        Raises:
            UsageError: the system's `draw` fails.
        """
        panel = self.panel
        panel.clear()
        if shapes := shapes_of(self.problem, self.path[-1], self.control):
            self._seen = np.concatenate([self._seen, *map(corners_of, shapes)])
            self._seen = np.stack([self._seen.min(0), self._seen.max(0)])
            set_stage(panel, self.problem, self._seen)
            for shape in shapes:
                panel.add_artist(artist_of(shape, BLUE))
        elif self.problem.system.n == 1:
            self._time_panel(panel)
        else:
            self._plane(panel)
        dt = self.problem.horizon.dt
        panel.set_title(f"t = {(len(self.path) - 1) * dt:.2f} s", loc="left", fontsize=9)
        return pixels(self.figure)[..., :3].copy()

    def _plane(self, panel: Axes) -> None:
        box, axes = self.problem.initial_states, plane_axes(self.problem)
        path = np.array(self.path)
        set_plane(panel, self.problem, axes, np.stack([*path, to_numpy(box.lower), to_numpy(box.upper)]))
        panel.plot(*path[:, axes].T, color=BLUE, linewidth=1.0)
        panel.plot(*path[-1, axes], "o", color=BLUE, markersize=5)

    def _time_panel(self, panel: Axes) -> None:
        dt, box = self.problem.horizon.dt, self.problem.initial_states
        t, x = dt * np.arange(len(self.path)), np.array(self.path)[:, 0]
        panel.set_xlim(0, self.problem.horizon.duration)
        panel.set_xlabel("time (s)", fontsize=8)
        panel.set_ylabel(self.problem.system.state_labels[0], fontsize=8)
        panel.tick_params(labelsize=7)
        if self.problem.has_goal:
            panel.axhline(float(self.problem.goal[0]), color=VERMILION, linestyle=":")
        panel.update_datalim([(0, float(box.lower[0])), (0, float(box.upper[0]))])
        panel.plot(t, x, color=BLUE, linewidth=1.0)
        panel.plot(t[-1], x[-1], "o", color=BLUE, markersize=5)


def set_stage(panel: Axes, problem: Problem, corners: np.ndarray) -> None:
    """Set the view of a panel in metres so that it contains the points (k, 2); draw the shapes of the goal in red."""
    rest = to_numpy(problem.controls.moved(problem.goal, problem.rest))
    goal = shapes_of(problem, to_numpy(problem.goal), rest) if problem.has_goal else []
    corners = np.concatenate([corners, *map(corners_of, goal)])
    low, high = corners.min(0), corners.max(0)
    side = 1.1 * max(float((high - low).max()), 1e-9) / 2
    panel.set(xlim=(low + high)[0] / 2 + [-side, side], ylim=(low + high)[1] / 2 + [-side, side])
    panel.set_aspect("equal")
    panel.set_xlabel("(m)", fontsize=8)
    panel.tick_params(labelsize=7)
    panel.grid(color="#EEEEEE", linewidth=0.6)
    panel.set_axisbelow(True)
    for shape in goal:
        panel.add_artist(artist_of(shape, VERMILION, 0.35))


def plane_axes(problem: Problem) -> list[int]:
    """The two states of the plane: the widest of X₀."""
    return [*widest_axes(problem.initial_states), 1, 0][:2]


def set_plane(panel: Axes, problem: Problem, axes: list[int], states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Set a panel of two states to contain the states (k, n), draw the goal as a star; return the panel's corners."""
    for axis, index in zip("xy", axes, strict=True):
        getattr(panel, f"set_{axis}label")(problem.system.state_labels[index], fontsize=8)
    low, high = states.min(0)[axes], states.max(0)[axes]
    margin = 0.06 * np.maximum(high - low, 1e-9)
    low, high = low - margin, high + margin
    panel.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    panel.tick_params(labelsize=7)
    if problem.has_goal:
        panel.plot(*to_numpy(problem.goal)[axes], "*", color=VERMILION, markersize=10)
    return low, high


def _corners(problem: Problem, states: Sequence[np.ndarray], u: np.ndarray) -> np.ndarray:
    """The corner points (k, 2) of the shapes of some states."""
    shapes = [shape for x in states for shape in shapes_of(problem, x, u)]
    return np.concatenate([np.zeros((0, 2)), *map(corners_of, shapes)])


def shapes_of(problem: Problem, x: np.ndarray, u: np.ndarray) -> Sequence[Shape]:
    """The shapes that the system draws in a state (n,) under a control (m,).

    Raises:
        UsageError: its `draw` fails, or returns something other than shapes.
    """
    system = problem.system
    try:
        shapes = list(system.draw(np.asarray(x, dtype=float), np.asarray(u, dtype=float)))
        finite = all(isinstance(s, Shape) and np.isfinite(corners_of(s)).all() and corners_of(s).size for s in shapes)
    except Exception as error:  # the system may be the user's
        raise UsageError(
            f"Expected {system.title}.draw(x, u) of arrays ({system.n},) and ({system.m},), got {one_line(error)}; "
            "return Line, Disk, Polygon and Arrow of lyapnet.base.shapes."
        ) from error
    if not finite:
        raise UsageError(
            f"Expected {system.title}.draw to return Line, Disk, Polygon and Arrow of lyapnet.base.shapes at finite "
            f"points (x, y), got {shapes}; correct it."
        )
    return shapes


def artist_of(shape: Shape, color: str, alpha: float = 1.0) -> Artist:
    """The matplotlib artist of a shape; faint lines are grey, arrows of a blue system are orange."""
    match shape:
        case Line(points, width, faint):
            tint = GREY if faint else color
            return Line2D(*np.asarray(points).T, color=tint, linewidth=width, alpha=alpha, solid_capstyle="round")
        case Disk(center, radius):
            return Circle(tuple(np.asarray(center)), radius, color=color, alpha=alpha, linewidth=0)
        case Polygon(points):
            return Patch(np.asarray(points), closed=True, color=color, alpha=alpha, linewidth=0)
        case Arrow(tail, head):
            tint = ORANGE if color == BLUE else color
            return FancyArrowPatch(
                tuple(np.asarray(tail)), tuple(np.asarray(head)), arrowstyle="-|>", mutation_scale=9, color=tint,
                alpha=alpha, shrinkA=0, shrinkB=0, linewidth=1.5,
            )  # fmt: skip

"""Animations of closed loops: the system's shapes, or a plane of two states, with controls and cost."""

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image

from lyapnet.base.drawing import BLUE, GREEN, GREY, ORANGE, VERMILION, to_numpy
from lyapnet.base.shapes import Shape, corners_of
from lyapnet.base.types import Value
from lyapnet.evaluation.figures import Slice
from lyapnet.evaluation.movie import Movie
from lyapnet.evaluation.scenes import artist_of, plane_axes, set_plane, set_stage, shapes_of
from lyapnet.loop.rollout import Trajectory
from lyapnet.task.problem import Problem

BACKGROUND_OPACITY = 0.18  # opacity of the shapes of all closed loops but the first


class Film(Movie):
    """An animation of closed loops, frame by frame.

    The left panel shows the system's shapes: those of the first closed loop, faintly those of the others, and in red
    those of the goal. For a system without shapes it shows the plane of the two widest states of X₀ with level sets of
    V(t, ·), the other states at the centre of X₀; for a single state, this state over time. The right panels show the
    controls with their limits, and the cost to go with V; the first closed loop is in full colour.

    Args:
        trajectory: a batch (b,) of closed loops of a V.
        problem: their problem.
        V: value function of the level sets.
        rate: frames per second.
        speed: seconds of the system per second of the animation; None: 1, adapted to a duration of 3 to 10 s.

    Raises:
        UsageError: rate or speed is no positive number, or the system's `draw` fails.
    """

    def __init__(
        self, trajectory: Trajectory, problem: Problem, V: Value, rate: float = 20.0, speed: float | None = None
    ):
        super().__init__(float(trajectory.t[-1]), len(trajectory.t) - 1, rate, speed)
        self.problem, self.V = problem, V
        self.t, self.x, self.u = (to_numpy(part) for part in (trajectory.t, trajectory.x, trajectory.u))
        self.to_go = to_numpy(trajectory.cost - trajectory.running_cost)
        self.value = to_numpy(trajectory.require_value())
        self.palette: Image.Image = _palette()
        self.figure = Figure(figsize=(8.6, 4.3), layout="constrained")
        drawn = [self._shapes(node, 0) for node in (0, len(self.u))]
        self._scene = self._stage() if any(drawn) else self._plane() if problem.system.n > 1 else self._time_panel()
        self._curves = self._panels()
        self._canvas = FigureCanvasAgg(self.figure)
        self.figure.set_dpi(110)

    def frames(self) -> Iterator[np.ndarray]:
        canvas = self._canvas
        canvas.draw()  # the background, drawn once for all frames
        still = canvas.copy_from_bbox(self.figure.bbox)
        for node in self.nodes:
            canvas.restore_region(still)
            for line, times, values in self._curves:
                line.set_data(times[: node + 1], values[: node + 1])
                line.axes.draw_artist(line)
            self._clock.set_text(f"t = {self.t[node]:.2f} s")
            self._panel.draw_artist(self._clock)
            for artist in self._scene(node):
                self._panel.draw_artist(artist)
                artist.remove()
            frame = np.array(canvas.buffer_rgba())[..., :3]
            yield frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2]

    def _shapes(self, node: int, loop: int) -> Sequence[Shape]:
        return shapes_of(self.problem, self.x[node, loop], self.u[min(node, len(self.u) - 1), loop])

    def _left_panel(self) -> Axes:
        self._grid = self.figure.add_gridspec(1, 2, width_ratios=(1, 1))
        panel = self.figure.add_subplot(self._grid[0])
        self._panel, self._clock = panel, panel.set_title("t = 0.00 s", loc="left", fontsize=9, animated=True)
        note = "" if math.isclose(self.speed, 1) else f"{self.speed:.2g} × real time"
        panel.set_title(note, loc="right", fontsize=8, color=GREY)
        return panel

    def _stage(self) -> Any:
        """Prepare the panel of the system's shapes; return the function that draws those of a node."""
        panel, problem = self._left_panel(), self.problem
        shown = [self._shapes(node, loop) for node in self.nodes for loop in range(self.x.shape[1])]
        set_stage(panel, problem, np.concatenate([corners_of(shape) for shapes in shown for shape in shapes]))

        def draw_node(node: int) -> Iterator[Artist]:
            for loop in reversed(range(self.x.shape[1])):
                for shape in self._shapes(node, loop):
                    yield panel.add_artist(artist_of(shape, BLUE, BACKGROUND_OPACITY if loop else 1.0))

        return draw_node

    def _plane(self) -> Any:
        """Prepare the panel of two states with level sets of V; return the function that draws those of a node."""
        panel, problem = self._left_panel(), self.problem
        axes = plane_axes(problem)
        region = _grid(problem, axes, *set_plane(panel, problem, axes, self.x.reshape(-1, problem.system.n)))
        first = self._values(0, region)
        levels = np.quantile(first, np.linspace(0.03, 0.97, 9))
        levels = levels[np.append(True, np.diff(levels) > 0)]

        def draw_node(node: int) -> Iterator[Artist]:
            coordinates = [to_numpy(line) for line in region.grid]
            yield panel.contour(*coordinates, self._values(node, region), levels=levels, colors=GREY, linewidths=0.7)
            for loop in range(self.x.shape[1]):
                path = self.x[: node + 1, loop][:, axes]
                yield from panel.plot(*path.T, color=BLUE, linewidth=1.0, alpha=0.35 if loop else 1.0)
                yield from panel.plot(*path[-1], "o", color=BLUE, markersize=5, alpha=0.5 if loop else 1.0)

        return draw_node

    def _time_panel(self) -> Any:
        """Prepare the panel of a single state over time; return the function that draws the curve up to a node."""
        panel, problem = self._left_panel(), self.problem
        low, high = float(self.x.min()), float(self.x.max())
        margin = 0.06 * max(high - low, 1e-9)
        panel.set(xlim=(0, self.t[-1]), ylim=(low - margin, high + margin), xlabel="time (s)")
        panel.set_ylabel(problem.system.state_labels[0], fontsize=8)
        panel.tick_params(labelsize=7)
        if problem.has_goal:
            panel.axhline(float(problem.goal[0]), color=VERMILION, linestyle=":")
        heights = torch.linspace(low - margin, high + margin, 41).to(problem.goal)[:, None]
        with torch.no_grad():
            times = [torch.as_tensor(self.t[node]).to(heights) for node in self.nodes]
            values = np.stack([to_numpy(self.V(t, heights)) for t in times], 1)
        panel.contour(self.t[self.nodes], to_numpy(heights[:, 0]), values, levels=9, colors=GREY, linewidths=0.7)

        def draw_node(node: int) -> Iterator[Artist]:
            for loop in range(self.x.shape[1]):
                t, x = self.t[: node + 1], self.x[: node + 1, loop, 0]
                yield from panel.plot(t, x, color=BLUE, linewidth=1.0, alpha=0.35 if loop else 1.0)
                yield from panel.plot(t[-1], x[-1], "o", color=BLUE, markersize=5, alpha=0.5 if loop else 1.0)

        return draw_node

    def _values(self, node: int, region: Slice) -> np.ndarray:
        with torch.no_grad():
            values = self.V(torch.as_tensor(self.t[node]).to(region.states), region.states)
        return to_numpy(values).reshape([len(line) for line in region.grid]).T

    def _panels(self) -> list[tuple[Any, np.ndarray, np.ndarray]]:
        """Draw the panels of controls and cost; return the lines that grow, with their times and values."""
        system, x = self.problem.system, torch.as_tensor(self.x[:-1])
        limits = self.problem.controls.limits_at(x.to(self.problem.goal))
        rows = min(system.m, 4)
        grid = self._grid[1].subgridspec(rows + 1, 1)
        panels: list[Axes] = [*grid.subplots(sharex=True, squeeze=False)[:, 0]]
        growing = []
        above: Any = {"loc": "left", "fontsize": 7, "pad": 2}  # beside a low panel a long label would not fit
        for k, panel in enumerate(panels[:-1]):
            panel.set_title(system.control_labels[k], **above)
            for limit in limits or ():
                if limit.ndim > 1:  # of the first closed loop
                    panel.plot(self.t[:-1], to_numpy(limit[:, 0, k]), color=GREY, linewidth=0.9, linestyle="--")
                elif math.isfinite(height := float(limit.expand(system.m)[k])):
                    panel.axhline(height, color=GREY, linewidth=0.9, linestyle="--")
            growing += self._lines(panel, self.u[..., k], GREEN)
        last = panels[-1]
        growing += self._lines(last, self.to_go, ORANGE, "cost to go")
        growing += self._lines(last, self.value, BLUE, "V(t, x)", "--", others=False)
        last.set_title("cost", **above)
        last.set_xlabel("time (s)", fontsize=8)
        last.set_xlim(0, self.t[-1])
        last.legend(fontsize=7, frameon=False, loc="upper right")
        for panel in panels:
            panel.tick_params(labelsize=7)
        return growing

    def _lines(
        self, panel: Axes, values: np.ndarray, color: str, label: str = "", style: str = "-", others: bool = True
    ) -> list[tuple[Any, np.ndarray, np.ndarray]]:
        """Draw the curves (N or N + 1, b) of all closed loops faintly; return the growing line of the first one."""
        times = self.t[: len(values)]
        shown = values if others else values[:, :1]
        panel.plot(times, shown, color=color, linewidth=0.7, alpha=0.25, linestyle=style)
        lines = panel.plot([], [], color=color, linewidth=1.3, linestyle=style, label=label or None, animated=True)
        return [(lines[0], times, values[:, 0])]


def _palette() -> Image.Image:
    """A palette of at most 256 colours: the colours of all figures, each in steps towards white."""
    named = [to_rgb(color) for color in (BLUE, GREEN, ORANGE, VERMILION, GREY, "black")]
    shades = [1 - (1 - np.array(color)) * share for color in named for share in np.linspace(1, 0, 42)]
    palette = Image.new("P", (1, 1))
    palette.putpalette((np.array(shades) * 255).round().astype(int).flatten().tolist())
    return palette


def _grid(problem: Problem, axes: list[int], low: np.ndarray, high: np.ndarray, points: int = 41) -> Slice:
    """A grid over two states; the other states are at the centre of X₀."""
    like = problem.initial_states.center
    grid = [torch.linspace(float(a), float(b), points).to(like) for a, b in zip(low, high, strict=True)]
    mesh = torch.meshgrid(*grid, indexing="ij")
    states = like.repeat(points**2, 1)
    states[:, list(axes)] = torch.stack([component.flatten() for component in mesh], -1)
    return Slice(axes, grid, states)

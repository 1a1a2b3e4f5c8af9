"""A figure of closed loops under noise: bands of many paths from a few initial states."""

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from lyapnet.base.drawing import BLUE, GREEN, GREY, ORANGE, legend_below, to_numpy
from lyapnet.base.types import State
from lyapnet.evaluation.figures import name_panels_left_out, states_and_controls_to_draw
from lyapnet.loop.rollout import Trajectory
from lyapnet.task.problem import Problem

PATHS = 200  # number of paths from each initial state
STATES = 2  # number of initial states; bands of more would overlap
BAND = (0.05, 0.95)  # probabilities of the edges of a band


def states_to_draw(x0: State) -> Tensor:
    """The two of some initial states (b, n) that are farthest apart, each repeated PATHS times: (PATHS, STATES, n)."""
    extent = (x0.amax(0) - x0.amin(0)).clamp_min(torch.finfo(x0.dtype).tiny)
    distance = torch.cdist(x0 / extent, x0 / extent)
    i, j = divmod(int(distance.argmax()), len(x0))
    return x0[[i, j]].expand(PATHS, -1, -1)


def bands(trajectory: Trajectory, problem: Problem) -> Figure:
    """Median and 5 to 95 % band of each state, control and the cost to go, of paths (paths, states) of one task.

    The last panel compares V, averaged over the paths, with the mean of the cost to go.
    """
    system, t = problem.system, to_numpy(trajectory.t)
    to_go = trajectory.cost - trajectory.running_cost
    drawn, controls = states_and_controls_to_draw(system)
    curves = [(system.state_labels[i], trajectory.x[..., i]) for i in drawn]
    curves += [(system.control_labels[i], trajectory.u[..., i]) for i in controls]
    columns = 1 if len(curves) < 4 else 2
    rows = -(-(len(curves) + 1) // columns)
    figure = Figure(figsize=(4.6 * columns, 1.5 * rows + 0.6), layout="constrained")
    panels = list(figure.subplots(rows, columns, sharex=True, squeeze=False).flatten(order="F"))
    for panel, (label, paths) in zip(panels, curves, strict=False):
        for k, color in enumerate((BLUE, ORANGE)):
            low, middle, high = np.quantile(to_numpy(paths[..., k]), (BAND[0], 0.5, BAND[1]), axis=1)
            at = t[: len(middle)]
            panel.fill_between(at, low, high, color=color, alpha=0.25, linewidth=0)
            panel.plot(at, middle, color=color, linewidth=1.2, label=f"from state {k + 1}: median, 5 to 95 % of paths")
            panel.plot(at, to_numpy(paths[:, 0, k]), color=color, linewidth=0.5, alpha=0.8)
        panel.set_ylabel(label.replace(" (", "\n("), fontsize=8)
    last = panels[len(curves)]
    for k in range(STATES):
        last.plot(t, to_numpy(to_go[..., k].mean(1)), color=GREEN, linewidth=2.2, alpha=0.6, label="mean cost to go")
        last.plot(t, to_numpy(trajectory.require_value()[..., k].mean(1)), color=GREY, ls="--", label="mean of V")
    last.set_ylabel("cost", fontsize=8)
    handles = [*panels[0].get_legend_handles_labels()[0], *last.get_legend_handles_labels()[0][:2]]
    name_panels_left_out(figure, system)
    for spare in panels[len(curves) + 1 :]:
        spare.set_visible(False)
    for panel in panels:
        panel.tick_params(labelsize=7)
    for panel in (panels[rows - 1], last):
        panel.set_xlabel("time (s)", fontsize=8)
        panel.tick_params(labelbottom=True)
    legend_below(figure, handles, columns=2)
    return figure

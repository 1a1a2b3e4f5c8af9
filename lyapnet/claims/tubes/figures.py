"""Figures of tubes: bounds of all closed loops from X₀, and of their costs."""

from typing import Any

import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from lyapnet.base.drawing import BLUE, GREEN, GREY, VERMILION, legend_below, to_numpy
from lyapnet.base.random_streams import CERTIFICATION, stream
from lyapnet.base.types import PerState
from lyapnet.claims.costs import Inside
from lyapnet.claims.tubes.tube import ProvedTube
from lyapnet.controller.controller import Controller

SHOWN = 12  # number of simulated closed loops in the figure
OfFirstStates = Float[Tensor, " first"]  # one number for each of the first few states


def tube(
    claim: ProvedTube, controller: Controller, inside: Inside, optimum: OfFirstStates | None, headline: str,
    least: tuple[PerState, str] | None = None,
) -> Figure:  # fmt: skip
    """Bounds of each state over time with some simulated closed loops; and relative bounds of the cost.

    Args:
        inside: states of X₀ with bounds of their costs.
        optimum: the optimal costs of the first of these states.
        least: lower bounds of the optimum for these states, and the controls for which they hold.
    """
    labels = controller.system.state_labels
    count = len(claim.seen) + 1
    columns = 2 if count == 4 else min(3, count)
    rows = -(-count // columns)
    figure = Figure(figsize=(3.3 * columns, 2.5 * rows + 0.6), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).flatten()
    x0 = inside.x0[:SHOWN] if len(inside.x0) else controller.initial_states.sample(SHOWN, stream(1, CERTIFICATION))
    trajectory = controller.rollout(x0)
    for panel, k, i in zip(panels, range(len(claim.seen)), claim.seen, strict=False):
        _draw_state(panel, claim, k, trajectory, i)
        panel.set(xlabel="t (s)", ylabel=labels[i])
    _draw_cost(panels[count - 1], inside, optimum, least)
    for panel in panels[count:]:
        panel.set_visible(False)
    figure.suptitle(headline, fontsize=9)
    handles = [handle for panel in (panels[0], panels[count - 1]) for handle in panel.get_legend_handles_labels()[0]]
    legend_below(figure, handles, columns=2)
    return figure


def _draw_state(panel: Axes, claim: ProvedTube, k: int, trajectory: Any, i: int) -> None:
    low, high = claim.ranges[:, k].unbind(-1)
    if bool(low.isfinite().all()):
        edges = torch.linspace(0, claim.duration, len(low) + 1)
        panel.fill_between(
            to_numpy(edges), to_numpy(torch.cat([low, low[-1:]])), to_numpy(torch.cat([high, high[-1:]])),
            step="post", color=BLUE, alpha=0.2, linewidth=0, label="proved: all closed loops from there",
        )  # fmt: skip
    x = trajectory.x[..., i]
    lines = panel.plot(to_numpy(trajectory.t), to_numpy(x), color=GREY, linewidth=0.6)
    if lines:
        lines[0].set_label("some, simulated by steps of Δt")


def _draw_cost(panel: Axes, inside: Inside, optimum: OfFirstStates | None, least: tuple[PerState, str] | None) -> None:
    """Draw bounds and optima, divided by the middle of the bounds, over this middle; nothing without a proof."""
    panel.set(xlabel="cost from x₀, proved", ylabel="relative to it")
    lowest, highest = inside.low, inside.guaranteed
    if lowest is None or not len(inside.x0):
        return
    middle = (lowest + highest) / 2
    order = middle.argsort()
    x, low, high = (to_numpy(y[order]) for y in (middle, lowest / middle, highest / middle))
    panel.fill_between(x, low, high, color=BLUE, alpha=0.2, linewidth=0)
    panel.plot(x, high, color=BLUE, linewidth=1, label="proved: the closed loop costs at most, and at least")
    panel.plot(x, low, color=BLUE, linewidth=1)
    if least is not None:
        lowest, whose = least
        label = f"proved: {whose} costs at least"
        panel.plot(x, to_numpy((lowest / middle)[order]), ".", color=GREEN, markersize=2, label=label)
    relevant = (middle > 0.1 * middle.mean()) & lowest.isfinite()  # relative bounds of small costs are always wide
    if bool(relevant.any()):
        bottom, top = (lowest / middle)[relevant].min(), (highest / middle)[relevant].max()
        panel.set_ylim(min(0.95, float(bottom)), max(1.05, float(top)))
    if optimum is not None:
        first = middle[: len(optimum)]
        panel.plot(
            to_numpy(first),
            to_numpy(optimum / first),
            ".",
            color=VERMILION,
            markersize=4,
            label="optimum of the steps of Δt",
        )

"""The figure of the closed loops after T."""

from collections.abc import Sequence

import torch
from matplotlib.figure import Figure

from lyapnet.base.drawing import CYCLE, legend_below, to_numpy
from lyapnet.controller.controller import Controller
from lyapnet.evaluation.after_horizon import LoopsAfterHorizon

# distances relative to the largest one before T
AXIS_BOTTOM, AXIS_TOP = 1e-12, 1e3  # limits of the logarithmic axis
ZERO = 1e-24  # replaces 0, which a logarithmic axis cannot show


def distances(found: Sequence[LoopsAfterHorizon], controller: Controller) -> Figure:
    """‖x − x*‖ over t under each law: the mean, and a band from the smallest to the largest distance."""
    figure = Figure(figsize=(5.6, 3.6), layout="constrained")
    axes = figure.subplots()
    drawn = {one.beyond: one.distance for one in found if one.distance is not None}
    before = max(float(distance[: controller.horizon.steps + 1].max()) for distance in drawn.values()) or 1.0
    for color, (beyond, distance) in zip(CYCLE, drawn.items(), strict=False):
        t = to_numpy(controller.horizon.dt * torch.arange(len(distance)))
        shown = to_numpy(distance.clamp(min=ZERO * before))
        axes.fill_between(t, shown.min(1), shown.max(1), color=color, alpha=0.15, lw=0)
        axes.semilogy(t, shown.mean(1), color=color, linewidth=1.4, label=beyond)
    bottom, top = axes.get_ylim()
    axes.set_ylim(max(bottom, AXIS_BOTTOM * before), min(top, AXIS_TOP * before))
    axes.axvline(controller.horizon.duration, color="black", linewidth=0.8, linestyle=":", label="T")
    axes.set_xlabel("time t (s)")
    axes.set_ylabel("‖x − x*‖")
    missing = [one.beyond for one in found if one.distance is None]
    also = f"; none of {', '.join(missing)}" if missing else ""
    axes.set_title(f"mean and range of {next(iter(drawn.values())).shape[1]} closed loops{also}", fontsize=8)
    legend_below(figure, axes)
    return figure

"""What a controller does after T, as a picture."""

from collections.abc import Sequence

import torch
from matplotlib.figure import Figure

from lyapnet.base.drawing import CYCLE, legend_below, numpy_of
from lyapnet.controller.controller import Controller
from lyapnet.evaluation.afterwards import Afterwards

LEAST, FAR = 1e-12, 1e3  # ends of the axis at the most, times the greatest distance before T
OUT_OF_SIGHT = 1e-24  # likewise, for zero, which a logarithmic axis does not have


def distances(found: Sequence[Afterwards], controller: Controller) -> Figure:
    """‖x − x*‖ against t under each law: the mean, and the band from the closest closed loop to the furthest."""
    figure = Figure(figsize=(5.6, 3.6), layout="constrained")
    axes = figure.subplots()
    drawn = {one.beyond: one.distance for one in found if one.distance is not None}
    before = max(float(distance[: controller.horizon.steps + 1].max()) for distance in drawn.values()) or 1.0
    for color, (beyond, distance) in zip(CYCLE, drawn.items(), strict=False):
        t = numpy_of(controller.horizon.dt * torch.arange(len(distance)))
        shown = numpy_of(distance.clamp(min=OUT_OF_SIGHT * before))
        axes.fill_between(t, shown.min(1), shown.max(1), color=color, alpha=0.15, lw=0)
        axes.semilogy(t, shown.mean(1), color=color, linewidth=1.4, label=beyond)
    bottom, top = axes.get_ylim()
    axes.set_ylim(max(bottom, LEAST * before), min(top, FAR * before))
    axes.axvline(controller.horizon.duration, color="black", linewidth=0.8, linestyle=":", label="T")
    axes.set_xlabel("time t (s)")
    axes.set_ylabel("‖x − x*‖")
    missing = [one.beyond for one in found if one.distance is None]
    also = f"; none of {', '.join(missing)}" if missing else ""
    axes.set_title(f"mean and range of {next(iter(drawn.values())).shape[1]} closed loops{also}", fontsize=8)
    legend_below(figure, axes)
    return figure

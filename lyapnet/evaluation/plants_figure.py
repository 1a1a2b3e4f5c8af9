"""A figure of the cost on plants that differ from the model, against each parameter."""

from matplotlib.figure import Figure

from lyapnet.base.drawing import BLUE, GREY, ORANGE, to_numpy
from lyapnet.evaluation.on_plants import OnPlants


def cost_against_parameters(measured: OnPlants) -> Figure:
    """J / J* of each closed loop against each parameter of its plant; closed loops that are not finite at the top.

    Args:
        measured: closed loops whose J* is known.
    """
    problem, n = measured.plants.problem, measured.plants.n
    names = [problem.system.state_names[i].replace("_", " ") for i in problem.system.constants]
    ratio, p = to_numpy(measured.ratio), to_numpy(measured.z0[:, n:])
    finite = to_numpy(measured.cost.isfinite() & measured.ratio.isfinite())
    lost = to_numpy(~measured.cost.isfinite())
    top = float(ratio[finite].max(initial=1.0))
    figure = Figure(figsize=(2.8 * len(names) + 0.6, 2.8), layout="constrained")
    for k, (panel, name) in enumerate(
        zip(figure.subplots(1, len(names), sharey=True, squeeze=False)[0], names, strict=True)
    ):
        panel.axhline(1, color=GREY, linewidth=0.8)
        panel.plot(p[finite, k], ratio[finite], ".", color=BLUE, markersize=3)
        if lost.any():
            panel.plot(p[lost, k], [top] * int(lost.sum()), "x", color=ORANGE, label="not finite")
        panel.set_xlabel(name, fontsize=9)
        panel.tick_params(labelsize=8)
    first = figure.axes[0]
    first.set_ylabel("cost / optimum of the same plant", fontsize=9)
    if lost.any():
        first.legend(fontsize=8)
    return figure

"""A figure of states, their estimates and the standard deviations of these, along one closed loop."""

from matplotlib.figure import Figure

from lyapnet.base.drawing import BLUE, GREY, ORANGE, VERMILION, legend_below, to_numpy
from lyapnet.controller.output_feedback import OutputFeedback
from lyapnet.evaluation.figures import MOST_PANELS
from lyapnet.evaluation.with_estimator import EstimatedLoops

BAND = 2  # half-width of the band around an estimate, in standard deviations
ROOM = 0.15  # space above and below the curves, relative to their extent


def states_and_estimates(loops: EstimatedLoops, estimator: OutputFeedback) -> Figure:
    """Each state of the first closed loop, its estimate with a band of ± 2 standard deviations, and its readings.

    Panels are scaled by state and estimate, so that a wide band, as often at first, is cut off.
    """
    system, outputs = estimator.problem.system, estimator.outputs
    measured = {name: k for k, name in enumerate(outputs.names)}
    t, count = to_numpy(loops.t), min(system.n, MOST_PANELS)
    columns = 1 if count < 4 else 2
    rows = -(-count // columns)
    figure = Figure(figsize=(4.6 * columns, 1.6 * rows + 0.6), layout="constrained")
    panels = list(figure.subplots(rows, columns, sharex=True, squeeze=False).flatten(order="F"))
    handles = dict[str, object]()
    for i, panel in enumerate(panels[:count]):
        x, x_hat = (to_numpy(part[:, 0, i]) for part in (loops.x, loops.x_hat))
        width = BAND * to_numpy(loops.P[:, 0, i, i].sqrt())
        panel.fill_between(t, x_hat - width, x_hat + width, color=ORANGE, alpha=0.3, linewidth=0, label="estimate ± 2σ")
        k = measured.get(system.state_names[i])
        if k is not None:
            panel.plot(t, to_numpy(loops.y[:, 0, k]), ".", color=GREY, markersize=2, label="reading")
        panel.plot(t, x, color=BLUE, linewidth=1.6, label="state")
        panel.plot(t, x_hat, color=VERMILION, linewidth=1, linestyle="--", label="estimate")
        low, high = min(x.min(), x_hat.min()), max(x.max(), x_hat.max())
        room = ROOM * (high - low) or 1.0
        panel.set_ylim(low - room, high + room)
        panel.set_ylabel(system.state_labels[i].replace(" (", "\n("), fontsize=8)
        panel.tick_params(labelsize=7)
        handles |= {str(each.get_label()): each for each in panel.get_legend_handles_labels()[0]}
    for spare in panels[count:]:
        spare.set_visible(False)
    for column in range(columns):
        last = panels[min((column + 1) * rows, count) - 1]
        last.set_xlabel("time (s)", fontsize=8)
        last.tick_params(labelbottom=True)
    legend_below(figure, [*handles.values()])  # pyright: ignore[reportArgumentType]
    return figure

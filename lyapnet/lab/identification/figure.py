"""A figure of readings, of the fitted model, and of their difference."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lyapnet.base.drawing import BLUE, GREY, ORANGE, VERMILION, legend_below
from lyapnet.lab.identification.results import Curve, Identification, fit_of

MOST_READINGS, MOST_RECORDINGS = 4, 3
BAND = 2  # half-width of the band around zero, in standard deviations of a reading


def measured_and_fitted(found: Identification) -> Figure:
    """For each reading, data and model, and below their difference with a band of ± 2σ; recordings side by side.

    Held-out data have another colour; there, only initial states are fitted.
    """
    names = list(dict.fromkeys(curve.name for curve in found.curves))[:MOST_RECORDINGS]
    readings = list(found.noise)[:MOST_READINGS]
    figure = Figure(figsize=(max(7.2, 4.6 * len(names)), 2.5 * len(readings) + 0.7), layout="constrained")
    panels = figure.subplots(
        2 * len(readings), len(names), sharex="col", sharey="row", squeeze=False, height_ratios=[3, 1.2] * len(readings)
    )
    for column, name in enumerate(names):
        curves = [curve for curve in found.curves if curve.name == name]
        for j, reading in enumerate(readings):
            _draw(panels[2 * j, column], panels[2 * j + 1, column], curves, j, found.noise[reading])
            if not column:
                unit = f" ({found.units[reading]})" if found.units[reading] else ""
                panels[2 * j, 0].set_ylabel(f"{reading}{unit}", fontsize=8)
                panels[2 * j + 1, 0].set_ylabel("data − model", fontsize=7)
        panels[0, column].set_title(_title(name, curves), fontsize=8)
        panels[-1, column].set_xlabel("time (s)", fontsize=8)
    handles = {str(each.get_label()): each for p in panels[0] for each in p.get_legend_handles_labels()[0]}
    legend_below(figure, [*handles.values()])  # pyright: ignore[reportArgumentType]
    return figure


def _draw(above: Axes, below: Axes, curves: Sequence[Curve], j: int, sigma: float) -> None:
    for curve in curves:
        color, label = (VERMILION, "model, held out") if curve.held_out else (BLUE, "model, fitted")
        above.plot(curve.t, curve.y[:, j], ".", color=GREY, alpha=0.6, markersize=3, label="data", rasterized=True)
        t, y_hat = _with_gaps(curve, curve.t), _with_gaps(curve, curve.y_hat[:, j])
        above.plot(t, y_hat, color=color, linewidth=0.9, label=label)
        left = curve.y[:, j] - curve.y_hat[:, j]
        below.plot(curve.t, left, ".", color=color, markersize=1.2, rasterized=True)
    below.axhspan(-BAND * sigma, BAND * sigma, color=ORANGE, alpha=0.25, linewidth=0)
    for panel in (above, below):
        panel.tick_params(labelsize=7)
        panel.margins(x=0.01)


def _with_gaps(curve: Curve, values: np.ndarray) -> np.ndarray:
    """Values with a gap wherever the model starts again from another state."""
    return np.insert(values.astype(float), curve.starts[1:], np.nan)


def _title(name: str, curves: Sequence[Curve]) -> str:
    """The name of a recording, and the fit of each of its parts."""
    parts = list[str]()
    for curve in curves:
        shares = ", ".join(f"{share:.1%}" for share in fit_of([curve]))
        parts.append(f"{'held out' if curve.held_out else 'fit'} {shares}")
    return f"{name.rpartition('/')[2]}: {'; '.join(parts)}"

"""The figure of a sweep."""

import math
from collections import defaultdict
from collections.abc import Sequence
from statistics import fmean

from matplotlib.figure import Figure

from lyapnet.base.drawing import CYCLE, GREY, legend_below
from lyapnet.lab.sweep.runs import SweepRow

SWEPT = {  # name of a measure in a row ↦ label of its axis
    "cost_mean": "mean cost J",
    "cost_ratio": "cost / optimum",
    "value_error": "value error",
    "constraint_loss": "constraint loss",
    "training_seconds": "training (s)",
    "peak_bytes": "peak memory (MB)",
}


def swept(rows: Sequence[SweepRow]) -> Figure:
    """Measures of runs against the varied key: a point for each seed, and a line through the means."""
    places = _places([row.value for row in rows])
    columns = {label: [_swept_number(row, name) for row in rows] for name, label in SWEPT.items()}
    known = {label: [number for number in column if number is not None] for label, column in columns.items()}
    shown = {label: numbers for label, numbers in known.items() if len(numbers) == len(rows)}
    figure = Figure(figsize=(9, 2.6 * math.ceil(len(shown) / 3)), layout="constrained")
    panels = figure.subplots(math.ceil(len(shown) / 3), 3, squeeze=False).flatten()
    for panel, (label, column) in zip(panels, shown.items(), strict=False):
        for config, color in zip(dict.fromkeys(row.config for row in rows), CYCLE, strict=False):
            seeds = defaultdict(list)
            for row, number in zip(rows, column, strict=True):
                if row.config == config:
                    seeds[places[row.value]].append(number)
            for value, numbers in seeds.items():
                panel.plot([value] * len(numbers), numbers, "o", color=color, markersize=3, alpha=0.6)
            panel.plot([*seeds], [fmean(numbers) for numbers in seeds.values()], color=color, label=config)
        if max(column) > 10 * min(column) > 0:
            panel.set_yscale("log")
        elif label != SWEPT["cost_ratio"]:
            panel.set_ylim(0, 1.08 * max(column))
        panel.set_ylabel(label, fontsize=8)
        panel.set_xlabel(rows[0].key or "", fontsize=8)
        panel.set_xticks([*places.values()], [str(value) for value in places])
        panel.tick_params(labelsize=8)
        panel.grid(color=GREY, alpha=0.25, linewidth=0.5)
    for panel in panels[len(shown) :]:
        panel.set_axis_off()
    legend_below(figure, panels[0])
    return figure


def _places(values: Sequence[str | None]) -> dict[str | None, float]:
    """The place of each value on the axis of a key: its number, or if it is none, its index."""
    try:
        return {value: float(value or "") for value in values}
    except ValueError:
        return {value: float(i) for i, value in enumerate(dict.fromkeys(values))}


def _swept_number(row: SweepRow, name: str) -> float | None:
    if name == "peak_bytes":
        return row.peak_bytes / 1e6
    return row.measures[name] if name in row.measures else getattr(row, name)

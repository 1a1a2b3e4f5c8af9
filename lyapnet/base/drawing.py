"""Common parts of all figures: colours, arrays, legends, pixels."""

from collections.abc import Sequence

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

# Okabe and Ito's colours, which colour-blind readers can distinguish.
BLUE, ORANGE, GREEN, VERMILION, GREY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#777777"
SKY, PURPLE = "#56B4E9", "#CC79A7"
CYCLE = (BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY, GREY)


def legend_below(figure: Figure, shown: Axes | Sequence[Artist], columns: int = 4) -> None:
    """Add one legend below the panels of a figure, for the labelled artists of a panel or for given artists."""
    handles = shown.get_legend_handles_labels()[0] if isinstance(shown, Axes) else list(shown)
    figure.legend(
        handles=handles, loc="outside lower center", ncols=columns, fontsize=7, frameon=False, columnspacing=1
    )


def pixels(figure: Figure) -> np.ndarray:
    """The figure as (height, width, 4) bytes, for TensorBoard."""
    canvas = FigureCanvasAgg(figure)
    figure.set_dpi(110)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())


def to_numpy(tensor: Tensor) -> np.ndarray:
    """A tensor as an array, for matplotlib."""
    return tensor.detach().cpu().numpy()

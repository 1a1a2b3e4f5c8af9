"""Costs relative to known optima, as evaluations, certificates and comparisons report them."""

import torch
from torch import Tensor

from lyapnet.task.cost import spread


def mean_optimum(optima: Tensor) -> float | None:
    """The mean of the known optima (b,); unknown ones are NaN. None if none is known."""
    known = torch.isfinite(optima)
    return float(optima[known].mean()) if known.any() else None


def ratio_of_means(costs: Tensor, optima: Tensor) -> float | None:
    """Mean cost / mean optimum over the states (b,) whose optimum is known; None if none is.

    A mean of ratios would be dominated by states near the goal, where the optimum tends to 0.
    """
    known = torch.isfinite(optima)
    return float(costs[known].mean() / optima[known].mean()) if known.any() else None


def in_spreads(differences: Tensor, optima: Tensor) -> float | None:
    """Mean difference / standard deviation of the optima, over the states whose optimum is known; None if none is.

    For costs of any sign, where a ratio has no meaning. For the difference J − J* it is the regret.
    """
    known = torch.isfinite(optima)
    return float(differences[known].mean() / spread(optima[known])) if known.any() else None

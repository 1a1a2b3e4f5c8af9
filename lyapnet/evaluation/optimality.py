"""Costs held against known optima: the one ratio that evaluations, certificates and comparisons report."""

import torch
from torch import Tensor

from lyapnet.task.cost import spread


def mean_optimum(optima: Tensor) -> float | None:
    """The mean of the known optima (b,), NaN where one is not known; None where none is."""
    known = torch.isfinite(optima)
    return float(optima[known].mean()) if known.any() else None


def ratio_of_means(costs: Tensor, optima: Tensor) -> float | None:
    """Mean cost / mean optimum over the states (b,) whose optimum is known; None where none is.

    A ratio of means rather than a mean of ratios: near the goal the optimum tends to 0, and its ratio says nothing.
    """
    known = torch.isfinite(optima)
    return float(costs[known].mean() / optima[known].mean()) if known.any() else None


def in_spreads(differences: Tensor, optima: Tensor) -> float | None:
    """Mean difference / the spread of the optima (standard deviation), over the states whose optimum is known.

    For costs of any sign, whose ratio says nothing: of J − J*, the regret. None where no optimum is known.
    """
    known = torch.isfinite(optima)
    return float(differences[known].mean() / spread(optima[known])) if known.any() else None

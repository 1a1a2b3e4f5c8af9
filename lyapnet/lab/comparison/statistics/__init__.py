"""Statistics of results: means and intervals over the seeds of a method, and comparisons of methods."""

from lyapnet.lab.comparison.statistics.comparison import TASKS, Comparison, Speedup, compared, in_order
from lyapnet.lab.comparison.statistics.groups import CONVERGED, NEAR, AtStep, Group, Reach
from lyapnet.lab.comparison.statistics.one_result import cost_ratio, first_within, optimum, relative_costs
from lyapnet.lab.comparison.statistics.spread import Spread, interquartile_mean, spread

__all__ = [
    "CONVERGED",
    "NEAR",
    "TASKS",
    "AtStep",
    "Comparison",
    "Group",
    "Reach",
    "Speedup",
    "Spread",
    "compared",
    "cost_ratio",
    "first_within",
    "in_order",
    "interquartile_mean",
    "optimum",
    "relative_costs",
    "spread",
]

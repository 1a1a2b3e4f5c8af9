"""Costs: a running cost and a terminal cost."""

from lyapnet.task.cost.base import Cost
from lyapnet.task.cost.goal import goal_in_words, reason_for_no_goal, spread
from lyapnet.task.cost.penalty import PenaltyCost, closeness
from lyapnet.task.cost.quadratic import QuadraticCost, is_quadratic
from lyapnet.task.cost.smoothed import SmoothedCost
from lyapnet.task.cost.time import TimeCost, arrival_steps, squared_distance, time_cost_of
from lyapnet.task.cost.weights import MATRICES, DiagonalWeights, with_matrices
from lyapnet.task.cost.wrappers import (
    CostWrapper,
    ObstacleCost,
    PeriodicCost,
    PseudoHuberCost,
    RegulatorsTail,
    RegulatorTail,
    TargetCost,
    innermost,
    is_quadratic_about_target,
)

COSTS: dict[str, type[Cost]] = {"quadratic": QuadraticCost}

__all__ = [
    "COSTS",
    "MATRICES",
    "Cost",
    "CostWrapper",
    "DiagonalWeights",
    "ObstacleCost",
    "PenaltyCost",
    "PeriodicCost",
    "PseudoHuberCost",
    "QuadraticCost",
    "RegulatorTail",
    "RegulatorsTail",
    "SmoothedCost",
    "TargetCost",
    "TimeCost",
    "arrival_steps",
    "closeness",
    "goal_in_words",
    "innermost",
    "is_quadratic",
    "is_quadratic_about_target",
    "reason_for_no_goal",
    "spread",
    "squared_distance",
    "time_cost_of",
    "with_matrices",
]

"""Whether a cost has a goal: a state at which q and φ vanish, with their slopes, and below which neither goes."""

import torch
from jaxtyping import Float
from torch import Tensor

from lyapnet.base.types import PerState
from lyapnet.task.cost.base import Cost

THIN = 1e-3  # of the mean size of costs, which their spread counts for at the least: X₀ may be a point
VANISHING = 1e-2  # of what q and φ are in the median, below which they vanish: the tail of an obstacle may reach a goal
NEGATIVE = 1e-3  # of the same, below zero: there V is no distance


def reason_for_no_goal(cost: Cost, goal: Float[Tensor, " n"], x: Float[Tensor, "b n"]) -> str:
    """Why a state is no goal of a cost; empty where it is one.

    At a goal q and φ vanish with their slopes, and nowhere are they negative: V is then a distance to it, in units of
    cost. A profit, a harvest, and what is left of a tumour have none.

    Args:
        cost: without the penalty that training adds for constraints.
        goal: (n,), that of the cost, or the origin.
        x: states (b, n) where the task begins.
    """
    where = goal_in_words(cost, goal)
    distance = (x - goal).abs().median(0).values
    for symbol, function in (("q", cost.state), ("φ", cost.terminal)):
        values = function(x).detach()
        size = float(values.abs().median()) or float(values.abs().mean())
        with torch.enable_grad():
            leaf = goal.detach().clone().requires_grad_()
            value = function(leaf)
            slope = torch.autograd.grad(value, leaf, materialize_grads=True)[0] if value.requires_grad else 0 * goal
        if max(abs(float(value.detach())), float((slope * distance).abs().max())) > VANISHING * size:
            return f"{symbol} is {float(value.detach()):.3g}, of slope {_listed(slope)}, at {where}"
        lowest = int(values.argmin())
        if float(values[lowest]) < -NEGATIVE * size:
            return f"{symbol} is negative, {float(values[lowest]):.3g}, at x = {_listed(x[lowest])}"
    return ""


def goal_in_words(cost: Cost, goal: Float[Tensor, " n"]) -> str:
    """The goal, and where nobody named it that it stands in for one."""
    if cost.goal is None:
        return "the origin, which stands in for a target: nobody named one"
    return f"the goal {_listed(goal)}"


def spread(cost: PerState) -> Float[Tensor, ""]:
    """The standard deviation of some costs, THIN of their mean size at the least.

    Without a goal costs may be of any sign, and small as a whole where their differences are not: this is what
    differences are held against.
    """
    return cost.std(correction=0).maximum(THIN * cost.abs().mean())


def _listed(values: Tensor) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in values.detach().tolist()) + ")"

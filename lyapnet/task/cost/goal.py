"""Whether a cost has a goal: a state at which q and φ vanish with their slopes, while both are nowhere negative."""

import torch
from jaxtyping import Float
from torch import Tensor

from lyapnet.base.types import PerState
from lyapnet.task.cost.base import Cost

MIN_SPREAD = 1e-3  # smallest spread of costs, relative to their mean size, for an X₀ of a single point
VANISHING_TOLERANCE = 1e-2  # value at the goal relative to the median that counts as zero, as of an obstacle's tail
NEGATIVITY_TOLERANCE = 1e-3  # negative value relative to the median that counts as negative


def reason_for_no_goal(cost: Cost, goal: Float[Tensor, " n"], x: Float[Tensor, "b n"]) -> str:
    """The reason why a state is no goal of a cost; empty if it is one.

    At a goal q and φ vanish with their slopes, and they are nowhere negative, so that V measures the distance to it. A
    profit, a harvest, or the remainder of a tumour have no goal.

    Args:
        cost: the cost, without the penalty for constraints.
        goal: (n,), the goal of the cost, or the origin.
        x: typical states (b, n) of the task.
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
        if max(abs(float(value.detach())), float((slope * distance).abs().max())) > VANISHING_TOLERANCE * size:
            return f"{symbol} is {float(value.detach()):.3g}, of slope {_format_vector(slope)}, at {where}"
        lowest = int(values.argmin())
        if float(values[lowest]) < -NEGATIVITY_TOLERANCE * size:
            return f"{symbol} is negative, {float(values[lowest]):.3g}, at x = {_format_vector(x[lowest])}"
    return ""


def goal_in_words(cost: Cost, goal: Float[Tensor, " n"]) -> str:
    """Describe the goal, and say if it is only the default."""
    if cost.goal is None:
        return "the origin, the default, because no target is named"
    return f"the goal {_format_vector(goal)}"


def spread(cost: PerState) -> Float[Tensor, ""]:
    """The standard deviation of some costs, at least MIN_SPREAD times their mean size.

    It is the scale of cost differences in tasks without a goal, where costs may have any sign and a small mean.
    """
    return cost.std(correction=0).maximum(MIN_SPREAD * cost.abs().mean())


def _format_vector(values: Tensor) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in values.detach().tolist()) + ")"

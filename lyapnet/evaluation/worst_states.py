"""A search for the states of X₀ from which closed loops cost most, relative to V(0, x₀)."""

from collections.abc import Callable

import torch
from torch import Tensor

from lyapnet.base.types import PerState, State
from lyapnet.loop.programs.terms import value_floored
from lyapnet.task.cost import spread
from lyapnet.task.sets import Box

MIN_EXCESS = 0.05  # relative excess of the cost over V(0, x₀) above which a state counts as lost
ROUNDS = 6  # searches near the states with the largest excess
WORST_STATES = 16  # number of these states
STATES_NEAR_EACH = 16  # random states near each of them
SPREAD = 0.03  # standard deviation of these states about it, relative to the width of X₀


def excess(cost: PerState, value: PerState, has_goal: bool = True, typical: Tensor | None = None) -> PerState:
    """The excess (J_N − V(0, x₀)) / V(0, x₀) of the cost over V, infinite where a closed loop is not finite.

    V is at least a share of the median of typical costs. Without a goal the excess is relative to their spread.

    Args:
        typical: costs (k,) from random states; None: `cost`.
    """
    typical = cost if typical is None else typical
    typical = typical[typical.isfinite()]
    if not len(typical):
        return torch.full_like(cost, torch.inf)
    size = value_floored(value, typical) if has_goal else spread(typical)
    return ((cost - value) / size).nan_to_num(torch.inf, torch.inf)


def search_near_worst(
    box: Box, x0: State, excesses: PerState, measure: Callable[[State], PerState], generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Test states near those with the largest excess, again and again, if one of the given states is lost.

    Beside a cliff of the cost a closed loop fails from one state in thousands, which random states hardly ever meet;
    but it costs more from the states around it.

    Args:
        box: X₀.
        x0: random states (b, n) of X₀.
        excesses: their excesses.
        measure: states ↦ their excesses.
        generator: draws the further states.

    Returns:
        All tested states (k, n) and their excesses (k,), the given ones first.
    """
    for _ in range(ROUNDS if bool((excesses > MIN_EXCESS).any()) else 0):
        worst = x0[excesses.topk(min(WORST_STATES, len(x0))).indices].repeat_interleave(STATES_NEAR_EACH, 0)
        noise = torch.randn(worst.shape, generator=generator).to(worst)
        low, high = box.lower.to(worst), box.upper.to(worst)
        near = (worst + SPREAD * (high - low) * noise).maximum(low).minimum(high)
        x0, excesses = torch.cat([x0, near]), torch.cat([excesses, measure(near)])
    return x0, excesses

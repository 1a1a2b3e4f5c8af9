"""A cost of time: a constant rate until the state is near its goal."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from lyapnet.base.types import PerState, State, StatePath
from lyapnet.task.cost.base import Cost
from lyapnet.task.cost.wrappers import CostWrapper


class TimeCost(CostWrapper):
    """Another cost plus k (1 − exp(−d²/2)) per second, d² = Σ_i ((x_i − x*_i)/w_i)²: the time until d ≤ 1.

    Far from the goal it is k per second (0.99 k at d = 3). Near the goal it is k d²/2, so that V is smooth there, and
    the law becomes a linear regulator. With k = 1, limited controls and a small R, V is about the time to the goal.

    Far from the goal its slope vanishes. Optima are therefore computed with larger w first, see `widening`.

    Args:
        cost: the other cost, with its goal at the origin.
        near: a cost with q = d²/2 of n states.
        per_second: k.
        n: number of states; entries of x after them are parameters.

    Raises:
        ValueError: k is not positive.
    """

    near: Cost
    per_second: float
    n: int
    widening: Float[Tensor, ""]  # factor of w; other than 1 only during the search for optima

    def __init__(self, cost: Cost, near: Cost, per_second: float, n: int):
        super().__init__(cost)
        if not 0 < per_second < math.inf:
            raise ValueError(f"Expected a cost of time > 0, got {per_second:g}; give it in cost per second.")
        self.near, self.per_second, self.n = near, per_second, n
        self.register_buffer("widening", torch.tensor(1.0), persistent=False)
        self.words: str = f"{per_second:g} per second until near the goal"

    def state(self, x: State) -> PerState:
        return self.cost.state(x) + self.per_second * (1 - torch.exp(-self.near.state(x) / self.widening.square()))

    def ignores(self, i: int, n: int) -> bool:
        return self.near.ignores(i, n) and self.cost.ignores(i, n)


def time_cost_of(cost: Cost) -> TimeCost | None:
    """The cost of time that a cost contains; None if it has none."""
    while isinstance(cost, CostWrapper):
        if isinstance(cost, TimeCost):
            return cost
        cost = cost.cost
    return None


def squared_distance(cost: Cost, x: State) -> PerState:
    """d² of a cost that contains a cost of time."""
    time = time_cost_of(cost)
    assert time is not None
    return 2 * time.near.state(cost.from_goal(x)[..., : time.n])


def arrival_steps(cost: Cost, x: StatePath) -> Tensor:
    """The number of steps after which d ≤ 1 for the rest of each trajectory (N + 1, *batch, n).

    It is N + 1 for trajectories that end farther away.
    """
    outside = squared_distance(cost, x) > 1
    return len(x) - (~outside).flip(0).long().cumprod(0).sum(0)

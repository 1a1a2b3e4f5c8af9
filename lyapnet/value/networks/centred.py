"""V as a function of the distance x − x* from the goal."""

import torch
from jaxtyping import Float
from torch import Tensor

from lyapnet.base.types import PerState, State, Time
from lyapnet.value.calculus import ValueFunction


class CentredNetwork(ValueFunction):
    """V(t, x) = N(t, x − x*): moves a network's guarantees and resolution from the origin to another goal.

    Args:
        network: N.
        goal: x*, in the states of N.
    """

    goal: Float[Tensor, " n"]

    def __init__(self, network: ValueFunction, goal: Tensor):
        super().__init__()
        self.network = network
        self.register_buffer("goal", goal.to(torch.get_default_dtype()), persistent=False)

    def forward(self, t: Time, x: State) -> PerState:
        return self.network(t, x - self.goal)

    def value_and_state_gradient(self, t: Time, x: State) -> tuple[PerState, State]:
        """V and V_x."""
        return self.network.value_and_state_gradient(t, x - self.goal)

    def curvature(self, t: Time) -> Tensor | None:
        return self.network.curvature(t)

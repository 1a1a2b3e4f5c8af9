"""Guarantees by construction: V tied to the terminal cost at t = T, and to zero at the goal."""

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor, nn

from lyapnet.calculus import state_gradient
from lyapnet.cost import QuadraticCost
from lyapnet.networks.base import Scaling
from lyapnet.networks.icnn import PartiallyConvexNetwork
from lyapnet.types import PerState, State, Time, Value


class TerminalAnchor(nn.Module):
    """V(t, x) = φ(x) + (1 − t/T) N(t, x), so that V(T, x) = φ(x) for any network N.

    Where N is convex in x, so is V; where N(t, 0) = 0, so is V(t, 0). With N ≥ 0, as an AnchoredNetwork is, V ≥ φ at
    every t: an upper bound of the cost-to-go still fits, the cost-to-go itself need not.
    """

    def __init__(self, network: nn.Module, cost: QuadraticCost, duration: float):
        super().__init__()
        self.network, self.cost, self.duration = network, cost, duration

    def forward(self, t: Time, x: State) -> PerState:
        return self.cost.terminal(x) + (1 - t / self.duration) * self.network(t, x)

    def state_gradient(self, t: Time, x: State) -> State:
        """V_x, with φ_x = 2Q_T x."""
        remaining = (1 - t / self.duration)[..., None]
        return 2 * (x @ self.cost.Q_T) + remaining * state_gradient(self.network, t, x)


class GoalAnchor(nn.Module):
    """V(t, x) = N(t, x) − N(t, 0) − N_x(t, 0)ᵀx + ε‖x‖²: the Bregman divergence of N from the goal, plus ε‖x‖².

    For N convex in x: V is convex in x, V ≥ ε‖x‖², V(t, 0) = 0 and V_x(t, 0) = 0 at every t. This closes the
    hole through which c(t) + ε‖x‖², with c falling fast, satisfies the Lyapunov condition without control.

    Args:
        network: N, convex in x.
        epsilon: ε > 0, in cost per squared state unit.
    """

    def __init__(self, network: nn.Module, epsilon: float = 1e-3):
        super().__init__()
        self.network, self.epsilon = network, epsilon

    def forward(self, t: Time, x: State) -> PerState:
        value, value_at_goal = _at_state_and_goal(self.network, t, x)
        slope_at_goal = state_gradient(self.network, t, x.new_zeros(*t.shape, x.shape[-1]))
        return value - value_at_goal - (slope_at_goal * x).sum(-1) + self.epsilon * (x**2).sum(-1)

    def state_gradient(self, t: Time, x: State) -> State:
        """V_x = N_x(t, x) − N_x(t, 0) + 2εx."""
        slope, slope_at_goal = _at_state_and_goal(partial(state_gradient, self.network), t, x)
        return slope - slope_at_goal + 2 * self.epsilon * x


class AnchoredNetwork(GoalAnchor):
    """A partially convex network inside a GoalAnchor: a Lyapunov candidate for any weights.

    Args:
        scaling, hidden, activation: of the PartiallyConvexNetwork.
        epsilon: ε > 0, in cost per squared state unit.
    """

    def __init__(
        self,
        scaling: Scaling,
        hidden: Sequence[int] = (64, 64),
        activation: str = "softplus",
        epsilon: float = 1e-3,
    ):
        super().__init__(PartiallyConvexNetwork(scaling, hidden, activation), epsilon)


def _at_state_and_goal(function: Value, t: Time, x: State) -> tuple[Tensor, Tensor]:
    """A function of (t, x) at the states and at the goal in one call: a small network costs per call, not per state."""
    if x.ndim > 1 and (t.ndim == 0 or t.shape[-1] == 1):  # one time for a row of states: the goal joins the row
        row = x.ndim - 2
        both = function(t, torch.cat([x, x.new_zeros(*x.shape[:-2], 1, x.shape[-1])], row))
        return both.narrow(row, 0, x.shape[row]), both.narrow(row, x.shape[row], 1)
    both = function(t, torch.stack([x, torch.zeros_like(x)]))
    return both[0], both[1]

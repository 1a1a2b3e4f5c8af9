"""Networks with guarantees by construction: V(T, x) = φ(x), and V = 0 at the goal."""

from collections.abc import Sequence

import torch
from torch import Tensor

from lyapnet.base.types import PerState, State, Time
from lyapnet.task.cost import Cost
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.networks.base import Scaling
from lyapnet.value.networks.expansion import ExpansionNetwork
from lyapnet.value.networks.icnn import PartiallyConvexNetwork


class TerminalAnchor(ValueFunction):
    """V(t, x) = φ(x) + (1 − t/T) N(t, x), so that V(T, x) = φ(x) for any network N.

    If N is convex in x, so is V; if N(t, 0) = 0, then V(t, 0) = 0. If N ≥ 0, as for an AnchoredNetwork, V ≥ φ at every
    t: such a V can represent upper bounds of the cost-to-go, but not every cost-to-go.

    Raises:
        ValueError: N is an ExpansionNetwork, which equals φ at T already.
    """

    def __init__(self, network: ValueFunction, cost: Cost, duration: float):
        super().__init__()
        if isinstance(network, ExpansionNetwork):
            raise ValueError("Expected terminal=free with the expansion network, got exact; it starts at φ: remove it.")
        self.network, self.cost, self.duration = network, cost, duration

    def forward(self, t: Time, x: State) -> PerState:
        return self.cost.terminal(x) + (1 - t / self.duration) * self.network(t, x)

    def value_and_state_gradient(self, t: Time, x: State) -> tuple[PerState, State]:
        """V and V_x."""
        remaining = 1 - t / self.duration
        N, N_x = self.network.value_and_state_gradient(t, x)
        return self.cost.terminal(x) + remaining * N, self.cost.terminal_gradient(x) + remaining[..., None] * N_x


class GoalAnchor(ValueFunction):
    """V(t, x) = N(t, x) − N(t, 0) − N_x(t, 0)ᵀx + ε‖x‖²: the Bregman divergence of N from the goal, plus ε‖x‖².

    For N convex in x: V is convex in x, V ≥ ε‖x‖², V(t, 0) = 0 and V_x(t, 0) = 0 at every t. This excludes the trivial
    solution c(t) + ε‖x‖² with fast decreasing c, which satisfies the Lyapunov condition without control.

    Args:
        network: N, convex in x.
        epsilon: ε > 0, in cost per squared state unit.
    """

    def __init__(self, network: ValueFunction, epsilon: float = 1e-3):
        super().__init__()
        self.network, self.epsilon = network, epsilon

    def forward(self, t: Time, x: State) -> PerState:
        at_goal = self.network.value_and_state_gradient(t, x.new_zeros(*t.shape, x.shape[-1]))
        return self._divergence(self.network(t, x), *at_goal, x)

    def _divergence(self, value: PerState, value_at_goal: Tensor, slope_at_goal: Tensor, x: State) -> PerState:
        return value - value_at_goal - (slope_at_goal * x).sum(-1) + self.epsilon * (x**2).sum(-1)

    def value_and_state_gradient(self, t: Time, x: State) -> tuple[PerState, State]:
        """V and V_x = N_x(t, x) − N_x(t, 0) + 2εx."""
        joined = _join_goal(t, x)
        both = self.network.value_and_state_gradient(t, joined)
        (value, value_at_goal), (slope, slope_at_goal) = (_split_goal(y, t, x) for y in both)
        value = self._divergence(value, value_at_goal, slope_at_goal, x)
        return value, slope - slope_at_goal + 2 * self.epsilon * x


class AnchoredNetwork(GoalAnchor):
    """A partially convex network inside a GoalAnchor: a Lyapunov candidate for any weights.

    Args:
        scaling, hidden, activation: arguments of the PartiallyConvexNetwork.
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


def _join_goal(t: Time, x: State) -> Tensor:
    """Append the goal to the states for one common call: the time of a small network is mostly per call."""
    if _is_row(t, x):
        return torch.cat([x, x.new_zeros(*x.shape[:-2], 1, x.shape[-1])], -2)
    return torch.stack([x, torch.zeros_like(x)])


def _split_goal(joined: Tensor, t: Time, x: State) -> tuple[Tensor, Tensor]:
    """Split the result of a function of the joined states into those at the states and at the goal."""
    if not _is_row(t, x):
        return joined[0], joined[1]
    row = x.ndim - 2
    return joined.narrow(row, 0, x.shape[row]), joined.narrow(row, x.shape[row], 1)


def _is_row(t: Time, x: State) -> bool:
    """Whether all states of a row share one time, so that the goal can be appended to the row."""
    return x.ndim > 1 and (t.ndim == 0 or t.shape[-1] == 1)

"""The penalty that replaces constraints in training."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lyapnet.base.types import PerState, State
from lyapnet.task.cost.base import Cost
from lyapnet.task.cost.wrappers import CostWrapper


def closeness(constraints: nn.Module, margin: Tensor, x: State) -> PerState:
    """Σ_j max(0, 1 + h_j(x)/m_j)³: for a single constraint 1 at h = 0, and 0 for h ≤ −m."""
    return (torch.relu(1 + constraints(x) / margin) ** 3).sum(-1)


class PenaltyCost(CostWrapper):
    """Another cost plus a penalty w Σ_j max(0, 1 + h_j(x)/m_j)³ per second for constraints h(x) ≤ 0.

    The penalty is w at h_j = 0 and 0 for h_j ≤ −m_j. The terminal cost includes the penalty of one step. It is twice
    continuously differentiable, and so is the value function. With sufficiently large w the optimum satisfies h ≤ 0,
    at a lower cost than with the constraint h ≤ −m.

    Args:
        cost: the other cost.
        constraints: h, x ↦ (*batch, k).
        margin: m of all h_j, or m_j of each, in the unit of h.
        weight: w, in cost per second.
        step: Δt, in s.

    Source: Nocedal, Wright, Numerical Optimization, 2006, ch. 17 (penalty methods), with the constraint shifted by m.
    """

    constraints: nn.Module
    margin: Float[Tensor, "*k"]
    step: float
    weight: Float[Tensor, ""]  # w, in cost per second

    def __init__(
        self,
        cost: Cost,
        constraints: nn.Module,
        margin: float | Sequence[float],
        weight: float = 0.0,
        step: float = 0.0,
    ):
        super().__init__(cost)
        self.constraints, self.step = constraints, step
        self.register_buffer("margin", torch.tensor(margin, dtype=torch.float64), persistent=False)
        self.register_buffer("weight", torch.tensor(float(weight)), persistent=False)

    def state(self, x: State) -> PerState:
        return self.cost.state(x) + self.penalty(x)

    def terminal(self, x: State) -> PerState:
        return self.cost.terminal(x) + self.step * self.penalty(x)

    def penalty(self, x: State) -> PerState:
        """The penalty of a state, in cost per second."""
        return self.weight * closeness(self.constraints, self.margin, x)

    def ignores(self, i: int, n: int) -> bool:
        return self.cost.ignores(i, n) and self._constraints_ignore(i, n)

    def ignores_at_end(self, i: int, n: int) -> bool:
        return self.cost.ignores_at_end(i, n) and self._constraints_ignore(i, n)

    def _constraints_ignore(self, i: int, n: int) -> bool:
        return bool(self.constraints.ignores(i, n))  # pyright: ignore[reportCallIssue]

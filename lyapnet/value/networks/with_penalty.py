"""V as a network plus the constraint penalty of one step, which is known."""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from lyapnet.base.types import PerState, State, Time
from lyapnet.task.constraints import Constraints
from lyapnet.task.cost import closeness
from lyapnet.value.calculus import ValueFunction, gradients


class WithPenalty(ValueFunction):
    """V(t, x) = N(t, x) + Δt w Σ_j max(0, 1 + h_j(x)/m_j)³, with the penalty of `PenaltyCost` for one step.

    This penalty is steep but known. The network learns the rest, the cost from the next state on. It is smooth wherever
    the lookahead law can avoid the constraints within one step.

    Args:
        network: N.
        constraints: h.
        margin: m of all h_j, or m_j of each, in the unit of h.
        step: Δt, in s.
    """

    network: ValueFunction
    constraints: Constraints
    margin: Float[Tensor, "*k"]
    step: float
    weight: Float[Tensor, ""]  # w, in cost per second

    def __init__(self, network: ValueFunction, constraints: Constraints, margin: float | Sequence[float], step: float):
        super().__init__()
        self.network, self.step = network, step
        self.register_buffer("margin", torch.tensor(margin, dtype=torch.float64), persistent=False)
        self._constraints = [constraints]  # in a list, so that the task's constraints are no submodule of V
        self.register_buffer("weight", torch.tensor(0.0))
        self.register_load_state_dict_pre_hook(_rename_to_network)

    def forward(self, t: Time, x: State) -> PerState:
        return self.network(t, x) + self._penalty(t, x)

    def value_and_state_gradient(self, t: Time, x: State) -> tuple[PerState, State]:
        """V and V_x."""
        value, slope = self.network.value_and_state_gradient(t, x)
        return value + self._penalty(t, x), slope + gradients(self._penalty, t, x)[1]

    def curvature(self, t: Time) -> Tensor | None:
        return self.network.curvature(t)

    def curvature_at(self, t: Time, x: State) -> Tensor | None:
        return self.network.curvature_at(t, x)

    def _penalty(self, t: Time, x: State) -> PerState:
        return self.step * self.weight * closeness(self._constraints[0], self.margin, x)


def learned_part(V: ValueFunction) -> ValueFunction:
    """V without the penalty of one step, if it has one."""
    return V.network if isinstance(V, WithPenalty) else V


def _rename_to_network(module: WithPenalty, state: dict[str, Any], prefix: str, *others: Any) -> None:
    """Rename the weights of a V without penalty, from a task without constraints, to those of N."""
    if f"{prefix}weight" not in state:
        for name in [name for name in state if name.startswith(prefix)]:
            state[f"{prefix}network.{name.removeprefix(prefix)}"] = state.pop(name)
        state[f"{prefix}weight"] = module.weight

"""V of a family of problems at fixed parameters."""

import torch
from jaxtyping import Float
from torch import Tensor

from lyapnet.base.types import PerState, State, Time
from lyapnet.value.calculus import ValueFunction


class AtParameters(ValueFunction):
    """V(t, (x, p)) of a family as a function of (t, x) at fixed p.

    Args:
        V: value function of the family.
        p: the parameters (k,).
    """

    p: Float[Tensor, " k"]

    def __init__(self, V: ValueFunction, p: Tensor):
        super().__init__()
        self.V, self.made_for = V, V.made_for
        self.register_buffer("p", p, persistent=False)

    def _append_parameters(self, x: Tensor) -> Tensor:
        return torch.cat([x, self.p.expand(*x.shape[:-1], -1)], -1)

    def forward(self, t: Time, x: State) -> PerState:
        return self.V(t, self._append_parameters(x))

    def value_and_state_gradient(self, t: Time, x: State) -> tuple[PerState, State]:
        value, gradient = self.V.value_and_state_gradient(t, self._append_parameters(x))
        return value, gradient[..., : x.shape[-1]]

    def curvature(self, t: Time) -> Tensor | None:
        H, n = self.V.curvature(t), -len(self.p)
        return None if H is None else H[..., :n, :n]

    def curvature_at(self, t: Time, x: State) -> Tensor | None:
        H, n = self.V.curvature_at(t, self._append_parameters(x)), -len(self.p)
        return None if H is None else H[..., :n, :n]

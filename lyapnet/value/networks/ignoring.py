"""A V that does not depend on some of the states."""

from collections.abc import Sequence

import torch
from jaxtyping import Int
from torch import Tensor

from lyapnet.base.types import PerState, State, Time
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.networks.with_penalty import learned_part


class IgnoringStates(ValueFunction):
    """V(t, x) = N(t, x_kept), independent of the other states.

    The cost-to-go has this form if neither dynamics nor cost depend on the other states.

    Args:
        network: N, a function of the kept states.
        kept: indices of the kept states, in increasing order.
        n: the number of states.
    """

    kept: Int[Tensor, " k"]

    def __init__(self, network: ValueFunction, kept: Sequence[int], n: int):
        super().__init__()
        self.network, self.n = network, n
        self.register_buffer("kept", torch.tensor(kept, dtype=torch.long), persistent=False)

    def forward(self, t: Time, x: State) -> PerState:
        return self.network(t, x[..., self.kept])

    def value_and_state_gradient(self, t: Time, x: State) -> tuple[PerState, State]:
        """V, and V_x with zeros for the ignored states."""
        value, gradient = self.network.value_and_state_gradient(t, x[..., self.kept])
        return value, torch.zeros_like(x).index_add(-1, self.kept, gradient)

    def curvature(self, t: Time) -> Tensor | None:
        return self._with_zeros(self.network.curvature(t))

    def curvature_at(self, t: Time, x: State) -> Tensor | None:
        return self._with_zeros(self.network.curvature_at(t, x[..., self.kept]))

    def _with_zeros(self, H: Tensor | None) -> Tensor | None:
        """H with zeros for the ignored states."""
        if H is None:
            return None
        places = torch.eye(self.n, dtype=H.dtype, device=H.device)[self.kept]
        return places.mT @ H @ places


def kept_states(V: ValueFunction, n: int) -> list[int]:
    """The indices of the states on which V depends, out of n."""
    V = learned_part(V)
    return V.kept.tolist() if isinstance(V, IgnoringStates) else list(range(n))

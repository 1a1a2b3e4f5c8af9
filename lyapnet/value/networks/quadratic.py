"""V as a quadratic form of the state with a time-varying matrix."""

from collections.abc import Sequence
from itertools import pairwise
from typing import cast

import torch
from torch import Tensor, nn

from lyapnet.base.linear_algebra import apply
from lyapnet.base.types import PerState, State, Time
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.networks.base import InputScaling, Scaling, activation_named, require_widths


class QuadraticForm(ValueFunction):
    """V(t, x) = s‖L(τ)ξ‖² + ε‖x‖², with L(τ) (n, n) a multilayer perceptron of time and s the scale of V.

    The value functions of linear-quadratic tasks have this form, V = xᵀP(t)x. For any weights V is convex in x,
    V ≥ ε‖x‖², V(t, 0) = 0 and V_x(t, 0) = 0 at every t: a Lyapunov candidate.

    Args:
        scaling: magnitudes of the inputs and of V.
        hidden: widths of the hidden layers.
        activation: a key of ACTIVATIONS.
        epsilon: ε > 0, in cost per squared state unit.
    """

    def __init__(
        self,
        scaling: Scaling,
        hidden: Sequence[int] = (64, 64),
        activation: str = "tanh",
        epsilon: float = 1e-6,
    ):
        super().__init__()
        require_widths(hidden)
        self.inputs = InputScaling(scaling)
        self.value_scale, self.epsilon = scaling.value, epsilon
        self.activation = activation_named(activation)
        n, widths = self.inputs.features, [1, *hidden]
        self.hidden = cast(Sequence[nn.Linear], nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(widths)))
        self.output = nn.Linear(widths[-1], n * n)
        with torch.no_grad():  # initially V = s‖ξ‖²/n, up to small random terms
            self.output.weight.div_(n)
            self.output.bias.copy_(torch.eye(n).flatten() / n**0.5)

    def _factor(self, t: Time) -> Tensor:
        """L, (*shape of t, n, n)."""
        z, n = self.inputs.time(t), self.inputs.features
        for layer in self.hidden:
            z = self.activation.function(layer(z))
        return self.output(z).unflatten(-1, (n, n))

    def forward(self, t: Time, x: State) -> PerState:
        return self.value_and_state_gradient(t, x)[0]

    def value_and_state_gradient(self, t: Time, x: State) -> tuple[PerState, State]:
        """V, and V_x = 2s diag(1/scale) LᵀLξ + 2εx."""
        L, xi = self._factor(t), self.inputs.state(x)
        y = _apply(L, xi)
        value = self.value_scale * (y**2).sum(-1) + self.epsilon * (x**2).sum(-1)
        return value, self.inputs.pull_back(x, 2 * self.value_scale * _apply(L.mT, y)) + 2 * self.epsilon * x


def _apply(A: Tensor, v: Tensor) -> Tensor:
    """Av, as a single product if all states share one time."""
    if A.ndim > 2 and A.shape[-3] == 1 and v.ndim > 1:
        return v @ A.squeeze(-3).mT
    return apply(A, v)

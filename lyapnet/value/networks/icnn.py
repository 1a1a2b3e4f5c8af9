"""Input-convex networks: jointly in (t, x) as in the paper, and in x alone.

Source of both: Amos, Xu, Kolter, "Input convex neural networks", ICML 2017.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import cast

import torch
from torch import Tensor, nn

from lyapnet.base.types import PerState, State, Time
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.networks.base import InputScaling, Scaling, activation_named, require_widths


class NonNegativeLinear(nn.Module):
    """z ↦ softplus(W)z / fan_in: a linear map with positive weights, which keeps convexity."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.raw_weight = nn.Parameter(torch.randn(outputs, inputs))

    @property
    def weight(self) -> Tensor:
        """The positive weights; scaled by 1/fan_in, so that depth does not enlarge the output."""
        return nn.functional.softplus(self.raw_weight) / self.raw_weight.shape[1]

    def forward(self, z: Tensor) -> Tensor:
        return z @ self.weight.mT


class ICNN(ValueFunction):
    """V(t, x) = s · N(τ, ξ) + ε‖x‖², with N convex in (t, x) jointly: the paper's Lyapunov network.

    z₁ = σ(A₁y + b₁), z_k = σ(W_k z_{k−1} + A_k y + b_k), N = W z_K + Ay + b with y = (τ, ξ), W ≥ 0 and σ convex
    and nondecreasing. V(t, 0) need not be zero, unlike that of the anchored network.

    Args:
        scaling: magnitudes of the inputs and of V.
        hidden: widths of the hidden layers.
        activation: a convex, nondecreasing key of ACTIVATIONS.
        epsilon: ε, in cost per squared state unit.
    """

    def __init__(
        self,
        scaling: Scaling,
        hidden: Sequence[int] = (64, 64),
        activation: str = "softplus",
        epsilon: float = 1e-3,
    ):
        super().__init__()
        require_widths(hidden)
        self.inputs = InputScaling(scaling)
        self.value_scale, self.epsilon = scaling.value, epsilon
        self.activation = activation_named(activation, convex=True)
        features = 1 + self.inputs.features
        through = [nn.Linear(features, width) for width in (*hidden, 1)]
        convex = [NonNegativeLinear(a, b) for a, b in pairwise((*hidden, 1))]
        self.through = cast(Sequence[nn.Linear], nn.ModuleList(through))
        self.convex = cast(Sequence[NonNegativeLinear], nn.ModuleList(convex))

    def _pre_activations(self, t: Time, x: State) -> list[Tensor]:
        """a₁ … a_K and, last, the output N."""
        xi = self.inputs.state(x)
        y = torch.cat([self.inputs.time(t).expand(*xi.shape[:-1], 1), xi], -1)
        activations = [self.through[0](y)]
        for through, convex in zip(self.through[1:], self.convex, strict=True):
            activations.append(convex(self.activation.function(activations[-1])) + through(y))
        return activations

    def forward(self, t: Time, x: State) -> PerState:
        return self._value(self._pre_activations(t, x)[-1], x)

    def _value(self, N: Tensor, x: State) -> PerState:
        return self.value_scale * N[..., 0] + self.epsilon * (x**2).sum(-1)

    def value_and_state_gradient(self, t: Time, x: State) -> tuple[PerState, State]:
        """V, and V_x by the chain rule, layer by layer from the output."""
        *activations, N = self._pre_activations(t, x)
        g_y = self.through[-1].weight[0]
        g_a = torch.ones_like(g_y[:1])
        layers = zip(activations, self.convex, self.through[:-1], strict=True)
        for a, convex, through in reversed(list(layers)):
            g_a = (g_a @ convex.weight) * self.activation.derivative(a)
            g_y = g_y + g_a @ through.weight
        slope = self.inputs.pull_back(x, self.value_scale * g_y[..., 1:]) + 2 * self.epsilon * x
        return self._value(N, x), slope


class PartiallyConvexNetwork(ValueFunction):
    """N(t, x) convex in x for every t, with free dependence on t.

    h = tanh(Cτ + c), z₁ = σ(A₁ξ + B₁h + b₁), z_k = σ(W_k z_{k−1} + A_kξ + B_kh + b_k),
    N = s · w(t)ᵀ z_K with W_k ≥ 0, w(t) = softplus(Dh + d)/width ≥ 0 and σ convex and nondecreasing: a sum of convex
    functions with nonnegative, time-varying weights.

    Args:
        scaling: magnitudes of the inputs and of V.
        hidden: widths of the convex layers; h has the width of the first.
        activation: a convex, nondecreasing key of ACTIVATIONS.
    """

    def __init__(self, scaling: Scaling, hidden: Sequence[int] = (64, 64), activation: str = "softplus"):
        super().__init__()
        require_widths(hidden)
        self.inputs = InputScaling(scaling)
        self.value_scale = scaling.value
        self.activation = activation_named(activation, convex=True)
        self.time = nn.Linear(1, hidden[0])
        through = [nn.Linear(self.inputs.features, width, bias=False) for width in hidden]
        shift = [nn.Linear(hidden[0], width) for width in hidden]
        convex = [NonNegativeLinear(a, b) for a, b in pairwise(hidden)]
        self.through = cast(Sequence[nn.Linear], nn.ModuleList(through))
        self.shift = cast(Sequence[nn.Linear], nn.ModuleList(shift))
        self.convex = cast(Sequence[NonNegativeLinear], nn.ModuleList(convex))
        self.weights = nn.Linear(hidden[0], hidden[-1])

    def _pre_activations(self, t: Time, x: State) -> tuple[list[Tensor], Tensor]:
        """a₁ … a_K, and s · w(t)."""
        h = torch.tanh(self.time(self.inputs.time(t)))
        xi = self.inputs.state(x)
        activations = [self.through[0](xi) + self.shift[0](h)]
        for through, shift, convex in zip(self.through[1:], self.shift[1:], self.convex, strict=True):
            activations.append(convex(self.activation.function(activations[-1])) + through(xi) + shift(h))
        weights = nn.functional.softplus(self.weights(h)) * (self.value_scale / self.weights.out_features)
        return activations, weights

    def forward(self, t: Time, x: State) -> PerState:
        activations, weights = self._pre_activations(t, x)
        return (weights * self.activation.function(activations[-1])).sum(-1)

    def value_and_state_gradient(self, t: Time, x: State) -> tuple[PerState, State]:
        """N, and N_x by the chain rule, layer by layer from the output."""
        activations, weights = self._pre_activations(t, x)
        value = (weights * self.activation.function(activations[-1])).sum(-1)
        g_a = weights * self.activation.derivative(activations[-1])
        g_xi = g_a @ self.through[-1].weight
        layers = zip(activations[:-1], self.convex, self.through[:-1], strict=True)
        for a, convex, through in reversed(list(layers)):
            g_a = (g_a @ convex.weight) * self.activation.derivative(a)
            g_xi = g_xi + g_a @ through.weight
        return value, self.inputs.pull_back(x, g_xi)

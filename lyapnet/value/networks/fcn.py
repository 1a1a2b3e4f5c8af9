"""The fully connected network."""

from collections.abc import Sequence
from itertools import pairwise
from typing import cast

import torch
from torch import Tensor, nn

from lyapnet.base.types import PerState, State, Time
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.networks.base import InputScaling, Scaling, activation_named, require_widths


class FCN(ValueFunction):
    """V(t, x) = s · N(τ, ξ), with N a multilayer perceptron and s the scale of V.

    Args:
        scaling: magnitudes of the inputs and of V.
        hidden: widths of the hidden layers.
        activation: a key of ACTIVATIONS.
        embedded_angles: see InputScaling.
    """

    def __init__(
        self,
        scaling: Scaling,
        hidden: Sequence[int] = (64, 64),
        activation: str = "tanh",
        embedded_angles: Sequence[int] = (),
    ):
        super().__init__()
        require_widths(hidden)
        self.inputs = InputScaling(scaling, embedded_angles)
        self.value_scale = scaling.value
        self.activation = activation_named(activation)
        widths = [1 + self.inputs.features, *hidden]
        self.hidden = cast(Sequence[nn.Linear], nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(widths)))
        self.output = nn.Linear(widths[-1], 1)

    def _pre_activations(self, t: Time, x: State) -> list[Tensor]:
        xi = self.inputs.state(x)
        z = torch.cat([self.inputs.time(t).expand(*xi.shape[:-1], 1), xi], -1)
        activations = []
        for layer in self.hidden:
            activations.append(layer(z))
            z = self.activation.function(activations[-1])
        return activations

    def forward(self, t: Time, x: State) -> PerState:
        last = self._pre_activations(t, x)[-1]
        return self.value_scale * self.output(self.activation.function(last))[..., 0]

    def value_and_state_gradient(self, t: Time, x: State) -> tuple[PerState, State]:
        """V, and V_x by the chain rule, layer by layer from the output."""
        activations = self._pre_activations(t, x)
        value = self.value_scale * self.output(self.activation.function(activations[-1]))[..., 0]
        gradient = self.value_scale * self.output.weight[0]
        for layer, a in zip(reversed(self.hidden), reversed(activations), strict=True):
            gradient = (gradient * self.activation.derivative(a)) @ layer.weight
        return value, self.inputs.pull_back(x, gradient[..., 1:])

"""Common parts of the networks: scaled inputs, and activations with their derivatives."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from lyapnet.base.types import State, Time


class Scaling(NamedTuple):
    """The typical magnitudes of a network's inputs and output, which are of order one in these units.

    They come from the task and not from the weights, so that a checkpoint can be used with another horizon or X₀: it
    then depends on relative time and relative state.
    """

    state: Sequence[float]  # typical |x_i|, in state units
    duration: float  # T in s
    value: float  # typical V, in units of cost


class Activation(NamedTuple):
    """A smooth function, its derivative, and whether it is convex and nondecreasing."""

    function: Callable[[Tensor], Tensor]
    derivative: Callable[[Tensor], Tensor]
    convex: bool


def _tanh(a: Tensor) -> Tensor:
    # tanh a = 2σ(2a) − 1 up to 1e-16; four times as fast as torch.tanh in float64 on a CPU
    return 2 * torch.sigmoid(2 * a) - 1


def _tanh_derivative(a: Tensor) -> Tensor:
    return 1 - _tanh(a) ** 2


def _silu_derivative(a: Tensor) -> Tensor:
    s = torch.sigmoid(a)
    return s * (1 + a * (1 - s))


def _softplus(a: Tensor) -> Tensor:
    # torch's default threshold of 20 causes a jump of 2e-9 in float64
    return nn.functional.softplus(a, threshold=40.0)


# Smooth activations only: V_x enters the policy, so that an activation with kinks would make the control jump.
ACTIVATIONS: dict[str, Activation] = {
    "tanh": Activation(_tanh, _tanh_derivative, convex=False),
    "softplus": Activation(_softplus, torch.sigmoid, convex=True),
    "silu": Activation(nn.functional.silu, _silu_derivative, convex=False),
    "sin": Activation(torch.sin, torch.cos, convex=False),
}


class InputScaling(nn.Module):
    """(t, x) ↦ (τ, ξ) with τ = 2t/T − 1 ∈ [−1, 1] and ξ = x / scale, and (sin θ, cos θ) of chosen angles θ in ξ.

    Args:
        scaling: magnitudes of the inputs.
        embedded_angles: indices of the states whose sine and cosine are further inputs. The angle itself remains an
            input, because θ and θ + 2π are different states: the goal is one unwrapped angle.
    """

    state_scale: Float[Tensor, " n"]
    angles: Int[Tensor, " k"]

    def __init__(self, scaling: Scaling, embedded_angles: Sequence[int] = ()):
        super().__init__()
        self.duration = scaling.duration
        scale = torch.tensor(scaling.state, dtype=torch.get_default_dtype())
        self.register_buffer("state_scale", scale, persistent=False)
        self.register_buffer("angles", torch.tensor(embedded_angles, dtype=torch.long), persistent=False)

    @property
    def features(self) -> int:
        """Length of ξ."""
        return len(self.state_scale) + 2 * len(self.angles)

    def time(self, t: Time) -> Tensor:
        """τ, (*batch, 1)."""
        return (2 / self.duration * t - 1)[..., None]

    def state(self, x: State) -> Tensor:
        """ξ, (*batch, features)."""
        xi = x / self.state_scale
        if not len(self.angles):
            return xi
        theta = x[..., self.angles]
        return torch.cat([xi, torch.sin(theta), torch.cos(theta)], -1)

    def pull_back(self, x: State, gradient: Tensor) -> State:
        """∂/∂x from ∂/∂ξ: the transposed Jacobian of `state` applied to (*batch, features)."""
        n, k = len(self.state_scale), len(self.angles)
        pulled = gradient[..., :n] / self.state_scale
        if not k:
            return pulled
        theta, sine, cosine = x[..., self.angles], gradient[..., n : n + k], gradient[..., n + k :]
        return pulled.index_add(-1, self.angles, sine * theta.cos() - cosine * theta.sin())


def activation_named(name: str, *, convex: bool = False) -> Activation:
    """The activation with a name.

    Raises:
        ValueError: there is none; or it has to be convex and nondecreasing, and is not.
    """
    known = [key for key, activation in ACTIVATIONS.items() if activation.convex or not convex]
    if name not in known:
        kind = "a convex activation" if convex else "an activation"
        raise ValueError(f"Expected {kind}, got {name!r}; choose one of: {', '.join(known)}.")
    return ACTIVATIONS[name]


def require_widths(hidden: Sequence[int]) -> None:
    """Raise ValueError unless there are hidden layers of positive width."""
    if not hidden or min(hidden) < 1:
        raise ValueError(f"Expected hidden layers of width ≥ 1, got {list(hidden)}; for example [64, 64].")

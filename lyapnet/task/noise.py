"""Noise of a stochastic system, dx = (f + g u) dt + σ(x) dW."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lyapnet.base.contracts import call_checked
from lyapnet.base.errors import UsageError
from lyapnet.base.linear_algebra import apply
from lyapnet.base.types import Noise as NoiseMatrix
from lyapnet.base.types import State
from lyapnet.task.systems import ControlSystem

Increments = Float[Tensor, "steps *batch sources"]  # ΔW of each step, in √s


class Noise(nn.Module, ABC):
    """σ(x), (*batch, n, k), in state units per √s, for k independent Wiener processes W.

    The equation is Itô's. A step of Euler–Maruyama adds σ(x)ΔW, with ΔW normal with variance Δt, to the step without
    noise; its strong order is ½, or 1 for a constant σ, and its weak order is 1.

    Source: Kloeden, Platen, Numerical Solution of Stochastic Differential Equations, 1992, ch. 10.
    """

    sources: int  # k

    @abstractmethod
    def forward(self, x: State) -> NoiseMatrix:
        """σ(x)."""

    def draw(self, steps: int, dt: float, x0: State, generator: torch.Generator) -> Increments:
        """ΔW of each step of Δt from a batch of states."""
        shape = (steps, *x0.shape[:-1], self.sources)
        return (math.sqrt(dt) * torch.randn(shape, generator=generator, dtype=torch.float64)).to(x0)

    def displacement(self, x: State, increment: Float[Tensor, "*batch sources"]) -> State:
        """σ(x)ΔW."""
        return apply(self(x), increment)


class StateNoise(Noise):
    """Independent Wiener processes for some states: σ is constant, with one column for each noisy state.

    Args:
        strengths: standard deviation of each state per √s, (n,); 0 for a state without noise.
        dtype: that of σ; None: torch's default.

    Raises:
        ValueError: a strength is negative or not finite, or all are zero.
    """

    sigma: Float[Tensor, "n sources"]

    def __init__(self, strengths: Sequence[float], dtype: torch.dtype | None = None):
        super().__init__()
        if not all(0 <= s < math.inf for s in strengths) or not any(strengths):
            raise ValueError(
                f"Expected strengths ≥ 0 with a positive one, got {[*strengths]}; leave noise out if none."
            )
        noisy = [i for i, s in enumerate(strengths) if s]
        self.sources = len(noisy)
        self.register_buffer("sigma", torch.diag(torch.tensor(strengths, dtype=dtype))[:, noisy], persistent=False)
        if not self.sigma.any(0).all():
            raise ValueError(f"Expected strengths above rounding, got {[*strengths]}; leave noise out if none.")

    def forward(self, x: State) -> NoiseMatrix:
        return self.sigma.expand(*x.shape[:-1], -1, -1)


class SystemNoise(Noise):
    """The noise that a system declares by its method `noise(x)`.

    Args:
        system: the system.
        like: a state (n,), at which the number of sources is determined.

    Raises:
        UsageError: the method fails, or does not return a matrix with at least one column.
    """

    def __init__(self, system: ControlSystem, like: State):
        super().__init__()
        self.system = system
        name, noise = f"{type(system).__name__}.noise(x)", system.noise
        sigma: Any = call_checked(name, noise, [like[None]])  # pyright: ignore[reportArgumentType]
        if not isinstance(sigma, Tensor) or not sigma.ndim or not sigma.shape[-1]:
            got = tuple(sigma.shape) if isinstance(sigma, Tensor) else type(sigma).__name__
            raise UsageError(
                f"Expected {name} of shape (*batch, {system.n}, k) with a column for each of k ≥ 1 sources, got {got}; "
                "correct it, or leave the method out if there is no noise."
            )
        self.sources = sigma.shape[-1]

    def forward(self, x: State) -> NoiseMatrix:
        return self.system.noise(x)  # pyright: ignore[reportCallIssue]


def once_if_constant(sigma: NoiseMatrix) -> Tensor:
    """σ with length one instead of expanded batch axes, so that products with it are computed once."""
    return sigma[tuple(slice(1) if stride == 0 else slice(None) for stride in sigma.stride()[:-2])]

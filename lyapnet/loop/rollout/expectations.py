"""What noise adds to V along a path: its unpredicted part in each step, of mean zero."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from lyapnet.base.types import PerState, State, StatePath, StepPath, Time, Times, ValuePath
from lyapnet.task.noise import Increments, Noise
from lyapnet.value.calculus import ValueFunction

STATES_PER_BLOCK = 4096  # states at which V is evaluated at once without a gradient; their hidden layers fit a cache


def expected_value(V: ValueFunction, noise: Noise, t: Time, mean: State, x: State, dt: float) -> PerState:
    """E V(t, mean + σ(x)ΔW) over ΔW, by the 2k points mean ± √(k Δt) σ_j, with σ_j the columns of σ(x).

    Exact for a V of third degree in x. Source: Stroud, Approximate Calculation of Multiple Integrals, 1971.
    """
    columns = math.sqrt(noise.sources * dt) * noise(x).movedim(-1, 0)
    return V(t, torch.cat([mean + columns, mean - columns])).mean(0)


def surprises(
    V: ValueFunction, noise: Noise, t: Times, x: StatePath, value: ValuePath, increments: Increments
) -> StepPath:
    """D_n = V(t_{n+1}, x_{n+1}) − E[V(t_{n+1}, x_{n+1}) | x_n] of each step, of mean zero, with its gradient."""
    dt = float(t[1] - t[0])

    def expected(later: Tensor, x: State, following: State, increments: Tensor) -> Tensor:
        return expected_value(V, noise, later, following - noise.displacement(x, increments), x, dt)

    later = t[1:].reshape(-1, *[1] * (x.ndim - 2))
    return value[1:] - _in_blocks(expected, later, x[:-1], x[1:], increments)


@torch.no_grad()
def martingale(V: ValueFunction, noise: Noise, t: Times, x: StatePath, increments: Increments) -> PerState:
    """M = Σ_n V_x(t_n, x_n)ᵀσ(x_n)ΔW_n, which has mean zero for any V and makes J − M vary less than J.

    If V is the cost to go of its law, J − M = V(0, x₀) up to errors of the step: M is a control variate for E J.
    """

    def terms(t: Tensor, x: State, increments: Tensor) -> Tensor:
        return (V.value_and_state_gradient(t, x)[1] * noise.displacement(x, increments)).sum(-1)

    return _in_blocks(terms, t[:-1].reshape(-1, *[1] * (x.ndim - 2)), x[:-1], increments).sum(0)


def _in_blocks(function: Callable[..., Tensor], *columns: Tensor) -> Tensor:
    """A function of columns over the steps; without a gradient in blocks of STATES_PER_BLOCK states."""
    if torch.is_grad_enabled():
        return function(*columns)
    steps = max(1, STATES_PER_BLOCK // max(1, columns[-1][0, ..., 0].numel()))
    return torch.cat([function(*block) for block in zip(*(column.split(steps) for column in columns), strict=True)])

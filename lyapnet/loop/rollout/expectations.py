"""What noise adds to V along a path: its unpredicted part in each step, of mean zero."""

import math

import torch
from torch import Tensor

from lyapnet.base.types import PerState, State, StatePath, StepPath, Time, Times, ValuePath
from lyapnet.task.noise import Increments, Noise
from lyapnet.value.calculus import ValueFunction


def expected_value(V: ValueFunction, noise: Noise, t: Time, mean: State, x: State, dt: float) -> PerState:
    """E V(t, mean + σ(x)ΔW) over ΔW, by the 2k points mean ± √(k Δt) σ_j, with σ_j the columns of σ(x).

    Exact for a V of third degree in x. Source: Stroud, Approximate Calculation of Multiple Integrals, 1971.
    """
    columns = math.sqrt(noise.sources * dt) * noise(x).movedim(-1, 0)
    return V(t, torch.cat([mean + columns, mean - columns])).mean(0)


def surprises(V: ValueFunction, noise: Noise, t: Times, x: StatePath, value: ValuePath, increments: Increments) -> StepPath:
    """D_n = V(t_{n+1}, x_{n+1}) − E[V(t_{n+1}, x_{n+1}) | x_n] of each step, of mean zero, with its gradient."""
    dt, later = float(t[1] - t[0]), t[1:].reshape(-1, *[1] * (x.ndim - 2))
    mean = x[1:] - noise.displacement(x[:-1], increments)
    return value[1:] - expected_value(V, noise, later, mean, x[:-1], dt)


@torch.no_grad()
def martingale(V: ValueFunction, noise: Noise, t: Times, x: StatePath, increments: Increments) -> PerState:
    """M = Σ_n V_x(t_n, x_n)ᵀσ(x_n)ΔW_n, which has mean zero for any V and makes J − M vary less than J.

    For V of a law, J − M = V(0, x₀) up to errors of V and of the step: M is a control variate for E J.
    """
    nodes = t[:-1].reshape(-1, *[1] * (x.ndim - 2))
    slope: Tensor = V.value_and_state_gradient(nodes, x[:-1])[1]
    return (slope * noise.displacement(x[:-1], increments)).sum(-1).sum(0)

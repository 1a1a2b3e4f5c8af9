"""Optima of tasks with noise that lyapnet had no part in: closed forms, and dynamic programming in one dimension.

All are optima of the task's own steps, x_{n+1} = F(x_n) + Δt g u_n + σ√Δt ξ_n, at a cost Δt ℓ each; those of continuous
time, which the literature gives, are beside them in `CONTINUOUS`.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.special import roots_genlaguerre, roots_hermitenorm
from torch import Tensor

from lyapnet.task.problem import Problem

Array = NDArray[np.float64]


class Exact(NamedTuple):
    """V(0, x) of states (b, n), and the optimal control at the n-th node, (n, x) ↦ u (b, m)."""

    value: Callable[[Tensor], Tensor]
    control: Callable[[int, Tensor], Tensor]


class Quadratic(NamedTuple):
    """V_n(x) = c + pᵀx + xᵀPx at each node, and its law u = k − Kx."""

    c: list[float]
    p: list[Array]
    P: list[Array]
    k: list[Array]
    K: list[Array]

    def exact(self) -> Exact:
        """As functions of tensors."""

        def value(x: Tensor) -> Tensor:
            z = x.double().numpy(force=True)
            return torch.as_tensor(self.c[0] + z @ self.p[0] + ((z @ self.P[0]) * z).sum(-1))

        def control(n: int, x: Tensor) -> Tensor:
            return torch.as_tensor(self.k[n] - x.double().numpy(force=True) @ self.K[n].T)

        return Exact(value, control)


def linear_quadratic(problem: Problem) -> Quadratic:
    """The Riccati recursion of a linear task without limits, its cost of second degree, σ affine in x.

    φ and q may have a linear part, as sums of states have. The matrices are read off the task at 0 and at unit states.
    """
    n, dt, one = problem.system.n, problem.horizon.dt, torch.eye(problem.system.n, dtype=torch.float64)
    zero, noise, cost = one[0] * 0, problem.noise, problem.cost
    f0, B = (np.asarray(part) for part in (dt * problem.system.f(zero), dt * problem.system.g(zero)))
    A = np.eye(n) + dt * np.asarray(problem.system.f(one) - problem.system.f(zero)).T
    R = dt * np.asarray(cost.R(zero))
    sigma = [] if noise is None else [math.sqrt(dt) * np.asarray(noise(zero))[:, j] for j in range(noise.sources)]
    slopes = [] if noise is None else [
        math.sqrt(dt) * np.asarray((noise(one) - noise(zero))[..., j]).T for j in range(noise.sources)
    ]  # fmt: skip

    def polynomial(function: Callable[[Tensor], Tensor]) -> tuple[float, Array, Array]:
        c = float(function(zero))
        up, down = np.asarray(function(one)) - c, np.asarray(function(-one)) - c
        pairs = np.asarray(function(one[:, None] + one[None])) - c
        P = (pairs - up[:, None] - up[None]) / 2
        return c, (up - down) / 2, np.where(np.eye(n) > 0, (up + down) / 2, P)

    q = polynomial(lambda x: dt * cost.state(x))
    c, p, P = polynomial(cost.terminal)
    found = Quadratic([c], [p], [P], [], [])
    for _ in range(problem.horizon.steps):
        c, p, P = found.c[0], found.p[0], found.P[0]
        weight = R + B.T @ P @ B
        K, k = np.linalg.solve(weight, B.T @ P @ A), -np.linalg.solve(weight, B.T @ (P @ f0 + p / 2))
        closed, free = A - B @ K, f0 + B @ k
        c_n = q[0] + c + p @ free + free @ P @ free + k @ R @ k
        p_n = q[1] + closed.T @ (p + 2 * P @ free) - 2 * K.T @ R @ k
        P_n = q[2] + closed.T @ P @ closed + K.T @ R @ K
        for s, S in zip(sigma, slopes, strict=True):
            c_n, p_n, P_n = c_n + s @ P @ s, p_n + 2 * S.T @ P @ s, P_n + S.T @ P @ S
        for stored, new in zip(found, (c_n, p_n, P_n, k, K), strict=True):
            stored.insert(0, new)  # pyright: ignore[reportArgumentType]
    return found


class Curves(NamedTuple):
    """V_n and the least m ↦ mean of the next state, one spline for each node, in one dimension."""

    value: CubicSpline
    mean: list[CubicSpline]


def one_dimension(
    drift: Callable[[Array], Array],
    terminal: Callable[[Array], Array],
    steps: Sequence[float],
    grid: Array,
    expected: Callable[[Callable[[Array], Array], Array, float], Array],
    weight: float,
) -> Curves:
    """Dynamic programming on a line: V_n(x) = min over m of Δt w ((m − F(x))/Δt)² + E V_{n+1}(m + noise).

    Args:
        drift: b of F(x) = x + Δt b(x).
        steps: Δt of each step.
        expected: (V, m, Δt) ↦ E V(m + noise).
        weight: w, of the square of the velocity that the control adds.
    """
    value, means = np.asarray(terminal(grid)), list[CubicSpline]()
    for dt in reversed(steps):
        later = CubicSpline(grid, value)
        ahead = expected(later, grid, dt)
        smooth = CubicSpline(grid, ahead)
        free = grid + dt * drift(grid)
        total = weight / dt * (grid[:, None] - free[None]) ** 2 + ahead[:, None]
        m = grid[total.argmin(0)]
        for _ in range(20):  # Newton's method from the best node
            slope = 2 * weight / dt * (m - free) + smooth(m, 1)
            bend = np.maximum(2 * weight / dt + smooth(m, 2), weight / dt)
            m = np.clip(m - slope / bend, grid[0], grid[-1])
        value = np.minimum(weight / dt * (m - free) ** 2 + smooth(m), total.min(0))
        means.insert(0, CubicSpline(grid, m))
    return Curves(CubicSpline(grid, value), means)


def on_a_line(function: Callable[[Array], Array], m: Array, deviation: float) -> Array:
    """E of a function of m plus normal noise."""
    points, weights = roots_hermitenorm(15)
    chances = zip(points, weights / weights.sum(), strict=True)
    return sum((w * function(m + deviation * z) for z, w in chances), np.zeros_like(m))


def about_a_point(function: Callable[[Array], Array], m: Array, deviation: float, d: int) -> Array:
    """E of a function of the distance from a point, after normal noise in d dimensions from the distance m."""
    lengths, shares = roots_genlaguerre(12, (d - 1) / 2 - 1)
    total = np.zeros_like(m)
    for half, share in zip(lengths, shares / shares.sum(), strict=True):
        across = 2 * half * deviation**2
        total += share * on_a_line(lambda y, a=across: function(np.sqrt(y**2 + a)), m, deviation)
    return total

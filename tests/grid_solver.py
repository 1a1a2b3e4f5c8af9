"""Dynamic programming on a grid, for two states and one control: an independent optimum under noise.

V_n(x) = min over u of ∫ℓ + E V_{n+1}(F(x, u) + σ(x)ΔW), or with a risk θ (1/θ) log E exp(θV) in the place of E V: with
cubic splines between the nodes of the grid, the mean over ΔW by three points for each source (exact to the fifth
degree), and the minimum among given controls, refined by a parabola through the best and its neighbours.
"""

import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline
from torch import Tensor

from lyapnet.task.problem import Problem

Array = NDArray[np.float64]
GAUSS_HERMITE = ((-math.sqrt(3), 1 / 6), (0.0, 2 / 3), (math.sqrt(3), 1 / 6))


@torch.no_grad()
def solve_on_grid(
    problem: Problem, lower: Sequence[float], upper: Sequence[float], points: int, controls: Sequence[float]
) -> Callable[[Tensor], Tensor]:
    """x₀ ↦ J*(x₀), the least expected cost of the problem's steps.

    Args:
        lower, upper: corners of the grid; states outside are moved to its border.
        points: nodes along each axis.
        controls: equally spaced controls, of which the best is refined.
    """
    axes = [np.linspace(a, b, points) for a, b in zip(lower, upper, strict=True)]
    x = torch.tensor(np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2))
    u = torch.tensor(controls, dtype=torch.float64)[:, None, None].expand(-1, len(x), 1)
    mean, paid = problem.step(x.expand(len(u), -1, -1), u)
    value = np.asarray(problem.cost.terminal(x)).reshape(points, points)
    draws = _draws(problem, x)
    for _ in range(problem.horizon.steps):
        spline = RectBivariateSpline(*axes, value)

        def later(x: Tensor, spline: RectBivariateSpline = spline) -> Array:
            first, second = (np.clip(np.asarray(x[..., i]), lower[i], upper[i]) for i in range(2))
            return spline.ev(first, second)

        Q = np.asarray(paid) + _expected([(later(mean + step), weight) for step, weight in draws], problem.risk)
        value = _least(Q).reshape(points, points)
    final = RectBivariateSpline(*axes, value)
    return lambda x0: torch.tensor(final.ev(np.asarray(x0[..., 0]), np.asarray(x0[..., 1])))


def _draws(problem: Problem, x: Tensor) -> list[tuple[Tensor, float]]:
    """(displacement by noise at each node of the grid, its weight)."""
    if problem.noise is None:
        return [(torch.zeros_like(x), 1.0)]
    draws = list[tuple[Tensor, float]]()
    for combination in itertools.product(GAUSS_HERMITE, repeat=problem.noise.sources):
        w = math.sqrt(problem.horizon.dt) * torch.tensor([point for point, _ in combination], dtype=torch.float64)
        draws.append((problem.noise.displacement(x, w.expand(len(x), -1)), math.prod(p for _, p in combination)))
    return draws


def _expected(values: list[tuple[Array, float]], risk: float) -> Array:
    """Σ w v, or with a risk θ (1/θ) log Σ w exp(θv)."""
    if not risk:
        return np.asarray(sum(weight * value for value, weight in values))
    most = np.max([value for value, _ in values], 0)
    return most + np.log(sum(weight * np.exp(risk * (value - most)) for value, weight in values)) / risk


def _least(Q: Array) -> Array:
    """The least of Q (controls, nodes) over the controls, by a parabola through the best one and its neighbours."""
    best = np.clip(Q.argmin(0), 1, len(Q) - 2)
    each = np.arange(Q.shape[1])
    before, middle, after = Q[best - 1, each], Q[best, each], Q[best + 1, each]
    bend = before - 2 * middle + after
    at = np.where(bend > 0, (before - after) / (2 * np.where(bend > 0, bend, 1)), 0).clip(-1, 1)
    return np.minimum(middle, middle + (after - before) / 2 * at + bend / 2 * at**2)

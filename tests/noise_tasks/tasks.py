"""The tasks with noise: which there are, and the optima that are known of them."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lyapnet.task.problem import Problem
from tests.noise_tasks.exact import Exact, about_a_point, linear_quadratic, on_a_line, one_dimension

HERE = Path(__file__).parent
CONF = HERE.parents[1] / "conf"
Array = NDArray[np.float64]


class Task(NamedTuple):
    """A config, and what is known of it.

    Attributes:
        file: its config; a system.py may lie beside it.
        exact: the problem ↦ the optimum of its steps; None: unknown.
        continuous: V(0, x₀) at the centre of X₀ in continuous time, from the literature; None: unknown.
    """

    file: Path
    exact: Callable[[Problem], Exact] | None = None
    continuous: float | None = None


def quadratic(problem: Problem) -> Exact:
    """By the Riccati recursion."""
    return linear_quadratic(problem).exact()


def wells(problem: Problem) -> Exact:
    """The double wells, coordinate by coordinate: the three deep ones and the others."""
    steps, grid = [problem.horizon.dt] * problem.horizon.steps, np.linspace(-3.5, 3.5, 1401)
    curves = [
        one_dimension(
            lambda x, k=kappa: -4 * k * x * (x**2 - 1), lambda x, v=nu: v * (x**2 - 1) ** 2, steps, grid,
            lambda V, m, dt: on_a_line(V, m, math.sqrt(dt)), 0.5,
        )
        for kappa, nu in ((5.0, 3.0), (1.0, 1.0))
    ]  # fmt: skip
    of = [curves[0]] * 3 + [curves[1]] * 7

    def value(x: Tensor) -> Tensor:
        return torch.as_tensor(sum(curve.value(np.asarray(x[..., i])) for i, curve in enumerate(of)))

    def control(n: int, x: Tensor) -> Tensor:
        z, free = np.asarray(x), np.asarray(x + problem.horizon.dt * problem.system.f(x))
        m = np.stack([curve.mean[n](z[..., i]) for i, curve in enumerate(of)], -1)
        return torch.as_tensor((m - free) / problem.horizon.dt)

    return Exact(value, control)


def logarithm(scale: float, target: float, sigma: float, farthest: float) -> Callable[[Problem], Exact]:
    """dx = 2u dt + σ dW in 100 dimensions, with φ = scale · ln((1 + r²)/2), r = ‖x − target‖: dynamic programming in r.

    Steps of time may differ: a last state is the time that is left, if there is one.
    """

    def exact(problem: Problem) -> Exact:
        d, N, dt = problem.system.m, problem.horizon.steps, problem.horizon.dt
        x, steps = problem.initial_states.center.double(), [dt] * N
        if problem.system.n > d:
            steps = []
            for _ in range(N):
                following = x + dt * problem.system.f(x)
                steps.append(float(x[-1] - following[-1]))
                x = following
        grid = np.concatenate([np.linspace(0, 3, 600, endpoint=False), np.linspace(3, farthest, 900)])
        curves = one_dimension(
            lambda r: 0 * r, lambda r: scale * np.log((1 + r**2) / 2), steps, grid,
            lambda V, m, dt: about_a_point(V, m, sigma * math.sqrt(dt), d), 0.25,
        )  # fmt: skip

        def distance(x: Tensor) -> tuple[Array, Array]:
            y = np.asarray(x)[..., :d] - target
            return y, np.linalg.norm(y, axis=-1)

        def value(x: Tensor) -> Tensor:
            return torch.as_tensor(curves.value(distance(x)[1]))

        def control(n: int, x: Tensor) -> Tensor:
            y, r = distance(x)
            speed = (curves.mean[n](r) - r) / (2 * steps[n])
            return torch.as_tensor(speed[..., None] * y / np.maximum(r, 1e-12)[..., None])

        return Exact(value, control)

    return exact


def on_grid(lower: list[float], upper: list[float], points: int, controls: Array) -> Callable[[Problem], Exact]:
    """Two states and one control, by dynamic programming on a grid; the value alone."""
    from tests.grid_solver import solve_on_grid

    def exact(problem: Problem) -> Exact:
        return Exact(solve_on_grid(problem, lower, upper, points, controls.tolist()), unknown)

    return exact


def unknown(n: int, x: Tensor) -> Tensor:
    """A law that is not known."""
    return torch.full((*x.shape[:-1], 1), math.nan, dtype=torch.float64)


def folder(name: str, file: str = "task.yaml") -> Path:
    """A config of a task of this folder."""
    return HERE / name / file


TASKS = {
    **{name: Task(folder(name), quadratic) for name in ("lqg_2", "lqg_4", "lqg_12", "lqg_multiplicative")},
    "ou_easy": Task(folder("ornstein_uhlenbeck", "easy.yaml"), quadratic, 4.055382),
    "ou_hard": Task(folder("ornstein_uhlenbeck", "hard.yaml"), quadratic, 20.697248),
    "ou_linear": Task(folder("ou_linear"), quadratic),
    "double_well": Task(folder("double_well"), wells, 2.087430),
    "hjb_lq": Task(folder("hjb_lq"), logarithm(1, 0, 2**0.5, 30), 4.590162),
    "distant_target": Task(folder("distant_target"), logarithm(1000, 3, 0.4 * 2**0.5, 40), -401.882),
    "quadcopter": Task(folder("quadcopter")),
    "planar_quadrotor": Task(folder("planar_quadrotor")),
    "van_der_pol": Task(folder("van_der_pol"), on_grid([-4, -5], [4, 5], 101, np.linspace(-10, 10, 41))),
    "pendulum": Task(CONF / "pendulum_noise.yaml", on_grid([-1.5, -8], [4.5, 4], 101, np.linspace(-16, 10, 40))),
    "gap": Task(folder("walker", "gap.yaml"), on_grid([0, -2.5], [2.02, 2], 181, np.linspace(-8, 8, 41))),
    "bridge": Task(folder("walker", "bridge.yaml"), on_grid([0, -2.5], [2.02, 2], 181, np.linspace(-8, 8, 41))),
}

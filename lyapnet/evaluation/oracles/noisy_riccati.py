"""Exact solution of linear-quadratic tasks with noise, by the Riccati recursion of their steps."""

import math

import torch

from lyapnet.base.errors import OracleError
from lyapnet.base.types import ControlPath, State
from lyapnet.evaluation.oracles.base import Optima, Oracle, Report, silent
from lyapnet.task.cost import is_quadratic
from lyapnet.task.noise import Noise
from lyapnet.task.problem import Problem
from lyapnet.task.systems import is_linear
from lyapnet.value.expansions import Expansion, riccati

AFFINE_TOLERANCE = 1e-9  # relative difference below which σ at the middle of two states counts as the mean of both
FAR = 8.0  # half the side of a box around X₀ and the goal, in extents of both, in which σ has to be affine too


class NoisyRiccatiOracle(Oracle):
    """J*(x₀) = V(0, x₀), which is quadratic in x₀, with a constant that is the cost of the noise."""

    def __init__(self, solution: Expansion):
        self.solution = solution

    def solve(
        self, x0: State, known: ControlPath | None = None, progress: Report = silent, seconds: float = math.inf
    ) -> Optima:
        return Optima(self.solution.initially(x0.double().cpu()).to(x0), [""] * len(x0))


def noisy_riccati(problem: Problem, free: bool) -> NoisyRiccatiOracle:
    """The oracle of a task with noise.

    Args:
        free: whether the task has neither control limits nor constraints.

    Raises:
        OracleError: the task is not linear-quadratic, σ is not affine in x, or not constant in a task with risk.
    """
    system, cost, noise = problem.system, problem.cost, problem.noise
    assert noise is not None
    quadratic = is_linear(system) and is_quadratic(cost) and cost.R_constant is not None
    if not (free and quadratic and _is_affine(problem, noise)):
        raise OracleError(
            "Expected a linear system without limits, a quadratic cost, and σ affine in x, for an optimum under noise, "
            "got others; costs stand alone."
        )
    if problem.risk and not _is_constant(problem, noise):
        raise OracleError("Expected a constant σ for an optimum with risk, got another; costs stand alone.")
    solution = riccati(problem)
    if not all(part.isfinite().all() for part in solution):
        raise OracleError("Expected a smaller risk, got one with which no law keeps E exp(risk J) finite.")
    return NoisyRiccatiOracle(solution)


def _is_constant(problem: Problem, noise: Noise) -> bool:
    """Whether σ, which is affine, is the same at the goal and at states of X₀."""
    x = problem.initial_states.sample(128, torch.Generator().manual_seed(0)).to(problem.goal)
    at_goal = noise(problem.goal[None])
    return bool((noise(x) - at_goal).abs().max() <= AFFINE_TOLERANCE * at_goal.abs().max())


def _is_affine(problem: Problem, noise: Noise) -> bool:
    """Whether σ at the middle of two states is the mean of both: states of X₀, of a much larger box, and the goal."""
    generator, goal = torch.Generator().manual_seed(0), problem.goal
    near = problem.initial_states.sample(128, generator).to(goal)
    extent = torch.cat([near, goal[None]]).sub(goal).abs().amax(0).clamp_min(torch.finfo(goal.dtype).tiny)
    extent = extent.where(extent > extent.max() * AFFINE_TOLERANCE, 1.0)  # of a state that X₀ fixes at the goal
    far = goal + FAR * extent * (2 * torch.rand(near.shape, generator=generator, dtype=near.dtype) - 1)
    one, other = torch.cat([near, far, near, far]), torch.cat([near.flip(0), far.flip(0), far, goal.expand_as(far)])
    mean = (noise(one) + noise(other)) / 2
    error = (noise((one + other) / 2) - mean).abs().max()
    return bool(error <= AFFINE_TOLERANCE * mean.abs().max())

"""Reference costs from the same states: the plant in continuous time, and LQR."""

from collections.abc import Callable

import torch
from torch import nn

from lyapnet.base.linear_algebra import apply
from lyapnet.base.types import Control, PerState, State
from lyapnet.task.horizon import Horizon
from lyapnet.task.noise import Increments
from lyapnet.task.problem import Problem
from lyapnet.value.expansions import in_float64, path_under, regulator

SUBSTEPS = 4  # Runge-Kutta steps of fourth order within Δt that stand for continuous time


def in_continuous_time(problem: Problem) -> Problem:
    """The problem with SUBSTEPS steps of fourth order in each Δt."""
    horizon = problem.horizon
    return problem.in_steps(steps=SUBSTEPS * horizon.steps, dt=horizon.dt / SUBSTEPS, method="rk4")


def costs_of_holding(policy: nn.Module, own: Horizon, problem: Problem, x0: State) -> PerState:
    """The costs of a law, with each control held for a step of the law's own horizon; infinite if it diverges.

    Args:
        policy: u(t, x).
        own: the horizon of the law.
        problem: the problem to roll out; its steps divide those of `own`.
    """
    times, each, u = own.times(x0), problem.horizon.steps // own.steps, x0

    def law(n: int, x: State) -> Control:
        nonlocal u
        u = u if n % each else policy(times[n // each], x)
        return u

    return path_under(problem, law, x0).cost


def costs_of_plant(problem: Problem, policy: nn.Module, x0: State) -> PerState:
    """The costs of a law on the plant in continuous time, with u held for Δt."""
    return costs_of_holding(policy, problem.horizon, in_continuous_time(problem), x0)


def costs_of_lqr(problem: Problem, x0: State, increments: Increments | None = None) -> PerState | None:
    """The costs of LQR: u = ū_n + K_n(x − x*) of the problem linearised at its goal, over N steps, projected onto U.

    None if there is no goal, or one that moves with a reference, or no finite linearisation there, or if the limits of
    U are unknown.

    Args:
        increments: ΔW of each step; None: without noise.
    """
    stays = problem.has_goal and not problem.follows_reference
    law = _lqr(problem) if stays and problem.controls.limits is not None else None
    if law is None:
        return None
    drawn = None if increments is None else increments.double().cpu()
    return path_under(in_float64(problem), law, x0.double().cpu(), drawn).cost.to(x0)


def _lqr(problem: Problem) -> Callable[[int, State], Control] | None:
    try:
        u, K = regulator(problem.replaced(risk=0.0))
    except torch.linalg.LinAlgError:  # pyright: ignore[reportPrivateImportUsage]
        return None
    exact = in_float64(problem)
    if not (u.isfinite().all() and K.isfinite().all()):
        return None
    return lambda n, x: exact.controls.project(u[n] + apply(K[n], x - exact.goal))

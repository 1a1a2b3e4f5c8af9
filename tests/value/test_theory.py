"""The equations of docs/theory.md, by their numbers, against the code that they are about."""

import pytest
import torch
from torch.testing import assert_close

from lyapnet.loop.programs.terms import hinge, terminal_hinge, violation
from lyapnet.loop.rollout import Rollout
from lyapnet.task.sets import ControlBox, Unbounded
from lyapnet.value.calculus import gradients, time_derivative
from lyapnet.value.expansions import riccati
from lyapnet.value.policy import HJBPolicy, SampledPolicy
from tests.problems import problem_of


def quadratic(R, v):
    return torch.einsum("...i,...ij,...j->...", v, R, v)


def residual(problem, V, t, x):
    """(6), at the minimiser (4)."""
    u = HJBPolicy(problem, V)(t, x)
    return time_derivative(V, problem.system, t, x, u) + problem.cost.running(x, u), u


@pytest.mark.parametrize("limited", [False, True])
def test_equation_7_at_each_state(system, cost, V, limited):
    """V̇ + ℓ ≥ r + (u − u*)ᵀR(u − u*), with equality where there are no limits."""
    problem = problem_of(system, cost).replaced(controls=ControlBox(-0.3, 0.3) if limited else Unbounded())
    t, x = torch.rand(200), torch.randn(200, system.n)
    r, best = residual(problem, V, t, x)
    u = problem.controls.project(torch.randn(200, system.m))
    left = time_derivative(V, system, t, x, u) + cost.running(x, u)
    room = left - r - quadratic(cost.R(x), u - best)
    assert (room > -1e-9 * left.abs().max()).all()
    assert limited or room.abs().max() < 1e-9 * left.abs().max()
    assert (left - r - 2 * quadratic(cost.R(x), u - best)).min() < 0


def test_the_residual_without_limits(system, cost, V):
    t, x = torch.rand(200), torch.randn(200, system.n)
    V_t, V_x = gradients(V, t, x)
    b = torch.einsum("bnm,bn->bm", system.g(x), V_x)
    expected = V_t + (V_x * system.f(x)).sum(-1) + cost.state(x) - quadratic(torch.linalg.inv(cost.R(x)), b) / 4
    assert_close(residual(problem_of(system, cost), V, t, x)[0], expected)


def test_equations_9_and_12(system, cost, V):
    problem = problem_of(system, cost)
    trajectory = Rollout(problem, HJBPolicy(problem, V))(0.1 * torch.randn(20, system.n))
    values, paid, end = trajectory.require_value(), trajectory.step_cost, trajectory.terminal_cost
    assert_close(values[0], trajectory.cost + values[-1] - end - violation(values, paid).sum(0))
    bound = values[0] + hinge(values, paid) + terminal_hinge(values, end)
    assert (trajectory.cost <= bound + 1e-9 * bound.abs()).all()
    assert (trajectory.cost > values[0]).any(), "a random V is no bound by itself"


def test_equation_24(system, cost, V):
    problem = problem_of(system, cost)
    policy, t, x = SampledPolicy(problem, V), torch.zeros(20), torch.randn(20, system.n)
    g, dt = system.g(x), problem.horizon.dt
    H = V.curvature(t + dt)
    H = riccati(problem).hessian[1] if H is None else H
    V_x = gradients(V, t + dt, x + dt * system.f(x))[1]
    weight = 2 * cost.R(x) + dt * g.mT @ H @ g
    expected = -torch.linalg.solve(weight, g.mT @ V_x[..., None])[..., 0]
    assert_close(policy(t, x), expected)

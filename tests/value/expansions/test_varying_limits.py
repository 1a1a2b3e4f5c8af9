"""Differential dynamic programming between limits that depend on the state."""

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from torch.testing import assert_close

from lyapnet.task.cost import QuadraticCost, TargetCost
from lyapnet.task.sets import ControlBox
from lyapnet.task.systems import SYSTEMS
from lyapnet.task.varying_limits import LimitTable
from lyapnet.value.expansions.dynamic_programming import optimal_trajectories
from lyapnet.value.policy import HJBPolicy, SampledPolicy
from tests.problems import Quadratic, problem_of

AT, UPPER, LOWER = [-1.0, 0.0, 2.0], [2.0, 2.0, 0.2], [-0.5, -1.5, -2.5]
STEPS, DT, REST = 15, 0.1, 0.3


def motor(controls=None):
    """A double integrator between limits that fall with its speed, with a control at rest that is not their middle."""
    cost = TargetCost(QuadraticCost([[2.0, 0.0], [0.0, 0.1]], [[0.2]], 5 * torch.eye(2)), [0.2, 0.0], [REST])
    table = LimitTable("velocity", AT, UPPER, LOWER)
    return problem_of(
        SYSTEMS["double_integrator"](), cost, steps=STEPS, dt=DT, controls=table if controls is None else controls
    )


def paid(u, x):
    """J of controls (N,) from a state, and the states, in plain Python."""
    J, nodes = 0.0, []
    for control in u:
        nodes.append(x)
        J += DT * (2 * (x[0] - 0.2) ** 2 + 0.1 * x[1] ** 2 + 0.2 * (control - REST) ** 2)
        x = np.array([x[0] + DT * x[1], x[1] + DT * control])
    return J + 5 * ((x[0] - 0.2) ** 2 + x[1] ** 2), np.array(nodes)


def least_cost(x0):
    """The optimum by sequential quadratic programming over u, with np.interp as limits."""

    def room(u):
        speed = paid(u, x0)[1][:, 1]
        return np.concatenate([np.interp(speed, AT, UPPER) - u, u - np.interp(speed, AT, LOWER)])

    found = minimize(
        lambda u: paid(u, x0)[0], np.zeros(STEPS), method="SLSQP", constraints={"type": "ineq", "fun": room},
        options={"ftol": 1e-14, "maxiter": 1000},
    )  # fmt: skip
    assert found.success
    assert room(found.x).min() < 1e-9, "limits that are met"
    return found.fun


STARTS = torch.tensor([[-2.0, 0.3], [1.9, 1.0], [-2.3, 0.9], [2.0, -0.2]], dtype=torch.float64)


def optimum_of(problem, x0):
    return optimal_trajectories(problem, x0, torch.zeros(STEPS, len(x0), 1))


def test_the_optimum_is_that_of_another_solver():
    optimum = optimum_of(motor(), STARTS)
    expected = torch.tensor([least_cost(x.numpy()) for x in STARTS])
    assert_close(optimum.path.cost, expected, rtol=1e-6, atol=0)
    u = motor().controls.applied(optimum.path.x[:-1], optimum.path.u)
    speed = optimum.path.x[:-1, :, 1].numpy()
    assert (u[..., 0].numpy() <= np.interp(speed, AT, UPPER)).all()
    assert (u[..., 0].numpy() >= np.interp(speed, AT, LOWER)).all()
    assert_close(torch.tensor(paid(u[:, 0, 0].numpy(), STARTS[0].numpy())[0]), optimum.path.cost[0])
    with pytest.raises(AssertionError):  # limits at rest, wherever it is
        assert_close(optimum_of(motor(ControlBox(-1.5, 2.0)), STARTS).path.cost, expected, rtol=1e-3, atol=0)


@pytest.mark.gate
def test_the_slope_of_the_optimum_knows_how_limits_move():
    """V_x and V_xx of the expansion against differences of optima from states beside."""
    step = 1e-4
    sides = step * torch.eye(2)
    optimum = optimum_of(motor(), STARTS)
    around = torch.cat([STARTS + side for side in (*sides, *-sides)])
    cost, slope = (part.reshape(4, *STARTS.shape[:1], -1) for part in _cost_and_slope(motor(), around))
    differences = torch.stack([(cost[k] - cost[k + 2])[:, 0] / (2 * step) for k in range(2)], -1)
    assert_close(optimum.expansion.gradient[0], differences, rtol=1e-4, atol=1e-5)
    bends = torch.stack([(slope[k] - slope[k + 2]) / (2 * step) for k in range(2)], -1)
    assert_close(optimum.expansion.hessian[0], bends, rtol=1e-2, atol=1e-2)
    held = motor()
    held.controls.bends.zero_()  # the same limits at rest, which do not move
    with pytest.raises(AssertionError):
        assert_close(optimum_of(held, STARTS).expansion.gradient[0], differences, rtol=1e-2, atol=1e-2)


def _cost_and_slope(problem, x0):
    optimum = optimum_of(problem, x0)
    return optimum.path.cost, optimum.expansion.gradient[0]


@pytest.mark.parametrize("law", [HJBPolicy, SampledPolicy])
def test_the_derivative_of_the_law_is_that_of_differences(law):
    problem = motor()
    policy, t = law(problem, Quadratic([[3.0, 1.0], [1.0, 2.0]])), torch.zeros(())
    x = 1.5 * torch.randn(400, 2, generator=torch.Generator().manual_seed(1))

    def control(x):
        return problem.controls.applied(x, policy(t, x))[..., 0]

    leaf = x.clone().requires_grad_()
    slope = torch.autograd.grad(control(leaf).sum(), leaf)[0]
    step = 1e-6
    sides = step * torch.eye(2)
    differences = torch.stack([(control(x + side) - control(x - side)) / (2 * step) for side in sides], -1)
    low, high = (side[:, 0] for side in problem.controls.limits_at(x))
    smooth = (control(x + 2 * step) - 2 * control(x) + control(x - 2 * step)).abs() < 1e-9  # no kink between
    at_limit = (control(x) == low) | (control(x) == high)
    assert int((smooth & at_limit & (slope[:, 1].abs() > 0.1)).sum()) > 50, "limits that move"
    assert_close(slope[smooth], differences[smooth], rtol=1e-5, atol=1e-5)
    fixed = law(motor(ControlBox(-1.5, 2.0)), Quadratic([[3.0, 1.0], [1.0, 2.0]]))
    (other,) = torch.autograd.grad(fixed(t, leaf).sum(), leaf)
    with pytest.raises(AssertionError):
        assert_close(other[smooth], differences[smooth], rtol=1e-2, atol=1e-2)

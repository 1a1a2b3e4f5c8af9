"""Optimal trajectories and expansions of V with other costs of controls than uᵀRu, and with a ball of controls."""

import pytest
import torch
from torch.testing import assert_close

from lyapnet.evaluation.oracles import oracle_of
from lyapnet.evaluation.oracles.transcription import Transcription
from lyapnet.task.ball import ControlBall
from lyapnet.task.cost import QuadraticCost
from lyapnet.task.cost.control_costs import AbsoluteCost, ControlCosts, LogCosCost, NormCost, PowerCost
from lyapnet.task.ellipsoid import ControlEllipsoid
from lyapnet.task.horizon import Horizon
from lyapnet.task.polytope import ControlPolytope
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box, ControlBox, Unbounded
from lyapnet.task.systems import Linear, Pendulum
from lyapnet.task.varying_limits import LimitTable
from lyapnet.value.expansions import dynamic_programming, held_control, optimal_trajectories, path_under, riccati
from tests.marks import sample

PLANE = [[0.0, 0, 1, 0], [0, 0, 0, 1], [0, 0, -0.1, 0], [0, 0, 0, -0.2]]


def problem_with(costs, controls, system=None, method="euler", steps=30):
    system = (
        Linear(torch.tensor(PLANE), torch.tensor([[0.0, 0], [0, 0], [1, 0.2], [0, 1]])) if system is None else system
    )
    n, m = system.n, system.m
    cost = QuadraticCost(0.1 * torch.eye(n), 0.02 * torch.eye(m), 8.0 * torch.eye(n))
    cost.nonquadratic = None if costs is None else ControlCosts(costs)
    return Problem(system, cost, controls, Box([0.4] * n, [1.0] * n), Horizon(steps, 0.1, method))


def falling():
    return LimitTable("velocity", [-3, 0, 3], [9.0, 9.0, 2.0], [-2.0, -9.0, -9.0])


CASES = {
    "ball": lambda: problem_with(None, ControlBall(1.2)),
    "norm in a ball": lambda: problem_with([NormCost(0.3)], ControlBall(1.2)),
    "absolute": lambda: problem_with([AbsoluteCost([0.3, 0.5])], ControlBox(-1.0, 1.0)),
    "power": lambda: problem_with([PowerCost(0.3, 1.5)], Unbounded()),
    "power, rk4": lambda: problem_with([PowerCost(0.3, 1.5)], Unbounded(), method="rk4"),
    "power of one control in a ball": lambda: problem_with([PowerCost(0.3, 1.5)], ControlBall(3.0), Pendulum()),
    "norm and log-cos of one control": lambda: problem_with(
        [NormCost(0.05), LogCosCost(0.05, 4.0)], ControlBox(-3.9999, 3.9999), Pendulum()
    ),
    "a thruster": lambda: problem_with([AbsoluteCost(0.3)], ControlBox([0.0, -1.0], [1.0, 0.0])),
    "ellipsoid": lambda: problem_with(None, ControlEllipsoid([[1.2, 0.3], [0.0, 0.7]], [0.1, -0.2])),
    "polytope": lambda: problem_with(None, ControlPolytope([[1, 1], [-1, 0], [0, -1], [1, -2]], [1.0, 0.8, 1.0, 1.2])),
    "limits that fall with speed": lambda: problem_with(None, falling(), Pendulum()),
    "limits that fall with speed, rk4": lambda: problem_with(None, falling(), Pendulum(), method="rk4"),
    "log-cos": lambda: problem_with([LogCosCost(0.05, 4.0)], ControlBox(-3.9999, 3.9999), Pendulum()),
}


@pytest.fixture(scope="module", params=sample(CASES, 12), ids=str)
def solved(request):
    """The problem, three states, and their optima by IPOPT and by differential dynamic programming from these."""
    problem = CASES[request.param]()
    x0 = problem.initial_states.sample(3, torch.Generator().manual_seed(0))
    optima = oracle_of(problem).solve(x0)
    return problem, x0, optima, optimal_trajectories(problem, x0, optima.u)


def test_ipopt_and_dynamic_programming_agree(solved):
    problem, x0, optima, optimum = solved
    assert_close(optimum.path.cost, optima.cost, rtol=1e-6, atol=0)
    assert problem.controls.contains(optimum.path.u).all()
    if isinstance(problem.system, Linear):  # a pendulum has other ways
        zero = torch.zeros_like(optimum.path.u)
        assert_close(optimal_trajectories(problem, x0, zero).path.cost, optima.cost, rtol=1e-2, atol=0)
        assert (path_under(problem, lambda n, _: zero[n], x0).cost > 1.1 * optima.cost).all()


def test_optima_kept_for_one_cost_are_none_of_another():
    costs = (None, [NormCost(0.3)], [NormCost(0.6)])
    folders = {Transcription(problem_with(each, ControlBall(1.2))).cache.folder for each in costs}
    assert len(folders) == 3


def test_the_expansion_has_the_slope_and_curvature_of_the_optimal_cost(solved, monkeypatch):
    problem, x0, _, optimum = solved
    n, h = problem.system.n, 1e-4
    d = torch.randn(n, generator=torch.Generator().manual_seed(1)).double()
    ends = [optimal_trajectories(problem, x0 + sign * h * d, optimum.path.u).path.cost for sign in (1, -1)]
    slope = (ends[0] - ends[1]) / (2 * h)
    own = optimum.expansion.gradient[0] @ d
    assert_close(own, slope, rtol=1e-5, atol=1e-6)
    curvature = (ends[0] + ends[1] - 2 * optimum.path.cost) / h**2
    own = (optimum.expansion.hessian[0] @ d) @ d
    off = (own - curvature).abs() > 0.02 * curvature.abs() + 0.01
    kinked = problem.cost.nonquadratic is not None
    assert off.sum() <= kinked, "beside a switch the difference has another slope on each side"
    if not kinked:
        return
    monkeypatch.setattr(dynamic_programming, "cost_beside", lambda *_: 0.0)
    other = optimal_trajectories(problem, x0, optimum.path.u).expansion
    assert ((other.gradient[0] @ d - slope).abs() > 1e-3 * slope.abs()).any() or (
        other.value[0] != optimum.path.cost
    ).any()


def test_the_held_control_is_the_least_of_a_step(solved):
    """Against random controls of U, for a quadratic V after the step."""
    problem, x, _, _ = solved
    n, m = problem.system.n, problem.system.m
    if problem.horizon.method != "euler":
        return
    A = torch.randn(n, n, generator=torch.Generator().manual_seed(2)).double()
    P, p = A @ A.mT + torch.eye(n).double(), torch.linspace(-1, 1, n).double()
    free = problem.response(x)
    u = held_control(problem, x, free, free.x @ P + p, P.expand(3, n, n))

    def cost(u):
        after, paid = problem.step(x.expand(*u.shape[:-1], -1), u)
        return paid + ((after @ P) * after).sum(-1) / 2 + after @ p

    tried = problem.controls.project(u + torch.randn(4000, 3, m, generator=torch.Generator().manual_seed(3)).double())
    near = problem.controls.project(u + 1e-3 * (tried - u))
    assert (cost(u) <= cost(torch.cat([tried, near])) + 1e-9).all()
    assert (cost(tried) > cost(u) + 1e-4).any()


def test_steps_pay_for_what_the_response_leaves_out():
    problem = CASES["absolute"]()
    x, u = torch.rand(5, 4), torch.randn(5, 2)
    paid, smooth = problem.step(x, u)[1], problem.smooth_step(x, u)[1]
    assert_close(paid - smooth, 0.1 * (u.abs() @ torch.tensor([0.3, 0.5])))
    assert_close(problem.response(x, u).slope, 0.04 * u)


def test_near_a_goal_where_a_kink_holds_u_nothing_is_done():
    """In the dead zone V is the cost without control; a smooth cost of controls bends like R at u = 0."""
    system = Linear(torch.tensor([[-0.5]]), torch.tensor([[1.0]]))
    held = riccati(problem_with([AbsoluteCost(0.3)], Unbounded(), system))
    decays = (1 - 0.05) ** (2 * torch.arange(31.0))
    assert_close(held.hessian[0, 0, 0], 2 * (0.1 * 0.1 * decays[:-1].sum() + 8 * decays[-1]), rtol=1e-9, atol=0)
    soft = riccati(problem_with([LogCosCost(0.3, 1e3)], ControlBox(-999.0, 999.0), system))
    quadratic = problem_with(None, Unbounded(), system)
    quadratic.cost = QuadraticCost([[0.1]], [[0.32]], [[8.0]])
    assert_close(soft.hessian, riccati(quadratic).hessian, rtol=1e-6, atol=0)
    assert (soft.hessian[0] < held.hessian[0]).all()

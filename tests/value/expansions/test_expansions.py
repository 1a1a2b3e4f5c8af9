"""Optimal trajectories and expansions: against Riccati's equation, IPOPT, and values beside the trajectory."""

import math

import pytest
import torch
from torch.testing import assert_close

from lyapnet.evaluation.oracles import discrete_riccati, oracle_of
from lyapnet.task.cost import QuadraticCost
from lyapnet.task.sets import Box, ControlBox
from lyapnet.task.systems import ControlAffineSystem, Linear, Pendulum
from lyapnet.value.expansions import dynamic_programming, greedy_law, optimal_trajectories, path_under, riccati, sizes
from tests.problems import problem_of


def hanging(steps=60, dt=0.04):
    """A pendulum that is to be swung up, from π ± 0.3."""
    cost = QuadraticCost(torch.diag(torch.tensor([0.5, 0.05])), [[0.05]], torch.diag(torch.tensor([50.0, 5.0])))
    return problem_of(Pendulum(), cost, steps, dt, Box([math.pi - 0.3, -0.5], [math.pi + 0.3, 0.5]))


def still(problem, count):
    return torch.zeros(problem.horizon.steps, count, problem.system.m)


@pytest.fixture(scope="module")
def swings():
    """Optima of nine states of the pendulum."""
    torch.set_default_dtype(torch.float64)
    problem = hanging()
    x0 = problem.initial_states.sample(9, torch.Generator().manual_seed(0))
    return problem, x0, optimal_trajectories(problem, x0, still(problem, 9))


def test_what_is_optimal_needs_one_pass_backwards_and_no_search(swings, monkeypatch):
    problem, x0, optimum = swings
    searched, passes = [], []
    search, backward = dynamic_programming._line_search, dynamic_programming._backward
    monkeypatch.setattr(
        dynamic_programming, "_line_search", lambda *given: searched.append(len(given[2].cost)) or search(*given)
    )
    monkeypatch.setattr(dynamic_programming, "_backward", lambda *given: passes.append(given[5]) or backward(*given))
    exact = optimal_trajectories(problem, x0, optimum.path.u).path.u
    searched.clear(), passes.clear()
    again = optimal_trajectories(problem, x0, exact)
    assert not searched
    assert passes == [False, True], "one of each kind, and the second is V around the trajectories"
    assert_close(again.path.cost, optimum.path.cost, rtol=1e-12, atol=0)
    for part, expected in zip(again.expansion, optimum.expansion, strict=True):
        assert_close(part, expected, rtol=1e-6, atol=1e-8)
    some = optimum.path.u.clone()
    some[:, [2, 5]] += 0.01
    beside = optimal_trajectories(problem, x0, some)
    assert searched
    assert max(searched) <= 2, "the others have been settled by what their passes expect"
    for part, expected in zip(beside.expansion, optimum.expansion, strict=True):
        assert_close(part, expected, rtol=1e-4, atol=1e-6)
    assert_close(beside.path.cost, optimum.path.cost, rtol=1e-9, atol=0)


def test_on_a_linear_problem_it_is_riccatis_solution():
    torch.manual_seed(1)
    system = Linear(torch.randn(3, 3).tolist(), torch.randn(3, 2).tolist())
    problem = problem_of(system, steps=30, dt=0.1)
    expansion, expected = riccati(problem), discrete_riccati(system, problem.cost, problem.horizon)
    assert_close(expansion.hessian / 2, expected.P, rtol=1e-12, atol=1e-12)
    assert not expansion.gradient.any()
    assert not expansion.value.any()
    x0 = torch.randn(5, 3)
    greedy = path_under(problem, greedy_law(problem, expansion), x0)
    assert_close(greedy.cost, expected.value(0, x0), rtol=1e-12, atol=0)
    assert_close(optimal_trajectories(problem, x0, still(problem, 5)).path.cost, expected.value(0, x0))


class Drifting(ControlAffineSystem):
    """An affine system: the origin is no equilibrium."""

    state_names, state_units, control_names, control_units = ("q", "v"), ("", ""), ("u",), ("",)

    def f(self, x):
        return torch.stack([x[..., 1], 0.7 - x[..., 0]], -1)

    def g(self, x):
        return torch.tensor([[0.0], [1.0]]).expand(*x.shape[:-1], 2, 1)


def test_of_an_affine_problem_it_is_the_value_function_too():
    problem = problem_of(Drifting(), steps=40)
    expansion, x0 = riccati(problem), torch.randn(6, 2)
    value = expansion.value[0] + x0 @ expansion.gradient[0] + ((x0 @ expansion.hessian[0]) * x0).sum(-1) / 2
    assert_close(value, path_under(problem, greedy_law(problem, expansion), x0).cost)
    assert_close(value, optimal_trajectories(problem, x0, still(problem, 6)).path.cost)
    assert not torch.allclose(value, ((x0 @ expansion.hessian[0]) * x0).sum(-1) / 2, rtol=1e-2)


def test_optima_against_ipopt(swings):
    pytest.importorskip("casadi")
    from lyapnet.evaluation.oracles.transcription import Transcription

    problem, x0, optimum = swings
    expected = Transcription(problem).solve(x0).cost
    known = expected.isfinite()
    assert known.sum() >= 6
    assert_close(optimum.path.cost[known], expected[known], rtol=1e-6, atol=0)


def test_the_expansion_is_of_second_order(swings):
    """Its error beside the trajectory falls with the third power of the distance; without its Hessian, the second."""
    problem, x0, optimum = swings
    expansion = optimum.expansion.member(0)
    assert_close(expansion.value[0], optimum.path.cost[0], rtol=1e-9, atol=0)

    def errors(length):
        delta = length * torch.tensor([[0.6, -0.8]])
        controls = optimum.path.u[:, :1]
        exact = optimal_trajectories(problem, x0[:1] + delta, controls).path.cost[0]
        linear = expansion.value[0] + delta[0] @ expansion.gradient[0]
        return float(exact - linear), float(exact - linear - delta[0] @ expansion.hessian[0] @ delta[0] / 2)

    (first_linear, first), (second_linear, second) = errors(0.2), errors(0.1)
    assert math.log2(abs(first / second)) > 2.6
    assert math.log2(abs(first_linear / second_linear)) == pytest.approx(2, abs=0.3)


@pytest.fixture(scope="module")
def limited():
    """Optima of the pendulum from some states with |u| ≤ 8, from a swing that pays no heed to the limits."""
    torch.set_default_dtype(torch.float64)
    problem = hanging().replaced(controls=ControlBox(-8.0, 8.0))
    x0 = problem.initial_states.sample(5, torch.Generator().manual_seed(0))
    return problem, x0, optimal_trajectories(problem, x0, still(problem, 5))


@pytest.mark.gate
def test_optima_within_limits_against_ipopt(limited, swings):
    pytest.importorskip("casadi")
    problem, x0, optimum = limited
    expected = oracle_of(problem).solve(x0).cost
    assert_close(optimum.path.cost, expected, rtol=1e-6, atol=0)
    assert problem.controls.contains(optimum.path.u).all()
    assert (optimum.path.u.abs() == 8).any(0).all(), "each meets a limit"
    free = oracle_of(swings[0]).solve(x0).cost
    assert (expected > 1.001 * free).all(), "which costs something"


def test_within_limits_the_expansion_is_of_second_order_too(limited):
    """Also while a limit holds the control, which then does not answer to the state."""
    problem, x0, optimum = limited
    expansion = optimum.expansion.member(0)
    assert_close(expansion.value[0], optimum.path.cost[0], rtol=1e-9, atol=0)

    def error(length):
        delta = length * torch.tensor([[0.6, -0.8]])
        exact = optimal_trajectories(problem, x0[:1] + delta, optimum.path.u[:, :1]).path.cost[0]
        return float(exact - expansion.value[0] - delta[0] @ expansion.gradient[0])

    assert math.log2(abs(error(0.02) / error(0.01))) == pytest.approx(2, abs=0.4)


def test_limits_that_are_never_met_change_nothing(swings):
    problem, x0, optimum = swings
    wide = optimal_trajectories(problem.replaced(controls=ControlBox(-500.0, 500.0)), x0, still(problem, 9))
    assert_close(wide.path.cost, optimum.path.cost, rtol=1e-9, atol=0)
    assert_close(wide.expansion.hessian, optimum.expansion.hessian, rtol=1e-6, atol=1e-6)


class Escaping(ControlAffineSystem):
    """ẋ = x³ + u: not finite in finite time without control."""

    state_names, state_units, control_names, control_units = ("x",), ("",), ("u",), ("",)

    def f(self, x):
        return x**3

    def g(self, x):
        return torch.ones_like(x)[..., None]


def test_what_is_not_finite_says_so_and_leaves_the_others_alone():
    problem = problem_of(Escaping(), steps=40, dt=0.2)
    x0 = torch.tensor([[0.1], [30.0], [0.2]])
    path = path_under(problem, lambda _, x: 0 * x, x0)
    assert path.cost.isfinite().tolist() == [True, False, True]
    assert path.x.isfinite().all()
    optimum = optimal_trajectories(problem, x0, still(problem, 3)).path.cost
    assert_close(optimum[[0, 2]], optimal_trajectories(problem, x0[[0, 2]], still(problem, 2)).path.cost)
    assert (optimum[[0, 2]] < path.cost[[0, 2]]).all()
    assert optimum[1] == torch.inf


def test_of_guesses_at_one_optimum_the_hopeless_are_left_once_one_has_settled(monkeypatch):
    monkeypatch.setattr("lyapnet.value.expansions.dynamic_programming.GRACE_ITERATIONS", 0)
    problem = hanging(steps=40)
    x0, best = problem.initial_states.center.expand(3, -1), problem.initial_states.center[None]
    settled = optimal_trajectories(problem, best, still(problem, 1)).path
    guesses = torch.cat([settled.u + 1e-3, settled.u + 0.5, settled.u.new_full(settled.u.shape, -100)], 1)
    alone, rivals = (optimal_trajectories(problem, x0, guesses, rivals=each).path.cost for each in (False, True))
    assert_close(alone, settled.cost.expand(3), rtol=1e-6, atol=0)
    assert_close(rivals[:2], alone[:2], rtol=1e-6, atol=0)
    assert rivals[2] > 2 * alone[2]


def test_differences_of_costs_are_held_against_their_size():
    cost, problem = torch.tensor([1.0, 3.0, torch.inf]), hanging()
    assert sizes(problem, cost) is cost, "with a goal zero is the least"
    problem.findings["no_goal"] = "nobody named one"
    assert_close(sizes(problem, cost - 7), torch.tensor([1.0, 1.0, 1.0]))  # by how much the finite ones are spread
    assert_close(sizes(problem, torch.tensor([-1e-9, 1.0])), torch.tensor([0.5, 0.5]))

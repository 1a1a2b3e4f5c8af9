"""Fitting V to optima: what the examples say, against Riccati's solution and rollouts; and what fitting brings."""

import math
from types import SimpleNamespace

import pytest
import torch
from torch.testing import assert_close

from lyapnet.evaluation.oracles import Optima, discrete_riccati
from lyapnet.expansions import no_control, optimal_trajectories, path_under, riccati
from lyapnet.networks import FCN, Scaling
from lyapnet.policy import SampledPolicy
from lyapnet.systems import Linear
from lyapnet.training import pretraining
from lyapnet.training.pretraining import errors, examples_of, fit, optima_for
from tests.problems import Formula, problem_of
from tests.test_expansions import hanging

GENERATOR = torch.Generator().manual_seed(0)


@pytest.fixture
def problem():
    return problem_of(Linear([[0.0, 1.0], [1.0, 0.0]], [[0.0], [1.0]]), steps=20, dt=0.1)


def shifted(problem, by):
    """The value function of a linear problem at the nodes, with a slope of its own added."""
    P = discrete_riccati(problem.system, problem.cost, problem.horizon).P

    def value(t, x):
        matrix = P[(t / problem.horizon.dt).round().long().clamp(0, problem.horizon.steps)]
        return ((x[..., None, :] @ matrix)[..., 0, :] * x).sum(-1) + by * x.sum(-1)

    return Formula(value)


def test_examples_are_the_value_function_of_a_linear_problem(problem):
    optimum = optima_for(problem, [riccati(problem)], problem.initial_states.sample(6))
    examples = examples_of(problem, optimum, GENERATOR)
    along, near = examples.x.reshape(2, problem.horizon.steps, 6, problem.system.n)
    assert torch.equal(along, optimum.path.x[:-1])
    apart = (along[:, :, None] - along[:, None]).abs().max()
    assert 0.1 * apart < (near - along).abs().max() <= apart / 2
    value_error, excess = errors(shifted(problem, 0.0), examples)
    assert float(value_error.detach()) < 1e-20
    assert float(excess.detach()) < 1e-20


def test_the_excess_is_what_wrong_controls_cost(problem):
    """To the last digit where the problem is linear: here along one trajectory, from its start."""
    x0, V = torch.tensor([[0.4, -0.7]]), shifted(problem, 0.3)
    policy, times = SampledPolicy(problem, V), problem.horizon.times(torch.zeros(()))
    path = path_under(problem, lambda n, x: policy(times[n], x).detach(), x0)
    optimum = optimal_trajectories(problem, x0, torch.zeros(problem.horizon.steps, 1, 1))
    along = examples_of(
        problem, optimum._replace(path=optimum.path._replace(x=path.x), expansion=at(path.x, problem)), GENERATOR
    )
    _, excess = errors(V, along)
    expected = float(path.cost - optimum.path.cost)
    assert expected > 0.01
    assert float(excess.detach()) * along.mean_cost == pytest.approx(expected, rel=1e-9)


def at(x, problem):
    """Riccati's expansion around any states."""
    P = discrete_riccati(problem.system, problem.cost, problem.horizon).P[:, None]
    gradient = 2 * (P @ x[..., None])[..., 0]
    return riccati(problem)._replace(
        x=x, value=(gradient * x).sum(-1) / 2, gradient=gradient, hessian=2 * P.expand(*x.shape, x.shape[-1])
    )


def test_fitting_lowers_both_errors_on_states_that_it_did_not_see(monkeypatch):
    monkeypatch.setattr(pretraining, "STEPS", 300)
    problem = hanging(steps=40)
    expansion = optimal_trajectories(problem, problem.initial_states.center[None], torch.zeros(40, 1, 1)).expansion
    seen, unseen = (
        examples_of(problem, optima_for(problem, [expansion.member(0)], problem.initial_states.sample(12)), GENERATOR)
        for _ in range(2)
    )
    V = FCN(Scaling((3.0, 3.0), problem.horizon.duration, seen.mean_cost), (32, 32))
    before = [float(error.detach()) for error in errors(V, unseen)]
    fit(V, seen, torch.Generator().manual_seed(0))
    after = [float(error.detach()) for error in errors(V, unseen)]
    assert after[0] < before[0] / 20
    assert after[1] < before[1] / 20


def test_only_finite_trajectories_are_examples(problem):
    x0 = problem.initial_states.sample(3)
    optimum = optimal_trajectories(problem, x0, torch.zeros(problem.horizon.steps, 3, 1))
    broken = optimum.path.cost.clone()
    broken[1] = torch.inf
    examples = examples_of(problem, optimum._replace(path=optimum.path._replace(cost=broken)), GENERATOR)
    assert len(examples.t) == 2 * 2 * problem.horizon.steps
    assert_close(examples.mean_cost, float(optimum.path.cost[[0, 2]].mean()))


def test_as_many_trajectories_as_fit_into_memory(problem, monkeypatch):
    monkeypatch.setattr(pretraining, "NUMBERS", 2 * problem.horizon.steps * 3**2)
    assert optima_for(problem, [riccati(problem)], problem.initial_states.sample(9)).path.cost.shape == (2,)


@pytest.fixture
def without_oracle(monkeypatch):
    monkeypatch.setattr(pretraining, "optimal_cost", lambda _: None)


def test_few_are_sought_and_the_others_follow(monkeypatch, without_oracle):
    problem = hanging(steps=40)
    x0, expansions, batches = problem.initial_states.sample(9), [riccati(problem)], []
    expected = optima_for(problem, expansions, x0)

    def counted(problem, x0, u):
        batches.append(len(x0))
        return optimal_trajectories(problem, x0, u)

    monkeypatch.setattr(pretraining, "optimal_trajectories", counted)
    monkeypatch.setattr(pretraining, "SOUGHT", 4)
    optimum = optima_for(problem, expansions, x0)
    assert batches[0] == 4
    assert 5 in batches
    assert_close(optimum.path.x[0], x0)
    assert_close(optimum.path.cost, expected.path.cost, rtol=1e-6, atol=0)
    assert_close(optimum.expansion.hessian, expected.expansion.hessian, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(("share", "taken"), [(0.5, [5, 3]), (math.inf, [5])])
def test_what_an_oracle_knows_better_is_taken(share, taken, monkeypatch, without_oracle):
    problem = hanging(steps=40)
    x0, expansions, batches = problem.initial_states.sample(5), [riccati(problem)], []
    monkeypatch.setattr(pretraining, "ROUNDS", 0)
    monkeypatch.setattr(pretraining, "FAR", 3)
    good, idle = optima_for(problem, expansions, x0).path, path_under(problem, no_control(problem), x0)

    def solve(states):
        return Optima(share * good.cost[: len(states)], [""] * len(states), good.u[:, : len(states)])

    def spoiled(problem, x0, u):
        batches.append(len(x0))
        return optimal_trajectories(problem, x0, u) if batches[1:] else optimal_trajectories(problem, x0, 0 * u, 0)

    monkeypatch.setattr(pretraining, "optimal_cost", lambda _: SimpleNamespace(solve=solve))
    monkeypatch.setattr(pretraining, "optimal_trajectories", spoiled)
    cost = optima_for(problem, expansions, x0).path.cost
    assert batches == taken
    assert_close(cost[3:], idle.cost[3:])
    assert_close(cost[:3], (good if 3 in taken else idle).cost[:3], rtol=1e-6, atol=0)


def test_a_bad_minimum_is_left_by_way_of_its_neighbours(monkeypatch, without_oracle):
    problem = hanging(steps=40)
    x0, expansions = problem.initial_states.sample(8), [riccati(problem)]
    expected = optima_for(problem, expansions, x0).path.cost
    begun = []

    def spoiled(problem, x0, u):
        found = optimal_trajectories(problem, x0, u)
        if begun:
            return found
        begun.append(x0)
        bad = optimal_trajectories(problem, x0[:1], 0 * u[:, :1], iterations=0)
        return pretraining._with(found, torch.tensor([0]), bad)

    monkeypatch.setattr(pretraining, "optimal_trajectories", spoiled)
    assert_close(optima_for(problem, expansions, x0).path.cost, expected, rtol=1e-6, atol=0)
    begun.clear()
    monkeypatch.setattr(pretraining, "ROUNDS", 0)
    assert optima_for(problem, expansions, x0).path.cost[0] > 2 * expected[0]


def test_one_state_and_states_that_share_a_coordinate(without_oracle):
    problem = hanging(steps=20)
    x0 = problem.initial_states.sample(3)
    x0[:, 1] = 0.25
    whole = optima_for(problem, [riccati(problem)], x0)
    assert whole.path.cost.isfinite().all()
    assert_close(optima_for(problem, [riccati(problem)], x0[:1]).path.x[0], x0[:1])

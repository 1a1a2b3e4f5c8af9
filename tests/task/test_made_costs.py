"""Costs made of another, against their formulas; from a config; and through training, optimum and reports."""

import math

import pytest
import torch
from torch.testing import assert_close

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.evaluation.oracles import oracle_of
from lyapnet.experiment.config import config_from_plain, load_config
from lyapnet.task.cost import ObstacleCost, PeriodicCost, PseudoHuberCost, QuadraticCost, TargetCost
from lyapnet.training.start import expansions_of
from lyapnet.value.expansions import greedy_law, optimal_trajectories, path_under
from tests.configs import objects
from tests.fits import shorten_fits
from tests.problems import CONF

PENDULUM = {
    "experiment": "made",
    "system": {"name": "pendulum"},
    "cost": {"Q": [1, 0.1], "R": [0.1], "Q_T": [10, 1]},
    "initial_states": {"lower": [1.5, -0.5], "upper": [2.5, 0.5]},
    "horizon": {"steps": 50, "dt": 0.04},
}
BUMP = {"center": {"angle": 1.0}, "radius": 0.4, "weight": 8}


def made(**cost):
    return {**PENDULUM, "cost": {**PENDULUM["cost"], **cost}}


def problem_of(content, *overrides):
    return objects(config_from_plain(content, overrides))[0]


def quadratic():
    return QuadraticCost(torch.diag(torch.tensor([1.0, 0.1])), [[0.1]], torch.diag(torch.tensor([10.0, 1.0])))


def test_an_angle_that_goes_round():
    cost, x = PeriodicCost(quadratic(), [0], 2), 4 * torch.randn(50, 2)
    assert_close(cost.state(x), 2 * (1 - torch.cos(x[:, 0])) + 0.1 * x[:, 1] ** 2)
    assert_close(cost.terminal(x), 20 * (1 - torch.cos(x[:, 0])) + x[:, 1] ** 2)
    assert_close(cost.state(x), cost.state(x + torch.tensor([2 * math.pi, 0.0])))
    small = 1e-3 * x
    assert_close(cost.state(small), quadratic().state(small), rtol=1e-4, atol=0)
    assert not torch.allclose(cost.state(x), quadratic().state(x), rtol=0.1)
    assert not torch.allclose(cost.state(x), cost.state(x + torch.tensor([0.0, 2 * math.pi])))


def test_a_cost_that_grows_less_far_away():
    cost, x = PseudoHuberCost(quadratic(), 3.0), 4 * torch.randn(50, 2)
    for ours, q in ((cost.state(x), quadratic().state(x)), (cost.terminal(x), quadratic().terminal(x))):
        assert_close(ours, 18 * ((1 + q / 9).sqrt() - 1))
    assert_close(cost.state(1e-4 * x), quadratic().state(1e-4 * x), rtol=1e-6, atol=0)
    assert_close(cost.state(1e6 * x), 6 * quadratic().state(1e6 * x).sqrt(), rtol=1e-4, atol=0)
    u = torch.randn(50, 1)
    assert_close(cost.control(x, u), quadratic().control(x, u))
    about = problem_of(made(huber=3.0, obstacles=[BUMP]), "target=[0.5,0]").cost
    bump = 8 * torch.exp(-2 * ((x[:, 0] - 1) / 0.4) ** 2)
    assert_close(about.state(x), cost.state(x - torch.tensor([0.5, 0.0])) + bump)
    assert problem_of(made()).cost.state(x).max() > about.state(x).max(), "the twin: without it, it is dearer"


def test_an_obstacle():
    cost, x = ObstacleCost(quadratic(), [1], [0.5], 0.4, 8.0), torch.randn(50, 2)
    bump = cost.state(x) - quadratic().state(x)
    assert_close(bump, 8 * torch.exp(-2 * ((x[:, 1] - 0.5) / 0.4) ** 2))
    assert_close(cost.terminal(x), quadratic().terminal(x))
    u = torch.randn(50, 1)
    assert_close(cost.control(x, u), quadratic().control(x, u))
    two = ObstacleCost(cost, [0, 1], [0.0, 0.0], 1.0, 3.0)
    assert_close(two.state(x) - cost.state(x), 3 * torch.exp(-2 * (x**2).sum(-1)))


def test_a_target_moves_the_cost_and_not_the_obstacles():
    """x* counts for angle and goal; an obstacle stays where it is."""
    cost = problem_of(made(periodic=["angle"], obstacles=[BUMP]), "target=[0.5,0]").cost
    x = torch.randn(20, 2)
    bump = 8 * torch.exp(-2 * ((x[:, 0] - 1) / 0.4) ** 2)
    assert_close(cost.state(x), 2 * (1 - torch.cos(x[:, 0] - 0.5)) + 0.1 * x[:, 1] ** 2 + bump)
    assert_close(cost.goal, torch.tensor([0.5, 0.0]))
    u = torch.tensor([-9.81 * math.sin(0.5)])
    assert_close(cost.rest, u)
    assert float(cost.control(x[0], u)) == 0
    alike = ObstacleCost(TargetCost(PeriodicCost(quadratic(), [0], 2), [0.5, 0.0], u), [0], [1.0], 0.4, 8.0)
    assert_close(alike.running(x, torch.ones(20, 1)), cost.running(x, torch.ones(20, 1)))


@pytest.mark.gate
def test_both_routes_find_the_same_optimum():
    pytest.importorskip("casadi")
    problem = problem_of(made(periodic=["angle"], obstacles=[BUMP]))
    x0 = problem.initial_states.sample(3, torch.Generator().manual_seed(0))
    optima = oracle_of(problem).solve(x0)
    found = optimal_trajectories(problem, x0, optima.u + 0.01).path.cost
    assert_close(found, optima.cost, rtol=1e-6, atol=0)
    plain = oracle_of(problem_of(PENDULUM)).solve(x0).cost
    assert not torch.allclose(optima.cost, plain, rtol=1e-2)


@pytest.mark.gate
def test_a_guess_that_is_slow_at_first_is_not_given_up():
    """Here swinging back first is cheaper, and its guess settles long after that of the way straight up."""
    problem = objects(load_config(CONF / "pendulum_periodic.yaml"))[0]
    (_, at_goal), (_, optimum) = expansions_of(problem)
    centre = problem.initial_states.center[None]
    straight = path_under(problem, greedy_law(problem, at_goal), centre)
    assert float(optimal_trajectories(problem, centre, straight.u).path.cost) > 6
    assert float(optimum.value[0]) < 5
    assert float(optimum.x[:, 0].max()) > 4, "it swings back first"


@pytest.mark.gate
def test_it_trains_and_comes_back(tmp_path, monkeypatch):
    monkeypatch.setattr("lyapnet.training.start.MAX_OPTIMA", 12)
    shorten_fits(monkeypatch, 260, 140)
    monkeypatch.setattr("lyapnet.training.pretraining.BRIEF_STEPS", 10)
    brief = ["training.iterations=2", "evaluation.test_states=4", "evaluation.validation_states=4", "loggers=[csv]",
             "rollout.gradient=backprop"]  # fmt: skip
    run = lyapnet.train({**made(periodic=["angle"], obstacles=[BUMP]), "logs": str(tmp_path)}, brief)
    assert run.evaluation["cost_ratio"] < 1.1
    controller = lyapnet.load(run.best)
    assert isinstance(controller.cost, ObstacleCost)
    other = lyapnet.load(run.best, cost=quadratic()).cost
    assert float(other.state(torch.ones(2))) == pytest.approx(1.1 + 8), "in the place of the quadratic; obstacles stay"
    own = ObstacleCost(quadratic(), [0], [0.0], 1.0, 1.0)
    assert float(lyapnet.load(run.best, cost=own).cost.state(torch.zeros(2))) == 1, "made by hand: taken as it is"


@pytest.mark.parametrize(
    ("cost", "reason"),
    [
        ({"huber": 0}, "cost.huber > 0"),
        ({"huber": "much"}, "cost.huber"),
        ({"periodic": ["angel"]}, "cost.periodic among angle, velocity, got 'angel'"),
        ({"periodic": ["angle"], "Q": [[1, 0.1], [0.1, 1]]}, "no products of a cost.periodic angle"),
        ({"obstacles": [{**BUMP, "radius": 0}]}, "radius > 0"),
        ({"obstacles": [{**BUMP, "center": {"x": 1}}]}, "cost.obstacles.0..center among angle, velocity, got 'x'"),
        ({"obstacles": [{**BUMP, "colour": 1}]}, "cost.obstacles, each as"),
        ({"obstacles": [{**BUMP, "weight": "much"}]}, "cost.obstacles, each as"),
        ({"obstacles": [{**BUMP, "center": 3}]}, "cost.obstacles, each as"),
        ({"obstacles": [{}]}, "cost.obstacles, each as"),
    ],
)
def test_what_does_not_fit_is_refused(cost, reason):
    with pytest.raises(UsageError, match=f"Expected .*{reason}"):
        problem_of(made(**cost))

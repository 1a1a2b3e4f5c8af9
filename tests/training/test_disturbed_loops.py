"""Closed loops on random plants: how they differ from those of the model, and what a fit to where they lead brings."""

import pytest
import torch
from torch.testing import assert_close

from lyapnet.task.sets import Box
from lyapnet.task.systems import Cartpole, ControlSystem, DoubleIntegrator, KinematicBicycle, Linear
from lyapnet.training import disturbed_loops, examples, pretraining
from lyapnet.training.disturbed_loops import disturbed_path, rate_is_certain
from lyapnet.training.examples import draw_examples
from lyapnet.training.optima import optima_for
from lyapnet.training.pretraining import fit
from lyapnet.value.expansions import optimal_trajectories, path_under
from tests.fits import shorten_fits
from tests.problems import problem_of
from tests.training.test_pretraining import learner_of
from tests.value.expansions.test_expansions import hanging


class WithClock(ControlSystem):
    """ẋ = (x₂, sin x₁ + u³, 1)."""

    state_names, control_names = ("position", "speed", "time"), ("push",)

    def dynamics(self, x, u):
        return torch.stack([x[..., 1], torch.sin(x[..., 0]) + u[..., 0] ** 3, torch.ones_like(x[..., 0])], -1)


def pushed(problem, generator, count=40):
    """Paths under random controls."""
    x0 = problem.initial_states.sample(count, generator)
    u = torch.randn(problem.horizon.steps, count, problem.system.m, generator=generator)
    return path_under(problem, lambda n, _: problem.controls.project(u[n]), x0)


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(0)


@pytest.mark.parametrize(
    ("system", "certain"),
    [
        (DoubleIntegrator(), [True, False]),
        (Cartpole(), [True, True, False, False]),
        (WithClock(), [True, False, True]),
        (Linear([[0.0, 2.0], [-1.0, 0.0]], [[0.0], [1.0]]), [False, False]),
    ],
    ids=["double integrator", "cart-pole", "with a clock", "turned by 2"],
)
def test_the_rates_of_positions_and_clocks_are_those_of_every_plant(system, certain, generator):
    problem = problem_of(system)
    assert rate_is_certain(problem, pushed(problem, generator)).tolist() == certain


def test_each_loop_has_a_plant_of_its_own_whose_rates_differ_by_constant_factors(generator):
    problem = problem_of(Cartpole(), steps=20, dt=0.02, initial_states=Box([-0.2] * 4, [0.2] * 4))
    optimal = pushed(problem, generator)
    path = disturbed_path(learner_of(problem), optimal, generator)
    changes = path.x.diff(dim=0)
    following, at_rest = (problem.step(path.x[:-1], u)[0] for u in (path.u, 0 * path.u))
    assert_close(changes[..., :2], (following - path.x[:-1])[..., :2])
    parts = torch.stack([at_rest - path.x[:-1], following - at_rest], -1)[..., 2:, :]  # (steps, loops, 2 states, 2)
    A, b = parts.permute(1, 2, 0, 3), changes[..., 2:].permute(1, 2, 0)[..., None]
    factors = torch.linalg.lstsq(A, b).solution
    assert_close(A @ factors, b, rtol=1e-6, atol=1e-12)
    assert 0.69 <= factors.min() < 0.75
    assert 1.25 < factors.max() <= 1.31
    out = path.x[0] / optimal.x[0]
    assert 1 <= out.min() < 1.05
    assert 1.15 < out.max() <= 1.2


def test_without_changes_they_are_the_loops_of_the_model(monkeypatch, generator):
    problem = problem_of(KinematicBicycle(), steps=10, dt=0.05)
    monkeypatch.setattr(disturbed_loops, "RATE_CHANGE", 0.0)
    monkeypatch.setattr(disturbed_loops, "DISTANCE", 0.0)
    learner, optimal = learner_of(problem), pushed(problem, generator)
    path, expected = disturbed_path(learner, optimal, generator), learner.path_from(optimal.x[0])
    for own, other in zip(path, expected, strict=True):
        assert_close(own, other, rtol=1e-9, atol=1e-9)


@pytest.mark.gate
def test_a_fit_to_where_they_lead_makes_the_law_better_there_and_no_worse_on_the_model(monkeypatch):
    """A pendulum that hangs, from states beyond X₀ on plants whose accelerations differ by 30 %."""
    problem = hanging(steps=40)
    shorten_fits(monkeypatch, 400, 200)
    monkeypatch.setattr(examples, "MIN_OPTIMA", 8)
    monkeypatch.setattr(pretraining, "MAX_WIDENED_EXCESS", 1.0)
    first = optimal_trajectories(problem, problem.initial_states.center[None], torch.zeros(40, 1, 1))
    optimum = optima_for(problem, [first.expansion.member(0)], problem.initial_states.sample(12))
    eight_times, costs = optimum.path.member(torch.arange(96) % 12), {}
    for rounds in (0, 3):
        torch.manual_seed(0)
        monkeypatch.setattr(pretraining, "DISTURBED_ROUNDS", rounds)
        learner = learner_of(problem, float(optimum.path.cost.mean()))
        fit(learner, optimum, draw_examples(problem, optimum, torch.Generator().manual_seed(0)))
        with monkeypatch.context() as patch:
            patch.setattr(disturbed_loops, "DISTANCE", 1.0)
            far = disturbed_path(learner, eight_times, torch.Generator().manual_seed(1))
        costs[rounds] = float(learner.path_from(optimum.path.x[0]).cost.mean()), float(far.cost.mean())
    assert costs[3][0] <= 1.01 * costs[0][0]
    assert costs[3][1] < 0.7 * costs[0][1]

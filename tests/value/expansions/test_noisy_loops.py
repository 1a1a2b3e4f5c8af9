"""Expansions around loops under noise that lead another way than the optimum without noise."""

import pytest
import torch
from torch.testing import assert_close

from lyapnet.training.optima import waves
from lyapnet.value.expansions import (
    expansion_of_another_way,
    expansion_under_noise,
    greedy_law,
    optimal_trajectories,
    path_under,
    riccati,
)
from tests.noise_tasks.run import problem_in
from tests.noise_tasks.tasks import TASKS


def generator():
    return torch.Generator().manual_seed(2)


@pytest.fixture(scope="module", params=[0.5, 0.1], ids=["strong noise", "weak noise"])
def walk(request):
    """(σ, the walker before a wall with a gap, costs of a law, the expansion on his way, one on another way)."""
    torch.set_default_dtype(torch.float64)
    problem = problem_in(TASKS["gap"], f"noise={{aside: {request.param}}}")
    centre = problem.initial_states.center[None]
    optimum = optimal_trajectories(problem, centre, torch.zeros(problem.horizon.steps, 1, 1))
    known = expansion_under_noise(problem, optimum.expansion.member(0), generator())
    other = expansion_of_another_way(problem, known, waves(problem, 2.0, 8), generator())
    x0 = problem.initial_states.sample(512, generator())
    increments = problem.noise.draw(problem.horizon.steps, problem.horizon.dt, x0, generator())

    def follow(expansion):
        return path_under(problem, greedy_law(problem, expansion), x0, increments)

    return request.param, follow(known), None if other is None else follow(other)


def test_noise_makes_another_way_the_cheaper_one(walk):
    """Around the end of the wall at −0.8 m under strong noise; the gap is the best way under weak noise."""
    sigma, known, other = walk
    assert known.x[50, :, 1].abs().median() < 0.1
    assert (other is not None) == (sigma > 0.3)
    if other is not None:
        assert float(other.cost.mean()) < 0.97 * float(known.cost.mean())
        assert float(other.x[50, :, 1].median()) < -0.8


@pytest.mark.parametrize("known", ["the best law", "a law of half the control"])
def test_a_linear_quadratic_task_has_one_way(known):
    problem = problem_in(TASKS["lqg_2"])
    exact = riccati(problem)
    half = exact._replace(gradient=exact.gradient / 2, hessian=exact.hessian / 2)
    best = known == "the best law"
    found = expansion_of_another_way(problem, exact if best else half, waves(problem, 1.0, 3), generator())
    assert (found is None) == best
    if found is not None:
        assert_close(found.hessian, exact.hessian, rtol=1e-9, atol=1e-12)
        x0 = problem.initial_states.sample(9, generator())
        assert_close(found.initially(x0), exact.initially(x0), rtol=1e-9, atol=0)


@pytest.mark.parametrize("broken", [0, 2])
def test_a_guess_whose_loops_are_not_finite_leaves_the_others(broken):
    problem = problem_in(TASKS["lqg_2"])
    exact, guesses = riccati(problem), waves(problem, 1.0, 3)
    half = exact._replace(gradient=exact.gradient / 2, hessian=exact.hessian / 2)
    guesses[broken] = lambda n, x: x[..., :1] * torch.inf
    found = expansion_of_another_way(problem, half, guesses, generator())
    assert found is not None
    assert_close(found.hessian, exact.hessian, rtol=1e-9, atol=1e-12)
    assert expansion_of_another_way(problem, half, [guesses[broken]], generator()) is None


def test_none_is_sought_where_derivatives_take_too_much_memory(monkeypatch):
    problem = problem_in(TASKS["lqg_2"])
    exact = riccati(problem)
    half = exact._replace(gradient=exact.gradient / 2, hessian=exact.hessian / 2)
    assert expansion_of_another_way(problem, half, waves(problem, 1.0, 3), generator()) is not None
    monkeypatch.setattr("lyapnet.value.expansions.noisy_loops.MAX_ENTRIES", 1000)
    assert expansion_of_another_way(problem, half, waves(problem, 1.0, 3), generator()) is None

"""A task without a goal over horizons of any length: where its optima are, and what training makes of it."""

import pytest
import torch

from lyapnet.evaluation.oracles import oracle_of
from tests.tasks_without_goal.run import train_and_measure
from tests.tasks_without_goal.tasks import problem_in, replay
from tests.tasks_without_goal.turnpike import FOLDER, GOLDEN_RULE, HORIZONS, changes_for, task_of

pytest.importorskip("casadi")


@pytest.mark.gate
@pytest.mark.parametrize("years", HORIZONS[:2])
def test_least_costs_are_those_of_the_task(years):
    problem, task = problem_in(FOLDER, *changes_for(years)), task_of(years)
    assert problem.no_goal
    optima = oracle_of(problem).solve(torch.tensor(task.states[:4]))
    assert torch.allclose(optima.cost, torch.tensor(task.optima[:4]), rtol=1e-6, atol=0)
    found = replay(problem, task.states[:4], optima.u.transpose(0, 1))
    assert torch.allclose(found.J, optima.cost, rtol=1e-9, atol=0)


@pytest.mark.gate
@pytest.mark.parametrize(("years", "stays"), [("80", True), ("20", False)])
def test_optima_of_a_long_horizon_share_their_middle(years, stays):
    """From both ends of X₀; twenty years are too few to save that much."""
    problem = problem_in(FOLDER, *changes_for(years))
    x0 = torch.stack([problem.initial_states.lower, problem.initial_states.upper])
    oracle = oracle_of(problem)
    path = oracle.rollout(x0, oracle.solve(x0).u)[0]
    away = (path[len(path) // 2] / GOLDEN_RULE - 1).abs().max()
    assert bool(away < 0.02) is stays


@pytest.mark.nightly
@pytest.mark.parametrize("years", HORIZONS)
def test_training_is_right_over_any_horizon(years):
    run, found = train_and_measure(task_of(years), seed=0)
    assert run["status"] == 0
    assert found["regret"] <= 0.01
    assert found["beyond"] == 0

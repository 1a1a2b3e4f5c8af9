"""Optima through contact: those from softer contacts reach what a hard one hides."""

import pytest
import torch

from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import load_config
from lyapnet.task.systems.contact import variable_lengths
from lyapnet.value.expansions import at_rest, greedy_law, in_float64, optimal_trajectories, path_under, riccati
from tests.problems import CONF


def problem_of_config(name, *overrides):
    return in_float64(build_problem(load_config(CONF / f"{name}.yaml", overrides)))


def costs(problem, x0, u, softer_first):
    return optimal_trajectories(problem, x0, u, softer_first=softer_first).path.cost


@pytest.mark.gate
def test_a_hard_contact_that_rest_does_not_meet_has_no_slope_and_a_soft_one_has():
    problem = problem_of_config("pushing", "system.parameters.stiffness=1000")
    x0 = torch.tensor([[0.0, 1.0, 0.0, 0.0], [-0.2, 1.2, 0.0, 0.0]], dtype=torch.float64)
    u = path_under(problem, at_rest(problem), x0).u
    hard, softer = (costs(problem, x0, u, softer_first) for softer_first in (False, True))
    assert hard[1] > 1300  # at rest
    assert softer[0] < 801.81  # the best of five published there
    assert softer[1] < 655


@pytest.mark.gate
def test_leaning_on_a_wall_is_found():
    problem = problem_of_config("cartpole_walls")
    x0 = torch.tensor([[0.2, 0.0, 0.3, 0.0]], dtype=torch.float64)
    u = path_under(problem, greedy_law(problem, riccati(problem)), x0).u
    hard, softer = (float(costs(problem, x0, u, softer_first)) for softer_first in (False, True))
    assert hard > 249
    assert softer < 178


def test_only_parameters_that_stand_alone_are_lengths():
    names = [problem_of_config(name).system.contact_lengths for name in ("pushing", "pendulum_swingup")]
    assert names == [["length"], ()]
    problem = problem_of_config("pushing")
    before = problem.system.dynamics(torch.tensor([0.0, 1.0, 0.0, 0.0]).double(), torch.zeros(1).double())
    ((length, value),) = variable_lengths(problem)
    assert (float(length), value) == (0.001, 0.001)
    length.fill_(0.1)
    after = problem.system.dynamics(torch.tensor([0.0, 1.0, 0.0, 0.0]).double(), torch.zeros(1).double())
    assert (after - before).abs().max() > 1

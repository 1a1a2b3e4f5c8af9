"""The dearest corner of X₀, which uniform draws miss."""

import itertools

import pytest
import torch

from lyapnet.controller.controller import Controller
from lyapnet.evaluation.measurement import dearest_corner
from lyapnet.task.sets import Box
from lyapnet.task.systems import DoubleIntegrator
from tests.problems import Formula, problem_of


def controller_of(V, lower=(-1.0, -2.0), upper=(3.0, 1.0)):
    return Controller(problem_of(DoubleIntegrator(), initial_states=Box(lower, upper)), Formula(V))


def test_it_is_the_dearest_of_all():
    controller = controller_of(lambda t, x: (x**2).sum(-1))
    found = dearest_corner(controller)
    states = torch.tensor(list(itertools.product((-1.0, 3.0), (-2.0, 1.0))))
    costs = [float(controller.rollout(x).cost) for x in states]
    assert found.count == 4
    assert found.cost == pytest.approx(max(costs))
    assert found.x0 == states[costs.index(max(costs))].tolist()
    assert found.value == pytest.approx(sum(x**2 for x in found.x0))
    assert min(costs) < 0.9 * found.cost


def test_loops_that_diverge_have_no_cost():
    assert dearest_corner(controller_of(lambda t, x: -1e9 * (x**4).sum(-1))).cost is None

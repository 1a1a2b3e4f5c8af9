"""Optima within limits, whatever the units of cost and control: IPOPT against differential dynamic programming."""

import math

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from lyapnet.evaluation.oracles import oracle_of
from lyapnet.evaluation.oracles.multistart import Candidate
from lyapnet.task.cost import QuadraticCost
from lyapnet.task.sets import Box, ControlBox
from lyapnet.task.systems import Linear
from lyapnet.value.expansions import optimal_trajectories
from tests.problems import problem_of

pytest.importorskip("casadi")


def limited(cost=1.0, unit=1.0):
    """A double integrator with |u| ≤ 0.5 in another unit of control, which costs so many times as much."""
    weight = cost * torch.diag(torch.tensor([10.0, 0.1]))
    system = Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [unit]])
    controls = ControlBox(-0.5 / unit, 0.5 / unit)
    return problem_of(system, QuadraticCost(weight, [[cost * unit**2]], weight), 60, 0.05, controls=controls)


@pytest.mark.gate
@pytest.mark.parametrize(("cost", "unit"), [(1.0, 1.0), (1e-4, 1.0), (1e12, 1.0), (1.0, 1e4), (1.0, 1e-6)])
def test_units_do_not_matter(cost, unit):
    problem = limited(cost, unit)
    x0 = problem.initial_states.sample(3, torch.Generator().manual_seed(0))
    optima = oracle_of(problem).solve(x0)
    expected = optimal_trajectories(problem, x0, torch.zeros(60, 3, 1)).path
    assert_close(optima.cost, expected.cost, rtol=1e-8, atol=0)
    assert_close(
        optima.cost / cost, optimal_trajectories(limited(), x0, torch.zeros(60, 3, 1)).path.cost, rtol=1e-8, atol=0
    )
    assert problem.controls.contains(optima.u).all()
    assert (expected.u.abs() == problem.controls.upper).any()


def test_units_of_states_do_not_matter():
    """Metres, and 10⁻⁴ and 10⁴ of them: the same optima, from the same lines."""
    costs = []
    for position, speed in ((1.0, 1.0), (1e4, 1e-4), (1e-4, 1e4)):
        weight = torch.diag(torch.tensor([10 / position**2, 0.1 / speed**2]))
        system = Linear([[0.0, position / speed], [0.0, 0.0]], [[0.0], [speed]])
        cost, controls = QuadraticCost(weight, [[1.0]], weight), ControlBox(-0.5, 0.5)
        problem = problem_of(system, cost, 60, 0.05, Box([-position, -speed], [position, speed]), controls)
        costs.append(oracle_of(problem).solve(torch.tensor([[position, speed], [-position, 0.3 * speed]])).cost)
    assert_close(costs[1], costs[0], rtol=1e-8, atol=0)
    assert_close(costs[2], costs[0], rtol=1e-8, atol=0)


class Dragged(Linear):
    """A double integrator with drag √(v²) v, of which no slope exists at rest."""

    def __init__(self):
        super().__init__([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])

    def f(self, x):
        return super().f(x) - torch.tensor([0.0, 0.3]) * x[..., 1:].square().sqrt() * x[..., 1:]


def test_slopes_need_not_exist_where_a_path_begins():
    problem = limited().replaced(system=Dragged())
    x0 = torch.tensor([[1.0, 0.0], [0.7, 0.0]])
    optima = oracle_of(problem).solve(x0)
    assert_close(optima.cost, optimal_trajectories(problem, x0, torch.zeros(60, 2, 1)).path.cost, rtol=1e-6, atol=0)


def test_a_bent_path_is_a_start_too():
    """Its cost says nothing of that of the optimum where the way there costs nothing."""
    problem = limited()
    free = QuadraticCost(torch.zeros(2, 2), [[1.0]], torch.diag(torch.tensor([50.0, 5.0])))
    oracle = oracle_of(problem.replaced(cost=free))
    x0 = problem.initial_states.sample(1, torch.Generator().manual_seed(0))
    s = np.arange(1, 61)[:, None] / 60
    line, bend = (1 - s) * x0.numpy(), np.sin(np.pi * s) * np.array([[0.5, -1.0]])
    idle = np.zeros((60, 1))
    found = [oracle.minimise(x0[0].numpy(), Candidate(x, idle, math.inf)) for x in (line, line + bend, line - 2 * bend)]
    assert [type(each) for each in found if isinstance(each, str)] == []
    assert [each.cost for each in found] == pytest.approx([found[0].cost] * len(found), rel=1e-6)


def test_known_controls_beyond_the_limits_are_not_believed():
    problem = limited()
    x0 = problem.initial_states.sample(3, torch.Generator().manual_seed(0))
    free = optimal_trajectories(limited(unit=1.0).replaced(controls=ControlBox(-50.0, 50.0)), x0, torch.zeros(60, 3, 1))
    assert (free.path.u.abs() > 0.5).any()
    assert_close(oracle_of(problem).solve(x0, free.path.u).cost, oracle_of(problem).solve(x0).cost, rtol=1e-8, atol=0)

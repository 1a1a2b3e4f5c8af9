"""Optima within limits, whatever the units of cost and control: IPOPT against differential dynamic programming."""

import pytest
import torch
from torch.testing import assert_close

from lyapnet.cost import QuadraticCost
from lyapnet.evaluation.oracles import oracle_of
from lyapnet.expansions import optimal_trajectories
from lyapnet.sets import ControlBox
from lyapnet.systems import Linear
from tests.problems import problem_of

pytest.importorskip("casadi")


def limited(cost=1.0, unit=1.0):
    """A double integrator with |u| ≤ 0.5 in another unit of control, which costs so many times as much."""
    weight = cost * torch.diag(torch.tensor([10.0, 0.1]))
    system = Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [unit]])
    controls = ControlBox(-0.5 / unit, 0.5 / unit)
    return problem_of(system, QuadraticCost(weight, [[cost * unit**2]], weight), 60, 0.05, controls=controls)


@pytest.mark.parametrize(("cost", "unit"), [(1.0, 1.0), (1e-4, 1.0), (1e4, 1.0), (1.0, 1e4)])
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


def test_known_controls_beyond_the_limits_are_not_believed():
    problem = limited()
    x0 = problem.initial_states.sample(3, torch.Generator().manual_seed(0))
    free = optimal_trajectories(limited(unit=1.0).replaced(controls=ControlBox(-50.0, 50.0)), x0, torch.zeros(60, 3, 1))
    assert (free.path.u.abs() > 0.5).any()
    assert_close(oracle_of(problem).solve(x0, free.path.u).cost, oracle_of(problem).solve(x0).cost, rtol=1e-8, atol=0)

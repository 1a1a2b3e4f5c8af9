"""Horizons and problems, and what is refused of the parts that a problem is made of."""

import math
from pathlib import Path

import pytest
import torch
from torch.testing import assert_close

from lyapnet.build import build_problem
from lyapnet.config import load_config
from lyapnet.cost import Cost, QuadraticCost
from lyapnet.errors import UsageError
from lyapnet.problem import Horizon, check_system
from lyapnet.sets import Box, Unbounded
from lyapnet.systems import DoubleIntegrator
from tests.problems import problem_of

CONF = Path(__file__).parents[1] / "conf"


# Horizon


@pytest.mark.parametrize(("steps", "dt"), [(0, 0.1), (-1, 0.1), (1, 0.0), (1, -0.1), (1, math.inf), (1, math.nan)])
def test_a_horizon_of_nothing_is_refused(steps, dt):
    with pytest.raises(ValueError, match=r"Expected (steps ≥ 1|dt > 0), got"):
        Horizon(steps, dt)


def test_horizon_nodes_are_multiples_of_dt():
    horizon = Horizon(400, 0.01)
    assert horizon.duration == 4.0
    assert horizon.times(torch.zeros(1)).tolist() == [n * 0.01 for n in range(401)]
    assert horizon.times(torch.zeros(1, dtype=torch.float32)).dtype == torch.float32


# Problem


class Away(Cost):
    """q = φ = ‖x − goal‖² and R = 1."""

    def __init__(self, goal):
        super().__init__()
        self.goal = goal

    def state(self, x):
        return ((x - self.goal) ** 2).sum(-1)

    def R(self, x):
        return torch.ones(*x.shape[:-1], 1, 1).to(x)

    def terminal(self, x):
        return self.state(x)


def test_the_goal_is_the_costs_or_the_origin():
    assert problem_of(DoubleIntegrator()).goal.tolist() == [0, 0]
    problem = problem_of(DoubleIntegrator(), Away(torch.tensor([1.0, 0.5])))
    assert problem.goal.tolist() == [1, 0.5]
    assert problem.float().goal.dtype == torch.float32


def test_parts_are_exchanged_one_by_one():
    problem = problem_of(DoubleIntegrator())
    other = problem.replaced(horizon=Horizon(3, 0.2))
    assert other.horizon.steps == 3
    for name in ("system", "cost", "controls", "initial_states"):
        assert getattr(other, name) is getattr(problem, name)
    assert problem.horizon.steps == 10


def test_a_box_of_another_dimension_is_refused():
    with pytest.raises(ValueError, match=r"Expected initial_states with 2 entries .*, got 3"):
        problem_of(DoubleIntegrator(), initial_states=Box([-1.0] * 3, [1.0] * 3))


def test_a_problem_checks_its_parts_on_its_own_states():
    """R loses its definiteness where x₁ ≤ −0.5: in X₀ or not."""
    cost = QuadraticCost(torch.eye(2), lambda x: x[..., :1, None] + 0.5, torch.eye(2))
    problem_of(DoubleIntegrator(), cost, initial_states=Box([-0.4, -1.0], [1.0, 1.0])).check()
    with pytest.raises(ValueError, match=r"Expected R\(x\) symmetric positive definite"):
        problem_of(DoubleIntegrator(), cost).check()
    with pytest.raises(UsageError, match=r"Detached\.f\(x\) differentiable"):
        problem_of(Detached()).check()


@pytest.mark.parametrize("m", [1, 2, 3])
def test_one_number_is_a_diagonal_for_R_as_it_is_for_Q(m, tmp_path):
    shift = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]
    B = torch.eye(3)[:, 3 - m :].tolist()
    text = f"""
experiment: small
program: {{name: value}}
system: {{name: linear, parameters: {{A: {shift}, B: {B}}}}}
cost: {{Q: [2], R: [0.5], Q_T: [3]}}
initial_states: {{lower: [-1], upper: [1]}}
horizon: {{steps: 4, dt: 0.1}}
network: {{name: fcn}}
"""
    (tmp_path / "small.yaml").write_text(text, encoding="utf-8")
    cost = build_problem(load_config(tmp_path / "small.yaml")).cost
    for matrix, expected, size in ((cost.Q, 2, 3), (cost.R_constant, 0.5, m), (cost.Q_T, 3, 3)):
        assert torch.equal(matrix, expected * torch.eye(size))
    rows = load_config(tmp_path / "small.yaml", [f"cost.R={(0.5 * torch.eye(m)).tolist()}"])
    assert torch.equal(build_problem(rows).cost.R_constant, cost.R_constant)
    assert_close(cost.R_inverse, 2 * torch.eye(m))
    with pytest.raises(UsageError, match=rf"Expected cost.R with {m} entries"):
        build_problem(load_config(tmp_path / "small.yaml", [f"cost.R={[0.5] * (m + 1)}"]))


@pytest.mark.parametrize("name", ["double_integrator", "reacher"])
def test_everything_follows_a_problem_to_a_precision(name):
    problem = build_problem(load_config(CONF / f"{name}.yaml", ["training.precision=float32"]))
    assert {buffer.dtype for buffer in problem.buffers()} == {torch.float32}
    assert problem.goal.dtype == problem.cost.R(problem.goal).dtype == torch.float32


# Systems that break their contract


class Sound(DoubleIntegrator):
    """The twin of the systems below: what they break is right here."""


class ThreeRows(Sound):
    def f(self, x):
        return torch.cat([x, x[..., :1]], -1)


class SinglePrecision(Sound):
    def g(self, x):
        return super().g(x).float()


class Detached(Sound):
    def f(self, x):
        return super().f(x).detach()


class NumPy(Sound):
    def f(self, x):
        return x.detach().numpy()


class OneUnit(Sound):
    def __init__(self):
        super().__init__()
        self.state_units = ("m",)


@pytest.mark.parametrize(
    ("system", "named"),
    [
        (ThreeRows, r"ThreeRows\.f\(x\).*\(2, 2\).*\(2, 3\)"),
        (SinglePrecision, r"SinglePrecision\.g\(x\).*float64.*float32"),
        (Detached, r"Detached\.f\(x\) differentiable"),
        (NumPy, r"NumPy\.f\(x\).*ndarray"),
        (OneUnit, "one unit for each"),
    ],
)
def test_system_that_breaks_its_contract_is_refused_by_name(system, named):
    x = torch.ones(2, 2)
    check_system(Sound(), x)
    with pytest.raises(UsageError, match=named):
        check_system(system(), x)


def test_a_control_set_whose_minimum_lies_outside_is_refused():
    class Leaky(Unbounded):
        def project(self, u):
            return u.clamp(-1, 1)

    problem_of(DoubleIntegrator()).check()
    with pytest.raises(ValueError, match=r"Leaky\.minimise"):
        problem_of(DoubleIntegrator(), controls=Leaky()).check()

"""Targets of a family that different controls hold, and states of a target that are solved for."""

import pytest
import torch
from torch.testing import assert_close

from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly import Parts, build_problem, member
from lyapnet.experiment.config import config_from_plain
from lyapnet.task.family import InterpolatedTargets, LinearTargets, family_cost_of
from lyapnet.task.systems import ControlAffineSystem
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.policy import HJBPolicy
from lyapnet.value.regulator import Regulator

HELD_AT_ANGLES = {
    "experiment": "held",
    "system": {"name": "pendulum"},
    "cost": {"Q": [1, 0.1], "R": 0.1, "Q_T": [10, 1]},
    "initial_states": {"lower": -1, "upper": 1},
    "horizon": {"steps": 20, "dt": 0.05},
    "family": {"target_angle": [-1, 1.5], "mass": [0.5, 1.5]},
}


class Tanks(ControlAffineSystem):
    """Two tanks in a row, ẋ₁ = u − √x₁ and ẋ₂ = √x₁ − c√x₂: the lower level x₂ is held by x₁ = c²x₂ and u = c√x₂."""

    state_names, state_units = ("upper", "lower"), ("m", "m")
    control_names, control_units = ("pump",), ("m/s",)

    def __init__(self, c: float = 1.2):
        super().__init__()
        self.c = c

    def f(self, x):
        upper, lower = x.sqrt().unbind(-1)
        return torch.stack([-upper, upper - self.c * lower], -1)

    def g(self, x):
        return x.new_tensor([[1.0], [0.0]]).expand(*x.shape[:-1], 2, 1)


TANKS = {
    "experiment": "tanks",
    "system": {"name": f"{__name__}:Tanks"},
    "cost": {"Q": [1, 10], "R": 1, "Q_T": [10, 100]},
    "initial_states": {"lower": 0.1, "upper": 0.7},
    "horizon": {"steps": 20, "dt": 0.1},
    "family": {"target_lower": [0.2, 0.6]},
}


def problem(base, **changes):
    return build_problem(config_from_plain({**base, "training": {"precision": "float64"}, **changes}))


def test_the_control_that_holds_each_angle_costs_nothing():
    """By its closed form u* = −m g l sin θ for a pendulum that stands at 0."""
    task = problem(HELD_AT_ANGLES)
    p = torch.tensor([[-1.0, 0.5], [0.3, 0.7], [1.5, 1.5], [1.1, 1.2]])
    z = torch.cat([p[:, :1], torch.zeros(4, 1), p], -1)
    u = task.rest_at(z)
    assert_close(task.system.dynamics(z, u), torch.zeros_like(z), atol=1e-6, rtol=0)
    assert_close(u.abs()[:, 0], (p[:, 1] * 9.81 * p[:, 0].sin()).abs(), atol=1e-6, rtol=0)
    assert_close(task.cost.running(z, u), torch.zeros(4), atol=1e-12, rtol=0)
    assert (task.cost.running(z, u + 0.1) > 1e-4).all()  # any other one does


def test_the_polynomials_are_of_the_degree_that_each_parameter_needs():
    targets = family_cost_of(problem(HELD_AT_ANGLES).cost).targets
    assert isinstance(targets, InterpolatedTargets)
    assert targets.basis.counts[1] == 2  # u* is linear in the mass
    assert targets.basis.counts[0] > 5  # and a sine of the angle
    easy = problem(HELD_AT_ANGLES, family={"target_angle": [-0.01, 0.01]})
    assert family_cost_of(easy.cost).targets.basis.counts[0] < targets.basis.counts[0]


def test_a_parameter_that_matters_only_off_the_middle_counts():
    """u* = m g l sin θ does not depend on the length at θ = 0."""
    task = problem(HELD_AT_ANGLES, family={"target_angle": [-0.4, 0.4], "length": [0.9, 1.1]})
    p = torch.tensor([[0.4, 1.1], [-0.3, 0.95]])
    z = torch.cat([p[:, :1], torch.zeros(2, 1), p], -1)
    assert_close(task.system.dynamics(z, task.rest_at(z)), torch.zeros_like(z), atol=1e-6, rtol=0)


def test_targets_that_one_control_holds_are_exact():
    task = problem(HELD_AT_ANGLES, system={"name": "double_integrator"}, family={"target_position": [-1, 3]})
    assert isinstance(family_cost_of(task.cost).targets, LinearTargets)


@pytest.mark.gate
@pytest.mark.parametrize("base", [HELD_AT_ANGLES, TANKS], ids=["pendulum", "tanks"])
def test_a_member_is_the_task_that_is_built_alone(base):
    config = config_from_plain({**base, "training": {"precision": "float64"}})
    family, n = build_problem(config), 2
    for z in family.initial_states.sample(4, torch.Generator().manual_seed(3)):
        own, parts, p = member(config, Parts(), family, dict(zip(config.family, z[n:].tolist(), strict=True)))
        alone, x = build_problem(own, parts), family.initial_states.sample(8)[:, :n]
        assert p == z[n:].tolist()
        together, u = torch.cat([x, z[n:].expand(8, -1)], -1), torch.randn(8, 1)
        assert_close(family.cost.running(together, u), alone.cost.running(x, u), atol=1e-6, rtol=1e-6)
        assert_close(family.cost.terminal(together), alone.cost.terminal(x), atol=1e-6, rtol=1e-6)
        assert_close(family.rest_at(together), alone.rest_at(x), atol=1e-6, rtol=1e-6)
        wrong = torch.cat([x, (z[n:] + 0.1).expand(8, -1)], -1)
        assert not torch.allclose(family.cost.running(wrong, u), alone.cost.running(x, u), rtol=1e-3)


def test_states_that_are_not_given_are_solved_for():
    """By their closed form."""
    task = problem(TANKS)
    cost = family_cost_of(task.cost)
    level = torch.linspace(0.2, 0.6, 9)[:, None]
    assert_close(cost.target(level), torch.cat([1.44 * level, level], -1), atol=1e-7, rtol=0)
    assert_close(cost.targets.rest(level), 1.2 * level.sqrt(), atol=1e-7, rtol=0)
    assert cost.targets.solved == [0]


def test_other_states_are_0_where_that_is_held_and_those_that_are_written_stay():
    task = problem(HELD_AT_ANGLES, system={"name": "planar_quadrotor"}, family={"target_x": [-1, 1]},
                   cost={"Q": 1, "R": 1, "Q_T": 1})  # fmt: skip
    assert_close(family_cost_of(task.cost).target(torch.tensor([0.4])), torch.tensor([0.4, 0, 0, 0, 0, 0]))
    task = problem(HELD_AT_ANGLES, system={"name": "planar_quadrotor"}, family={"target_x": [-1, 1]},
                   target={"z": 0.5}, cost={"Q": 1, "R": 1, "Q_T": 1})  # fmt: skip
    expected = torch.tensor([0.4, 0.5, 0, 0, 0, 0])
    assert_close(family_cost_of(task.cost).target(torch.tensor([0.4])), expected, atol=1e-9, rtol=0)


@pytest.mark.gate
def test_the_regulator_of_each_member_counts_u_from_its_own():
    task = problem(TANKS)
    regulator, z = Regulator(task), torch.tensor([[1.44 * 0.3, 0.3, 0.3], [1.44 * 0.55, 0.55, 0.55]])
    assert_close(regulator(z), 1.2 * z[:, 1:2].sqrt(), atol=1e-6, rtol=0)
    assert_close(regulator.cost(z), torch.zeros(2), atol=1e-10, rtol=0)


def test_the_law_of_V_minimises_over_u_counted_from_that_of_each_member():
    """By brute force."""
    task = problem(HELD_AT_ANGLES, controls={"lower": -16, "upper": 16})
    slope = torch.tensor([0.7, -0.4, 0.0, 0.0])

    class Plane(ValueFunction):
        def forward(self, t, x):
            return x @ slope

    law, z = HJBPolicy(task, Plane()), task.initial_states.sample(16, torch.Generator().manual_seed(0))
    grid = torch.linspace(-16, 16, 8001)[:, None]
    copies = z.expand(len(grid), *z.shape)
    u = grid[:, None].expand(-1, len(z), -1)
    hamiltonian = task.cost.running(copies, u) + (task.system.dynamics(copies, u) * slope).sum(-1)
    assert_close(law(torch.tensor(0.0), z), grid[hamiltonian.argmin(0)], atol=4e-3, rtol=0)
    assert not torch.allclose(task.rest_at(z), task.rest)


@pytest.mark.parametrize(
    ("base", "changes", "reason"),
    [
        (
            HELD_AT_ANGLES,
            {"controls": {"lower": -5, "upper": 5}},
            "within limits that hold the target of target_angle = ",
        ),
        (HELD_AT_ANGLES, {"family": {"target_velocity": [-1, 1]}}, "target that some control holds"),
        (HELD_AT_ANGLES, {"target": [0, 1], "family": {"target_angle": [-1, 1]}}, "target that some control holds"),
        (TANKS, {"family": {"target_lower": [-0.2, 0.6]}}, "target that some control holds|are finite"),
        (TANKS, {"family": {"target_lower": [1e-9, 0.6]}}, "smooth in target_lower|some control holds"),
        (TANKS, {"controls": {"lower": 0, "upper": 0.8}}, "hold the target of target_lower = "),
        (TANKS, {"target_control": [0], "target": {"lower": 0.3}}, "every state with target_control"),
    ],
)
def test_targets_that_no_family_can_have(base, changes, reason):
    with pytest.raises(UsageError, match=reason) as raised:
        problem(base, **changes)
    assert "\n" not in str(raised.value)

"""Facts of a cost in the body of its class: they are its buffers."""

import copy

import pytest
import torch
from torch.testing import assert_close

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.assembly.classes import Parts
from lyapnet.experiment.config import config_from_plain
from lyapnet.task.systems import MechanicalSystem

TASK = {
    "experiment": "x", "system": {"name": "double_integrator"}, "initial_states": {"lower": -1, "upper": 1},
    "horizon": {"steps": 4, "dt": 0.1},
}  # fmt: skip


class Bowl(lyapnet.Cost):
    """‖x − goal‖² with R = 1."""

    def state(self, x):
        return (self.from_goal(x) ** 2).sum(-1)

    def R(self, x):
        return torch.ones_like(x[..., :1, None])

    def terminal(self, x):
        return self.state(x)


class Tensors(Bowl):
    """With tensors."""

    goal, rest, R_constant = torch.tensor([0.5, 0.0]), torch.tensor([0.25]), torch.eye(1)


class Lists(Bowl):
    """With lists, of another goal than its base."""

    goal, rest = [0.5, 0.0], (0.25,)


class Further(Tensors):
    """One fact from its base, one of its own."""

    goal = torch.tensor([-0.5, 0.0])


class Computed(Bowl):
    """A property."""

    @property
    def goal(self):
        return torch.tensor([0.5, 0.0])


def problem_of(cost, **changes):
    return build_problem(config_from_plain({**TASK, "cost": {"name": cost}, **changes}))


@pytest.mark.parametrize(("name", "goal"), [("Tensors", 0.5), ("Lists", 0.5), ("Further", -0.5), ("Computed", 0.5)])
def test_what_a_class_says_is_a_buffer(name, goal):
    problem = build_problem(config_from_plain({**TASK, "cost": {"name": f"{__name__}:{name}"}}))
    assert problem.goal.tolist() == [goal, 0]
    assert problem.goal.dtype == torch.float64
    if name != "Computed":
        assert problem.rest.tolist() == [0.25]
        assert dict(copy.deepcopy(problem.cost).float().named_buffers())["goal"].dtype == torch.float32
        assert problem.cost.goal is not build_problem(config_from_plain(
            {**TASK, "cost": {"name": f"{__name__}:{name}"}})).cost.goal  # fmt: skip
    assert Bowl().goal is None
    assert_close(lyapnet.TargetCost(globals()[name](), [0.1, 0.2], [0.0]).goal, torch.tensor([0.1, 0.2]))


class Short(Bowl):
    """One number for two states."""

    goal = (1.0,)


class Wide(Bowl):
    """Two numbers for one control."""

    rest = torch.zeros(2)


class Words(Bowl):
    """No number."""

    goal = "there"


class Damped(MechanicalSystem):
    """With an attribute that its base has a buffer of."""

    state_names, state_units = ("angle", "velocity"), ("rad", "rad/s")
    control_names, control_units = ("torque",), ("N·m",)
    D = torch.tensor([0.1])

    def __init__(self):
        super().__init__([[1.0]], [0.0])

    def mass_matrix(self, q):
        return torch.ones_like(q)[..., None]

    def forces(self, q, qdot):
        return 0 * q


@pytest.mark.parametrize(
    ("cost", "reason"),
    [("Short", r"goal of Short of shape \(2,\), got \(1,\)"), ("Wide", r"rest of Wide of shape \(1,\), got \(2,\)"),
     ("Words", "Expected cost.parameters of .*Words that can be built, got")],
)  # fmt: skip
def test_facts_that_do_not_fit_are_named(cost, reason):
    with pytest.raises(UsageError, match=reason):
        build_problem(config_from_plain({**TASK, "cost": {"name": f"{__name__}:{cost}"}}))


def test_another_buffer_of_that_name_is_explained():
    with pytest.raises(UsageError, match=r"'D' already exists.*give that attribute of your class another name"):
        build_problem(
            config_from_plain({**TASK, "system": {"name": f"{__name__}:Damped"}, "cost": {"Q": 1, "R": 1, "Q_T": 1}})
        )
    assert Parts().cost is None

"""Costs of controls and the ball in a config."""

import pytest
import torch
from torch.testing import assert_close

from lyapnet.base.errors import UsageError
from lyapnet.controller.controller import Controller
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import config_from_plain
from lyapnet.task.ball import ControlBall
from lyapnet.task.cost import QuadraticCost
from lyapnet.task.cost.control_costs import AbsoluteCost, SeparableCost
from lyapnet.task.problem import Problem
from lyapnet.task.sets import ControlBox
from lyapnet.value.policy import HJBPolicy, SontagPolicy
from tests.problems import Quadratic

PLAIN = {
    "experiment": "x", "system": {"name": "rocket"}, "cost": {"Q": 1, "R": 0.1, "Q_T": 10},
    "initial_states": {"lower": -1, "upper": 1}, "horizon": {"steps": 10, "dt": 0.1},
}  # fmt: skip
BALL = {"name": "ball", "parameters": {"radius": 2.0}}


class Fourth(SeparableCost):
    """A cost of a user's own."""

    def forward(self, u):
        return (self.weight * u**4).sum(-1)


class Kinked(SeparableCost):
    def forward(self, u):
        return (self.weight * u.abs()).sum(-1)


class Concave(SeparableCost):
    def forward(self, u):
        return -(self.weight * u**2).sum(-1)


class Uneven(SeparableCost):
    def forward(self, u):
        return (self.weight * (u.exp() - 1 - u)).sum(-1)


class Lifted(SeparableCost):
    def forward(self, u):
        return (self.weight * u**4).sum(-1) + 1


class Dearer(AbsoluteCost):
    def forward(self, u):
        return 3 * super().forward(u)


class Shapeless(SeparableCost):
    def forward(self, u):
        return self.weight * u**4


class Unmade(SeparableCost):
    def __init__(self, weight):
        self.weight = weight

    def forward(self, u):
        return (u**4).sum(-1)


@pytest.mark.parametrize("cls", [Kinked, Concave, Uneven, Lifted, Dearer, Shapeless, Unmade])
def test_a_cost_of_a_users_own_that_breaks_the_contract_is_refused(cls):
    with pytest.raises(UsageError, match=r"Expected .+, got .+[;:,] .+"):
        problem({"name": f"{__name__}:{cls.__name__}", "weight": 0.5})


def problem(*costs, controls=None, **sections):
    plain = {**PLAIN, "cost": {**PLAIN["cost"], "control_costs": list(costs)}, **sections}
    if controls is not None:
        plain["controls"] = controls
    return build_problem(config_from_plain(plain))


def test_they_are_part_of_the_running_cost_whatever_it_is_made_of():
    x, u = torch.rand(4, 4), torch.randn(4, 2)
    plain, fuel = problem(), problem({"name": "norm", "weight": 2}, controls=BALL)
    assert isinstance(fuel.controls, ControlBall)
    assert_close(fuel.cost.running(x, u) - plain.cost.running(x, u), 2 * u.norm(dim=-1))
    huber = build_problem(config_from_plain({
        **PLAIN, "cost": {**PLAIN["cost"], "huber": 1.0, "control_costs": [{"name": "absolute", "weight": [1, 3]}]},
    }))  # fmt: skip
    family = problem({"name": "absolute", "weight": [1, 3]}, family={"gravity": [1, 2]})
    weighted = u.abs() @ torch.tensor([1.0, 3.0])
    for task, z in ((huber, x), (family, torch.cat([x, torch.ones(4, 1)], -1))):
        assert_close(task.cost.running(z, u) - task.cost.smooth_running(z, u), weighted)


def test_a_cost_with_a_limit_of_its_own_needs_no_other():
    task = problem({"name": "log_cos", "weight": 1, "limit": [3, 4]})
    assert isinstance(task.controls, ControlBox)
    assert_close(task.controls.upper, torch.tensor([3.0, 4.0]), rtol=1e-5, atol=0)
    assert task.cost.beside(task.controls.upper).isfinite()
    tighter = problem({"name": "log_cos", "weight": 1, "limit": 3}, controls={"lower": -1, "upper": 5}).controls
    assert_close(torch.stack([tighter.lower, tighter.upper]), torch.tensor([[-1.0, -1], [3, 3]]), rtol=1e-5, atol=0)
    with pytest.raises(UsageError, match=r"Expected cost.control_costs that are finite between .+, got others; .+\."):
        problem({"name": "log_cos", "weight": 1, "limit": 1}, controls={"lower": 2, "upper": 3})


def test_a_cost_of_a_users_own():
    task = problem({"name": f"{__name__}:Fourth", "weight": 0.5})
    assert_close(task.cost.beside(torch.tensor([[1.0, 2.0]])), torch.tensor([8.5]))


@pytest.mark.parametrize(
    ("costs", "sections", "text"),
    [
        (["norm"], {}, "another type, got: Cannot assign str"),
        ([{"weight": 1}], {}, r"cost.control_costs\[0\] as"),
        ([{"name": "nrom", "weight": 1}], {}, "'nrom'.*norm"),
        ([{"name": "norm"}], {}, r"cost.control_costs\[0\].*weight, got none"),
        ([{"name": "norm", "weight": 1, "size": 2}], {}, "got .*size"),
        ([{"name": "norm", "weight": -1}], {}, r"weight as a number > 0"),
        ([{"name": "absolute", "weight": [1, 2, 3]}], {}, r"one weight of .*, or 2 of them, got 3"),
        ([{"name": "absolute", "weight": 1}], {"controls": BALL}, "known minimiser in ControlBall, got AbsoluteCost"),
        ([{"name": "norm", "weight": 1}], {"controls": {"lower": -1, "upper": 1}}, "known minimiser in ControlBox"),
        ([], {"controls": {"name": "ball", "parameters": {"radius": 0}}}, "radius > 0, got 0"),
        ([], {"controls": {"name": "ball"}}, "radius"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said(costs, sections, text):
    with pytest.raises(UsageError, match=f"Expected .*{text}"):
        problem(*costs, **sections)


def test_other_parts_refuse_what_they_do_not_know():
    double = {
        "system": {"name": "double_integrator"},
        "cost": {"Q": 1, "R": 1, "control_costs": [{"name": "absolute", "weight": 1}]},
        "horizon": {"steps": 10, "dt": 0.1, "stationary": True},
    }  # fmt: skip
    with pytest.raises(UsageError, match=r"Expected no cost.control_costs with horizon.stationary, got some; .+\."):
        build_problem(config_from_plain({**PLAIN, **double}))
    task = problem({"name": "absolute", "weight": 1})
    with pytest.raises(ValueError, match=r"Expected controls that cost uᵀRu for Sontag's formula, got more; .+"):
        SontagPolicy(task, Quadratic(torch.eye(4)))


def test_a_record_tells_tasks_with_other_costs_of_controls_apart():
    tasks = [problem(), *(problem({"name": "norm", "weight": w}, controls=BALL) for w in (1, 2))]
    tasks.append(problem(controls=BALL))
    box = {"lower": -1, "upper": 1}
    tasks += [problem({"name": "absolute", "weight": w}, controls=box) for w in ([0.3, 0.5], [0.5, 0.3], 2e4)]
    tasks.append(problem(controls=box))
    for i, one in enumerate(tasks):
        for j, other in enumerate(tasks):
            assert bool(one.differences(other.record())) == (i != j), (i, j)


def test_a_controller_of_such_a_task_stays_in_the_ball():
    task = problem({"name": "norm", "weight": 1}, controls=BALL)
    controller = Controller(task, Quadratic(40 * torch.eye(4)), policy=HJBPolicy)
    u = controller.policy(0.0, torch.cat([s * task.initial_states.sample(500) for s in (1, 0.01)]))
    size = u.norm(dim=-1)
    assert float(size.max()) == pytest.approx(2.0, rel=1e-9)
    assert task.controls.contains(u).all()
    assert (size == 0).any()


class Taxed(QuadraticCost):
    """A cost whose controls pay more than R says, by `running` of its own."""

    def running(self, x, u):
        return super().running(x, u) + 5


def test_running_of_a_users_own_is_paid_in_every_step():
    plain = problem()
    cost = Taxed(torch.eye(4), torch.eye(2), torch.eye(4))
    task = Problem(plain.system, cost, plain.controls, plain.initial_states, plain.horizon)
    assert_close(task.step(torch.zeros(1, 4), torch.zeros(1, 2))[1], torch.tensor([0.5]))

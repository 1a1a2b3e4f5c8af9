"""Targets: the same problem as one whose coordinates have the target for their origin."""

import math

import pytest
import torch
import yaml
from torch.testing import assert_close

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.claims.ignorable_states import ignorable_states
from lyapnet.evaluation.figures import trajectories
from lyapnet.evaluation.oracles import oracle_of
from lyapnet.experiment.config import config_from_plain
from lyapnet.loop.rollout import Rollout
from lyapnet.task.cost import ObstacleCost, QuadraticCost, TargetCost
from lyapnet.task.sets import Box, ControlBox, Unbounded
from lyapnet.task.systems import ControlAffineSystem, Pendulum
from lyapnet.value.expansions import optimal_trajectories, riccati
from lyapnet.value.policy import POLICIES
from tests.configs import objects
from tests.fits import shorten_fits
from tests.problems import CONF, Formula, problem_of, untrained

TARGET = [math.pi / 4, 0.0]
MINE = {
    "experiment": "held",
    "system": {"name": "pendulum"},
    "cost": {"Q": [1, 0.1], "R": [0.1], "Q_T": [10, 1]},
    "target": TARGET,
    "initial_states": {"lower": [0, -1], "upper": [1.5, 1]},
    "horizon": {"steps": 40, "dt": 0.05},
}


class Moved(ControlAffineSystem):
    """A system in z = x − x* and v = u − u*."""

    state_names, state_units = ("angle", "velocity"), ("rad", "rad/s")
    control_names, control_units = ("torque",), ("N·m",)

    def __init__(self, system, x, u):
        super().__init__()
        self.system, self.x, self.u = system, x, u

    def f(self, x):
        return self.system.dynamics(x + self.x, self.u.expand(*x.shape[:-1], 1))

    def g(self, x):
        return self.system.g(x + self.x)


def cost():
    return QuadraticCost(torch.diag(torch.tensor([1.0, 0.1])), [[0.1]], torch.diag(torch.tensor([10.0, 1.0])))


@pytest.fixture(params=["unlimited", "limited"])
def both(request):
    """(the problem about a target, the same in coordinates that begin there, x*, u*)."""
    system = Pendulum()
    x = torch.tensor(TARGET)
    u, left = system.holding_control(x)
    assert_close(left, torch.zeros(2), rtol=0, atol=1e-12)
    assert float(u) == pytest.approx(-9.81 * math.sin(TARGET[0]))
    limits = request.param == "limited"
    about = problem_of(
        system, TargetCost(cost(), TARGET, u), 40, 0.05, Box([0.0, -1.0], [1.5, 1.0]),
        ControlBox(-12.0, -4.0) if limits else Unbounded(),
    )  # fmt: skip
    moved = problem_of(
        Moved(system, x, u), cost(), 40, 0.05, Box(torch.tensor([0.0, -1.0]) - x, torch.tensor([1.5, 1.0]) - x),
        ControlBox([-12 - float(u)], [-4 - float(u)]) if limits else Unbounded(),
    )  # fmt: skip
    return about, moved, x, u


@pytest.mark.gate
def test_optima_are_the_same(both):
    about, moved, x, u = both
    x0 = about.initial_states.sample(6, torch.Generator().manual_seed(0))
    start = torch.zeros(40, 6, 1)
    one, other = optimal_trajectories(about, x0, start + u), optimal_trajectories(moved, x0 - x, start)
    assert_close(one.path.cost, other.path.cost, rtol=1e-9, atol=0)
    assert_close(one.path.u - u, other.path.u, rtol=0, atol=1e-5)
    assert_close(one.expansion.x - x, other.expansion.x, rtol=0, atol=1e-6)
    nearby, there = riccati(about), riccati(moved)
    assert_close(nearby.x[0], x)
    assert_close(nearby.value, torch.zeros(41), rtol=0, atol=1e-12)
    assert_close(nearby.hessian, there.hessian, rtol=1e-9, atol=1e-9)
    assert not torch.allclose(nearby.hessian, riccati(problem_of(about.system, cost(), 40, 0.05)).hessian, rtol=1e-3)


@pytest.mark.gate
def test_the_transcription_agrees(both):
    pytest.importorskip("casadi")
    about, moved, x, _ = both
    x0 = about.initial_states.sample(3, torch.Generator().manual_seed(1))
    expected = oracle_of(moved).solve(x0 - x).cost
    assert_close(oracle_of(about).solve(x0).cost, expected, rtol=1e-6, atol=0)
    start = torch.zeros(40, 3, 1)
    assert_close(optimal_trajectories(about, x0, start).path.cost, expected, rtol=1e-6, atol=0)


@pytest.mark.parametrize("law", POLICIES)
def test_control_laws_are_the_same(both, law):
    about, moved, x, u = both
    if law == "sontag" and about.controls.limited:
        pytest.skip("refused: it is made for controls without limits")
    P = torch.tensor([[3.0, 1.0], [1.0, 0.8]])
    V = Formula(lambda t, z: (2 - t) * ((z @ P) * z).sum(-1))
    shifted = Formula(lambda t, y: V(t, y - x))
    states, t = about.initial_states.sample(30), torch.tensor(0.5)
    expected = POLICIES[law](moved, V)(t, states - x)
    assert_close(POLICIES[law](about, shifted)(t, states), expected + u, rtol=1e-9, atol=1e-9)
    loop = Rollout(about, POLICIES[law](about, shifted), gradient="backprop")(states)
    assert_close(loop.cost, Rollout(moved, POLICIES[law](moved, V), gradient="backprop")(states - x).cost)


def test_at_the_target_nothing_costs(both):
    about, _, x, u = both
    assert_close(about.goal, x)
    assert_close(about.rest, u)
    assert float(about.cost.running(x, u)) == float(about.cost.terminal(x)) == 0
    assert float(about.cost.running(x, 0 * u)) > 1
    y = torch.randn(5, 2, requires_grad=True)
    (slope,) = torch.autograd.grad(about.cost.terminal(y).sum(), y)
    assert_close(about.cost.terminal_gradient(y.detach()), slope)


def test_a_target_from_a_config():
    problem = objects(config_from_plain(MINE))[0]
    assert_close(problem.goal, torch.tensor(TARGET))
    assert float(problem.rest) == pytest.approx(-9.81 * math.sin(TARGET[0]))
    other = objects(config_from_plain(MINE, ["target_control=[-2]", "target=[0.5]"]))[0]
    assert_close(other.goal, torch.tensor([0.5, 0.5]))
    assert float(other.rest) == -2
    assert not objects(config_from_plain({**MINE, "target": None}))[0].goal.any()


def test_the_shipped_one():
    content = yaml.safe_load((CONF / "pendulum_held.yaml").read_text())
    assert set(content) == {"system", "cost", "target", "initial_states", "horizon"}


@pytest.mark.parametrize(
    ("override", "reason"),
    [
        ("target=[1,2,3]", "target with 2 entries"),
        ("target=[0.7,1]", "a target that some control holds, .* got 1 for the rate of angle"),
        ("target_control=[1,2]", "target_control with one entry"),
        ("controls={lower: -1, upper: 1}", r"at the target within its limits, got \w+ .*= -6\.9\d+ of -1 to 1"),
        ("target=null target_control=[1]", "target with target_control, got none"),
    ],
)
def test_targets_that_do_not_fit_are_refused(override, reason):
    with pytest.raises(UsageError, match=f"Expected .*{reason}"):
        objects(config_from_plain(MINE, override.split(" ") if "null" in override else [override]))


def test_networks_that_know_the_origin_know_the_target():
    """Their guarantees hold at x*: V and V_x vanish, and V is positive elsewhere."""
    anchored = {"network": {"name": "anchored", "hidden": [8]}, "program": {"name": "value"}}
    problem, V, *_ = objects(config_from_plain({**MINE, **anchored}))
    t = torch.tensor([0.0, 0.7])
    value, slope = V.value_and_state_gradient(t, problem.goal.expand(2, 2))
    assert_close(value, torch.zeros(2), rtol=0, atol=1e-12)
    assert_close(slope, torch.zeros(2, 2), rtol=0, atol=1e-12)
    assert (V(torch.zeros(50), problem.initial_states.sample(50)) > 0).all()
    origin = V(t, torch.zeros(2, 2))
    assert (origin > 1e-3).all(), "the origin is a state like others"
    problem.check_value_function(V)


@pytest.mark.gate
def test_what_a_cost_ignores_it_ignores_about_a_target():
    inner = QuadraticCost(torch.diag(torch.tensor([0.0, 1.0])), [[1.0]], torch.diag(torch.tensor([0.0, 1.0])))
    about = TargetCost(inner, [0.5, 0.0], [0.0])
    assert [about.ignores(i, 2) for i in range(2)] == [True, False]
    assert [about.ignores_at_end(i, 2) for i in range(2)] == [True, False]
    bump = ObstacleCost(about, [0], [1.0], 0.4, 8.0)
    assert not bump.ignores(0, 2)
    assert bump.ignores_at_end(0, 2)
    task = {**MINE, "system": {"name": "double_integrator"}, "target": [0.5, 0],
            "cost": {"Q": [0, 1], "R": [1], "Q_T": [0, 1]}, "program": {"name": "value"},
            "network": {"name": "fcn", "hidden": [8], "ignored_states": ["position"], "terminal": "exact"}}  # fmt: skip
    problem, V, *_ = objects(config_from_plain(task))
    assert_close(V(torch.tensor(2.0), torch.tensor([7.0, 0.3])), torch.tensor(0.09))
    cart = untrained("cartpole_balancing_certified", "target=[0, 0, 0, 0]")
    assert isinstance(cart.cost, TargetCost)
    assert ignorable_states(cart.closed_loop) == [0]
    assert problem.differences({**problem.record(), "u*": [[1.0]] * 3}) == ["u*"]
    without = {key: value for key, value in problem.record().items() if key != "u*"}
    assert not problem.differences(without), "u* = 0 is the same as none"


@pytest.mark.gate
def test_fine_tuning_to_another_target_is_no_silent_matter(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr("lyapnet.training.start.MAX_OPTIMA", 12)
    shorten_fits(monkeypatch, 130, 70)
    monkeypatch.setattr("lyapnet.training.pretraining.BRIEF_STEPS", 10)
    brief = ["training.iterations=1", "evaluation.test_states=2", "evaluation.validation_states=2", "loggers=[csv]",
             "rollout.gradient=backprop", "evaluation.optimum=false"]  # fmt: skip
    task = {**MINE, "logs": str(tmp_path)}
    run = lyapnet.train(task, brief)

    def notes(**changes):
        caplog.clear()
        lyapnet.train({**task, **changes}, brief, finetune=run.best)
        return [record.getMessage() for record in caplog.records if "was trained about" in record.getMessage()]

    assert not notes(cost={**MINE["cost"], "R": [0.2]})
    (note,) = notes(target=[0.3, 0])
    assert "this run is about [0.3, 0.0]" in note
    assert "about [0.0, 0.0]" in notes(target=None)[0]


def test_figures_show_the_target(both):
    about, _, x, u = both
    V = Formula(lambda t, y: ((y - x) ** 2).sum(-1) * (1 + 0 * t))
    loop = Rollout(about, POLICIES["hjb"](about, V), gradient="backprop")
    with torch.no_grad():
        panels = trajectories(loop(about.initial_states.sample(2)), about).axes
    dotted = [line.get_ydata()[0] for panel in panels for line in panel.lines if line.get_linestyle() == ":"]
    assert dotted == pytest.approx([*x.tolist(), float(u)])

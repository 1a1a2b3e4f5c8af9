"""Tasks without end: the regulator's cost as φ, V(x) without time, and what both say of linear systems."""

import dataclasses

import pytest
import torch
from scipy.linalg import solve_continuous_are
from torch.testing import assert_close

from lyapnet import load, train
from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly import Parts, build_problem, build_value_function
from lyapnet.experiment.config import config_from_plain
from lyapnet.task.cost import Cost
from lyapnet.training.build import build_module
from lyapnet.training.start import choose_start
from lyapnet.value.after_horizon import AfterHorizon
from lyapnet.value.calculus import gradients
from lyapnet.value.expansions import riccati
from lyapnet.value.networks import FCN, Scaling, StationaryNetwork, Timeless
from tests.fits import shorten_fits

CHAIN = {
    "experiment": "mine",
    "system": {"name": "integrator_chain", "parameters": {"length": 3}},
    "cost": {"Q": [2, 1, 0.5], "R": 0.3},
    "initial_states": {"lower": [-1, -1, -1], "upper": [1, 1, 1]},
    "horizon": {"steps": 200, "dt": 0.05, "stationary": True},
}
QUICK = [
    *("training.iterations=1", "rollout.compile=off", "loggers=[csv]", "evaluation.optimum=false"),
    *("evaluation.validation_states=4", "evaluation.test_states=4"),
]
PENDULUM = CHAIN | {
    "system": {"name": "pendulum", "parameters": {"damping": 0.1}},
    "cost": {"Q": [1, 0.1], "R": 0.5, "huber": 1.0},
    "controls": {"lower": -20, "upper": 20},
    "initial_states": {"lower": [-1, -1], "upper": [1, 1]},
}


def problem(content, *overrides):
    return build_problem(config_from_plain(content, overrides))


def P_of(problem):
    return problem.cost.P


def test_the_tail_is_a_fixed_point_of_riccatis_recursion():
    hessian = riccati(problem(CHAIN)).hessian
    assert_close(hessian, hessian[-1].expand_as(hessian), rtol=1e-9, atol=1e-12)
    twin = CHAIN | {"cost": CHAIN["cost"] | {"Q_T": [2, 1, 0.5]}, "horizon": {"steps": 200, "dt": 0.05}}
    other = riccati(problem(twin)).hessian
    assert not torch.allclose(other[0], other[-1], rtol=1e-3)
    assert_close(other[0], hessian[0], rtol=1e-3, atol=1e-3)  # where a long horizon leads


@pytest.mark.parametrize(("method", "order"), [("euler", 1), ("rk4", 2)])
def test_it_converges_to_the_continuous_equation(method, order):
    A, B = torch.diag(torch.ones(2), 1).double(), torch.tensor([[0.0], [0.0], [1.0]]).double()
    exact = torch.tensor(solve_continuous_are(A.numpy(), B.numpy(), torch.diag(torch.tensor([2, 1, 0.5])), [[0.3]]))
    errors = []
    for dt in (0.02, 0.01):
        P = P_of(problem(CHAIN, f"horizon.dt={dt}", f"rollout.method={method}", "rollout.policy=hjb"))
        errors.append(float((P - exact).abs().max()))
    assert errors[1] < 0.03 * float(exact.max())
    assert errors[0] / errors[1] == pytest.approx(2**order, rel=0.1)


def test_a_nonlinear_task_is_linearised_at_its_target():
    target = problem(PENDULUM, "target=[0.5,0]")
    about = P_of(target)
    assert float(target.cost.terminal(torch.tensor([0.5, 0.0]).double())) == 0
    assert not torch.allclose(about, P_of(problem(PENDULUM)), rtol=1e-2)


def test_states_that_nothing_depends_on_have_no_tail():
    cartpole = {
        "system": {"name": "cartpole"}, "cost": {"Q": [0, 1, 0.1, 0.1], "R": 0.1},
        "initial_states": {"lower": [-0.1] * 4, "upper": [0.1] * 4}, "network": {"ignored_states": ["cart position"]},
    }  # fmt: skip
    own = problem(CHAIN | cartpole)
    assert not P_of(own)[0].any()
    assert own.cost.ignores_at_end(0, 4)
    assert not own.cost.ignores_at_end(1, 4)
    V = build_value_function(config_from_plain(CHAIN | cartpole), own)
    x = torch.rand(5, 4).double()
    assert_close(V(torch.zeros(()).double(), x), V(torch.ones(()).double(), x + torch.tensor([3.0, 0, 0, 0])))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (["cost.Q_T=1"], "no cost.Q_T with horizon.stationary"),
        (["cost.Q=[2,0,0]", "system.name=linear"], "Expected"),
        (["controls.lower=0"], "limits around the control at the goal"),
    ],
)
def test_what_has_no_regulator_is_refused(changes, message):
    with pytest.raises(UsageError, match=message):
        problem(CHAIN, *changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (["network.terminal=exact"], "network.terminal=free with horizon.stationary"),
        (["network.smooth=true"], "takes smooth, got stationary; remove network.smooth"),
        (["network.name=stationary", "horizon.stationary=false", "cost.Q_T=1"], "horizon.stationary: true"),
    ],
)
def test_a_network_that_does_not_suit_is_refused(changes, message):
    config = config_from_plain(CHAIN | {"program": {"name": "value"}}, changes)
    with pytest.raises(UsageError, match=message):
        build_value_function(config, build_problem(config))


def obstacle_at(distance):
    """An obstacle of radius 0.2 beside the goal."""
    return {"cost": CHAIN["cost"] | {"obstacles": [{"center": {"x1": distance}, "radius": 0.2, "weight": 5.0}]}}


def test_a_goal_at_which_something_is_paid_is_refused():
    with pytest.raises(UsageError, match=r"q\(x\*\) = 0 for horizon.stationary, got 3.03"):  # 5 exp(−2/4)
        problem(CHAIN | obstacle_at(0.1))
    assert P_of(problem(CHAIN | obstacle_at(0.8))).isfinite().all()


def test_a_goal_outside_the_constraints_is_refused():
    away = {"initial_states": {"lower": [1.5, 0, 0], "upper": [2, 0.1, 0.1]}}
    with pytest.raises(UsageError, match="a goal within the constraints"):
        problem(CHAIN | away | {"constraints": {"lower": {"x1": 1.2}}})
    own = problem(CHAIN | away | {"constraints": {"lower": {"x1": -1.2}}})
    assert_close(P_of(own), P_of(problem(CHAIN)))


class Flat(Cost):
    """Its q is one number, where it should be one for each state."""

    def state(self, x):
        return (x**2).sum()

    def R(self, x):
        return torch.ones(*x.shape[:-1], 1, 1)

    def terminal(self, x):
        return (x**2).sum(-1)


def test_what_is_wrong_with_an_own_cost_is_said_in_words():
    own = Parts(cost=Flat())
    idle = {"system": {"name": "linear", "parameters": {"A": [[0.0]], "B": [[1.0]]}}, "cost": {}}
    with pytest.raises(UsageError, match=r"q\(x\) of Flat"):
        build_problem(config_from_plain(CHAIN | idle | {"initial_states": {"lower": [-1], "upper": [1]}}), own)


def test_where_nothing_moves_and_nothing_costs_there_is_no_regulator():
    idle = {"system": {"name": "linear", "parameters": {"A": [[0.0]], "B": [[1.0]]}}, "cost": {"Q": 0, "R": 1}}
    with pytest.raises(UsageError, match="no state is involved"):
        problem(CHAIN | idle | {"initial_states": {"lower": [-1], "upper": [1]}})


def test_a_goal_that_no_regulator_reaches_is_refused():
    drifting = {"system": {"name": "linear", "parameters": {"A": [[0.5, 0.0], [0.0, 0.0]], "B": [[0.0], [1.0]]}}}
    two = {"cost": {"Q": 1, "R": 1}, "initial_states": {"lower": [-1, -1], "upper": [1, 1]}}
    with pytest.raises(UsageError, match="a linear law stabilises"):
        problem(CHAIN | drifting | two)
    held = {"system": {"name": "linear", "parameters": {"A": [[-0.5, 0.0], [0.0, 0.0]], "B": [[0.0], [1.0]]}}}
    assert float(P_of(problem(CHAIN | held | two))[0, 0]) > 0


def test_a_goal_that_no_control_holds_is_refused():
    with pytest.raises(UsageError, match="a goal that is an equilibrium"):
        problem(PENDULUM, "target=[0.5,0]", "target_control=[0]")


SCALING = Scaling(state=(1.0, 2.0), duration=2.0, value=3.0)


@pytest.fixture
def network():
    """A network with random weights about a goal that is not the origin."""
    torch.manual_seed(1)
    V = StationaryNetwork(SCALING, [8, 6], embedded_angles=[0]).double()
    V.start_from_regulator(torch.tensor([0.3, -0.2]).double(), torch.tensor([[2.0, 0.5], [0.5, 1.0]]).double(), 0.4)
    torch.nn.init.normal_(V.network.output.weight, std=0.5)
    return V.requires_grad_(False)


def test_V_is_right_at_the_goal_for_any_weights(network):
    goal, now = network.goal.clone(), torch.zeros(()).double()
    assert float(network(now, goal)) == 0
    assert not network.value_and_state_gradient(now, goal)[1].any()
    second = torch.autograd.functional.hessian(lambda x: network(now, x), goal + 1e-6)
    assert_close(second, torch.tensor([[2.0, 0.5], [0.5, 1.0]]).double(), rtol=1e-4, atol=1e-4)
    assert_close(network.curvature(now), torch.tensor([[2.0, 0.5], [0.5, 1.0]]).double())


def test_V_is_positive_elsewhere_and_the_same_at_all_times(network):
    x = network.goal + 20 * torch.randn(500, 2).double()
    assert bool((network(torch.zeros(()).double(), x) > 0).all())
    t = torch.rand(500).double()
    assert_close(network(t, x), network(torch.zeros(500).double(), x))
    assert not gradients(network, t, x)[0].any()


def test_its_gradient_is_autograds(network):
    x, t = network.goal + 3 * torch.randn(200, 2).double(), torch.rand(200).double()
    value, slope = network.value_and_state_gradient(t, x)
    assert_close(slope, gradients(network, t, x)[1])
    assert_close(value, network(t, x))


def test_any_other_network_is_read_at_one_time():
    torch.manual_seed(0)
    V = FCN(SCALING, [4])
    x, t = torch.randn(9, 2), torch.rand(9)
    assert_close(Timeless(V)(t, x), V(torch.zeros(9), x))
    assert not torch.allclose(V(t, x), V(torch.zeros(9), x))
    assert_close(Timeless(V).value_and_state_gradient(t, x)[1], gradients(V, torch.zeros(9), x)[1])
    config = config_from_plain(CHAIN, ["network.name=fcn", "program.name=value", "rollout.policy=hjb"])
    assert isinstance(build_value_function(config, build_problem(config)), Timeless)


@pytest.mark.gate
@pytest.mark.usefixtures("few_optima")
def test_the_regulator_of_a_linear_system_is_known_before_training():
    (learner,) = build_module(config_from_plain(CHAIN)).members
    start = choose_start([learner])
    assert start is not None
    x, P = 1e-3 * torch.randn(50, 3).double(), P_of(learner.problem)
    assert_close(learner.V(torch.zeros(()).double(), x), ((x @ P) * x).sum(-1), rtol=1e-3, atol=0)


@torch.no_grad()
def test_before_a_start_too_V_vanishes_at_the_target_alone():
    config = config_from_plain(CHAIN, ["target=[0.5,0,0]"])
    V, target = build_value_function(config, build_problem(config)), torch.tensor([0.5, 0.0, 0.0]).double()
    assert float(V(torch.zeros(()).double(), target)) == 0 < float(V(torch.zeros(()).double(), 0 * target))


@pytest.mark.gate
def test_from_the_goal_alone_there_is_a_start():
    only = {"initial_states": {"lower": [0, 0, 0], "upper": [0, 0, 0]}}
    (learner,) = build_module(config_from_plain(CHAIN | only)).members
    start = choose_start([learner])
    assert start is not None
    assert start.chosen.cost == 0
    H = learner.V.curvature(torch.zeros(()).double())
    assert_close(H, 2 * P_of(learner.problem), rtol=1e-6, atol=1e-6)


@pytest.mark.gate
def test_the_level_up_to_which_the_regulator_is_right_is_found(monkeypatch):
    """Of a pendulum between tight limits it lies far below what V is on a wide X₀, and a fit sees both."""
    monkeypatch.setattr("lyapnet.training.start.MAX_OPTIMA", 24)
    shorten_fits(monkeypatch, 150, 50)
    tight = ["controls={lower: -12, upper: 12}", "initial_states={lower: [-3, -3], upper: [3, 3]}", "cost.R=0.05"]
    (learner,) = build_module(config_from_plain(PENDULUM, tight)).members
    start = choose_start([learner])
    assert start is not None
    names = [each.name for each in start.candidates]
    assert "the regulator, up to where it is right" in names
    assert "V = 0" not in names
    x0 = learner.problem.initial_states.sample(100, torch.Generator().manual_seed(0)).double()
    everywhere = ((x0 @ P_of(learner.problem)) * x0).sum(-1).mean()
    assert float(learner.V.scale) < 0.3 * float(everywhere)


@pytest.fixture
def few_optima(monkeypatch):
    """For what does not ask how good a start is."""
    monkeypatch.setattr("lyapnet.training.start.MAX_OPTIMA", 12)
    shorten_fits(monkeypatch, 130, 70)


@pytest.mark.gate
@pytest.mark.usefixtures("few_optima")
def test_a_checkpoint_is_loaded_with_its_tail(tmp_path):
    own = CHAIN | {"logs": str(tmp_path), "trainer": {"accelerator": "cpu"}}
    run = train(config_from_plain(own, [*QUICK, "training.warmup=0"]))
    controller = load(run.best)
    assert controller.horizon.stationary
    assert controller.after_horizon() == AfterHorizon("hold", 64, 64), "one law for ever"
    assert run.evaluation["after_T"] == "hold"
    assert_close(P_of(controller.problem), P_of(problem(CHAIN)))
    assert dataclasses.replace(controller.horizon, stationary=False) != controller.horizon
    ends = config_from_plain(own, ["horizon.stationary=false", "cost.Q_T=1", "program.name=value"])
    with pytest.raises(UsageError, match=r"which has V\(x\), got a task of V\(t, x\)"):
        train(ends, finetune=run.best)

"""Weights of the cost as parameters of a family: every member costs what a config with its weights says."""

import json
import math
from collections import Counter

import numpy as np
import pytest
import torch
from torch.testing import assert_close

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.base.interpolation import Curve
from lyapnet.base.random_streams import TEST, stream
from lyapnet.cli import main
from lyapnet.evaluation.oracles import oracle_of
from lyapnet.evaluation.robustness import nominal
from lyapnet.experiment.assembly import Parts, build_problem
from lyapnet.experiment.assembly.weights import weights_of
from lyapnet.experiment.config import config_from_plain
from lyapnet.task.cost import QuadraticCost
from lyapnet.task.family import FamilySystem
from lyapnet.task.systems import SYSTEMS, ControlAffineSystem, DoubleIntegrator
from lyapnet.training import start
from lyapnet.training.build_learner import build_learner
from lyapnet.training.initial_networks import start_from
from lyapnet.value.expansions import greedy_law, optimal_trajectories, path_under, riccati
from lyapnet.value.networks import ExpansionNetwork
from lyapnet.value.policy import HJBPolicy
from lyapnet.value.regulator import Regulator
from tests.fits import shorten_fits
from tests.problems import Formula

PENDULUM = {
    "experiment": "weights",
    "system": {"name": "pendulum"},
    "cost": {"Q": [0.5, 0.05], "R": [0.05], "Q_T": [50, 5]},
    "controls": {"lower": -8, "upper": 8},
    "initial_states": {"lower": [-1, -1], "upper": [1, 1]},
    "horizon": {"steps": 20, "dt": 0.05},
}
LINEAR = {
    "experiment": "linear",
    "system": {"name": "double_integrator"},
    "cost": {"Q": [1, 0.1], "R": [0.1], "Q_T": [10, 1]},
    "initial_states": {"lower": [-1, -1], "upper": [1, 1]},
    "horizon": {"steps": 20, "dt": 0.05},
    "family": {"cost.Q.0": [0.3, 3], "cost.R.force": [0.02, 0.5]},
}
ALL = {"cost.Q.0": [0.1, 10], "cost.R.torque": [0.01, 1], "Q_T_velocity": [1, 100]}


def problem(plain, **others):
    return build_problem(config_from_plain({**plain, **others}))


def joined(task, x, **parameters):
    return task.system.joined(x, parameters)


def members(task, z):
    """x and the parameters by name of each state (x, p)."""
    assert isinstance(task.system, FamilySystem)
    return [(x, task.system.values(p.tolist())) for x, p in zip(*task.system.split(z), strict=True)]


def with_diagonal(matrix, i, value):
    """A matrix of a config, whose flat list is the diagonal, with another entry of it."""
    if isinstance(matrix[0], list):
        return [[value if (k, j) == (i, i) else entry for j, entry in enumerate(row)] for k, row in enumerate(matrix)]
    return [value if k == i else entry for k, entry in enumerate(matrix)]


@pytest.mark.parametrize(
    "cost",
    [
        {},
        {"Q": [[0.5, 0.02], [0.02, 0.05]], "R": 0.05, "Q_T": [[50, 3], [3, 5]]},
        {"periodic": ["angle"]},
        {"huber": 2},
        {"periodic": ["angle"], "huber": 0.5, "obstacles": [{"center": {"angle": 0.5}, "radius": 0.3, "weight": 2}]},
    ],
    ids=["diagonals", "rows", "periodic", "huber", "all"],
)
@pytest.mark.parametrize("target", [None, [2 * math.pi, 0]], ids=["origin", "target"])
def test_a_member_costs_what_its_weights_say(cost, target):
    cost = PENDULUM["cost"] | cost
    family = problem(PENDULUM, cost=cost, family=ALL, target=target)
    x, u = torch.randn(7, 2) + (0 if target is None else torch.tensor(target)), torch.randn(7, 1)
    z = joined(family, x, Q_angle=2.5, R_torque=0.3, Q_T_velocity=7)
    own = {"Q": with_diagonal(cost["Q"], 0, 2.5), "R": [0.3], "Q_T": with_diagonal(cost["Q_T"], 1, 7)}
    for weights, agrees in ((own, True), (own | {"R": [0.31]}, False), (own | {"Q": cost["Q"]}, False)):
        member = problem(PENDULUM, cost=cost | weights, target=target)
        assert torch.allclose(family.cost.running(z, u), member.cost.running(x, u)) == agrees
    assert_close(family.cost.terminal(z), member.cost.terminal(x))
    assert_close(family.cost.solve_R(z, u), u / 0.3)
    assert not torch.allclose(family.cost.terminal(joined(family, x, Q_angle=2.5, R_torque=0.3, Q_T_velocity=8)),
                              member.cost.terminal(x))  # fmt: skip


def test_each_state_of_a_batch_has_weights_of_its_own():
    family = problem(PENDULUM, family=ALL)
    z, u = family.initial_states.sample(6), torch.randn(6, 1)
    for i, (x, w) in enumerate(members(family, z)):
        assert list(w) == ["Q_angle", "R_torque", "Q_T_velocity"]
        cost = {"Q": [w["Q_angle"], 0.05], "R": [w["R_torque"]], "Q_T": [50, w["Q_T_velocity"]]}
        member = problem(PENDULUM, cost=cost)
        assert_close(family.cost.running(z, u)[i], member.cost.running(x, u[i]))
        assert_close(family.cost.terminal(z)[i], member.cost.terminal(x))


def test_weights_are_drawn_evenly_over_decades():
    box = problem(PENDULUM, family=ALL).initial_states
    assert_close(box.lower[2:], torch.tensor([-1.0, -2.0, 0.0]))
    assert_close(box.upper[2:], torch.tensor([1.0, 0.0, 2.0]))


def test_the_law_divides_by_the_weight_of_each_member():
    family, plain = problem(PENDULUM, family=ALL, controls={}), problem(PENDULUM, controls={})
    x = torch.randn(4, 2)
    R = torch.tensor([0.01, 0.1, 0.5, 1.0])
    u = HJBPolicy(family, Formula(lambda t, z: (z[..., :2] ** 2).sum(-1)))(
        torch.tensor(0.0), joined(family, x, Q_angle=1, R_torque=R, Q_T_velocity=1)
    )
    alone = HJBPolicy(plain, Formula(lambda t, x: (x**2).sum(-1)))(torch.tensor(0.0), x)  # R = 0.05
    assert_close(u, alone * 0.05 / R[:, None])


def linear_member(Q, R, **others):
    return problem(LINEAR, family={}, cost={"Q": [Q, 0.1], "R": [R], "Q_T": [10, 1]}, **others)


@pytest.mark.gate
def test_optima_of_a_linear_family_are_those_of_riccati():
    """By differential dynamic programming in (x, log w), against the Riccati equation with these weights."""
    short = {"horizon": {"steps": 6, "dt": 0.15}}
    family = problem(LINEAR, **short)
    z0 = family.initial_states.sample(2)
    path = path_under(family, greedy_law(family, riccati(family)), z0)
    optimum = optimal_trajectories(family, z0, path.u)
    for i, (x, w) in enumerate(members(family, z0)):
        Q, R = w.values()
        alone = riccati(linear_member(Q, R, **short)).initially(x)
        assert_close(optimum.path.cost[i], alone)
        assert not torch.allclose(path.cost[i], alone, rtol=1e-4), "the law of the mean weights is another"
        assert not torch.allclose(riccati(linear_member(Q, 1.1 * R, **short)).initially(x), alone)


@pytest.mark.gate
def test_the_slope_of_v_by_the_weights_is_that_of_riccati():
    family, x = problem(LINEAR), torch.tensor([0.8, -0.3])
    z0 = joined(family, x, Q_position=1.0, R_force=0.1)
    optimum = optimal_trajectories(
        family, z0[None], path_under(family, greedy_law(family, riccati(family)), z0[None]).u
    )
    slope, step = optimum.expansion.gradient[0, 0, 2:], 1e-4
    for k in range(2):
        ends = [
            riccati(linear_member(*(w * 10 ** (sign * step * (j == k)) for j, w in enumerate((1.0, 0.1))))).initially(x)
            for sign in (1, -1)
        ]
        assert_close(slope[k], (ends[0] - ends[1]) / (2 * step), rtol=1e-5, atol=1e-6)
    assert slope.abs().min() > 0.01


def test_the_regulator_of_a_member_is_that_of_its_weights():
    family, x = problem(LINEAR, family={"cost.Q.0": [0.5, 2], "cost.R.0": [0.05, 0.2]}), torch.tensor([[0.8, -0.3]])
    own, alone = Regulator(family), Regulator(linear_member(1.7, 0.06))
    assert_close(own(joined(family, x, Q_position=1.7, R_force=0.06)), alone(x), rtol=1e-2, atol=0)
    assert not torch.allclose(own(joined(family, x, Q_position=1.7, R_force=0.1)), alone(x), rtol=1e-2, atol=0)


def started(plain, **others):
    """(family, V) with V on top of the Riccati solutions, N = 0."""
    config = config_from_plain({**plain, **others})
    task = build_problem(config)
    learner = build_learner(config, task)
    start_from(learner, riccati(task), task.initial_states.sample(64))
    assert isinstance(learner.V, ExpansionNetwork)
    return task, learner.V


@torch.no_grad()
def test_v_starts_near_the_riccati_solution_of_every_member():
    """Its growth with each weight is that of the Riccati solutions at the ends of the range."""
    family, V = started(LINEAR, horizon={"steps": 60, "dt": 0.05})
    z = family.initial_states.sample(4)
    t = torch.tensor(0.0)
    for at_member, (x, w) in zip(z, members(family, z), strict=True):
        expected = riccati(linear_member(*w.values(), horizon={"steps": 60, "dt": 0.05}))
        assert_close(V(t, at_member), expected.initially(x), rtol=0.2, atol=0)
        assert_close(V.curvature_at(t, at_member)[:2, :2], expected.hessian[0], rtol=0.25, atol=0.05)
    mean = riccati(family)
    assert not torch.allclose(torch.stack([mean.initially(each) for each in z]), V(t, z), rtol=0.2)


@pytest.mark.parametrize(
    "plain", [LINEAR, {**PENDULUM, "family": {**ALL, "mass": [0.9, 1.1]}}], ids=["linear", "mixed"]
)
def test_v_with_weights_has_the_gradient_of_autograd(plain):
    family, V = started(plain)
    torch.nn.init.normal_(V.network.output.weight)
    family.check_value_function(V)
    with torch.no_grad():
        V.size_rates += 0.1  # which the gradient has to follow
        assert isinstance(V.expansion, Curve)
        V.expansion.values[:, -len(V.weights) * V.n :] += 0.1
    family.check_value_function(V)
    at_goals = family.initial_states.sample(3) * torch.cat([torch.zeros(2), torch.ones(V.n - 2)])
    value, V_x = V.value_and_state_gradient(torch.tensor(0.3), at_goals)
    assert_close(torch.cat([value, V_x[:, :2].flatten()]), torch.zeros(9), rtol=0, atol=1e-9)
    own = V.value_and_state_gradient
    V.value_and_state_gradient = lambda t, x: (own(t, x)[0], own(t, x)[1] * (1 + 0.01 * V.placed.sum(0)))
    with pytest.raises(UsageError, match="as V and its gradient"):  # the entries of the weights count too
        family.check_value_function(V)


@pytest.mark.gate
def test_the_optimum_of_a_nonlinear_family_is_that_of_each_member():
    pytest.importorskip("casadi")
    family = problem(PENDULUM, family=ALL)
    weights = torch.tensor([[0.2, 0.5, 3.0], [5.0, 0.02, 60.0]])
    x = torch.tensor([[0.8, 0.2], [0.8, 0.2]])
    together = oracle_of(family).solve(torch.cat([x, weights.log10()], -1)).cost
    for i, (q, r, end) in enumerate(weights.tolist()):
        alone = oracle_of(problem(PENDULUM, cost={"Q": [q, 0.05], "R": [r], "Q_T": [50, end]}))
        assert_close(together[i : i + 1], alone.solve(x[i : i + 1]).cost, rtol=1e-6, atol=0)
    assert abs(float(together[0] - together[1])) > 0.1


def test_weights_stand_beside_plants_and_targets():
    family = problem(
        PENDULUM, family={"mass": [0.8, 1.2], "R_torque": [0.01, 1], "target_velocity": [0, 0]}, target_control=[0]
    )
    assert family.system.parameters_in_f == {"mass": 0}
    z = joined(family, torch.tensor([[0.3, 0.4]]), mass=0.9, R_torque=0.5, target_velocity=0.0)
    member = problem(PENDULUM, system={"name": "pendulum", "parameters": {"mass": 0.9}}, cost={
        "Q": [0.5, 0.05], "R": [0.5], "Q_T": [50, 5]})  # fmt: skip
    u = torch.tensor([[2.0]])
    assert_close(family.system.dynamics(z, u)[:, :2], member.system.dynamics(z[:, :2], u))
    assert_close(family.cost.running(z, u), member.cost.running(z[:, :2], u))


@pytest.mark.parametrize("name", SYSTEMS)
def test_no_two_weights_of_a_system_have_one_name(name):
    try:
        system = SYSTEMS[name]()
    except TypeError:
        pytest.skip("it has no default arguments")
    assert len(weights_of(system)) == 2 * system.n + system.m
    assert Counter(weights_of(system).values()).most_common(1)[0][1] == 1


class Resistor(DoubleIntegrator):
    """It has a number with the name that a weight of the cost would have."""

    def __init__(self, R_force: float = 1.0):
        super().__init__()
        self.R_force = R_force

    def f(self, x):
        return torch.stack([x[..., 1], -self.R_force * x[..., 1]], -1)

    def dynamics(self, x, u):
        return ControlAffineSystem.dynamics(self, x, u)


def test_a_number_of_the_system_keeps_its_name():
    system = {"name": f"{__name__}:Resistor"}
    family = problem(LINEAR, system=system, family={"R_force": [1, 2]})
    assert (family.system.parameters_in_f, family.system.weights) == ({"R_force": 0}, frozenset())
    family = problem(LINEAR, system=system, family={"cost.R.force": [1, 2]})
    assert (family.system.parameters_in_f, family.system.weights) == ({}, {"R_force"})


class Own(lyapnet.Cost):
    """x² + 0.1 u²."""

    def state(self, x):
        return (x**2).sum(-1)

    def R(self, x):
        return 0.1 * torch.ones(*x.shape[:-1], 1, 1).to(x)

    def terminal(self, x):
        return (x**2).sum(-1)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"family": {"cost.R.0": [0, 1]}}, r"Expected family.R_torque > 0, got \[0.0, 1.0\]"),
        ({"family": {"Q_angle": [-1, 1]}}, r"Expected family.Q_angle > 0"),
        ({"family": {"cost.R.0": [2, 1]}}, r"Expected family.cost.R.0 as \[least, greatest\]"),
        ({"family": {"cost.R.0": [1, math.inf]}}, r"Expected family.cost.R.0 as \[least, greatest\]"),
        ({"family": {"cost.R.1": [1, 2]}}, "family.cost.R.1 among .*R_torque.* did you mean family.cost.R.0"),
        ({"family": {"cost.Q.angel": [1, 2]}}, "did you mean family.cost.Q.angle"),
        ({"family": {"cost.Q.-1": [1, 2]}}, "family.cost.Q.-1 among"),
        ({"family": {"cost.Q.0.1": [1, 2]}}, "family.cost.Q.0.1 among"),
        ({"family": {"cost.huber": [1, 2]}}, "family.cost.huber among"),
        ({"family": {"Q_angel": [1, 2]}}, "Expected family.Q_angel among Q_angle"),
        ({"family": {"cost.Q.0": [1, 2], "Q_angle": [1, 2]}}, "Expected each weight of the cost once"),
        ({"family": {"Q_angle": [0.1, 2]}, "cost": {"Q": [[1, 0.5], [0.5, 1]], "R": 1, "Q_T": 1}},
         r"family: Expected Q symmetric positive semidefinite, got smallest eigenvalue .* \[\[0.1, 0.5\]"),
        ({"family": {"R_torque": [0.1, 2]}, "cost": {"Q": [1, 1], "R": "inverse_mass", "Q_T": [1, 1]}},
         "Expected cost.R in numbers for the weights R_torque of a family, got inverse_mass"),
        ({"family": {"Q_angle": [0.1, 2]}, "cost": {"name": f"{__name__}:Own"}}, "got a cost of your own"),
    ],
)  # fmt: skip
def test_weights_that_are_none_are_refused(changes, expected):
    with pytest.raises(UsageError, match=expected):
        problem(PENDULUM, **changes)


@pytest.mark.gate
def test_random_plants_have_no_weights():
    with pytest.raises(UsageError, match="Expected parameters of randomise among the numbers"):
        lyapnet.train(config_from_plain({**PENDULUM, "randomise": {"Q_angle": [0.1, 2]}}))


def test_a_cost_object_has_no_weights_in_the_config():
    cost = QuadraticCost(torch.eye(2), torch.eye(1), torch.eye(2))
    with pytest.raises(UsageError, match="got a cost of your own"):
        build_problem(config_from_plain({**PENDULUM, "family": ALL}), Parts(cost=cost))


def test_a_weight_of_no_cost_at_the_end_is_one():
    """φ = 0 but for the weighted entry."""
    family = problem(PENDULUM, cost={"Q": [1, 1], "R": [1], "Q_T": [0, 0]}, family={"Q_T_angle": [1, 10]})
    z = joined(family, torch.tensor([[0.5, 3.0]]), Q_T_angle=4)
    assert_close(family.cost.terminal(z), torch.tensor([1.0]))


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """The checkpoint of a family in weights, after one step."""
    folder = tmp_path_factory.mktemp("weights")
    config = config_from_plain({
        **LINEAR, "system": {"name": "pendulum"}, "family": {"cost.Q.0": [0.3, 3], "cost.R.torque": [0.02, 0.5]},
        "logs": str(folder), "training": {"iterations": 1, "batch_size": 2}, "program": {"name": "value"},
        "network": {"name": "expansion", "hidden": [4]}, "rollout": {"policy": "sampled"},
        "evaluation": {"validation_states": 2, "test_states": 2, "optimum": False},
    })  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(start, "MAX_OPTIMA", 8)
        shorten_fits(patch, 20, 10)
        lyapnet.train(config)
    return folder / "linear" / "version_0" / "checkpoints" / "best.ckpt"


@pytest.mark.gate
def test_a_controller_is_told_weights_as_such(trained):
    controller, x = lyapnet.load(trained), np.array([[0.4, 0.1], [0.2, -0.3]])
    told = controller.policy(0.2, x, Q_angle=[1, 2], R_torque=0.1)
    z = np.column_stack([x, np.log10([1, 2]), np.log10([0.1, 0.1])])
    np.testing.assert_allclose(told, controller.policy(0.2, z), rtol=1e-6)
    np.testing.assert_array_equal(told, controller.policy(0.2, x, **{"cost.Q.0": [1, 2], "cost.R.torque": 0.1}))
    member = controller.with_(Q_angle=2, R_torque=0.1)
    np.testing.assert_allclose(member.policy(0.2, x[1]), told[1], rtol=1e-5)
    assert member.config.cost.Q == [[2, 0], [0, 0.1]]
    assert member.config.cost.R == [[0.1]]
    np.testing.assert_allclose(member.rollout(x).cost, controller.rollout(x, Q_angle=2, R_torque=0.1).cost)
    assert abs(member.rollout(x).cost - controller.with_(Q_angle=2, R_torque=0.2).rollout(x).cost).min() > 1e-4
    for least in (0.02, 0.5):
        controller.with_(Q_angle=0.3, R_torque=least)
    with pytest.raises(UsageError, match=r"Expected R_torque in \[0.02, 0.5\], for which V was trained, got 0.6"):
        controller.with_(Q_angle=2, R_torque=0.6)
    with pytest.raises(ValueError, match=r"Expected R_torque > 0, got -0\.1"):
        controller.policy(0, x, Q_angle=2, R_torque=-0.1)
    with pytest.raises(UsageError, match="Expected each weight of the cost once"):
        controller.policy(0, x, Q_angle=2, R_torque=0.1, **{"cost.R.0": 0.1})
    assert nominal(controller) == pytest.approx({"Q_angle": math.sqrt(0.9), "R_torque": 0.1})


@pytest.mark.gate
def test_commands_know_weights(trained, capsys, tmp_path):
    def done(*arguments):
        status = main([arguments[0], *arguments[1:]])
        return status, capsys.readouterr()

    at = ("--at", "cost.Q.0=2", "--at", "R_torque=0.1")
    status, printed = done("evaluate", str(trained), "--samples", "3", "--no-optimum", "--json", *at)
    assert status == 0
    member = lyapnet.load(trained).with_(Q_angle=2, R_torque=0.1)
    x0 = member.initial_states.sample(3, stream(0, TEST))
    assert json.loads(printed.out)["cost_mean"] == pytest.approx(float(member.rollout(x0).cost.mean()))
    assert done("certify", "sampled", str(trained), "--samples", "3", "--report", str(tmp_path))[0] == 0
    report = json.loads((tmp_path / "report.json").read_text())
    assert "which are constant: log10 Q_angle, log10 R_torque" in report["claim"]["words"]
    assert report["cost"]["with"] == "weights Q_angle, R_torque of the family"
    assert done("export", str(trained), "--to", "c", "--out", str(tmp_path / "c"))[0] == 0
    assert "log10 Q_angle, log10 R_torque" in (tmp_path / "c" / "policy.h").read_text()

"""Families: every member as it is alone, and V told which it is."""

import json
import math

import numpy as np
import pytest
import torch
from torch.testing import assert_close

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.base.random_streams import TEST, stream
from lyapnet.claims.draws import draws_of
from lyapnet.cli import main
from lyapnet.evaluation.figures import trajectories
from lyapnet.evaluation.oracles import oracle_of
from lyapnet.evaluation.robustness import robustness
from lyapnet.experiment.assembly import Parts, build_problem, member
from lyapnet.experiment.config import config_from_plain, load_config
from lyapnet.task.cost import innermost
from lyapnet.task.family import FamilySystem
from lyapnet.task.systems import SYSTEMS, Pendulum
from lyapnet.task.systems.base import MechanicalSystem
from lyapnet.training import start
from lyapnet.training.build_learner import build_learner
from lyapnet.training.initial_networks import start_from
from lyapnet.training.optima import minima
from lyapnet.value.expansions import Expansion, Optimum, Path, riccati
from lyapnet.value.networks import ExpansionNetwork
from tests.configs import objects
from tests.fits import shorten_fits
from tests.problems import CONF, problem_of

MASSES = {
    "experiment": "masses",
    "system": {"name": "pendulum", "parameters": {"damping": 0.1}},
    "cost": {"Q": [1, 0.1], "R": "inverse_mass", "Q_T": [10, 1]},
    "initial_states": {"lower": [-1, -1], "upper": [1, 1]},
    "horizon": {"steps": 20, "dt": 0.05},
    "family": {"mass": [0.8, 1.2], "length": [0.9, 1.5]},
}
GOALS = {
    "experiment": "goals",
    "system": {"name": "double_integrator"},
    "cost": {"Q": [1, 0.1], "R": [0.1], "Q_T": [10, 1], "obstacles": [
        {"center": {"position": 5}, "radius": 0.1, "weight": 1},
    ]},
    "initial_states": {"lower": [-1, -1], "upper": [1, 1]},
    "horizon": {"steps": 20, "dt": 0.05},
    "family": {"target_position": [-1, 3]},
}  # fmt: skip
READS = {  # the parameters of registered systems that f and g read
    "cartpole": ["cart_mass", "pole_mass", "length", "cart_damping", "pole_damping", "gravity"],
    "pendulum": ["mass", "length", "damping", "gravity"],
    "reacher": ["a1", "a2", "a3", "damping"],
    "planar_quadrotor": ["mass", "inertia", "arm", "gravity"],
    "path_tracking": ["speed", "length", "radius"],
    "van_der_pol": ["damping"],
}


def problem(plain, **others):
    return build_problem(config_from_plain({**plain, **others}))


@pytest.mark.parametrize("name", READS)
def test_each_member_is_the_system_built_with_its_parameters(name):
    cls, names = SYSTEMS[name], READS[name]
    usual = torch.tensor([getattr(cls(), parameter) for parameter in names]).clamp_min(0.01)  # some are 0
    family = FamilySystem(cls(), names, [""] * len(names))
    x, u = torch.randn(5, cls().n), torch.randn(5, cls().m)
    p = usual * (1 + 0.1 * torch.rand(5, len(names)))
    z = torch.cat([x, p], -1)
    zeros = torch.zeros_like(p)
    for i in range(5):
        member = cls(**dict(zip(names, p[i].tolist(), strict=True)))
        assert_close(family.f(z)[i], torch.cat([member.f(x[i]), zeros[i]]))
        assert_close(family.g(z)[i, : cls().n], member.g(x[i]))
        assert_close(family.dynamics(z, u)[i], torch.cat([member.dynamics(x[i], u[i]), zeros[i]]))
        if isinstance(member, MechanicalSystem):
            assert_close(family.inverse_mass(z)[i], member.inverse_mass(x[i]))
    assert not torch.allclose(family.f(z)[:, : cls().n], cls().f(x)), "the parameters count"


def test_the_cost_of_a_member_is_about_its_target():
    family, member = problem(GOALS), problem(GOALS, family={}, target=[2.5, 0])
    x, u = torch.randn(6, 2), torch.randn(6, 1)
    z = torch.cat([x, torch.full((6, 1), 2.5)], -1)
    assert_close(family.cost.running(z, u), member.cost.running(x, u))
    assert_close(family.cost.terminal(z), member.cost.terminal(x))
    assert_close(family.goal, torch.tensor([1.0, 0.0, 1.0]))
    assert_close(family.cost.from_goal(z), torch.cat([x - torch.tensor([2.5, 0]), torch.zeros(6, 1)], -1))
    assert float(family.cost.state(torch.tensor([5.0, 0.0, 5.0]))) == pytest.approx(1), "obstacles stay where they are"


def test_the_control_weight_is_that_of_each_member():
    family = problem(MASSES)
    member = problem(MASSES, family={}, system={"name": "pendulum", "parameters": {"mass": 0.8, "length": 1.5}})
    z = torch.tensor([[0.3, 0.1, 0.8, 1.5]])
    assert_close(family.cost.R(z), member.cost.R(z[:, :2]))
    assert_close(family.to(torch.float32).cost.R(z.float()), member.cost.R(z[:, :2]).float())
    assert callable(getattr(innermost(member.cost), "R_of_state", None))


def test_v_of_a_linear_family_is_known_before_training():
    """The Riccati solution about (x̄*, p̄) is that of every target: as exact as that of each alone."""
    family = problem(GOALS | {"cost": {"Q": [1, 0.1], "R": [0.1], "Q_T": [10, 1]}})
    member = problem(GOALS | {"cost": {"Q": [1, 0.1], "R": [0.1], "Q_T": [10, 1]}}, family={}, target=[2.5, 0])
    x0 = torch.randn(4, 2)
    z0 = torch.cat([x0, torch.full((4, 1), 2.5)], -1)
    optimum = riccati(member).initially(x0)
    assert_close(riccati(family).initially(z0), optimum)
    assert not torch.allclose(riccati(family).initially(z0 - 0.1), optimum)


@pytest.mark.gate
def test_the_optimum_of_a_family_is_that_of_each_member():
    pytest.importorskip("casadi")
    z0 = torch.tensor([[0.5, 0.0, 0.9, 1.0], [0.5, 0.0, 1.2, 1.5]])
    together = oracle_of(problem(MASSES)).solve(z0).cost
    for i, (mass, length) in enumerate(z0[:, 2:].tolist()):
        parameters = {"mass": mass, "length": length, "damping": 0.1}
        alone = oracle_of(problem(MASSES, family={}, system={"name": "pendulum", "parameters": parameters}))
        assert_close(together[i : i + 1], alone.solve(z0[i : i + 1, :2]).cost, rtol=1e-6, atol=0)
    assert abs(float(together[0] - together[1])) > 0.01


def started(plain):
    """(problem, V) with V on top of the Riccati solution, and random weights."""
    config = config_from_plain(plain)
    task = build_problem(config)
    learner = build_learner(config, task)
    V = learner.V
    assert isinstance(V, ExpansionNetwork)
    start_from(learner, riccati(task), task.initial_states.sample(64))
    torch.nn.init.normal_(V.network.output.weight)
    return task, V


def test_v_vanishes_at_the_target_of_every_member_whatever_the_network_learns():
    plain = GOALS | {"cost": {"Q": [1, 0.1], "R": [0.1], "Q_T": [10, 1]}}
    _, V = started(plain)
    at_goals = torch.tensor([[-1.0, 0.0, -1.0], [2.5, 0.0, 2.5]])
    value, V_x = V.value_and_state_gradient(torch.tensor(0.3), at_goals)
    assert_close(value, torch.zeros(2), rtol=0, atol=1e-12)
    assert_close(V_x[:, :2], torch.zeros(2, 2), rtol=0, atol=1e-9)
    with torch.no_grad():
        assert float(V(torch.tensor(0.3), torch.tensor([[0.0, 0.0, 2.5]]))) > 1


def test_v_of_a_family_has_the_gradient_of_autograd():
    for plain in (MASSES, GOALS):
        task, V = started(plain)
        task.check_value_function(V)


def test_the_network_sees_parameters_in_which_v_is_flat():
    """Around an upright pendulum no parameter counts to second order; with C from V's curvature N would not see any."""
    task, V = started(MASSES)
    z = task.initial_states.sample(64)
    xi = z @ V.coordinates - torch.cat([torch.zeros(2), task.initial_states.center[2:]]) @ V.coordinates
    assert (xi[:, 2:].abs().amax(0) > 0.8).all()
    assert (xi[:, 2:].abs().amax(0) <= 1.01).all()


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """The checkpoint of a family, after one step."""
    folder = tmp_path_factory.mktemp("family")
    config = config_from_plain({
        **MASSES, "logs": str(folder), "training": {"iterations": 1, "batch_size": 2},
        "program": {"name": "value"}, "network": {"name": "expansion", "hidden": [4]}, "rollout": {"policy": "sampled"},
        "evaluation": {"validation_states": 2, "test_states": 2, "optimum": False},
    })  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(start, "MAX_OPTIMA", 8)
        shorten_fits(patch, 20, 10)
        lyapnet.train(config)
    return folder / "masses" / "version_0" / "checkpoints" / "best.ckpt"


@pytest.mark.gate
def test_a_controller_is_told_its_member(trained):
    controller = lyapnet.load(trained)
    x, mass = np.array([[0.4, 0.1], [0.2, -0.3]]), np.array([0.8, 1.1])
    told = controller.policy(0.2, x, mass=mass, length=1.2)
    z = np.column_stack([x, mass, [1.2, 1.2]])
    np.testing.assert_array_equal(told, controller.policy(0.2, z))
    assert abs(told - controller.policy(0.2, x, mass=1.2, length=1.2)).max() > 1e-3
    member = controller.with_(mass=1.1, length=1.2)
    np.testing.assert_allclose(member.policy(0.2, x[1]), told[1], rtol=1e-12)
    np.testing.assert_allclose(member.value(0.2, x), controller.value(0.2, x, mass=1.1, length=1.2), rtol=1e-12)
    assert isinstance(member.system, Pendulum)
    assert (member.system.mass, member.system.length) == (1.1, 1.2)
    assert member.parameters["mass"] == 1.1
    path = controller.rollout(x, mass=1.1, length=1.2)
    whole = controller.rollout(np.column_stack([x, [1.1, 1.1], [1.2, 1.2]]))
    np.testing.assert_allclose(path.x, whole.x[..., :2], rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(path.cost, whole.cost, rtol=1e-10)
    assert controller.rollout(x, 3, mass=1.1, length=1.2).x.shape == (4, 2, 2)


@pytest.mark.gate
def test_a_member_is_the_same_however_it_is_named(trained):
    torch.set_default_dtype(torch.float32)  # as it is outside of tests: 0.9 is no number of float32
    controller, x = lyapnet.load(trained), np.array([[0.4, 0.1], [0.2, -0.3]])
    told = controller.policy(0.2, x, mass=0.9, length=1.4)
    np.testing.assert_array_equal(told, controller.policy(0.2, np.column_stack([x, [0.9, 0.9], [1.4, 1.4]])))
    np.testing.assert_array_equal(told, controller.policy(0.2, x, length=[1.4, 1.4], mass=0.9))
    member = controller.with_(length=1.4, mass=0.9)
    assert (member.system.mass, member.system.length) == (0.9, 1.4)
    np.testing.assert_allclose(member.policy(0.2, x), told, rtol=1e-12)
    np.testing.assert_array_equal(controller.rollout(x, length=1.4, mass=0.9).cost, member.rollout(x).cost)


@pytest.mark.gate
def test_a_policy_asked_outside_its_family_says_so_once(trained, caplog):
    controller = lyapnet.load(trained)
    controller.policy(0, [0.0, 0.0], mass=0.8, length=1.5)
    controller.policy(0, [0.0, 0.0], mass=0.8 * 1.5, length=1.5)
    assert not caplog.records
    for _ in range(2):
        controller.policy(0, [0.0, 0.0], mass=0.8, length=1.6)
    (record,) = caplog.records
    assert "length in [0.9, 1.5] and is evaluated outside" in record.getMessage()


@pytest.mark.gate
def test_what_a_member_is_asked_for_and_cannot_be(trained):
    controller = lyapnet.load(trained)
    with pytest.raises(UsageError, match="Expected values for mass, length, got mass"):
        controller.with_(mass=1)
    with pytest.raises(UsageError, match=r"Expected mass in \[0\.8, 1\.2\], for which V was trained, got 1\.3"):
        controller.with_(mass=1.3, length=1)
    with pytest.raises(UsageError, match="Expected a controller of a family"):
        controller.with_(mass=1, length=1).with_(mass=1, length=1)
    with pytest.raises(ValueError, match="Expected values for mass, length, got weight"):
        controller.policy(0, [0.0, 0.0], weight=3)
    with pytest.raises(ValueError, match="Expected no parameters, got mass"):
        controller.with_(mass=1, length=1).policy(0, [0.0, 0.0], mass=1)
    for mass in ("heavy", None, [1, 1, 1]):
        with pytest.raises(ValueError, match=r"Expected mass scalar or of shape \(2,\), got"):
            controller.policy(0, [[0.0, 0.0], [0.1, 0.0]], mass=mass, length=1)
    with pytest.raises(ValueError, match=r"Expected x of shape \(\*batch, 2\), got \(4,\)"):
        controller.policy(0, [0.0, 0.0, 1.0, 1.0], mass=1, length=1)
    with pytest.raises(UsageError, match=r"Expected mass as one number, got \[1, 1\]"):
        member(controller.config, Parts(), controller.problem, {"mass": [1, 1], "length": 1})


@pytest.mark.gate
def test_a_member_keeps_the_law_after_the_end(trained):
    """That of the family is a polynomial in its parameters; that of a member its own regulator."""
    x = np.array([0.1, -0.2])
    for beyond in (None, "riccati"):
        family = lyapnet.load(trained, beyond=beyond)
        own = family.with_(mass=0.9, length=1.1).policy(1e3, x)
        assert family.policy(1e3, x, mass=0.9, length=1.1) == pytest.approx(own, rel=1e-3)


@pytest.mark.gate
def test_a_disturbed_parameter_is_told_where_v_knows_it(trained):
    rows = {row.disturbance: row for row in robustness(lyapnet.load(trained), samples=4, optimum=False)}
    assert {"mass -20%", "mass -20%, told", "mass +20%, told", "length +20%, told"} <= rows.keys()
    assert "length -20%, told" not in rows, "outside the range"
    assert "none" in rows


@pytest.mark.gate
def test_a_member_is_evaluated_by_name(trained, capsys):
    def evaluated(*arguments):
        status = main(["evaluate", str(trained), "--samples", "3", "--no-optimum", "--json", *arguments])
        return status, capsys.readouterr()

    status, printed = evaluated("--at", "mass=0.9", "--at", "length=1")
    assert status == 0
    member = lyapnet.load(trained).with_(mass=0.9, length=1)
    x0 = member.initial_states.sample(3, stream(0, TEST))
    assert json.loads(printed.out)["cost_mean"] == pytest.approx(float(member.rollout(x0).cost.mean()))
    status, printed = evaluated()
    assert status == 0
    assert list(json.loads(printed.out)["terminal_errors"]) == ["angle (rad)", "velocity (rad/s)"]
    status, printed = evaluated("--at", "mass=heavy")
    assert status == 2
    assert "Expected --at NAME=VALUE with a number, got mass=heavy" in " ".join(printed.err.split())
    status, printed = evaluated("--at", "mass=0.9", "--at", "length=1", "--at", "mass=1")
    assert status == 2
    assert "Expected --at once for each parameter" in " ".join(printed.err.split())


@pytest.mark.gate
def test_a_certificate_is_about_all_members_or_one(trained, capsys, tmp_path):
    def certified(*arguments):
        status = main(["certify", *arguments])
        return status, " ".join(capsys.readouterr().err.split())

    assert certified("sampled", str(trained), "--samples", "3", "--report", str(tmp_path))[0] == 0
    report = json.loads((tmp_path / "report.json").read_text())
    assert "include the parameters of a family, which are constant: mass, length" in report["claim"]["words"]
    assert report["system"] == {"name": "family of pendulum", "parameters": {"damping": 0.1, "gravity": 9.81}}
    assert report["cost"] == {"Q": [1, 0.1], "R": "inverse_mass", "Q_T": [10, 1]}
    one = ("--at", "length=1.4", "--at", "mass=0.9")
    assert certified("statistical", str(trained), "--samples", "3", "--report", str(tmp_path), *one)[0] == 0
    report = json.loads((tmp_path / "report.json").read_text())
    assert (report["system"]["parameters"]["mass"], report["certificate"]["draws"]) == (0.9, 1), "another claim"
    assert report["command"].endswith("--at=length=1.4 --at=mass=0.9")
    assert certified("statistical", str(trained), "--samples", "4", "--at", "mass=0.90", "--at", "length=1.4")[0] == 0
    assert draws_of(trained, ["mass=0.9", "length=1.4"], radius=None).others(0, 3) == 1
    assert "Expected --at or --refine, got both" in certified("sound", str(trained), "--refine", "1", *one)[1]


@pytest.mark.gate
def test_weights_go_on_with_the_same_parameters_in_the_same_places(trained, tmp_path, caplog):
    few = {"logs": str(tmp_path), "training": {"iterations": 1, "batch_size": 2}, "program": {"name": "value"},
           "network": {"name": "expansion", "hidden": [4]}, "rollout": {"policy": "sampled"},
           "evaluation": {"validation_states": 2, "test_states": 2, "optimum": False}}  # fmt: skip
    swapped = {"family": {"length": [0.9, 1.5], "mass": [0.8, 1.2]}}
    with pytest.raises(UsageError, match=r"Expected a family in mass, length, as of .*, got one in length, mass"):
        lyapnet.train(config_from_plain(MASSES | few | swapped), finetune=trained)
    with pytest.raises(UsageError, match=r"got another order in family"):
        lyapnet.train(config_from_plain(MASSES | few | swapped | {"logs": str(trained.parents[3])}), resume="last")
    with pytest.raises(UsageError, match=r"got one in none"):
        lyapnet.train(config_from_plain(MASSES | few | {"family": {}}), finetune=trained)


@pytest.mark.gate
def test_figures_show_what_moves(trained):
    controller = lyapnet.load(trained)
    figure = trajectories(controller.rollout(controller.initial_states.sample(3)), controller.problem)
    labels = [axes.get_ylabel() for axes in figure.axes if axes.get_visible()]
    assert labels == ["angle\n(rad)", "velocity\n(rad/s)", "torque\n(N·m)", "cost"]


class Derived(Pendulum):
    """It reads a number that __init__ derives from the mass."""

    def __init__(self, mass: float = 1.0):
        super().__init__(mass=mass)
        self.weight = mass * 9.81

    def forces(self, q, qdot):
        return self.weight * torch.sin(q)


class Unread(Pendulum):
    """It does not read its number."""

    def __init__(self, wind: float = 1.0):
        super().__init__()
        self.wind = wind


class Wide(Pendulum):
    """It takes no tensor for its length."""

    def __init__(self, length: float = 1.0):
        super().__init__(length=length)

    def forces(self, q, qdot):
        return torch.full_like(q, self.length)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"family": {"mass": [1.2, 0.8]}}, r"Expected family.mass as \[least, greatest\]"),
        ({"family": {"mass": [0.8, 1, 1.2]}}, r"Expected family.mass as \[least, greatest\]"),
        ({"family": {"x": [0.8, 1.2]}}, "other than t, x, x0, steps, got x"),
        ({"family": {"mess": [0.8, 1.2]}}, "numbers that Pendulum keeps .mass, length, damping, gravity., got mess"),
        ({"family": {"target_angel": [-1, 1]}}, "Expected family.target_angel among target_angle, target_velocity"),
        ({"family": {"target_velocity": [-1, 1]}}, "Expected a target that some control holds"),
        ({"family": {"wind": [0, 1]}, "system": {"name": f"{__name__}:Unread"}}, "Unread.f or g to read wind"),
        ({"family": {"mass": [0.0, 1.2]}}, "mass > 0"),
        ({"family": {"mass": [0.8, 1.2]}, "system": {"name": f"{__name__}:Derived"}}, "derived in f and g"),
        ({"family": {"length": [0.8, 1.2]}, "system": {"name": f"{__name__}:Wide"}}, "as a tensor"),
    ],
)
def test_a_family_that_is_none_is_refused(changes, expected):
    with pytest.raises(UsageError, match=expected):
        problem(MASSES | {"cost": {"Q": [1, 0.1], "R": [0.1], "Q_T": [10, 1]}}, **changes)


def test_targets_that_one_given_control_is_counted_from():
    task = problem(MASSES | {"cost": {"Q": [1, 0.1], "R": [0.1], "Q_T": [10, 1]}},
                   family={"target_angle": [-1, 1]}, target_control=[0])  # fmt: skip
    assert_close(task.goal, torch.zeros(3))
    assert_close(task.cost.terminal(torch.tensor([0.5, 0.0, 0.5])), torch.tensor(0.0))


@pytest.mark.gate
@pytest.mark.parametrize("path", sorted(CONF.glob("*_family.yaml")), ids=lambda path: path.stem)
def test_the_shipped_families_learn(path):
    _, V, program, rollout = objects(load_config(path, ["network.hidden=[8]"]))
    trajectory = rollout(rollout.problem.initial_states.sample(3))
    program(trajectory).loss.backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in V.parameters())


def test_optima_that_are_no_minimum_are_left_out():
    """Behind a conjugate point V_xx has grown without bound, or is no number."""
    b, N, n = 6, 3, 2
    H = torch.ones(N + 1, b, n, n)
    H[0, 1], H[1, 2], H[0, 4] = 1e5, math.nan, 50.0
    x, cost = torch.arange(b).double()[None, :, None].expand(N + 1, b, n), torch.ones(b)
    cost[5] = math.inf
    optimum = Optimum(Path(x, torch.zeros(N, b, 1), cost), Expansion(x, torch.zeros(N + 1, b), x, H), cost)
    problem = problem_of(SYSTEMS["double_integrator"]())
    kept = minima(problem, optimum)
    assert kept.path.x[0, :, 0].tolist() == [0, 3, 4]
    assert kept.expansion.hessian.shape == (N + 1, 3, n, n)
    nothing = Optimum(optimum.path._replace(cost=torch.full((b,), math.inf)), optimum.expansion, cost)
    assert minima(problem, nothing).path.x.shape[1] == 0

"""References r(t): the time on them as a state, the control that follows them, files of points."""

import math

import numpy as np
import pytest
import torch
from torch.testing import assert_close

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.evaluation.after_horizon import share_at_goal
from lyapnet.evaluation.oracles import oracle_of
from lyapnet.evaluation.references import costs_of_lqr
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import config_from_plain, load_config
from lyapnet.lab.comparison.planners.feedback import Regulator, Rest
from lyapnet.lab.comparison.planners.mpc import PredictiveControl
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.expansions import riccati
from tests.problems import problem_of

PERIOD = 2.0
TIMES = np.linspace(0, PERIOD, 41)
FINE = np.linspace(0, PERIOD, 1001)
SINE = {"t": TIMES.tolist(), "position": np.sin(np.pi * TIMES).tolist()}
TASK = {
    "experiment": "followed",
    "system": {"name": "double_integrator"},
    "cost": {"Q": [1, 0.1], "R": 0.1, "Q_T": [10, 1]},
    "initial_states": {"lower": -1, "upper": 1},
    "horizon": {"steps": 20, "dt": 0.05},
    "training": {"precision": "float64"},
    "reference": {"points": SINE, "periodic": True},
}


def problem(**changes):
    return build_problem(config_from_plain({**TASK, **changes}))


def on_reference(tau):
    """(r, ṙ, τ) and ü of the sine."""
    w = math.pi
    return torch.stack([torch.sin(w * tau), w * torch.cos(w * tau), tau], -1), -(w**2) * torch.sin(w * tau)[:, None]


@pytest.mark.parametrize("periodic", [True, False])
def test_following_costs_nothing_and_its_velocity_and_force_are_those_of_the_sine(periodic):
    task = problem(reference={"points": SINE, "periodic": periodic})
    z, u = on_reference(torch.linspace(0, PERIOD, 17))
    assert_close(task.rest_at(z), u, atol=0.05, rtol=0)  # a spline through 41 points
    assert_close(task.cost.running(z, u), torch.zeros(17), atol=2e-4, rtol=0)
    assert_close(task.cost.terminal(z), torch.zeros(17), atol=2e-4, rtol=0)
    assert (task.cost.running(z, -u)[1:-1:4] > 0.1).all()
    sooner = z[3:] - torch.tensor([0.0, 0.0, 0.3])
    assert (task.cost.state(sooner) > 0.01).all()
    assert_close(task.system.dynamics(z, u)[:, 2], torch.ones(17))


def test_at_another_speed_it_is_another_reference():
    task = problem(reference={"points": SINE, "periodic": True, "speed": 2})
    z, u = on_reference(torch.linspace(0, PERIOD, 9))
    fast = z * torch.tensor([1.0, 2.0, 0.5])
    assert_close(task.cost.running(fast, 4 * u), torch.zeros(9), atol=1e-4, rtol=0)
    assert (task.cost.running(fast, u)[1:-1:4] > 0.1).all()


def test_without_end_it_repeats():
    task = problem()
    z, _ = on_reference(torch.tensor([0.3, 0.7]))
    again = z + torch.tensor([0.0, 0.0, 3 * PERIOD])
    assert_close(task.cost.state(again), task.cost.state(z), atol=1e-9, rtol=0)
    assert_close(task.system.recurring(again), z)
    assert_close(task.initial_states.upper[2], torch.tensor(PERIOD))
    once = problem(reference={"points": SINE})
    assert_close(once.system.recurring(again), again)
    assert_close(once.initial_states.upper[2], torch.tensor(PERIOD - 1.0))  # there a horizon of 1 s still fits


@pytest.mark.gate
def test_the_optimum_about_a_reference_is_the_regulators():
    """For a linear system V(t, x, τ) = (x − r(τ))ᵀP(t)(x − r(τ)) with the P of the task about 0, if r can be followed.

    In the steps r is followed up to their error, which falls with Δt.
    """
    gaps = []
    for steps in (50, 100):
        horizon = {"steps": steps, "dt": 1 / steps}
        task = problem(horizon=horizon, rollout={"method": "rk4"})
        x0 = task.initial_states.sample(8, torch.Generator().manual_seed(0))
        found = oracle_of(task).solve(x0).cost
        alone = build_problem(
            config_from_plain({**TASK, "reference": {}, "horizon": horizon, "rollout": {"method": "rk4"}})
        )
        P, offset = riccati(alone).hessian[0] / 2, task.cost.from_goal(x0)[:, :2]
        expected = ((offset @ P) * offset).sum(-1)
        gaps.append(float(((found - expected).abs() / expected).max()))
    assert gaps[1] < 0.02
    assert gaps[1] < 0.75 * gaps[0]


class Clock(ValueFunction):
    """Some V that depends on the time on the reference."""

    def forward(self, t, x):
        return x[..., 0] * (1 + x[..., 2]) + 0 * t


def test_the_law_after_T_begins_each_period_anew():
    task = problem()
    controller = lyapnet.Controller(task, Clock(), policy=lyapnet.HJBPolicy, beyond="receding")
    z = torch.tensor([0.1, 0.2, 0.4])
    once, later = (controller.policy(5.0, z + torch.tensor([0.0, 0.0, k * PERIOD])) for k in (0, 4))
    assert_close(once, later)
    held = lyapnet.Controller(task, Clock(), policy=lyapnet.HJBPolicy, beyond="hold")
    assert held.problem.system.recurring(z) is not z


def test_an_estimator_knows_the_time_on_the_reference():
    task = problem(outputs={"measure": ["position"], "noise": 0.01})
    config = config_from_plain({**TASK, "outputs": {"measure": ["position"], "noise": 0.01}})
    controller = lyapnet.Controller(task, Clock(), policy=lyapnet.HJBPolicy, config=config)
    loop = controller.with_estimator()
    loop.step([0.1], **{"reference time": 0.5})
    loop.step([0.1])
    assert_close(loop.x_hat[2], np.float64(0.55))
    assert_close(loop.P[2], np.zeros(3))


def test_what_is_about_a_goal_that_stays_is_left_out_or_refused():
    task = problem()
    controller = lyapnet.Controller(task, Clock(), policy=lyapnet.HJBPolicy)
    assert controller.after_horizon().beyond == "receding"
    assert share_at_goal(controller, task.initial_states.sample(2)) is None
    assert costs_of_lqr(task, task.initial_states.sample(2)) is None
    with pytest.raises(UsageError, match="a goal that stays for a sound certificate, got a reference"):
        lyapnet.certify(controller, lyapnet.Funnel(alpha=0.5))
    with pytest.raises(UsageError, match="a goal that stays for lqr"):
        Regulator(task)
    z, u = on_reference(torch.tensor([0.3]))
    assert_close(torch.from_numpy(Rest(task).law()(0, z[0].numpy())), u[0], atol=0.05, rtol=0)
    assert not PredictiveControl(task, 10)._tail.parameters.any()
    assert PredictiveControl(problem(reference={}), 10)._tail.parameters.any()


def test_an_estimator_begins_at_the_beginning():
    config = config_from_plain({**TASK, "outputs": {"measure": ["position"], "noise": 0.01}})
    controller = lyapnet.Controller(build_problem(config), Clock(), policy=lyapnet.HJBPolicy, config=config)
    assert controller.with_estimator().x_hat[2] == 0


def test_what_no_control_follows_needs_a_control_to_count_from(caplog):
    """A cart-pole cannot follow a sine with its pole upright."""
    followed = {"t": SINE["t"], "cart position": SINE["position"]}
    changes = {"system": {"name": "cartpole"}, "cost": {"Q": 1, "R": 1, "Q_T": 1}}
    with pytest.raises(UsageError, match=r"that some control follows, .* left by any; give columns for other states"):
        problem(**changes, reference={"points": followed, "periodic": True})
    task = problem(**changes, reference={"points": followed, "periodic": True, "control": [0.5]})
    assert_close(task.rest_at(torch.rand(3, 5)), torch.full((3, 1), 0.5))
    assert "0 for pole angle" in caplog.text
    tau = torch.tensor([0.4])
    z = torch.cat([torch.sin(math.pi * tau), torch.zeros(1), math.pi * torch.cos(math.pi * tau), torch.zeros(1), tau])
    assert_close(task.cost.state(z), torch.tensor(0.0), atol=1e-4, rtol=0)


def test_a_reference_beyond_the_limits_is_told(caplog):
    problem(controls={"lower": -5, "upper": 5})
    assert "more than the limits of" in caplog.text


def points(**changes):
    return {"reference": {"points": {**SINE, **changes}, "periodic": True}}


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"reference": {"periodic": True}}, "reference.file or reference.points, got neither"),
        ({"reference": {"file": "r.csv"}}, "got reference.file 'r.csv', which is read where a YAML file is loaded"),
        (points(position=[math.nan, *SINE["position"][1:]]), "finite numbers in reference"),
        (points(t=[*SINE["t"][:-1], math.inf]), "finite numbers in reference"),
        (points(**{"cart_position": SINE["position"], "cart position": SINE["position"]}), "each state once"),
        ({"reference": {"points": SINE, "periodic": True, "speed": 50}}, "a reference of 8 steps"),
        (points(t=[0.0, 1.0]), "three or more rising times"),
        (points(t=[0.1, *SINE["t"][1:]]), "three or more rising times from 0"),
        (points(t=SINE["t"][::-1]), "three or more rising times"),
        (points(place=SINE["position"]), "t and position, velocity, got 'place'"),
        (points(velocity=[1.0, 2.0]), "41 numbers for velocity, one for each t, got 2"),
        (points(position=SINE["t"]), "to end where it begins, got position from 0 to 2"),
        ({"reference": {"points": {"t": SINE["t"]}}}, "a state in reference.points"),
        ({"reference": {"points": SINE}, "horizon": {"steps": 50, "dt": 0.05}}, "as long as the horizon, 2.5 s, got 2"),
        ({**points(), "target": [1, 0]}, "without target"),
        ({**points(), "family": {"target_position": [0, 1]}}, "without target"),
        ({"reference": {"points": SINE, "control": [1, 2]}}, "reference.control with one entry"),
        (points(t=FINE.tolist(), position=np.sign(np.sin(np.pi * FINE + 1)).tolist()), "smooth reference"),
    ],
)  # fmt: skip
def test_references_that_are_none(changes, reason):
    with pytest.raises(UsageError, match=reason) as raised:
        problem(**changes)
    assert "\n" not in str(raised.value)


def write(tmp_path, text, **reference):
    (tmp_path / "r.csv").write_text(text)
    own = {key: value for key, value in TASK.items() if key != "reference"}
    lines = [f"{key}: {value}" for key, value in {**own, "reference": {"file": "r.csv", **reference}}.items()]
    (tmp_path / "task.yaml").write_text("\n".join(lines).replace("'", '"').replace("True", "true"))
    return tmp_path / "task.yaml"


def test_points_are_read_from_a_file_beside_the_yaml_and_kept(tmp_path):
    rows = "\n".join(f"{t:.9g},{y:.9g}" for t, y in zip(SINE["t"], SINE["position"], strict=True))
    config = load_config(write(tmp_path, f"t, position\n{rows}\n", periodic=True))
    assert config.reference.file == ""
    assert_close(torch.tensor(config.reference.points["position"]), torch.tensor(SINE["position"]))
    z, _ = on_reference(torch.tensor([0.3, 1.1]))
    assert_close(build_problem(config).cost.state(z), problem().cost.state(z), atol=1e-9, rtol=0)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "row of different names"),
        ("t,position\n0,0\n", "2 to 10000 rows"),
        ("t,t\n0,0\n1,1\n2,2\n", "different names"),
        ("t,position\n0,0\n1\n2,2\n", "2 numbers in row 3"),
        ("t,position\n0,0\n1,one\n2,2\n", "got 'one' for position in row 3"),
        ("t,position\n0,0\n1,nan\n2,2\n", "got 'nan' for position in row 3"),
        ("t,position\n" + "0,0\n" * 10_001, "2 to 10000 rows"),
    ],
)  # fmt: skip
def test_files_of_points_that_are_none(tmp_path, text, reason):
    with pytest.raises(UsageError, match=reason) as raised:
        load_config(write(tmp_path, text))
    assert "\n" not in str(raised.value)


def test_a_file_that_is_not_there_or_one_besides_points(tmp_path):
    path = write(tmp_path, "t,position\n0,0\n1,1\n2,0\n")
    (tmp_path / "r.csv").unlink()
    with pytest.raises(UsageError, match=r"Expected a CSV file, got .*r.csv"):
        load_config(path)
    with pytest.raises(UsageError, match=r"reference.file or reference.points, got both"):
        load_config(path, ["reference.points={t: [0, 1, 2]}"])


def test_a_system_has_nothing_to_follow_unless_told():
    assert problem_of(lyapnet.task.systems.DoubleIntegrator()).system.settings == ()


def test_random_plants_are_refused():
    config = config_from_plain({**TASK, "randomise": {"mass": [0.9, 1]}})
    controller = lyapnet.Controller(build_problem(config), Clock(), policy=lyapnet.HJBPolicy, config=config)
    with pytest.raises(UsageError, match="Expected randomise without reference, got both"):
        assert controller.plants

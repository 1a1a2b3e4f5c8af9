"""Constant disturbances of controls: estimated from readings, and taken off by the law."""

import numpy as np
import pytest
import torch

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.evaluation import evaluate
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import config_from_plain
from lyapnet.value.expansions import riccati
from tests.problems import OfExpansion

DT, STEPS, SIGMA, NOISE = 0.05, 400, 0.05, 0.01
TASK = {
    "experiment": "offset",
    "system": {"name": "double_integrator"},
    "cost": {"Q": [4, 1], "R": 0.1, "Q_T": [4, 1]},
    "initial_states": {"lower": -1, "upper": 1},
    "horizon": {"steps": STEPS, "dt": DT},
    "outputs": {"measure": ["position"], "noise": NOISE},
}
ESTIMATED = {"outputs": TASK["outputs"] | {"input_disturbances": {"force": SIGMA}}}


def controller_of(**changes):
    config = config_from_plain({**TASK, **changes})
    problem = build_problem(config)
    V = OfExpansion(problem, riccati(problem)).to(problem.initial_states.lower.dtype)
    return lyapnet.Controller(problem, V, config=config)


def run(controller, loop, d, steps=STEPS, x=(0.5, 0.0)):
    """States and controls of the task's own steps under u + d, from exact readings; d: a function of the step."""
    x, states, controls = torch.tensor([x]).double(), [], []
    for k in range(steps):
        states.append(x)
        controls.append(loop.step(x[:, :1]).double())
        x = controller.problem.step(x.to(controller.problem.goal), (controls[-1] + d(k)).to(controller.problem.goal))[0]
        x = x.double()
    return torch.cat(states), torch.cat(controls)


@pytest.mark.gate
@pytest.mark.parametrize("kind", ["ekf", "ukf"])
def test_a_constant_disturbance_leaves_no_offset(kind):
    controller = controller_of(**ESTIMATED)
    with_estimate, without = controller.with_estimator(kind), controller.with_estimator(kind, input_disturbances={})
    x, u = run(controller, with_estimate, lambda k: 0.7)
    assert x[-1].abs().max() < 1e-4
    assert float(with_estimate.d_hat) == pytest.approx(0.7, abs=1e-3)
    assert float(u[-1]) == pytest.approx(-0.7, abs=1e-3)
    x, _ = run(controller, without, lambda k: 0.7)
    assert abs(float(x[-1, 0])) > 0.1
    assert without.d_hat.shape == (1, 0)


def test_the_estimate_is_that_of_a_kalman_filter_written_in_numpy():
    """On (position, velocity, disturbance), by the information form of the update."""
    controller = controller_of(**ESTIMATED)
    loop, rng = controller.with_estimator(), np.random.default_rng(0)
    step = controller.problem.step
    zero, one = torch.zeros(1, 1).double(), torch.ones(1, 1).double()
    columns = [step(each[None], zero)[0][0] for each in torch.eye(2).double()] + [
        step(torch.zeros(1, 2).double(), one)[0][0]
    ]
    A = np.vstack([torch.stack(columns, 1).numpy(), [0, 0, 1]])
    walk = 1e-4 * np.r_[np.full(2, 2 / np.sqrt(12)), 0] / np.sqrt(STEPS * DT)  # which keeps the filter awake
    Q = DT * np.diag(np.r_[walk[:2], SIGMA] ** 2)
    x, P = np.zeros(3), np.diag([4 / 12, 4 / 12, SIGMA**2 * STEPS * DT])
    H, u = np.array([[1.0, 0, 0]]), None
    for _ in range(60):
        y = rng.normal(size=1)
        if u is not None:
            x = A @ x + np.r_[A[:2, 2] * u, 0]
            P = A @ P @ A.T + Q
        information = np.linalg.inv(P) + H.T @ H / NOISE**2
        P = np.linalg.inv(information)
        x = x + P @ H.T @ (y - H @ x) / NOISE**2
        u = float(loop.step(y)[0])
        np.testing.assert_allclose(loop.x_hat, x, rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(loop.P, P, rtol=1e-5, atol=1e-9)
        expected = controller.law(torch.tensor(loop.t).double(), torch.from_numpy(x[:2])) - x[2]
        assert u == pytest.approx(float(expected.detach()), rel=1e-6, abs=1e-7)


@pytest.mark.gate
def test_nothing_winds_up_at_a_limit():
    """A disturbance beyond what the control can take is known all the same, as the prediction knows the limits."""
    controller = controller_of(**ESTIMATED, controls={"lower": -1, "upper": 1})
    loop = controller.with_estimator()
    x, u = run(controller, loop, lambda k: 1.5 if k < 60 else 0.2)
    assert u.abs().max() == 1
    assert (u[20:60] == -1).all()
    assert x[-1].abs().max() < 1e-3
    assert float(loop.d_hat) == pytest.approx(0.2, abs=1e-2)
    again = controller.with_estimator()
    assert run(controller, again, lambda k: 1.5, steps=60)[1].abs().max() == 1
    assert float(again.d_hat) == pytest.approx(1.5, abs=0.05)


def test_a_law_of_single_precision_keeps_its_limits():
    pendulum = {
        "system": {"name": "pendulum"},
        "outputs": {"measure": ["angle"], "noise": NOISE, "input_disturbances": {"torque": SIGMA}},
    }
    controller = controller_of(**pendulum, controls={"lower": -0.1, "upper": 0.3}, training={"precision": "float32"})
    loop = controller.with_estimator()
    u = loop.step(torch.linspace(-3, 3, 7)[:, None])
    assert u.dtype == torch.float32
    assert controller.problem.controls.contains(u).all()
    assert u.max() == controller.problem.controls.upper.max()


@pytest.mark.gate
def test_an_evaluation_draws_disturbances_about_which_the_filter_is_not_too_sure():
    """They are constant, where the filter lets them drift: its covariance is larger than the errors."""
    controller = controller_of(**ESTIMATED)
    found = evaluate(controller, 300, optimum=False)["outputs"]
    assert 0.3 < found["nees"] < 1
    assert found["cost_ratio"] < 0.99, "with the state known, disturbances leave an offset"
    assert list(found["errors"])[-1] == "disturbance of force (N)"


@pytest.mark.parametrize(
    ("outputs", "told"),
    [
        ({"input_disturbances": {"push": 0.1}}, "outputs.input_disturbances among force, got 'push'"),
        ({"input_disturbances": {"force": 0.0}}, "input_disturbances"),
        ({"noise": None, "measure": [], "input_disturbances": {"force": 0.1}}, "outputs.noise"),
    ],
)
def test_what_does_not_fit_is_refused(outputs, told):
    with pytest.raises(UsageError, match=told):
        controller_of(outputs=TASK["outputs"] | outputs)


def test_more_disturbances_than_readings_are_refused():
    quadrotor = {
        "experiment": "two",
        "system": {"name": "planar_quadrotor"},
        "cost": {"Q": [1] * 6, "R": [0.1, 0.1], "Q_T": [1] * 6},
        "initial_states": {"lower": -0.1, "upper": 0.1},
        "horizon": {"steps": 20, "dt": 0.02},
    }
    names = list(build_problem(config_from_plain(quadrotor)).system.control_names)
    outputs = {"measure": ["x"], "noise": 0.01, "input_disturbances": dict.fromkeys(names, 0.1)}
    with pytest.raises(UsageError, match=r"at most as many .* as readings, 1, got 2"):
        build_problem(config_from_plain({**quadrotor, "outputs": outputs}))


def test_a_drift_may_be_a_number_of_numpy():
    loop = controller_of(**TASK).with_estimator(input_disturbances={"force": np.float64(SIGMA)})
    assert loop.d_hat.shape == (1,)
    with pytest.raises(UsageError, match="input_disturbances"):
        controller_of(**TASK).with_estimator(input_disturbances={"force": np.float64(0)})

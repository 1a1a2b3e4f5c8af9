"""A controller that reads outputs: one loop is one of a batch, limits hold, families, random plants; and refusals."""

import math

import numpy as np
import pytest
import torch
from torch.testing import assert_close

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly import Parts, build_problem
from lyapnet.experiment.config import config_from_plain
from lyapnet.task.systems import Pendulum
from lyapnet.value.expansions import riccati
from tests.problems import OfExpansion

TASK = {
    "experiment": "outputs",
    "system": {"name": "pendulum"},
    "cost": {"Q": [1, 0.1], "R": 0.1, "Q_T": [2, 1]},
    "initial_states": {"lower": -1, "upper": 1},
    "controls": {"lower": -0.5, "upper": 0.5},
    "horizon": {"steps": 20, "dt": 0.05},
    "outputs": {"measure": ["angle"], "noise": 0.01},
}


def controller_of(**changes):
    """One with the V of the Riccati solution."""
    config = config_from_plain({**TASK, **changes})
    problem = build_problem(config)
    V = OfExpansion(problem, riccati(problem)).to(problem.initial_states.lower.dtype)
    return lyapnet.Controller(problem, V, config=config)


class Seen(Pendulum):
    """A pendulum of which a camera sees sine and cosine of the angle."""

    def output(self, x):
        return torch.stack([torch.sin(x[..., 0]), torch.cos(x[..., 0])], -1)


@pytest.mark.parametrize("kind", ["ekf", "ukf"])
def test_one_loop_by_numpy_is_one_of_a_batch(kind):
    controller = controller_of()
    y = 0.3 * torch.randn(6, 4, 1, generator=torch.Generator().manual_seed(1))
    batch = controller.with_estimator(kind)
    u = torch.stack([batch.step(each) for each in y])
    for i in range(4):
        one = controller.with_estimator(kind)
        alone = np.stack([one.step(each.numpy()) for each in y[:, i]])
        assert isinstance(one.x_hat, np.ndarray)
        assert_close(torch.from_numpy(alone), u[:, i])
        assert_close(torch.from_numpy(one.P), batch.P[i])
        assert one.t == batch.t == pytest.approx(5 * 0.05)
    assert u.abs().max() == 0.5  # the limits hold
    assert not torch.equal(u[:, 0], u[:, 1])


def test_the_first_control_knows_the_first_reading():
    """It is the law at the estimate; without its reading it would be the law at the centre of X₀."""
    controller = controller_of()
    feedback = controller.with_estimator(noise=1e-6)
    assert_close(feedback.x_hat, np.zeros(2))
    u = feedback.step([0.7])
    assert feedback.t == 0
    assert_close(feedback.x_hat, np.array([0.7, 0.0]), rtol=1e-5, atol=1e-5)
    assert_close(u, controller.policy(0.0, feedback.x_hat))
    assert not np.allclose(u, controller.policy(0.0, np.zeros(2)))


def test_each_call_predicts_by_a_step_under_the_control_that_was_applied():
    controller, missing = controller_of(), [math.nan]
    for given in (None, [0.2]):
        feedback = controller.with_estimator()
        u, before = feedback.step([0.7]), feedback.x_hat
        feedback.step(missing, applied=given)
        applied = torch.as_tensor(u if given is None else given)
        expected = controller.problem.step(torch.from_numpy(before), applied)[0]
        assert_close(torch.from_numpy(feedback.x_hat), expected)


@pytest.mark.parametrize("delay", [1, 4])
def test_after_a_delay_the_loop_is_the_one_without_from_where_the_plant_then_is(delay):
    """Of a plant like the model: rest acts for the delay, and then the law acts on the state at its own time."""
    controller = controller_of(controls={})
    problem, known = controller.problem, {"noise": 1e-7, "initial_deviation": 1e-6}

    def path_of(loop, steps):
        loop.reset(x.numpy())
        states, controls = [x], []
        for _ in range(steps):
            loop.step(states[-1][:1].numpy())
            controls.append(torch.as_tensor(loop.acting))
            states.append(problem.step(states[-1], controls[-1])[0].detach())
        return torch.stack(states), torch.stack(controls)

    x = torch.tensor([0.7, -0.4], dtype=torch.float64)
    states, controls = path_of(controller.with_estimator(delay=delay, **known), 20)
    assert_close(controls[:delay], torch.zeros(delay, 1, dtype=torch.float64))
    following = states[delay]
    for k in range(delay, 20):
        u = torch.as_tensor(controller.policy(k * 0.05, following.numpy()))
        assert_close(controls[k], u, rtol=1e-4, atol=1e-5)
        following = problem.step(following, u)[0].detach()
    without, _ = path_of(controller.with_estimator(**known), 20)
    assert not torch.allclose(without[-1], states[-1], atol=1e-3)


def test_a_plant_with_dead_time_is_steady_under_a_loop_that_knows_it_alone():
    """A lasting law whose dead time of 0.4 s is not told makes the pendulum swing ever more."""
    controller = controller_of(
        controls={}, horizon={"steps": 200, "dt": 0.05}, cost={"Q": [10, 1], "R": 0.1, "Q_T": [10, 1]}
    )
    problem, delay, last = controller.problem, 8, {}
    for told in (0, delay):
        loop = controller.with_estimator(noise=1e-4, delay=told)
        x, commands = torch.tensor([0.2, 0.0], dtype=torch.float64), [torch.zeros(1, dtype=torch.float64)] * delay
        for k in range(150):
            commands.append(torch.as_tensor(loop.step(x[:1].numpy(), applied=commands[max(k - 1, 0)].numpy())))
            x = problem.step(x, commands[k])[0].detach().clamp(-100, 100)
        last[told] = float(x.abs().max())
    assert last[delay] < 0.01 < 1 < last[0]


def test_acting_before_the_first_readings_is_refused():
    with pytest.raises(ValueError, match="Expected acting after a call of step, got none since the reset"):
        controller_of().with_estimator(delay=2).acting  # noqa: B018


def test_reset_begins_with_an_estimate_at_a_time():
    feedback = controller_of().with_estimator()
    feedback.step([0.7])
    P = np.diag([1e-12, 0.04])
    feedback.reset([0.5, 0.1], P, t=0.4)
    assert_close(feedback.P, P)
    feedback.step([0.7])
    assert feedback.t == 0.4
    assert_close(feedback.x_hat, np.array([0.5, 0.1]), rtol=0, atol=1e-6)
    feedback.reset()
    assert_close(feedback.x_hat, np.zeros(2))


def test_a_controller_that_was_trained_without_outputs_gets_them():
    controller = controller_of(outputs={})
    with pytest.raises(UsageError, match="Expected outputs for an estimator, got none"):
        controller.with_estimator()
    feedback = controller.with_estimator("ukf", measure=["velocity"], noise=[0.1], initial_deviation=0.2)
    assert feedback.step(torch.zeros(3, 1)).shape == (3, 1)
    assert_close(controller_of().with_estimator(noise=0.5).outputs.noise, torch.tensor([0.5]))


def test_the_output_of_a_system_of_ones_own_is_read():
    config = config_from_plain({**TASK, "outputs": {"noise": [0.01, 0.02]}})
    parts = Parts(system=Seen())
    problem = build_problem(config, parts)
    controller = lyapnet.Controller(problem, OfExpansion(problem, riccati(problem)), config=config, parts=parts)
    feedback = controller.with_estimator()
    for _ in range(5):
        feedback.step([math.sin(0.5), math.cos(0.5)])
    assert feedback.P[0, 0] < 0.01**2
    assert [*feedback.outputs.names] == ["reading 1", "reading 2"]


def test_a_family_is_told_its_estimated_parameters():
    controller = controller_of(family={"length": [0.5, 1.5]})
    feedback = controller.with_estimator()
    u = feedback.step([0.7])
    assert feedback.x_hat.shape == (3,)
    assert_close(u, controller.policy(0.0, feedback.x_hat[:2], length=feedback.x_hat[2]))


def test_parameters_of_random_plants_are_estimated_and_the_law_is_not_told():
    """From readings of a pendulum twice as long its length is found; the law still is that of the model."""
    controller = controller_of(randomise={"length": [0.5, 2.5]}, controls={})
    plants, feedback = controller.plants, controller.with_estimator()
    assert plants is not None
    z = torch.tensor([0.5, 0.0, 2.0])
    for _ in range(60):
        u = feedback.step(z[:1])
        assert_close(u, controller.policy(feedback.t, torch.as_tensor(feedback.x_hat)[..., :2]), rtol=1e-9, atol=1e-9)
        z = plants.problem.step(z, u)[0].detach()
    assert abs(float(feedback.x_hat[2]) - 2.0) < 0.2 < abs(1.5 - 2.0)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda c: c.with_estimator("kf"), "Expected an estimator as one of ekf, ukf, got 'kf'"),
        (lambda c: c.with_estimator(measure=["speed"]), "Expected outputs.measure among angle, velocity, got 'speed'"),
        (lambda c: c.with_estimator(measure=["angle", "angle"]), "with each state once, got angle twice"),
        (lambda c: c.with_estimator(noise=[0.1, 0.1]), "Expected outputs.noise with one entry"),
        (lambda c: c.with_estimator(noise=-0.1), "Expected outputs.noise > 0"),
        (lambda c: c.with_estimator(noise=0), "Expected outputs.noise > 0"),
        (lambda c: c.with_estimator(delay=-1), "Expected outputs.delay ≥ 0, got -1"),
        (lambda c: c.with_estimator(measure=[]), "Expected outputs.measure, or a method output"),
        (lambda c: c.with_estimator(process_noise={"angle": -1}), "Expected outputs.process_noise.angle ≥ 0"),
        (lambda c: c.with_estimator(process_noise={"speed": 1}), "Expected outputs.process_noise among angle"),
        (lambda c: c.with_estimator(initial_deviation=[1, 2, 3]), "Expected outputs.initial_deviation with 2 entries"),
        (lambda c: c.with_estimator().step([0.1, 0.2]), r"Expected y of shape \(\*batch, 1\), got \(2,\)"),
        (lambda c: c.with_estimator().step([math.inf]), "Expected finite readings"),
        (lambda c: c.with_estimator().reset([0.0]), r"Expected x_hat of shape \(\*batch, 2\), got \(1,\)"),
        (lambda c: c.with_estimator().reset(P=[[1, 2], [0, 1]]), "symmetric and positive semidefinite"),
        (lambda c: c.with_estimator().reset(P=[[1, 0], [0, -1]]), "symmetric and positive semidefinite"),
    ],
)  # fmt: skip
def test_bad_input_gets_one_line(call, message):
    with pytest.raises((UsageError, ValueError), match=message) as error:
        call(controller_of())
    assert "\n" not in str(error.value)


def test_a_batch_keeps_its_size():
    feedback = controller_of().with_estimator()
    feedback.step(np.zeros((3, 1)))
    with pytest.raises(ValueError, match=r"Expected y of shape \(3, 1\), got \(4, 1\)"):
        feedback.step(np.zeros((4, 1)))
    feedback.reset(np.zeros((2, 2)))
    with pytest.raises(ValueError, match="Expected readings of as many loops"):
        feedback.step(np.zeros((3, 1)))


def test_a_law_of_single_precision_is_fed_by_a_filter_of_double_precision():
    """P, 10⁻¹² here, would be lost in the rounding of single precision."""
    controller = controller_of(training={"precision": "float32"})
    feedback = controller.with_estimator(noise=1e-6)
    for _ in range(5):
        u = feedback.step(torch.tensor([0.5]))
    assert (u.dtype, feedback.belief.P.dtype) == (torch.float32, torch.float64)
    assert 0 < feedback.belief.P[0, 0] < 1.1e-12


@pytest.mark.parametrize(("applied", "told"), [([0.1, 0.2], "shape"), ([math.nan], "finite")])
def test_an_applied_control_that_is_none_is_refused(applied, told):
    feedback = controller_of().with_estimator()
    feedback.step([0.1])
    with pytest.raises(ValueError, match=f"applied as .*{told}"):
        feedback.step([0.1], applied=applied)


@pytest.mark.parametrize("wrong", [{"x_hat": [math.nan, 0.0]}, {"t": math.nan}])
def test_a_reset_to_what_is_no_number_is_refused(wrong):
    with pytest.raises(ValueError, match="finite x_hat and t"):
        controller_of().with_estimator().reset(**wrong)


def test_estimated_parameters_stay_in_their_ranges():
    feedback = controller_of(randomise={"length": [0.5, 1.5]}, controls={}).with_estimator()
    generator = torch.Generator().manual_seed(0)
    for _ in range(15):
        feedback.step(torch.randn(200, 1, generator=generator).double())
    assert feedback.x_hat[:, 2].min() == 0.5
    assert feedback.x_hat[:, 2].max() == 1.5


def test_estimates_at_an_end_of_a_range_are_named():
    """A pendulum of 3 m while 0.5 to 1.5 m are known; one of 1 m is in the middle."""
    config = {"randomise": {"length": [0.5, 1.5], "mass": [1, 1]}, "horizon": {"steps": 100, "dt": 0.02}}
    for length, expected in ((3.0, ["length"]), (1.0, [])):
        feedback = controller_of(**config, controls={}).with_estimator()
        assert feedback.at_range_end == []
        plant, x = feedback.problem, torch.tensor([[0.5, 0.0, length, 1.0], [0.5, 0.0, 1.0, 1.0]]).double()
        for _ in range(60):
            u = feedback.step(x[:, :1])
            x = plant.step(x, u.double())[0]
        assert feedback.at_range_end == expected, "in any loop of the batch"
    assert controller_of().with_estimator().at_range_end == []


SETPOINTS = {"family": {"target_angle": [-0.5, 0.5]}, "controls": {"lower": -20, "upper": 20}}


def test_a_setpoint_is_told_and_begins_the_horizon_anew():
    controller = controller_of(**SETPOINTS)
    feedback = controller.with_estimator(noise=1e-5)
    u = [feedback.step([0.3], target_angle=0.2), *(feedback.step([0.3]) for _ in range(3))]
    assert_close(feedback.x_hat[2], np.float64(0.2))
    assert_close(feedback.P[2], np.zeros(3))
    for k, each in enumerate(u[-1:], 3):
        assert_close(each, controller.policy(k * 0.05, feedback.x_hat), rtol=1e-4, atol=1e-4)
    changed = feedback.step([0.3], target_angle=-0.4)
    at_start, later = (controller.policy(t, feedback.x_hat) for t in (0.0, 0.2))
    assert_close(changed, at_start, rtol=1e-4, atol=1e-4)
    assert abs(at_start - later) > 1e-3  # the clock matters
    assert feedback.t == pytest.approx(0.2)
    feedback.step([0.3], target_angle=-0.4)  # the same again: the horizon goes on
    assert_close(feedback.step([0.3]), controller.policy(0.1, feedback.x_hat), rtol=1e-4, atol=1e-4)


def test_each_loop_of_a_batch_has_its_own_setpoint():
    controller, y = controller_of(**SETPOINTS), torch.full((3, 1), 0.1)
    goals = torch.tensor([-0.5, 0.0, 0.4])
    together = controller.with_estimator().step(y, target_angle=goals)
    for k in range(3):
        assert_close(controller.with_estimator().step(y[k], target_angle=float(goals[k])), together[k])
    assert together.unique().numel() == 3


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"target_angel": 0.1}, "settings among target_angle, got 'target_angel'"),
        ({"target_angle": 0.6}, "target_angle from -0.5 to 0.5"),
        ({"target_angle": math.nan}, "target_angle from -0.5 to 0.5"),
        ({"target_angle": [0.1, 0.2]}, "target_angle as a number"),
    ],
)
def test_settings_that_do_not_exist_are_refused(settings, reason):
    feedback = controller_of(**SETPOINTS).with_estimator()
    with pytest.raises(ValueError, match=reason):
        feedback.step([0.1], **settings)
    with pytest.raises(ValueError, match="settings among none"):
        controller_of().with_estimator().step([0.1], **settings)


def test_a_weight_of_the_cost_is_told_as_it_is():
    """Not its logarithm, which is what V knows."""
    controller = controller_of(family={"cost.R.0": [0.01, 1]}, controls={"lower": -20, "upper": 20})
    feedback = controller.with_estimator()
    u = feedback.step([0.3], R_torque=0.02)
    assert_close(feedback.x_hat[2], np.log10(0.02))
    assert_close(u, controller.policy(0.0, feedback.x_hat[:2], R_torque=0.02))
    assert not np.allclose(u, controller.policy(0.0, feedback.x_hat[:2], R_torque=0.5))
    with pytest.raises(ValueError, match=r"R_torque from 0.01 to 1, .* got 2"):
        feedback.step([0.3], R_torque=2)

"""Disturbances hit the plant and not the policy, and are measured against the optimum of the disturbed task."""

import math

import pytest
import torch
from scipy.linalg import solve_continuous_are
from torch.testing import assert_close

from lyapnet.controller.controller import Controller
from lyapnet.evaluation import robustness
from lyapnet.evaluation.robustness import (
    LatePolicy,
    disturbances,
    not_varied,
    physical_parameters,
    unchanged_parameters,
)
from lyapnet.evaluation.tables import robustness_table
from lyapnet.loop.rollout import Rollout
from lyapnet.task.cost import QuadraticCost
from lyapnet.task.systems import DoubleIntegrator, Linear
from lyapnet.value.expansions import riccati
from lyapnet.value.policy import SampledPolicy
from tests.problems import Formula, OfExpansion, Quadratic, problem_of, untrained

SMALL = ["network.hidden=[4,4]", "horizon.steps=20"]


@pytest.fixture
def controller():
    return untrained("double_integrator", *SMALL)


def by_name(controller, samples=50):
    return {disturbance.name: disturbance for disturbance in disturbances(controller, samples, 0)}


def test_states_outside_are_outside_and_not_far():
    controller = untrained("cartpole_balancing", *SMALL)
    X0, found = controller.initial_states, by_name(controller)
    for name, outside in (("none", False), ("x₀ up to 20% outside X₀", True)):
        x0 = found[name].x0
        reach = ((x0 - X0.center) / (X0.widths / 2)).abs().amax(-1)
        assert (reach > 1).all() == outside
        assert (reach <= 1.2 + 1e-12).all()
        assert reach.std() > 0.01


def test_a_fixed_component_stays_fixed():
    x0 = by_name(untrained("cartpole_swingup", *SMALL))["x₀ up to 20% outside X₀"].x0
    assert (x0[:, [0, 2, 3]] == 0).all()
    assert ((x0[:, 1] - torch.pi).abs() > 0.3).all()


def test_each_parameter_changes_the_plant_alone():
    controller = untrained("cartpole_swingup", *SMALL)
    found, x, u = by_name(controller, 3), torch.randn(5, 4).double(), torch.randn(5, 1).double()
    names = ("cart mass", "length", "pole damping", "pole mass")  # the cart has no damping, gravity is what it is
    expected = {f"{name} {share}" for name in names for share in ("-20%", "+20%")}
    assert {name for name in found if name.endswith(("-20%", "+20%"))} == expected
    lighter = untrained("cartpole_swingup", *SMALL, "system.parameters.pole_mass=0.8").system
    assert_close(found["pole mass -20%"].problem.system.dynamics(x, u), lighter.dynamics(x, u))
    assert not torch.allclose(found["pole mass -20%"].problem.system.dynamics(x, u), controller.system.dynamics(x, u))
    assert all(
        one.policy is controller.closed_loop.policy
        for name, one in found.items()
        if "noise" not in name and "late" not in name
    )
    assert controller.system.pole_mass == 1


class Loaded(Linear):
    """A joint, with a torque called gravity."""

    def __init__(self, gravity: float = 0.6, links: int = 3, friction: float = 0.0):
        super().__init__([[0.0, 1.0], [gravity, -friction]], [[0.0], [1.0]])


@pytest.mark.parametrize(("gravity", "varied"), [(0.6, True), (1.62, True), (9.81, False), (9.8, False), (9, True)])
def test_a_parameter_called_gravity_stays_where_it_is_that_of_the_earth(gravity, varied):
    parameters = {"gravity": gravity, "links": 3, "friction": 0.0}
    system = Loaded(**parameters)
    assert physical_parameters(system, parameters) == ({"gravity": gravity} if varied else {})
    reasons = unchanged_parameters(system, parameters)
    assert reasons == {
        **({} if varied else {"gravity": f"{gravity:g} m/s² of the Earth"}),
        "links": "no real number",
        "friction": "0, not positive",
    }


def test_what_has_no_row_is_named_below_the_table():
    unchanged = not_varied(untrained("cartpole_swingup", *SMALL))
    assert unchanged == {"cart_damping": "0, not positive", "gravity": "9.81 m/s² of the Earth"}
    for given, ends in (
        (unchanged, "Not varied: cart damping (0, not positive), gravity (9.81 m/s² of the Earth)"),
        ({}, "known"),
    ):
        assert str(robustness_table([], 3, {}, False, given).caption).endswith(ends)


def test_noise_is_on_what_the_policy_reads(controller):
    found, x, t = by_name(controller), torch.randn(4000, 2).double(), torch.tensor(0.1)
    noisy, clean = found["noise of 1% on the state"].policy, found["none"].policy
    assert not torch.equal(noisy(t, x), clean(t, x))
    assert not torch.equal(noisy(t, x), noisy(t, x)), "drawn anew"
    noisy.policy = torch.nn.Module()
    noisy.policy.forward = lambda t, x: x
    extent = controller.rollout(found["none"].x0).x.abs().amax((0, 1))
    assert_close((noisy(t, x) - x).std(0), 0.01 * extent, rtol=0.05, atol=0)


def test_a_late_control_is_that_of_the_state_before(controller):
    found = by_name(controller, 3)
    problem, law = controller.problem, controller.policy
    x = found["none"].x0
    for name, predicts in (("u one sample late", False), ("u one sample late, predicted", True)):
        path = Rollout(problem, found[name].policy, controller.method, "backprop")(x)
        now, u, times = x, torch.zeros(3, 1).double(), problem.horizon.times(x)
        for n in range(problem.horizon.steps):
            assert_close(path.x[n], now)
            following, _ = problem.step(now, u)
            now, u = following, law(times[n + 1], following) if predicts else law(times[n], now)
        assert_close(path.x[-1], now)


def test_a_prediction_of_the_model_loses_the_first_control_alone():
    """A double integrator under its optimal law of the steps."""
    problem = problem_of(DoubleIntegrator(), QuadraticCost(torch.eye(2), torch.eye(1), torch.eye(2)), 40, 0.1)
    V = OfExpansion(problem, riccati(problem))
    law, x0 = SampledPolicy(problem, V), torch.tensor([[1.0, 0.0], [0.5, -0.5]]).double()
    late, predicted = (
        Rollout(problem, LatePolicy(law, problem, predicts), gradient="backprop")(x0).cost for predicts in (False, True)
    )
    following, paid = problem.step(x0, torch.zeros(2, 1).double())
    assert_close(predicted, paid + V(torch.tensor(0.1), following))
    assert (late > predicted * 1.003).all()


def test_rows_are_ratios_to_the_optimum_of_the_disturbed_task(controller):
    rows = {row.disturbance: row for row in robustness.robustness(controller, 20)}
    undisturbed, finer, heavier = rows["none"], rows["half the Δt"], rows["mass +20%"]
    x0 = by_name(controller, 20)["none"].x0
    assert undisturbed.cost_mean == pytest.approx(float(controller.rollout(x0).cost.mean()), rel=1e-12)
    for row in rows.values():
        assert row.cost_ratio == pytest.approx(row.cost_mean / row.optimal_cost_mean)
        assert row.cost_ratio >= 1
    assert finer.optimal_cost_mean == pytest.approx(undisturbed.optimal_cost_mean, rel=0.1)
    assert finer.optimal_cost_mean != undisturbed.optimal_cost_mean
    rollout = Rollout(by_name(controller, 20)["mass +20%"].problem, controller.closed_loop.policy, gradient="backprop")
    assert heavier.cost_mean == pytest.approx(float(rollout(x0).cost.mean()), rel=1e-12)
    assert heavier.cost_mean != pytest.approx(undisturbed.cost_mean, rel=1e-6)


def test_the_law_of_continuous_time_is_optimal_in_the_row_of_that_name():
    """Where φ is the steady state of the Riccati equation, V is that at all times."""
    system, Q, R = DoubleIntegrator(), torch.diag(torch.tensor([10.0, 0.1])), torch.eye(1)
    P = torch.from_numpy(solve_continuous_are(system.A, system.B, Q, R))
    steady = Controller(problem_of(system, QuadraticCost(Q, R, P), 100, 0.04), Quadratic(P))
    rows = {row.disturbance: row for row in robustness.robustness(steady, 20)}
    assert rows["continuous time"].cost_ratio == pytest.approx(1, abs=1e-6)
    assert rows["none"].cost_ratio > 1.001


def test_a_law_that_is_made_to_be_held_is_held_in_continuous_time():
    """The sampled law of one step, by hand: u = −(ΔtR + ΔtPΔt)⁻¹ΔtP(1 + Δta)x0, under exact exponentials."""
    a, dt, P = 0.5, 0.4, 3.0
    problem = problem_of(Linear([[a]], [[1.0]]), QuadraticCost([[0.0]], [[1.0]], [[P]]), 1, dt)
    V = Formula(lambda t, x: P * x[..., 0] ** 2)
    V.curvature = lambda t: torch.tensor([[2 * P]])
    controller = Controller(problem, V, Rollout(problem, SampledPolicy(problem, V)))
    row = {each.disturbance: each for each in robustness.robustness(controller, 30)}["continuous time, u held for Δt"]
    x0 = by_name(controller, 30)["none"].x0
    u = -P * (1 + dt * a) * x0 / (1 + P * dt)
    grown, pushed = math.exp(a * dt), (math.exp(a * dt) - 1) / a
    cost = (dt * u**2 + P * (grown * x0 + pushed * u) ** 2).mean()
    best = P * grown**2 * dt / (dt + P * pushed**2) * (x0**2).mean()
    assert row.cost_mean == pytest.approx(float(cost), rel=1e-4)
    assert 0.99 * best < row.optimal_cost_mean < best, "of a linear task it is the optimum without holding"
    assert row.cost_ratio > 1.0005, "the law was made for Euler's step"


def test_a_loop_that_diverges_is_a_row_too(controller, monkeypatch):
    for p in controller.V.parameters():
        p.data.mul_(1e200)
    with pytest.raises(Exception, match="finite"):
        controller.rollout(by_name_x0(controller))
    monkeypatch.setattr(robustness, "magnitude", lambda controller, x0: torch.ones(2).double())
    assert all(row.cost_mean is None and row.cost_ratio is None for row in robustness.robustness(controller, 3))


def by_name_x0(controller):
    return controller.initial_states.sample(3, torch.Generator().manual_seed(0))


def test_no_sample_is_refused(controller):
    with pytest.raises(ValueError, match="samples ≥ 1"):
        robustness.robustness(controller, 0)

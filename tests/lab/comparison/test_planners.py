"""LQR, iLQR and MPC against optima of other routes; each with a twin that fails."""

import importlib.util
import math

import numpy as np
import pytest
import torch

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import load_config
from lyapnet.lab.comparison.planners import PlannerPolicy, mpc, planner_of
from lyapnet.lab.comparison.reference_problems import bounded_problem
from lyapnet.lab.comparison.results import PLANNED, ControlTimes, Result
from lyapnet.lab.comparison.scoring import costs_of, optima_of
from lyapnet.value.expansions import regulator
from tests.problems import CONF


def task(name, *overrides, scale=100.0):
    problem = build_problem(load_config(CONF / f"{name}.yaml", overrides))
    return bounded_problem(problem, [scale] * problem.system.m)


def scored(method, bounded, states=3):
    """(policy, cost / optimum of each state)."""
    policy = PlannerPolicy(planner_of(method, bounded.problem), bounded)
    x0 = bounded.problem.initial_states.sample(states, torch.Generator().manual_seed(3)).double()
    return policy, costs_of(policy, bounded, True, x0).cost / optima_of(bounded, x0)


@pytest.mark.parametrize("method", [name for name in PLANNED if name not in ("rest", "ilqr")])
def test_on_a_linear_task_all_are_optimal(method):
    """The optimum is Riccati's, of another routine; what follows MPC's horizon is the value of LQR, exact here."""
    policy, ratio = scored(method, task("double_integrator_value", "horizon.steps=60"))
    torch.testing.assert_close(ratio, torch.ones_like(ratio), rtol=1e-6, atol=0)
    assert (policy.unsolved_fraction is None) == (method == "lqr")


def test_the_gains_are_those_of_the_riccati_recursion():
    bounded = task("double_integrator_value", "horizon.steps=20")
    problem, (feedforward, gain) = bounded.problem, regulator(bounded.problem)
    (A, B), dt = _linear(problem), problem.horizon.dt
    Q, P = np.diag([10, 0.1]), np.diag([10, 0.1])
    R = problem.cost.R(torch.zeros(1, 2, dtype=torch.float64))[0].numpy()
    for n in reversed(range(20)):
        K = -np.linalg.solve(dt * R + B.T @ P @ B, B.T @ P @ A)
        np.testing.assert_allclose(gain[n].numpy(), K, rtol=1e-9)
        P = dt * Q + A.T @ P @ (A + B @ K)
    assert not feedforward.any()


def _linear(problem):
    """x_{n+1} = Ax + Bu, read off the step itself."""
    zero, n = torch.zeros(1, 2, dtype=torch.float64), 2
    none = torch.zeros(1, 1, dtype=torch.float64)
    A = torch.cat([problem.step(torch.eye(n, dtype=torch.float64)[i : i + 1], none)[0] for i in range(n)]).T
    return A.numpy(), problem.step(zero, none + 1)[0].T.numpy()


def test_with_the_whole_horizon_it_is_the_optimum_and_with_less_it_is_not():
    """A swing-up between limits; the optimum is IPOPT's, from several starts."""
    bounded = task("pendulum_limited", "horizon.steps=60", "horizon.dt=0.05", scale=8.0)
    _, whole = scored("mpc_100", bounded)
    torch.testing.assert_close(whole, torch.ones_like(whole), rtol=1e-4, atol=0)
    _, short = scored("mpc_10", bounded)
    assert short.max() > 1.05
    _, linear = scored("lqr", bounded)
    assert (linear > 1.5).any()


@pytest.mark.gate
def test_an_optimal_trajectory_from_where_it_starts():
    policy, ratio = scored("ilqr", task("reacher", "horizon.steps=20", "horizon.dt=0.05"), states=2)
    torch.testing.assert_close(ratio, torch.ones_like(ratio), rtol=1e-3, atol=0)
    assert policy.times.first > 20 * policy.times.median, "it plans once"


def test_mpc_knows_the_limits_and_lqr_does_not():
    bounded = task("pendulum_limited", "horizon.steps=30", "horizon.dt=0.1", scale=20.0)
    asked = {}
    for method in ("lqr", "mpc_25"):
        law = planner_of(method, bounded.problem).law()
        asked[method] = max(abs(float(law(n, np.array([2.9, 0.1]))[0])) for n in range(30))
    assert 7.9 < asked["mpc_25"] < 8.0001
    assert asked["lqr"] > 8.0


@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        ("cartpole_swingup", ["controls={lower: -12, upper: 12}"]),  # hundreds of iterations at the first step
        ("planar_quadrotor", ["horizon.steps=20"]),  # two steps would be a tenth of the horizon
    ],
)
def test_what_takes_long_or_is_short_converges(name, overrides):
    bounded = task(name, *overrides)
    planner = planner_of("mpc_100" if "swingup" in name else "mpc_10", bounded.problem)
    law, x0 = planner.law(), bounded.problem.initial_states.sample(1, torch.Generator().manual_seed(3))[0].double()
    for n in range(3):
        law(n, x0.numpy())
    assert (planner.solved, planner.unsolved) == (3, 0)


def test_what_does_not_converge_is_counted_and_goes_on(monkeypatch):
    bounded = task("pendulum_limited", "horizon.steps=30", "horizon.dt=0.1", scale=8.0)
    good, _ = scored("mpc_100", bounded, states=1)
    assert good.unsolved_fraction == 0
    monkeypatch.setattr(mpc, "ITERATIONS", 1)
    policy, ratio = scored("mpc_100", bounded, states=1)
    assert policy.unsolved_fraction == 1
    assert ratio.isfinite().all()


def test_without_casadi_mpc_says_what_it_needs(monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if name == "casadi" else find(name, *a))
    bounded = task("double_integrator_value", "horizon.steps=5")
    with pytest.raises(UsageError, match=r"CasADi for mpc_25, got none; pip install 'lyapnet\[oracle\]'"):
        planner_of("mpc_25", bounded.problem)
    assert planner_of("lqr", bounded.problem)


def test_a_result_keeps_its_times(tmp_path):
    times = ControlTimes(0.5, 2.0, 7.0)
    result = Result(
        "t", "mpc_25", 0, 0, 0.1, 0.0, [1.0, math.inf], [1.0, 1.0], [1.0, 1.0], None, 0.0, 5, "", [], times, 0.25
    )
    result.write(tmp_path / "result.json")
    assert Result.read(tmp_path / "result.json") == result


@pytest.mark.gate
def test_a_learned_value_makes_a_short_horizon_as_good_as_the_whole():
    controller = lyapnet.load("zoo:pendulum_swingup")
    bounded = bounded_problem(controller.problem, [20.0])
    x0 = bounded.problem.initial_states.sample(2, torch.Generator().manual_seed(3)).double()
    costs = []
    for given in (controller, None):  # the twin has LQR's value in its place
        policy = PlannerPolicy(planner_of("mpc_V_10", bounded.problem, given), bounded)
        costs.append(costs_of(policy, bounded, True, x0).cost / optima_of(bounded, x0))
        assert policy.unsolved_fraction == 0
    assert float(costs[0].max()) < 1.001
    assert float(costs[1].min()) > 1.01

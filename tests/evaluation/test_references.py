"""What the plant pays in continuous time, what LQR costs, and where V rises: each beside what it must not be."""

import io

import pytest
import torch
from rich.console import Console
from torch.testing import assert_close

from lyapnet.controller.controller import Controller
from lyapnet.evaluation import evaluate, oracle_of
from lyapnet.evaluation.references import costs_of_lqr, costs_of_plant
from lyapnet.evaluation.tables import evaluation_table
from lyapnet.loop.programs.terms import falls, largest_rise
from lyapnet.task.cost import Cost
from lyapnet.task.sets import ControlBox, ControlSet
from lyapnet.task.systems import DoubleIntegrator
from lyapnet.value.policy import SampledPolicy
from tests.problems import Formula, Quadratic, problem_of

COST = torch.linspace(1, 0.01, 50)[:, None]  # of each step


def values_of(step_cost, share=1.0):
    """V that falls by a share of what each step costs, to 1 at the end."""
    return share * torch.cat([step_cost, torch.ones(1, 1)]).flip(0).cumsum(0).flip(0)


def judged(values):
    cost = COST.sum(0) + 1
    return bool(falls(values, COST, cost)), float(largest_rise(values, cost))


def test_rounding_does_not_alarm_and_a_planted_rise_does():
    exact = values_of(COST)
    rounded = exact + 1e-14 * exact * torch.randn(exact.shape)
    assert judged(rounded)[0]
    planted = exact.clone()
    planted[25:] += 1e-3 * exact[0] - (planted[25] - planted[24])
    holds, rise = judged(planted)
    assert not holds
    assert rise == pytest.approx(1e-3)


@pytest.mark.parametrize(("share", "holds"), [(0.4, False), (0.6, True), (-1.0, False)])
def test_v_has_to_fall_by_half_of_what_each_step_costs(share, holds):
    assert judged(values_of(COST, share))[0] == holds


def test_a_rise_is_in_the_summary_and_the_table():
    problem = problem_of(DoubleIntegrator(), None, 40, 0.05)
    P = torch.tensor([[1.7, 1.0], [1.0, 1.7]])

    def planted(rise):
        def V(t, x):
            return (x @ P * x).sum(-1) * (1 + rise * (t > 0.99).to(x))

        return evaluate(Controller(problem, Formula(V), policy=SampledPolicy), 8)

    sound, broken = planted(0.0), planted(0.5)
    assert (sound["falling_fraction"], sound["largest_rise"]) == (1, 0)
    assert broken["falling_fraction"] < 1
    assert broken["largest_rise"] > 1e-3
    shown = io.StringIO()
    Console(file=shown, width=80).print(evaluation_table("a task", broken))
    lines = shown.getvalue().splitlines()
    rows = [line for line in lines if line.startswith("│")]
    assert all(row.split("│")[1].strip() for row in rows), "no row is broken at 80 columns"
    assert "The optimum is that of steps of 0.05 s (euler) with u held." in " ".join(shown.getvalue().split())
    for label in ("in continuous time, u held for Δt: cost / optimum", "LQR, without training", "largest rise of V"):
        assert label in shown.getvalue()


def test_the_plant_moves_in_continuous_time():
    problem = problem_of(DoubleIntegrator(), None, 20, 0.1)
    V, x0 = Quadratic(torch.eye(2)), problem.initial_states.sample(5)
    policy = SampledPolicy(problem, V)
    A, B = torch.tensor([[1.0, 0.1], [0.0, 1.0]]), torch.tensor([0.005, 0.1])  # exactly, u held for Δt = 0.1
    x, cost = x0, torch.zeros(5)
    with torch.no_grad():
        for n in range(20):
            u = policy(torch.tensor(0.1 * n), x)[:, 0]
            for node, weight in zip(
                (0.0, 0.05, 0.1), (1 / 6, 4 / 6, 1 / 6), strict=True
            ):  # Simpson, x² being of order 4
                p, v = x[:, 0] + node * x[:, 1] + node**2 / 2 * u, x[:, 1] + node * u
                cost = cost + 0.1 * weight * (p**2 + v**2 + u**2)
            x = x @ A.T + u[:, None] * B
    cost = cost + (x**2).sum(-1)
    held = costs_of_plant(problem, policy, x0)
    assert_close(held, cost, rtol=1e-5, atol=1e-5)
    assert (held - Controller(problem, V, policy=SampledPolicy).rollout(x0).cost).abs().max() > 1e-2, (
        "not Euler's steps"
    )


def test_a_plant_that_diverges_is_not_a_number():
    problem = problem_of(DoubleIntegrator(), None, 60, 0.1)
    result = evaluate(Controller(problem, Formula(lambda t, x: -30 * (x**2).sum(-1)), policy=SampledPolicy), 2)
    assert result["held_cost_mean"] is None or result["held_cost_mean"] > 1e6


class Ball(ControlSet):
    """|u| ≤ 1, as a set without limits of its own."""

    def minimise(self, R, b):
        return self.project(-b / (2 * R[..., 0]))

    def contains(self, u):
        return (u.abs() <= 1).all(-1)

    def project(self, u):
        return u.clamp(-1, 1)


class Profit(Cost):
    """q has a slope at the origin: a task without a goal."""

    def state(self, x):
        return (x**2).sum(-1) - x[..., 0]

    def R(self, x):
        return torch.ones_like(x[..., :1, None])

    def terminal(self, x):
        return (x**2).sum(-1)


def test_without_a_goal_or_known_limits_there_is_no_lqr():
    x0 = torch.zeros(2, 2)
    limited = ControlBox([-1.0], [1.0])
    for cost, controls, there in ((None, limited, True), (None, Ball(), False), (Profit(), limited, False)):
        problem = problem_of(DoubleIntegrator(), cost, controls=controls)
        assert problem.has_goal == (cost is None)
        assert (costs_of_lqr(problem, x0) is not None) == there


def test_lqr_is_the_optimum_of_a_linear_task_alone():
    linear = problem_of(DoubleIntegrator(), None, 20, 0.1)
    x0 = linear.initial_states.sample(6)
    assert_close(costs_of_lqr(linear, x0), oracle_of(linear).solve(x0).cost, rtol=1e-9, atol=1e-9)
    limited = problem_of(DoubleIntegrator(), None, 20, 0.1, controls=ControlBox([-0.1], [0.1]))
    kept, free = costs_of_lqr(limited, x0), costs_of_lqr(linear, x0)
    assert kept is not None
    assert free is not None
    assert (kept > 1.01 * free).any()

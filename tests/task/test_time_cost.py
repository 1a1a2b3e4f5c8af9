"""The cost of time, and optima that take the least of it, against the closed form of the double integrator."""

import math

import pytest
import torch

from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import config_from_plain
from lyapnet.task.cost import arrival_steps, squared_distance, time_cost_of
from lyapnet.value.expansions import dynamic_programming, optimal_trajectories


def problem_of(**changes):
    content = {
        "experiment": "time",
        "system": {"name": "double_integrator"},
        "cost": {"time": 2.0, "within": {"position": 0.04, "velocity": 0.08}, "R": 0.004},
        "controls": {"lower": -1, "upper": 1},
        "initial_states": {"lower": [-2, -2], "upper": [2, 2]},
        "horizon": {"steps": 180, "dt": 0.04},
        "training": {"precision": "float64"},
    }
    return build_problem(config_from_plain({**content, **changes}))


def cost_of(**changes):
    return {"cost": {"time": 2.0, "within": {"position": 0.04, "velocity": 0.08}, "R": 0.004, **changes}}


def least_time(x):
    """T* = v + 2√(x + v²/2) on one side of x + v|v|/2 = 0, and mirrored on the other."""
    position, velocity = x.unbind(-1)
    side = torch.where(position + velocity * velocity.abs() / 2 >= 0, 1.0, -1.0)
    position, velocity = side * position, side * velocity
    return velocity + 2 * (position + velocity**2 / 2).clamp_min(0).sqrt()


def test_it_costs_so_much_per_second_and_nothing_at_the_goal():
    cost = problem_of().cost
    x = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, -2.0], [4e-5, 0.0], [0.0, 8e-5]])
    q = cost.state(x)
    assert q[:3].tolist() == pytest.approx([0.0, 2.0, 2.0])
    assert q[3:].tolist() == pytest.approx([2 * 1e-6 / 2] * 2, rel=1e-5)  # k d²/2
    assert squared_distance(cost, x)[3:].tolist() == pytest.approx([1e-6] * 2)
    assert cost.terminal(x[1:2]).item() == pytest.approx(2.0 / (2 * 0.04**2))


def test_a_widened_cost_ends_so_many_times_as_far_away():
    """k(1 − e^{−(d/sw)²/2}) with the factor s: s² times the exponent's denominator."""
    cost, x = problem_of().cost, torch.tensor([[0.1, 0.0], [0.03, -0.05]])
    time_cost_of(cost).widening.fill_(3.0)
    d = (x / torch.tensor([0.04, 0.08])).square().sum(-1)
    assert cost.state(x).tolist() == pytest.approx((2.0 * (1 - torch.exp(-d / 2 / 9))).tolist())


def test_it_moves_with_a_target_and_knows_periodic_angles():
    moved = problem_of(target={"position": 0.5}).cost
    goal = torch.tensor([[0.5, 0.0], [0.0, 0.0]])
    assert moved.state(goal).tolist() == pytest.approx([0.0, 2.0])
    assert squared_distance(moved, goal)[0].item() == pytest.approx(0.0)
    pendulum = {"system": {"name": "pendulum"}, "initial_states": {"lower": [3, -1], "upper": [3.3, 1]}}
    widths = {"within": {"angle": 0.1, "velocity": 0.2}}
    turn = torch.tensor([[2 * math.pi, 0.0]])
    assert problem_of(**pendulum, **cost_of(**widths, periodic=["angle"])).cost.state(turn).item() < 1e-9
    assert problem_of(**pendulum, **cost_of(**widths)).cost.state(turn).item() == pytest.approx(2.0)


def test_arrival_is_when_a_trajectory_stays_near():
    cost = problem_of().cost
    far, near = [1.0, 0.0], [0.01, 0.0]
    x = torch.tensor([[far, far, near, far], [near, far, near, far], [far, near, near, near], [near, near, near, far]])
    assert arrival_steps(cost, x).tolist() == [3, 2, 0, 4]


@pytest.mark.gate
def test_optima_take_the_least_time(monkeypatch):
    problem = problem_of()
    x0 = problem.initial_states.sample(8, torch.Generator().manual_seed(3)).double()
    least = 2.0 * least_time(x0)

    def excess():
        at_rest = torch.zeros(problem.horizon.steps, len(x0), 1, dtype=torch.float64)
        return optimal_trajectories(problem, x0, at_rest).path.cost / least - 1

    found = excess()
    assert found.max() < 0.01
    assert found.mean() > -0.06  # time ends at d ≈ 1, not at the goal
    monkeypatch.setattr(dynamic_programming, "_softer_costs", lambda problem: [])
    assert excess().max() > 0.05  # the twin: without wider ends of time first some are late


@pytest.mark.gate
def test_its_widening_is_over_when_an_optimum_is_found():
    problem = problem_of(horizon={"steps": 40, "dt": 0.1})
    x0 = problem.initial_states.center[None].double() + 1
    optimal_trajectories(problem, x0, torch.zeros(40, 1, 1, dtype=torch.float64), iterations=2)
    time = time_cost_of(problem.cost)
    assert time is not None
    assert float(time.widening) == 1.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"within": {}}, r"cost\.within as \{state: distance > 0\}"),
        ({"within": {"position": 0.0}}, r"cost\.within as \{state: distance > 0\}"),
        ({"within": {"positon": 0.1}}, "cost.within among position"),
        ({"time": None, "Q": 1, "Q_T": 1}, r"a cost\.time with cost\.within"),
        ({"time": -1.0}, "cost.time"),
    ],
)
def test_what_does_not_fit_is_refused(changes, message):
    with pytest.raises(UsageError, match=message):
        problem_of(**cost_of(**changes))

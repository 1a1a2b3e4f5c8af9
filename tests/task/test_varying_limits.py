"""Limits of controls that depend on the state."""

import math

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from lyapnet.base.errors import UsageError
from lyapnet.task.cost import Cost, QuadraticCost, TargetCost
from lyapnet.task.mapped_controls import written_cost, written_system
from lyapnet.task.sets import ControlBox
from lyapnet.task.systems import SYSTEMS
from lyapnet.task.varying_limits import LimitTable, VaryingLimits
from tests.problems import problem_of

AT, UPPER, LOWER = [-1.3, 0.1, 0.7, 2.9], [3.1, 2.7, 1.9, 0.3], [-0.2, -1.7, -2.2, -2.3]


def table(**parts):
    return LimitTable(**{"state": "velocity", "at": AT, "upper": UPPER, "lower": LOWER, **parts})


def pendulum(controls, cost=None, **parts):
    return problem_of(SYSTEMS["pendulum"](damping=0.2), cost, controls=controls, **parts)


class Falling(VaryingLimits):
    """A class of a user's own: |u₁| ≤ 2/(1 + x₃²), and −1 ≤ u₂ ≤ 1 + x₄²/4."""

    def limits_at(self, x):
        first, second = 2 / (1 + x[..., 2] ** 2), 1 + x[..., 3] ** 2 / 4
        return torch.stack([-first, -torch.ones_like(first)], -1), torch.stack([first, second], -1)


def states(count, spread=4.0, seed=0):
    return spread * torch.randn(count, 2, generator=torch.Generator().manual_seed(seed))


def test_a_table_is_straight_between_its_entries_and_constant_beyond_them():
    x = states(5000)
    low, high = table().of(SYSTEMS["pendulum"]()).limits_at(x)
    for side, values, sign in ((low, LOWER, -1), (high, UPPER, 1)):
        exact = torch.from_numpy(np.interp(x[:, 1].numpy(), AT, values))[:, None]
        assert_close(side, exact, rtol=0, atol=1e-12)
        assert bool((sign * (exact - side) > 0).all())  # rounded inwards
    with pytest.raises(AssertionError):  # entries that another state moves
        assert_close(high[:, 0], torch.from_numpy(np.interp(x[:, 0].numpy(), AT, UPPER)))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("scale", [1.0, 1e-6, 1e7])
def test_no_control_leaves_its_limits_to_the_last_bit(dtype, scale):
    """Against the table in double precision at the very states, for shares inside, at and beyond the ends."""
    parts = {
        "at": [scale * 1.1 * a for a in AT],
        "upper": [u / scale for u in UPPER],
        "lower": [u / scale for u in LOWER],
    }
    limits = table(**parts).of(SYSTEMS["pendulum"]()).to(dtype)
    x = scale * states(20_000)
    x[:1000, 1] = torch.tensor(parts["at"]).repeat(250)
    x = x.to(dtype)
    speed = x[:, 1].double().numpy()
    low, high = (np.interp(speed, parts["at"], parts[side]) for side in ("lower", "upper"))
    for v in (-3.0, -1.0, 1.0, 3.0, 0.9999999, 2 * torch.rand(len(x), 1) - 1):
        share = torch.as_tensor(v).to(dtype).expand(len(x), 1)
        u = limits.applied(x, share).double().numpy()[:, 0]
        assert (low <= u).all()
        assert (u <= high).all()
    if dtype == torch.float32:  # without room single precision passes them
        limits.sizes.zero_()
        u = limits.applied(x, torch.ones(len(x), 1, dtype=dtype)).double().numpy()[:, 0]
        assert (u > high).any()


def test_at_an_entry_the_slope_is_the_one_before_it():
    limits, x = table().of(SYSTEMS["pendulum"]()), torch.zeros(4, 2)
    x[:, 1] = torch.tensor(AT)
    x.requires_grad_()
    slope = torch.autograd.grad(limits.limits_at(x)[1].sum(), x)[0][:, 1]
    assert_close(slope, torch.cat([torch.zeros(1), torch.tensor(UPPER).diff() / torch.tensor(AT).diff()]))


def test_the_task_in_shares_has_the_dynamics_and_the_cost_of_the_controls_that_act():
    cost = TargetCost(QuadraticCost(torch.eye(4), [[2.0, 0.3], [0.3, 1.0]], torch.eye(4)), [0.2] * 4, [0.1, 0.4])
    system = SYSTEMS["reacher"]()
    problem = problem_of(system, cost, controls=Falling())
    x, v = torch.randn(50, 4), 2 * torch.rand(50, 2) - 1
    u = problem.controls.applied(x, v)
    assert_close(problem.system.dynamics(x, v), system.dynamics(x, u))
    assert_close(problem.system.f(x) + (problem.system.g(x) @ v[..., None])[..., 0], system.dynamics(x, u))
    assert_close(problem.cost.running(x, v), cost.running(x, u))
    assert_close(problem.controls.asked(x, u), v)
    assert_close(problem.controls.applied(problem.goal, problem.rest), cost.rest_at(problem.goal))
    with pytest.raises(AssertionError):  # shares are no controls
        assert_close(problem.cost.running(x, u), cost.running(x, u))
    assert written_system(problem.system) is system
    assert written_cost(problem.cost) is cost


@pytest.mark.gate
def test_the_best_share_is_the_best_control_between_the_limits():
    system, cost = SYSTEMS["reacher"](), QuadraticCost(torch.eye(4), [[2.0, 0.9], [0.9, 1.0]], torch.eye(4))
    problem = problem_of(system, cost, controls=Falling())
    x, p = torch.randn(200, 4), 5 * torch.randn(200, 4)
    b = (problem.system.g(x).mT @ p[..., None])[..., 0] - 2 * (problem.cost.R(x) @ problem.rest_at(x)[..., None])[
        ..., 0
    ]
    u = problem.controls.applied(x, problem.best_control(problem.cost.R(x), b))
    low, high = problem.controls.limits_at(x)
    grid = torch.linspace(0, 1, 201)
    tried = torch.stack(torch.meshgrid(grid, grid, indexing="ij"), -1).reshape(-1, 1, 2)
    paid = [
        torch.stack([cost.running(x, w) + (p * system.dynamics(x, w)).sum(-1) for w in group])
        for group in (u[None], *(low + tried * (high - low)).split(4000))
    ]
    least = torch.cat(paid[1:]).amin(0)
    assert bool((paid[0][0] <= least + 1e-9).all())
    assert bool((paid[0][0] >= least - 0.02).all())
    assert bool(((u == low) | (u == high)).any())


def test_replaced_parts_stay_in_shares_once():
    problem = pendulum(table())
    other = problem.replaced(
        system=SYSTEMS["pendulum"](mass=2.0), cost=QuadraticCost(2 * torch.eye(2), [[1.0]], torch.eye(2))
    )
    x, v = states(5), torch.full((5, 1), 0.5)
    u = problem.controls.applied(x, v)
    assert_close(other.system.dynamics(x, v), SYSTEMS["pendulum"](mass=2.0).dynamics(x, u))
    same = problem.in_steps(steps=3)
    assert same.system is problem.system
    assert same.cost is problem.cost


def test_a_written_cost_is_found_within_others():
    problem = pendulum(table())
    inner = written_cost(problem.cost)
    assert isinstance(inner, QuadraticCost)
    moved = TargetCost(problem.cost, [1.0, 0.0], [0.0])
    found = written_cost(moved)
    x = states(5)
    assert_close(found.state(x), inner.state(x - torch.tensor([1.0, 0.0])))
    assert_close(found.R(x), inner.R(x))
    assert moved.cost is problem.cost


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ({"at": [0.0]}, "increasing"),
        ({"at": [0.0, 0.0, 1.0, 2.0]}, "increasing"),
        ({"at": "fast"}, "list of numbers"),
        ({"upper": [1.0, math.inf, 1.0, 1.0]}, "finite"),
        ({"upper": [1.0, 1.0]}, "4 entries"),
        ({"upper": [[1.0, 1.0]] * 4}, "as many controls"),
        ({"lower": UPPER}, "lower < upper"),
        ({"upper": [1.0, -1.0, 1.0, 1.0], "lower": None}, "lower < upper"),
    ],
)
def test_a_table_without_meaning_is_refused(parts, words):
    with pytest.raises(ValueError, match=rf"(?s)Expected .*{words}.*, got .+[;:] .+"):
        table(**parts)


class Reversed(VaryingLimits):
    def limits_at(self, x):
        return 1 - x[..., 1:], 1 + 0 * x[..., 1:]


class OfAnother(VaryingLimits):
    def limits_at(self, x):
        return -torch.ones_like(x), torch.ones_like(x)


class Own(QuadraticCost):
    def running(self, x, u):
        return Cost.running(self, x, u) + x[..., 0] * u[..., 0]


@pytest.mark.parametrize(
    ("controls", "cost", "words"),
    [
        (table(state="speed"), None, "angle, velocity"),
        (table(upper=[[u] * 2 for u in UPPER], lower=[[u] * 2 for u in LOWER]), None, r"1 controls \(torque\)"),
        (Reversed(), None, "lower < upper"),
        (OfAnother(), None, r"\(64, 1\)"),
        (table(), Own(torch.eye(2), [[1.0]], torch.eye(2)), "cost uᵀRu alone"),
    ],
)
def test_limits_that_do_not_fit_their_task_are_refused(controls, cost, words):
    with pytest.raises(UsageError, match=rf"Expected .*{words}.*, got .+[;:,] .+\."):
        pendulum(controls, cost).check()
    pendulum(table()).check()


def test_limits_for_one_control_count_for_all():
    limits = table(state="x", at=AT).of(type("Two", (), {"state_names": ["x"], "control_names": ["a", "b"], "m": 2})())
    low, high = limits.limits_at(torch.zeros(3, 1))
    assert low.shape == high.shape == (3, 2)
    assert bool((low[:, 0] == low[:, 1]).all())


def test_a_box_knows_no_state():
    box, x, u = ControlBox(-1.0, 1.0), states(3), torch.tensor([[0.5], [2.0], [-3.0]])
    assert box.applied(x, u) is u
    assert box.asked(x, u) is u
    assert box.fixed_limits == box.limits == box.limits_at(x)
    assert table().fixed_limits is None

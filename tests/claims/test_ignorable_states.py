"""Ignorable states: which states are, and that the funnel is that of the other states."""

import math

import pytest
import torch
from scipy.linalg import solve_continuous_are

from lyapnet.claims import ignorable_states as module
from lyapnet.claims.funnel import prove_funnel
from lyapnet.claims.ignorable_states import ignorable_states
from lyapnet.loop.rollout import Rollout
from lyapnet.prover.branch_and_bound import Budget
from lyapnet.task.cost import QuadraticCost
from lyapnet.task.sets import Box
from lyapnet.task.systems import Cartpole, ControlAffineSystem, DoubleIntegrator
from lyapnet.value.networks import FCN, IgnoringStates, Scaling
from tests.problems import Formula, hjb_loop, problem_of

DURATION, Q = 2.0, [10.0, 0.1]


def quadratic():
    """V = xᵀPx for every t, with Riccati's P."""
    P = torch.as_tensor(solve_continuous_are([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], [[Q[0], 0], [0, Q[1]]], [[1.0]]))
    return Formula(lambda t, x: ((x @ P) * x).sum(-1) + 0 * t)


class Odometer(ControlAffineSystem):
    """A double integrator, and the integral of its position."""

    state_names, state_units = ("position", "velocity", "sum"), ("m", "m/s", "m s")
    control_names, control_units = ("force",), ("N",)

    def __init__(self, push=None):
        super().__init__()
        self.push = push or (lambda x: torch.zeros_like(x[..., 2]))

    def f(self, x):
        return torch.stack([x[..., 1], self.push(x), x[..., 0]], -1)

    def g(self, x):
        one = torch.ones_like(x[..., :1])
        return torch.stack([torch.zeros_like(one), one, torch.zeros_like(one)], -2)


def loop(push=None, Q=(*Q, 0.0), Q_T=(*Q, 0.0), R=None, V=None):
    system = Odometer(push)
    cost = QuadraticCost(torch.diag(torch.tensor(Q)), R or [[1.0]], torch.diag(torch.tensor(Q_T)))
    return hjb_loop(system, cost, V or IgnoringStates(quadratic(), [0, 1], 3))


SUM, NONE = [2], []
HIDDEN = {  # forces that depend on the sum, although nan does not show it
    "comparison": lambda x: 0.1 * torch.where(x[..., 2] > 0, 1.0, -1.0),
    "sign": lambda x: 0.1 * torch.sign(x[..., 2]),
    "slope of a kink": lambda x: torch.ops.aten.threshold_backward(torch.full_like(x[..., 2], 0.1), x[..., 2], 0),
}


def network(n):
    return FCN(Scaling([1.0] * n, DURATION, 3.0), hidden=(4,))


@pytest.mark.parametrize(
    ("options", "ignored"),
    [
        ({}, SUM),
        ({"push": lambda x: -0.1 * torch.relu(x[..., 0])}, SUM),
        ({"push": lambda x: 0.1 * torch.sin(x[..., 2])}, NONE),
        ({"Q": (*Q, 1e-12)}, NONE),
        ({"Q_T": (*Q, 1e-12)}, NONE),
        ({"R": lambda x: (1 + x[..., 2] ** 2)[..., None, None]}, NONE),
        ({"R": lambda x: (1 + x[..., 1] ** 2)[..., None, None]}, SUM),
        ({"V": network(3)}, NONE),
        ({"V": IgnoringStates(network(2), [1, 2], 3)}, NONE),
        *(({"push": push}, NONE) for push in HIDDEN.values()),
        ({"push": lambda x: 0.1 * torch.sign(x[..., 0])}, NONE),  # stricter than necessary: any jump counts
    ],
    ids=[
        "nothing",
        "a kink elsewhere",
        "f",
        "Q",
        "Q_T",
        "R",
        "R elsewhere",
        "V",
        "half of V",
        *HIDDEN,
        "sign elsewhere",
    ],
)
def test_a_state_is_ignorable_where_nothing_depends_on_it(options, ignored):
    assert ignorable_states(loop(**options).double()) == ignored


@pytest.mark.parametrize("push", HIDDEN.values(), ids=HIDDEN)
def test_without_a_look_for_jumps_some_would_hide_it(push, monkeypatch):
    monkeypatch.setattr(module, "has_jumps", lambda closed_loop: False)
    assert ignorable_states(loop(push).double()) == SUM


def test_of_a_cartpole_it_is_the_cart_position():
    system, V = Cartpole(), IgnoringStates(network(3), [1, 2, 3], 4)

    def ignored(V, weight):
        cost = QuadraticCost(torch.diag(torch.tensor([weight, 25.0, 0.5, 0.1])), system.inverse_mass, torch.eye(4))
        cost.Q_T[0, 0] = weight
        return ignorable_states(hjb_loop(system, cost, V).double())

    assert ignored(V, 0.0) == [0]
    assert ignored(V, 1.0) == ignored(network(4), 0.0) == NONE


# The funnel


OPTIONS = {"alpha": 0.9, "delta": 0.02}


def plain_claim():
    """The claim of the same problem without the sum."""
    system, cost = DoubleIntegrator(), QuadraticCost(torch.diag(torch.tensor(Q)), [[1.0]], torch.diag(torch.tensor(Q)))
    X0, D = Box([-1.0, -0.7], [1.0, 0.7]), Box([-1.9, -3.4], [1.9, 3.4])
    problem = problem_of(system, cost, 100, DURATION / 100, X0)
    return prove_funnel(hjb_loop(system, cost, quadratic()), problem, states=D, budget=Budget(60), **OPTIONS)


@pytest.fixture(scope="module")
def claim():
    torch.set_default_dtype(torch.float64)
    X0, D = Box([-1.0, -0.7, -3.0], [1.0, 0.7, 5.0]), Box([-1.9, -3.4, -0.1], [1.9, 3.4, 0.1])
    return prove_funnel(
        loop(), problem_of(Odometer(), None, 100, DURATION / 100, X0), states=D, budget=Budget(60), **OPTIONS
    )


@pytest.mark.gate
def test_the_funnel_is_that_of_the_other_states(claim):
    """D need not contain X₀ along an ignorable state."""
    plain = plain_claim()
    assert (claim.left_out, plain.left_out) == (SUM, NONE)
    assert claim.verdict == plain.verdict == "certified"
    assert claim.volume_share == plain.volume_share == 1
    for name in ("rho", "wanted", "terminal_excess"):
        assert getattr(claim, name) == pytest.approx(getattr(plain, name), rel=1e-9)
    assert claim.states.lower.tolist() == [-1.9, -3.4, 0.0]


def rollout(claim, push=None):
    """(closed loops from the boundary of the funnel with any sum; whether each stays in it)."""
    closed_loop, angle = loop(push), torch.linspace(0, 2 * math.pi, 60)
    x0 = torch.stack([angle.cos(), angle.sin(), torch.linspace(-50, 50, 60)], -1)
    x0[:, :2] *= (claim.rho / closed_loop.policy.V(torch.zeros(()), x0)).sqrt()[:, None] * (1 - 1e-9)
    problem = problem_of(closed_loop.system, closed_loop.cost, 100, DURATION / 100)
    trajectory = Rollout(problem, closed_loop.policy, "rk4")(x0)
    inside = trajectory.value <= claim.rho + claim.delta * trajectory.t[:, None]
    return trajectory, inside.all(0) & (trajectory.cost <= claim.guaranteed_cost(trajectory.value[0]))


@pytest.mark.gate
def test_closed_loops_stay_in_it_whatever_the_state_is(claim):
    trajectory, stays = rollout(claim)
    assert stays.all()
    assert (trajectory.x[..., 2].abs() > 40).any()
    _, stays = rollout(claim, lambda x: 2 * torch.sin(x[..., 2]))
    assert not stays.all(), "the counterpart: a sum that acts as a force"

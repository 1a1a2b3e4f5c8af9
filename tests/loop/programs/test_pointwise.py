"""The condition off the closed loops: against Riccati's V, formulas by hand, and finite differences."""

import pytest
import torch
from scipy.linalg import solve_continuous_are
from torch.testing import assert_close

from lyapnet.base.random_streams import stream
from lyapnet.loop.programs import LyapunovProgram, PointwiseCondition, ValueProgram
from lyapnet.loop.rollout import Rollout
from lyapnet.task.cost import QuadraticCost
from lyapnet.task.noise import StateNoise
from lyapnet.task.sets import Box
from lyapnet.task.systems import DoubleIntegrator
from lyapnet.value.policy import HJBPolicy
from tests.problems import Formula, problem_of

A, B = torch.tensor([[0.0, 1.0], [0.0, 0.0]]).double(), torch.tensor([[0.0], [1.0]]).double()
Q, DURATION, POINTS = torch.diag(torch.tensor([10.0, 0.1], dtype=torch.float64)), 2.0, 12
MEAN_COST, LARGEST = (torch.tensor(cost, dtype=torch.float64) for cost in (3.0, 100.0))
WRONG = [[4.0, 0.5], [0.5, 0.3]]


def riccati():
    return torch.tensor(solve_continuous_are(A.numpy(), B.numpy(), Q.numpy(), [[1.0]]))


@pytest.fixture
def of(quadratic):
    """The condition of V = xᵀPx with φ = xᵀQ_T x; margin None for the value program."""

    def build(P, margin=None, Q_T=None, further=None, floor=None):
        cost = QuadraticCost(Q, [[1.0]], riccati() if Q_T is None else Q_T)
        problem = problem_of(DoubleIntegrator(), cost, steps=20, dt=DURATION / 20)
        rollout = Rollout(problem, HJBPolicy(problem, quadratic(P)))
        program = ValueProgram() if margin is None else LyapunovProgram(margin=margin)
        return PointwiseCondition(rollout, program, Box([-1.0, -2.0], [1.0, 2.0]), 1.0, POINTS, further, floor)

    return build


def value(condition, seed=0, largest=LARGEST):
    return condition(stream(seed), MEAN_COST, largest)


def by_hand(x, P, margin, Q_T, ceiling=torch.inf, unit_of=None, floor=0.01):
    """Both penalties at each state, from matrices: V̇ = 2xᵀP(Ax + Bu) and ℓ = xᵀQx + u² with u = −BᵀPx.

    They are relative to the ℓ under the law of `unit_of`, which is P itself unless another matrix is given.
    """
    P, unit_P = ((M + M.mT) / 2 for M in map(torch.as_tensor, (P, P if unit_of is None else unit_of)))
    rows = []
    for y in x:
        unit = y @ Q @ y + (B.T @ unit_P @ y).square().sum() + floor * MEAN_COST / DURATION
        u = -B.T @ P @ y
        V, running, terminal = y @ P @ y, y @ Q @ y + u @ u, y @ Q_T @ y
        rate = 2 * y @ P @ (A @ y + B @ u)
        condition = (rate + (1 + (margin or 0.0)) * running) / unit
        end = (terminal - V) / (terminal + floor * MEAN_COST)
        both = torch.stack([condition, end])
        rows.append((both.square() if margin is None else both.clamp_min(0)) * (ceiling >= V))
    return torch.stack(rows, -1)


def chosen(condition, P, margin, ceiling=torch.inf, seed=0):
    """The states of a step: the worse half of all that are drawn, and the first of them."""
    _, x = condition.draw(stream(seed))
    worst = by_hand(x, P, margin, torch.eye(2), ceiling)[0].topk(POINTS // 2).indices
    return torch.cat([x[worst], x[: POINTS - len(worst)]])


@pytest.mark.parametrize("margin", [None, 0.0])
def test_the_solution_of_riccati_leaves_nothing(of, margin):
    """V̇ + ℓ = 0 everywhere, and V(T, ·) = φ; the twin: a V that is too small."""
    assert abs(value(of(riccati(), margin)).item()) < 1e-12
    assert value(of(0.9 * riccati(), margin)) > 1e-3


@pytest.mark.parametrize("margin", [None, 0.0, 0.2])
def test_formulas_by_hand(of, margin):
    condition = of(WRONG, margin, torch.eye(2))
    expected = by_hand(chosen(condition, WRONG, margin), WRONG, margin, torch.eye(2)).mean(-1).sum()
    assert_close(value(condition).detach(), expected)
    assert expected > 0.1


def test_near_the_goal_violations_count_by_the_floor(of):
    condition = of(WRONG, 0.2, torch.eye(2), floor=0.3)
    _, x = condition.draw(stream(0))
    worst = by_hand(x, WRONG, 0.2, torch.eye(2), floor=0.3)[0].topk(POINTS // 2).indices
    x = torch.cat([x[worst], x[: POINTS - len(worst)]])
    expected = by_hand(x, WRONG, 0.2, torch.eye(2), floor=0.3).mean(-1).sum()
    assert_close(value(condition).detach(), expected)
    assert expected < 0.7 * value(of(WRONG, 0.2, torch.eye(2)))


def test_a_hinge_forgives_what_the_square_does_not(of):
    """1.3 times Riccati's V pays for more than ℓ: no violation, but no solution either."""
    generous = 1.3 * riccati()
    assert value(of(generous, 0.0)) == 0
    assert value(of(generous)) > 1e-2
    assert value(of(generous, 0.5)) > 1e-2, "a margin above what it pays for"


def test_points_above_the_ceiling_do_not_count(of):
    condition, largest = of(WRONG, 0.2, torch.eye(2)), torch.tensor(0.2)
    x = chosen(condition, WRONG, 0.2, 1.2 * largest)
    low, all_of_them = (by_hand(x, WRONG, 0.2, torch.eye(2), c).mean(-1).sum() for c in (1.2 * largest, torch.inf))
    assert_close(value(condition, largest=largest).detach(), low)
    assert 0 < low < 0.9 * all_of_them
    assert value(condition, largest=torch.tensor(0.0)) == 0


def test_points_are_those_of_the_stream(of):
    condition = of(WRONG, 0.2, torch.eye(2))
    assert value(condition) == value(condition)
    assert value(condition) != value(condition, seed=1)
    t, x = condition.draw(stream(0))
    assert len(t) == 4 * POINTS
    assert condition.region.contains(x).all()
    assert (t >= 0).all()
    assert (t <= DURATION).all()


def test_further_points_join_those_of_every_step(of):
    further = torch.tensor([[0.5, 0.3, -0.2], [2.0, -0.9, 1.5]])
    condition = of(WRONG, 0.2, torch.eye(2), further)
    x = torch.cat([chosen(condition, WRONG, 0.2), further[:, 1:]])
    assert_close(value(condition).detach(), by_hand(x, WRONG, 0.2, torch.eye(2)).mean(-1).sum())
    assert value(condition) != value(of(WRONG, 0.2, torch.eye(2)))


@pytest.mark.parametrize("margin", [None, 0.2])
def test_gradient_against_finite_differences(of, margin):
    """With the denominators held, which take no part in it; the twin: they would."""
    condition, Q_T = of(WRONG, margin, torch.eye(2)), torch.eye(2)
    (P,), x = condition.V.parameters(), chosen(condition, WRONG, margin)
    (slope,) = torch.autograd.grad(value(condition), P)

    def differences(held):
        columns = []
        for direction in 1e-5 * torch.eye(4).reshape(4, 2, 2):
            ends = [torch.tensor(WRONG) + direction, torch.tensor(WRONG) - direction]
            up, down = (by_hand(x, end, margin, Q_T, unit_of=WRONG if held else end).mean(-1).sum() for end in ends)
            columns.append((up - down) / 2e-5)
        return torch.stack(columns).reshape(1, 2, 2)

    assert_close(slope, differences(held=True), rtol=1e-5, atol=1e-6)
    assert not torch.allclose(slope, differences(held=False), rtol=1e-2)


def test_a_law_without_V_has_no_condition():
    rollout = Rollout(problem_of(DoubleIntegrator()), torch.nn.Identity())
    with pytest.raises(ValueError, match="Expected a control law that a V defines"):
        PointwiseCondition(rollout, ValueProgram(), Box([-1.0, -2.0], [1.0, 2.0]))


@pytest.mark.parametrize("margin", [None, 0.0])
def test_noise_adds_the_trace_term(margin):
    """V = xᵀPx + r(T − t), r = tr(σσᵀP), leaves nothing of 𝓛V + ℓ; the twin: without r(T − t) the value is too low."""
    P, sigma = riccati(), torch.tensor([0.0, 0.7], dtype=torch.float64)
    problem = problem_of(DoubleIntegrator(), QuadraticCost(Q, [[1.0]], P), steps=20, dt=DURATION / 20)
    problem = problem.replaced(noise=StateNoise(sigma.tolist()))
    r = float(sigma @ P @ sigma)
    left = []
    for share in (1.0, 0.0):
        V = Formula(lambda t, x, share=share: ((x @ P) * x).sum(-1) + share * r * (DURATION - t))
        program = ValueProgram() if margin is None else LyapunovProgram(margin=margin)
        loop = Rollout(problem, HJBPolicy(problem, V))
        left.append(value(PointwiseCondition(loop, program, Box([-1.0, -2.0], [1.0, 2.0]), 1.0, POINTS)).item())
    assert abs(left[0]) < 1e-12
    assert left[1] > 1e-2

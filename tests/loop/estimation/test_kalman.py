"""Kalman filters against a filter by scipy, the Riccati equation, finite differences and closed forms; and twins."""

import math

import numpy as np
import pytest
import scipy.linalg
import torch
from torch.testing import assert_close

from lyapnet.loop.estimation.kalman import (
    FILTERS,
    Belief,
    ExtendedKalmanFilter,
    UnscentedKalmanFilter,
    initial_deviation,
    least_drift,
)
from lyapnet.loop.estimation.observability import observability
from lyapnet.task.noise import StateNoise
from lyapnet.task.outputs import MeasuredStates, SystemOutput
from lyapnet.task.sets import Box
from lyapnet.task.systems import Cartpole, DoubleIntegrator, Pendulum
from lyapnet.task.systems.linear import Linear
from tests.problems import problem_of

DT, SIGMA = 0.1, 0.05


class Ranged(Pendulum):
    """A pendulum seen from a beacon: the distance of its tip, and its height."""

    def output(self, x):
        across, up = torch.sin(x[..., 0]), torch.cos(x[..., 0])
        return torch.stack([torch.sqrt((across - 3) ** 2 + up**2), up], -1)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def linear_filter(kind, noise=(0.3, 0.2), drift=0.0):
    """A filter of a mass whose position is measured, with noise on both states."""
    problem = problem_of(DoubleIntegrator()).replaced(noise=StateNoise(noise))
    return FILTERS[kind](problem, MeasuredStates(problem.system, [0], [SIGMA]), torch.full((2,), drift))


def random_belief(n, batch=(5,), seed=1):
    root = torch.randn(*batch, n, n, generator=seeded(seed))
    return Belief(torch.randn(*batch, n, generator=seeded(seed + 1)), root @ root.mT + 0.1 * torch.eye(n))


@pytest.mark.parametrize("kind", FILTERS)
def test_of_a_linear_system_it_is_the_kalman_filter(kind):
    """Written with NumPy for one loop at a time, in information form; another noise gives another result."""
    kalman, belief = linear_filter(kind), random_belief(2)
    u, y = torch.randn(5, 1, generator=seeded(3)), torch.randn(5, 1, generator=seeded(4))
    found = kalman.update(kalman.predict(belief, u), y)
    A, B = np.array([[1, DT], [0, 1]]), np.array([[0], [DT]])
    for i in range(5):
        x = A @ belief.x[i].numpy() + B @ u[i].numpy()
        P = A @ belief.P[i].numpy() @ A.T + DT * np.diag([0.09, 0.04])
        information = np.linalg.inv(P) + np.diag([SIGMA**-2, 0])
        P = np.linalg.inv(information)
        x = x + P @ np.array([SIGMA**-2, 0]) * (y[i].numpy() - x[0])
        assert_close(found.x[i].numpy(), x, rtol=1e-9, atol=1e-11)
        assert_close(found.P[i].numpy(), P, rtol=1e-9, atol=1e-11)
    other = linear_filter(kind, noise=(0.3, 0.4))
    assert not torch.allclose(other.update(other.predict(belief, u), y).P, found.P)


@pytest.mark.parametrize("kind", FILTERS)
def test_its_covariance_ends_at_that_of_the_riccati_equation(kind):
    kalman, belief = linear_filter(kind, drift=0.1), random_belief(2, ())
    for _ in range(200):
        belief = kalman.predict(kalman.update(belief, torch.zeros(1)), torch.zeros(1))
    A, H = np.array([[1, DT], [0, 1]]), np.array([[1.0, 0]])
    P = scipy.linalg.solve_discrete_are(A.T, H.T, DT * np.diag([0.1, 0.05]), np.array([[SIGMA**2]]))
    assert_close(belief.P.numpy(), P, rtol=1e-9, atol=0)


def test_jacobians_are_those_of_finite_differences():
    problem = problem_of(Ranged(), method="rk4")
    kalman = ExtendedKalmanFilter(problem, SystemOutput(problem.system, [0.1, 0.1], torch.rand(4, 2)), torch.zeros(2))
    x, u, h = torch.randn(3, 2, generator=seeded(5)), torch.randn(3, 1, generator=seeded(6)), 1e-6
    ahead, behind = x[:, None] + h * torch.eye(2), x[:, None] - h * torch.eye(2)
    steps = [problem.step(each, u[:, None].expand(3, 2, 1))[0] for each in (ahead, behind)]
    assert_close(kalman.step_jacobian(x, u), ((steps[0] - steps[1]) / (2 * h)).mT, rtol=1e-7, atol=1e-9)
    seen = [kalman.outputs(each) for each in (ahead, behind)]
    assert_close(kalman.output_jacobian(x), ((seen[0] - seen[1]) / (2 * h)).mT, rtol=1e-7, atol=1e-9)


def test_unscented_means_are_exact_to_third_order():
    """E cos θ of a normal θ to second order in its variance, where the extended filter has cos of the mean."""
    problem, s = problem_of(Ranged()), 0.02
    outputs = SystemOutput(problem.system, [0.1, 1e-9], torch.rand(4, 2))
    belief = Belief(torch.tensor([0.4, 0.0]), torch.diag(torch.tensor([s**2, 1e-6])))
    expected = math.exp(-(s**2) / 2) * math.cos(0.4)  # in closed form
    y, none = torch.tensor([torch.nan, expected]), torch.zeros(2)
    kinds = (UnscentedKalmanFilter, ExtendedKalmanFilter)
    surprises = [float(kind(problem, outputs, none).update(belief, y).x[0]) - 0.4 for kind in kinds]
    assert abs(surprises[0]) < 1e-6 < abs(surprises[1])


@pytest.mark.parametrize("kind", FILTERS)
def test_covariances_stay_symmetric_and_positive(kind):
    """Also with readings of six digits and a cart-pole that turns over; the shape of the batch is kept."""
    problem = problem_of(Cartpole(), dt=0.05)
    kalman = FILTERS[kind](problem, MeasuredStates(problem.system, [0, 1], [1e-6, 1e-6]), 1e-4 * torch.ones(4))
    belief = Belief(torch.zeros(2, 3, 4), (100 * torch.eye(4)).expand(2, 3, 4, 4))
    for k in range(100):
        belief = kalman.predict(kalman.update(belief, 0.01 * torch.ones(2, 3, 2) * k), torch.ones(2, 3, 1))
        assert torch.equal(belief.P, belief.P.mT)
        assert (torch.linalg.eigvalsh(belief.P) > 0).all()
    assert belief.x.shape == (2, 3, 4)


@pytest.mark.parametrize("kind", FILTERS)
def test_a_missing_reading_is_left_out(kind):
    problem = problem_of(Cartpole())
    belief = random_belief(4)
    both = FILTERS[kind](problem, MeasuredStates(problem.system, [0, 1], [0.1, 0.2]), torch.zeros(4))
    one = FILTERS[kind](problem, MeasuredStates(problem.system, [1], [0.2]), torch.zeros(4))
    y = torch.randn(5, 2, generator=seeded(7))
    without = y.clone()
    without[:, 0] = torch.nan
    alone, found = one.update(belief, y[:, 1:]), both.update(belief, without)
    assert_close(found.x, alone.x)
    assert_close(found.P, alone.P)
    assert not torch.allclose(both.update(belief, y).x, alone.x)
    nothing = both.update(belief, torch.full((5, 2), torch.nan))
    assert_close(nothing.P, belief.P)


def test_a_reading_of_an_angle_may_wrap_and_that_of_a_length_may_not():
    problem = problem_of(Cartpole())
    kalman = ExtendedKalmanFilter(problem, MeasuredStates(problem.system, [0, 1], [0.1, 0.1]), torch.zeros(4))
    belief = Belief(torch.tensor([1.0, 3.2, 0.0, 0.0]), torch.eye(4))
    plain, turned = (kalman.update(belief, torch.tensor([1.0, a])) for a in (3.1, 3.1 - 2 * math.pi))
    assert_close(plain.x, turned.x)
    assert float(kalman.update(belief, torch.tensor([1.0 - 2 * math.pi, 3.1])).x[0]) < -4


def test_the_first_uncertainty_is_that_of_a_uniform_state():
    box = Box([-1.0, 2.0, 0.0, -1.0], [3.0, 2.0, 0.0, 1.0])
    x, problem = box.sample(100_000, seeded()), problem_of(Cartpole(), initial_states=box)
    assert_close(initial_deviation(problem)[0], x[:, 0].std(), rtol=0.01, atol=0)
    assert_close(initial_deviation(problem)[1:3], torch.tensor([0.02, 0.01]))
    problem.system.settings = (3,)  # known exactly
    assert_close(initial_deviation(problem)[3], torch.tensor(0.0))
    drift = least_drift(problem_of(DoubleIntegrator(), steps=25))
    assert_close(drift, torch.full((2,), 1e-4 / math.sqrt(3 * 2.5)))


def told(states, steps=30, A=((0.0, 1.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, -3.0))):
    """Of a mass that is measured, and a state of its own which nothing else sees."""
    problem = problem_of(Linear(A, [[0.0], [1.0], [1.0]]), steps=steps)
    kalman = ExtendedKalmanFilter(problem, MeasuredStates(problem.system, states, [0.1] * len(states)), torch.zeros(3))
    x = torch.zeros(steps + 1, 2, 3)
    return observability(kalman, x, torch.zeros(steps, 2, 1), torch.ones(3))


def test_observability_is_that_of_the_gramian_and_of_batch_least_squares():
    """One solution for all readings at once, by NumPy; and a velocity without position tells no position."""
    found, A = told([0]), np.array([[1, DT, 0], [0, 1, 0], [0, 0, 0.7]])
    phi = [np.linalg.matrix_power(A, k) for k in range(31)]
    W = sum(np.outer(each[0], each[0]) for each in phi) / 0.1**2
    P = phi[-1] @ np.linalg.inv(np.eye(3) + W) @ phi[-1].T
    assert_close(found.of_first.numpy(), np.sqrt(np.diag(P)), rtol=1e-8, atol=0)
    assert found.rank == np.linalg.matrix_rank(W) == 2
    assert found.condition == math.inf
    assert found.of_first[0] < 0.1
    assert found.of_first[2] < 1e-4  # it decays
    assert told([1]).of_first[0] > 0.99
    every = told([0, 2])
    assert every.rank == 3
    assert math.isfinite(every.condition)
    values = np.linalg.eigvalsh(W + sum(np.outer(each[2], each[2]) for each in phi) / 0.1**2)
    assert_close(every.condition, float(values[-1] / values[0]), rtol=1e-6, atol=0)

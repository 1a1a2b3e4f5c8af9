"""The certainty equivalent (1/θ) log E exp(θV) of V under noise, against integrals and the recursion by hand."""

import math

import numpy as np
import pytest
import torch
from numpy.polynomial.hermite_e import hermegauss
from torch import Tensor
from torch.testing import assert_close

from lyapnet.base.errors import OracleError, UsageError
from lyapnet.evaluation.oracles import oracle_of
from lyapnet.task.cost import QuadraticCost
from lyapnet.task.horizon import Horizon
from lyapnet.task.noise import StateNoise
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box, Unbounded
from lyapnet.task.systems import Linear
from lyapnet.value.expansions import greedy_law, in_float64, riccati
from lyapnet.value.linearisation import TOO_MUCH_RISK, riccati_or_reason
from lyapnet.value.policy import SampledPolicy
from lyapnet.value.risk import mean_with_risk, risk_gain, with_risk
from tests.problems import OfExpansion, Quadratic

A, B = np.array([[0.0, 1.0], [0.3, -0.2]]), np.array([[0.0], [1.0]])
N, DT, SIGMA = 40, 0.05, np.array([0.1, 0.5])


def task(risk: float) -> Problem:
    cost = QuadraticCost([[1.0, 0.0], [0.0, 0.1]], [[0.1]], [[2.0, 0.0], [0.0, 1.0]])
    system, box = Linear(A.tolist(), B.tolist()), Box([-1.0, -1.0], [1.0, 1.0])
    problem = Problem(system, cost, Unbounded(), box, Horizon(N, DT), noise=StateNoise(SIGMA.tolist()), risk=risk)
    return in_float64(problem)


def by_hand(risk: float) -> tuple[float, np.ndarray, list[np.ndarray]]:
    """(c, H at t = 0, gains) of the linear exponential-quadratic regulator, H̃ = (H⁻¹ − θΣ)⁻¹ with Σ = Δt σσᵀ."""
    F, G, noise = np.eye(2) + DT * A, DT * B, DT * np.diag(SIGMA**2)
    c, H, gains = 0.0, 2 * np.diag([2.0, 1.0]), []
    for _ in range(N):
        later = np.linalg.inv(np.linalg.inv(H) - risk * noise)
        c -= np.linalg.slogdet(np.eye(2) - risk * noise @ H)[1] / (2 * risk)
        K = np.linalg.solve(2 * DT * np.array([[0.1]]) + G.T @ later @ G, G.T @ later @ F)
        H = 2 * DT * np.diag([1.0, 0.1]) + F.T @ later @ F - F.T @ later @ G @ K
        gains.insert(0, K)
    return c, H, gains


@pytest.mark.parametrize("risk", [0.2, 3.0])
def test_the_expansion_is_that_of_the_exponential_quadratic_regulator(risk):
    c, H, gains = by_hand(risk)
    problem = task(risk)
    found, mean = riccati(problem), riccati(task(0.0))
    assert_close(float(found.value[0]), c)
    assert_close(found.hessian[0], torch.tensor(H))
    assert float(mean.value[0]) < 0.999 * c  # the twin without risk
    x = torch.tensor([[0.7, -0.4]], dtype=torch.float64)
    at = torch.tensor(0.3, dtype=torch.float64)
    for law in (
        lambda x: greedy_law(problem, found)(6, x),
        lambda x: SampledPolicy(problem, OfExpansion(problem, found))(at, x),
    ):
        assert_close(law(x), -x @ torch.tensor(gains[6]).mT)
    assert not torch.allclose(greedy_law(task(0.0), found)(6, x), -x @ torch.tensor(gains[6]).mT, rtol=1e-3)
    assert_close(oracle_of(problem)(x), c + ((x @ torch.tensor(H)) * x).sum(-1) / 2)


def test_the_law_of_a_large_risk_is_bolder():
    """The adversary of the equivalent game pushes the state away, so that feedback is stronger."""
    assert (np.abs(by_hand(3.0)[2][0]) > 1.02 * np.abs(by_hand(1e-6)[2][0])).all()


def test_no_opponent_gains_more_than_the_law_of_risk_allows():
    """J − |w|²/(2θ) ≤ ½ xᵀHx for pushes σw, with equality for the worst: the law is that of H∞ with θ = 1/(2γ²)."""
    risk, problem = 3.0, task(3.0)
    found, mean = riccati(problem), riccati(task(0.0))
    x0 = torch.tensor([[0.7, -0.4]], dtype=torch.float64)
    allowed = float(((x0 @ found.hessian[0]) * x0).sum() / 2)
    generator = torch.Generator().manual_seed(0)

    def gained(of: Problem, expansion, worst: bool) -> float:
        law, x, gain = greedy_law(of, expansion), x0, 0.0
        sigma = torch.diag(torch.tensor(SIGMA))
        for n in range(N):
            u = law(n, x)
            free, paid = of.step(x, u)
            H = found.hessian[n + 1]
            S = torch.eye(2).double() - risk * DT * sigma.mT @ H @ sigma
            push = risk * (free @ H @ sigma) @ torch.linalg.inv(S)  # the best one against the law of risk
            w = push if worst else push * (1 + torch.randn(1, 2, generator=generator, dtype=torch.float64))
            x = free + DT * w @ sigma.mT
            gain += float(paid.sum() - DT * (w**2).sum() / (2 * risk))
        return gain + float(of.cost.terminal(x))

    assert_close(gained(problem, found, worst=True), allowed)
    assert all(gained(problem, found, worst=False) < allowed - 1e-6 for _ in range(5))
    assert gained(task(0.0), mean, worst=True) > allowed + 5e-4  # the law without risk


def test_the_certainty_equivalent_of_a_quadratic_function_is_its_integral():
    generator = torch.Generator().manual_seed(0)
    root = torch.randn(3, 3, generator=generator, dtype=torch.float64)
    H, p, c = root @ root.mT, torch.randn(3, generator=generator, dtype=torch.float64), 0.4
    sigma = 0.3 * torch.randn(3, 2, generator=generator, dtype=torch.float64)
    dt, risk = 0.1, 0.3
    W = torch.cat([torch.cat([torch.tensor([2 * c]).double(), p])[None], torch.cat([p[:, None], H], 1)])
    nodes, weights = hermegauss(60)
    z = torch.tensor(np.stack(np.meshgrid(nodes, nodes, indexing="ij"), -1).reshape(-1, 2))
    w = torch.tensor(np.outer(weights, weights).reshape(-1) / (2 * math.pi))

    def integral(at: Tensor) -> float:
        x = at + math.sqrt(dt) * z @ sigma.mT
        return float((w * torch.exp(risk * (c + x @ p + ((x @ H) * x).sum(-1) / 2))).sum().log() / risk)

    found = with_risk(W[None], sigma[None], dt, risk)[0]
    mean = dt / 2 * float((sigma.mT @ H @ sigma).diagonal().sum())
    for at in torch.randn(3, 3, generator=generator, dtype=torch.float64):
        one = torch.cat([torch.ones(1), at]).double()
        assert_close(float(one @ found @ one) / 2 + mean, integral(at))
    G = risk_gain(H, sigma, dt, risk)
    assert_close(found[1:, 1:], H + H @ G @ H)
    assert_close(found[1:, 0], p + H @ G @ p)


def test_with_too_large_a_risk_nothing_is_finite_and_the_reason_is_told():
    assert riccati_or_reason(task(40.0)) == TOO_MUCH_RISK
    assert not isinstance(riccati_or_reason(task(3.0)), type(TOO_MUCH_RISK))
    with pytest.raises(OracleError, match="smaller risk"):
        oracle_of(task(40.0))
    with pytest.raises(UsageError, match="finite at the goal, got 40; choose a smaller risk"):
        SampledPolicy(task(40.0), Quadratic(torch.eye(2)))
    assert SampledPolicy(task(3.0), Quadratic(torch.eye(2))).riccati is not None


def test_a_sigma_that_depends_on_the_state_has_no_exact_optimum_with_risk():
    class Multiplicative(Linear):
        def noise(self, x):
            return 0.1 + 0.3 * x[..., None]

    problem = task(0.5)
    other = Problem(
        Multiplicative([[0.0]], [[1.0]]), QuadraticCost([[1.0]], [[1.0]], [[1.0]]), Unbounded(), Box([-1.0], [1.0]),
        problem.horizon, risk=0.5,
    )  # fmt: skip
    with pytest.raises(OracleError, match="constant σ"):
        oracle_of(other.double())
    assert oracle_of(other.replaced(risk=0.0).double()) is not None


def test_the_mean_with_risk_lies_between_mean_and_greatest():
    samples = torch.tensor([[1.0, 4.0], [3.0, 4.0]], dtype=torch.float64)
    assert_close(mean_with_risk(samples, 0.0), samples.mean(0))
    assert_close(mean_with_risk(samples, 1e-6), samples.mean(0), atol=1e-5, rtol=0)
    assert_close(float(mean_with_risk(samples, 1.0)[0]), math.log((math.e + math.e**3) / 2))
    assert_close(mean_with_risk(samples, 200.0), samples.amax(0), atol=0.01, rtol=0)


def test_a_risk_is_kept_by_copies_and_refused_if_it_is_none():
    problem = task(0.7)
    assert problem.in_steps(steps=3).risk == in_float64(problem).risk == problem.without_noise().risk == 0.7
    assert problem.replaced(risk=0.0).risk == 0
    assert problem.differences(problem.record()) == task(0.0).differences(task(0.0).record()) == []
    for one, other in ((task(0.0), problem), (problem, task(0.0)), (task(0.8), problem)):
        assert one.differences(other.record()) == ["risk"]
    for wrong in (-1.0, math.inf, math.nan):
        with pytest.raises(ValueError, match="finite risk ≥ 0"):
            task(wrong)

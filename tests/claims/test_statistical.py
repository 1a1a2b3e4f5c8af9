"""The statistical claim: its bound against closed forms and coverage; its events against known closed loops."""

import math

import pytest
import torch
from scipy.stats import binom

from lyapnet.base.errors import DivergenceError
from lyapnet.claims.statistical import bound_share, count_successes, lower_bound
from lyapnet.evaluation.oracles.riccati import discrete_riccati
from lyapnet.loop.programs import Tolerances
from lyapnet.loop.rollout import Rollout
from lyapnet.task.cost import QuadraticCost
from lyapnet.task.sets import Box
from lyapnet.task.systems import Linear
from lyapnet.value.policy import HJBPolicy
from tests.problems import problem_of


def problem(rate=0.5):
    """ẋ = rate · x + u on X₀ = [−1, 1]."""
    cost = QuadraticCost([[1.0]], [[1.0]], [[1.0]])
    return problem_of(Linear([[rate]], [[1.0]]), cost, 40, 0.05, Box([-1.0], [1.0]))


@pytest.fixture
def scalar(quadratic):
    """rate, factor ↦ rollout of ẋ = rate · x + u under the law of `factor` times the optimal value."""

    def build(rate=0.5, factor=1.0):
        task = problem(rate)
        P = discrete_riccati(task.system, task.cost, task.horizon).P
        return Rollout(task, HJBPolicy(task, quadratic(factor * P, task.horizon.dt)))

    return build


@pytest.mark.parametrize(("samples", "confidence"), [(100, 0.95), (10_000, 1 - 1e-6)])
def test_all_successes_have_the_closed_form(samples, confidence):
    assert lower_bound(samples, samples, confidence) == pytest.approx((1 - confidence) ** (1 / samples), rel=1e-9)
    assert lower_bound(0, samples, confidence) == 0


@pytest.mark.parametrize("successes", [1, 17, 499, 500])
def test_the_tail_at_the_bound_is_what_the_confidence_leaves(successes):
    p = lower_bound(successes, 500, 1 - 1e-6)
    assert binom.sf(successes - 1, 500, p) == pytest.approx(1e-6, rel=1e-6)


def coverage(bound, p, samples):
    """P(bound(K) ≤ p) for K ~ Binomial(samples, p), summed exactly."""
    return math.fsum(binom.pmf(k, samples, p) for k in range(samples + 1) if bound(k) <= p)


@pytest.mark.parametrize("p", [0.5, 0.9, 0.99, 0.999])
def test_coverage_is_at_least_the_confidence(p):
    assert coverage(lambda k: lower_bound(k, 200, 0.99), p, 200) >= 0.99


def test_the_bound_of_the_normal_approximation_does_not_cover():
    """The twin: p̂ − z √(p̂(1 − p̂)/n) claims too much near p = 1."""
    wald = lambda k: k / 200 - 2.326 * math.sqrt(k / 200 * (1 - k / 200) / 200)  # noqa: E731
    assert coverage(wald, 0.99, 200) < 0.99


@pytest.mark.parametrize("arguments", [(-1, 10, 0.9), (11, 10, 0.9), (0, 0, 0.9), (1, 2, 0.0), (1, 2, 1.0)])
def test_impossible_counts_and_confidences_are_refused(arguments):
    with pytest.raises(ValueError, match="Expected"):
        lower_bound(*arguments)


def test_a_good_value_function_is_certified(scalar):
    # V_{n+1} − V_n + Δt ℓ ≤ 0 up to O(Δt) where V exceeds the optimum by a little
    claim = bound_share(scalar(factor=1.1), problem(), Tolerances(radius=0.6, cost=0.05), samples=2000)
    assert claim.successes == dict.fromkeys(("decrease", "terminal", "cost", "constraints", "all"), 2000)
    assert claim.verdict == "certified"
    assert claim.probability_lower_bound == pytest.approx(1e-6 ** (1 / 2000))
    assert len(claim.failures) == 0


def test_a_value_below_the_cost_is_falsified(scalar):
    claim = bound_share(scalar(factor=0.5), problem(), Tolerances(radius=0.6), samples=2000)
    assert claim.verdict == "falsified"
    assert claim.successes["cost"] == 0
    assert torch.equal(claim.failures, claim.states)


def test_a_radius_that_some_states_miss_gives_their_share(scalar):
    rollout = scalar()
    reach = float(rollout(torch.ones(1, 1)).x[-1].detach().abs())
    claim = bound_share(rollout, problem(), Tolerances(radius=0.7 * reach, cost=1e-6), samples=2000)
    share = claim.shares["terminal"]
    assert share == pytest.approx(0.7, abs=0.05)
    assert claim.lower_bounds["terminal"] < 0.7 < 1 - lower_bound(2000 - int(2000 * share), 2000, 1 - 1e-6)
    assert claim.verdict == "falsified"
    assert (claim.states[~claim.held[:, 1]].abs() > 0.65).all(), "those from far away miss it"
    assert len(claim.failures) == 2000 - claim.successes["all"]


def test_too_few_samples_leave_it_unknown(scalar):
    claim = bound_share(scalar(factor=1.1), problem(), Tolerances(radius=0.6, cost=0.05), samples=100)
    assert claim.verdict == "unknown"


def test_batches_do_not_change_the_claim(scalar):
    claims = [
        count_successes(scalar(), problem(), Tolerances(0.1), 100, torch.Generator().manual_seed(0), batch)
        for batch in (7, 100)
    ]
    assert claims[0].successes == claims[1].successes


def test_divergent_closed_loops_count_as_failures(scalar):
    rollout = scalar(factor=1.1)

    def diverging(x0):
        if (x0 > 0.99).any():
            raise DivergenceError("Expected a finite closed loop, got none.")
        return rollout(x0)

    claim = count_successes(diverging, problem(), Tolerances(radius=0.6, cost=0.05), samples=1000)
    beyond = int((problem().initial_states.sample(1000, torch.Generator().manual_seed(0)) > 0.99).sum())
    assert 0 < 1000 - claim.successes["all"] <= 16 * 3 * max(beyond, 5)
    assert claim.verdict == "falsified"


def test_sampling_never_certifies(scalar):
    assert count_successes(scalar(factor=1.1), problem(), Tolerances(0.6, cost=0.05)).verdict == "unknown"


def test_no_samples_and_negative_tolerances_are_refused(scalar):
    with pytest.raises(ValueError, match="samples"):
        count_successes(scalar(), problem(), Tolerances(0.1), samples=0)
    with pytest.raises(ValueError, match="radius"):
        Tolerances(radius=-1.0)

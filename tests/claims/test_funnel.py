"""Sound claims against known truths: Riccati solutions, planted violations, dense grids and accurate rollouts."""

import math
import re
from dataclasses import replace
from functools import cache

import pytest
import torch
from torch import nn

from lyapnet.base.errors import UsageError
from lyapnet.claims import funnel as funnels
from lyapnet.claims.funnel import enclosing_box, prove_funnel
from lyapnet.loop.rollout import Rollout
from lyapnet.prover import condition as conditions
from lyapnet.prover import elementary_functions, taylor
from lyapnet.prover import proof as proofs
from lyapnet.prover.bounds import BoundedFunction
from lyapnet.prover.boxes import faces
from lyapnet.prover.branch_and_bound import Budget, minimum, share_below
from lyapnet.prover.condition import DecreaseCondition
from lyapnet.prover.counterexamples import Counterexample
from lyapnet.prover.proof import prove
from lyapnet.task.sets import Box
from lyapnet.task.systems import Linear
from lyapnet.value.policy import HJBPolicy
from tests.claims.planted import DURATION, X0, Planted, domain, loop, problem, riccati, stationary
from tests.marks import sample
from tests.problems import AMPLE


@pytest.fixture
def P():
    return riccati()


def certify(closed_loop, **options):
    options = {"alpha": 0.9, "delta": 0.02, "budget": Budget(AMPLE), **options}
    return prove_funnel(closed_loop, problem(), **options)


@cache
def riccati_claim():
    return certify(loop(riccati()))


@pytest.mark.gate
def test_the_riccati_solution_is_certified(P):
    claim = riccati_claim()
    assert claim.verdict == "certified"
    assert claim.volume_share == 1
    assert claim.counterexample is None
    assert claim.rho == claim.wanted
    corners = torch.cartesian_prod(torch.tensor([-1.0, 1.0]), torch.tensor([-0.7, 0.7]))
    assert claim.wanted == pytest.approx(float(stationary(P)(torch.zeros(()), corners).max()), rel=2e-3)


@pytest.mark.gate
def test_closed_loops_stay_in_the_funnel_and_below_their_guaranteed_cost(P):
    """An independent integrator starts on the boundary of the funnel."""
    claim, V = riccati_claim(), stationary(P)
    angle = torch.linspace(0, 2 * math.pi, 60)
    x0 = torch.stack([angle.cos(), angle.sin()], -1)
    x0 = x0 * (claim.rho / V(torch.zeros(()), x0)).sqrt()[:, None] * (1 - 1e-9)
    trajectory = Rollout(problem(), HJBPolicy(problem(), V), "rk4")(x0)
    assert claim.states.contains(trajectory.x).all()
    assert (trajectory.value <= claim.rho + claim.delta * trajectory.t[:, None]).all()
    guaranteed = claim.guaranteed_cost(trajectory.value[0])
    assert (trajectory.cost <= guaranteed).all()
    assert (trajectory.cost > 0.2 * guaranteed).all()
    assert claim.guaranteed_cost(torch.tensor([1.01 * claim.rho])).isinf().all()


@pytest.mark.parametrize("factor", [0.5, -1.0])
def test_a_wrong_value_function_is_falsified(P, factor):
    closed_loop = loop(factor * P)
    condition = DecreaseCondition(closed_loop, 0.9, 0.02)
    proof = prove(condition, domain(), budget=Budget(AMPLE))
    assert proof.verdict == "falsified"
    assert proof.level == -math.inf
    found = proof.counterexample
    x = torch.tensor(found.x)
    assert Box(*(side[1:] for side in domain())).contains(x)
    assert float(condition(torch.tensor(found.t), x).detach()) == pytest.approx(found.condition)
    assert found.condition > 0


@pytest.mark.gate
def test_an_unstable_loop_is_falsified():
    system = Linear([[0.0, 1.0], [4.0, 0.0]], [[0.0], [1.0]])
    claim = certify(loop(1e-2 * torch.eye(2), system), budget=Budget(AMPLE, boxes=1000))
    assert claim.verdict == "falsified"
    assert claim.counterexample.condition > 0


def test_alpha_above_what_holds_is_falsified(P):
    """V̇ + ℓ = 0 along the optimal loop of V = xᵀPx, and of 1.1 V there is 10 % more to pay with, but no more."""
    assert prove(DecreaseCondition(loop(P), 0.95, 0.05), domain(), budget=Budget(AMPLE)).verdict == "certified"
    bad = DecreaseCondition(loop(0.8 * P), 1.0, 0.05)
    assert prove(bad, domain(), budget=Budget(AMPLE)).verdict == "falsified"


@pytest.mark.parametrize("side", sample([0.05, 0.3, 0.01], 3))
def test_planted_violations_are_never_certified(P, side):
    lower, upper = domain()
    for seed in range(2):
        generator = torch.Generator().manual_seed(seed)
        point = lower + (upper - lower) * torch.rand(3, generator=generator)
        condition = Planted(loop(P), 0.9, 0.05).plant(point, side, 0.01)
        budget = Budget(AMPLE, boxes=600)
        proof = prove(condition, (lower, upper), budget=budget, stop_at_counterexample=False, generator=generator)
        value = float(condition.height(point[0], point[1:]))
        assert proof.verdict != "certified"
        assert proof.level < value
        if proof.counterexample is not None:
            assert math.dist([proof.counterexample.t, *proof.counterexample.x], point.tolist()) < 3 * side


def proof_without_search(monkeypatch, P):
    """A proof of a condition that fails, when no counterexample is looked for."""
    monkeypatch.setattr(proofs, "find_counterexample", lambda *arguments: None)
    monkeypatch.setattr(proofs, "lowest_violation", lambda *arguments: None)
    condition = Planted(loop(P), 0.9, 0.05).plant(torch.tensor([1.1, 0.3, 0.4]), 0.05, 0.01)
    return prove(condition, domain(), budget=Budget(AMPLE, boxes=3000))


def test_bounds_alone_do_not_certify_what_fails(P, monkeypatch):
    assert proof_without_search(monkeypatch, P).verdict == "unknown"


def test_bounds_without_remainders_would(P, monkeypatch):
    """The counterpart: without remainders a false condition is certified."""

    def without_remainder(function):
        def wrong(*arguments, **keywords):
            form = function(*arguments, **keywords)
            return form.with_parts(form.terms, torch.zeros_like(form.radius))

        return wrong

    for module, name in ((elementary_functions, "linearised"), (taylor, "multiply")):
        monkeypatch.setattr(module, name, without_remainder(getattr(module, name)))
    monkeypatch.setattr(
        conditions, "BoundedFunction", lambda f, domain, *_: BoundedFunction(f, domain, 1)
    )  # everything is in remainders
    assert proof_without_search(monkeypatch, P).verdict == "certified"


@pytest.mark.gate
def test_a_violation_lowers_the_level_and_what_lies_below_holds(P):
    condition = Planted(loop(P), 0.9, 0.05).plant(torch.tensor([1.0, 0.5, 0.2]), 0.2, 0.3)
    proof = prove(condition, domain(), 12.0, Budget(AMPLE, boxes=10_000), stop_at_counterexample=False)
    assert proof.verdict == "falsified"
    value = float(condition.height(condition.point[0], condition.point[1:]))
    assert 0.2 * value < proof.level < value
    points = torch.cartesian_prod(*(torch.linspace(float(a), float(b), 60) for a, b in zip(*domain(), strict=True)))
    with torch.no_grad():
        c, W = condition(points[:, 0], points[:, 1:]), condition.height(points[:, 0], points[:, 1:])
    assert (c[proof.level >= W] <= 0).all()
    assert (c[1.2 * value >= W] > 0).any()


def true_with_a_dip(P):
    """A condition that holds, with a narrow dip; without the dip a single box would prove it."""
    return Planted(loop(P), 0.9, 0.05).plant(torch.tensor([1.1, 0.3, 0.4]), 0.3, -5.0)


def test_a_spent_budget_leaves_it_unknown(P):
    proof = prove(true_with_a_dip(P), domain(), budget=Budget(AMPLE, boxes=20, chunk=10))
    assert proof.verdict == "unknown"
    assert 0 < proof.remaining_volume <= 1
    assert proof.boxes <= 30
    assert len(proof.undecided) > 0


@pytest.mark.gate
def test_a_small_frontier_gives_up_the_highest_boxes(P):
    condition = true_with_a_dip(P)
    kept = prove(condition, domain(), budget=Budget(AMPLE))
    small = prove(condition, domain(), budget=Budget(AMPLE, chunk=16, frontier=8))
    assert kept.verdict == "certified"
    assert small.verdict == "unknown"
    assert small.level < kept.level


@pytest.mark.gate
def test_a_set_that_is_too_small_holds_a_lower_funnel(P):
    """V on its boundary bounds ρ + δT."""
    small = Box(torch.tensor([-1.1, -0.8]), torch.tensor([1.1, 0.8]))
    claim = certify(loop(P), states=small)
    inverse = torch.linalg.inv(torch.as_tensor(P))
    rim = min(1.1**2 / float(inverse[0, 0]), 0.8**2 / float(inverse[1, 1]))
    assert claim.verdict == "unknown"
    assert claim.rho + claim.delta * DURATION == pytest.approx(rim, rel=2e-3)
    assert claim.rho + claim.delta * DURATION < rim
    assert 0 < claim.volume_share < 1


@pytest.mark.parametrize(
    ("upper", "message"), [([0.9, 2.0], "around X₀.*index 0"), ([1.5, 2.0, 1.0], "a set of 2 states, got 3")]
)
def test_a_set_that_does_not_fit_is_refused(P, upper, message):
    states = Box(-torch.tensor(upper), torch.tensor(upper))
    with pytest.raises(UsageError, match=message):
        certify(loop(P), states=states)


def test_a_law_that_no_value_defines_is_refused(P):
    closed_loop = loop(P)
    closed_loop.policy = nn.Identity()
    with pytest.raises(UsageError, match="that a V defines"):
        DecreaseCondition(closed_loop, 0.9, 0.1)


@pytest.mark.gate
def test_least_values_and_shares():
    lower, upper = torch.tensor([0.0, -1.0, -2.0]), torch.tensor([1.0, 2.0, 3.0])

    def f(t, x):
        return (x[..., 0] - 0.4) ** 2 + torch.cos(x[..., 1]) + t

    assert minimum(f, lower[None], upper[None], Budget(10)) == pytest.approx(math.cos(3), rel=1e-3)
    assert minimum(f, lower[None], upper[None], Budget(10)) <= math.cos(3)
    assert minimum(f, lower[None], upper[None], Budget(10), lambda t, x: -x[..., 0], -1.0) == pytest.approx(
        0.36 + math.cos(3), rel=2e-3
    )
    low, high = faces(lower, upper, axes=range(1, 3))
    assert minimum(f, low, high, Budget(10)) == pytest.approx(math.cos(3), rel=1e-3)
    assert minimum(f, low[:2], high[:2], Budget(10)) == pytest.approx(1.4**2 + math.cos(3), rel=1e-3)
    flat = torch.tensor([0.0, -1.0, -1.0]), torch.tensor([0.0, 1.0, 1.0])
    share = share_below(lambda t, x: (x**2).sum(-1) + t, *flat, 1.0, Budget(10))
    assert math.pi / 4 - 0.01 < share <= math.pi / 4


def test_the_enclosing_box_reaches_around_the_level_set(P):
    box = enclosing_box(stationary(P), X0(), torch.zeros(2), DURATION, 10.0)
    extent = (10.0 * torch.linalg.inv(torch.as_tensor(P)).diagonal()).sqrt()
    assert (box.upper > extent).all()
    assert (box.upper < 1.3 * torch.maximum(extent, X0().upper)).all()


@pytest.mark.gate
def test_a_tiny_budget_proves_nothing_and_falsifies_nothing(P, monkeypatch):
    monkeypatch.setattr(funnels, "MIN_LEVEL_SECONDS", AMPLE)  # seconds for levels, enough on a busy machine too
    claim = certify(loop(P), budget=Budget(1e-6))
    assert claim.verdict == "unknown"
    assert re.fullmatch(r"seconds spent, \d+ of them before the first box: .*", claim.reason)
    assert claim.wanted == riccati_claim().wanted
    assert claim.states.upper.tolist() == riccati_claim().states.upper.tolist()


def test_what_fails_above_the_least_level_that_X0_needs_falsifies_nothing():
    claim = riccati_claim()
    assert claim.least <= claim.wanted <= 1.002 * claim.least
    between = Counterexample(1.0, [1.0, 1.0], 0.1, (claim.least + claim.wanted) / 2)
    undecided = replace(claim, rho=0.0, counterexample=between)
    assert undecided.verdict == "unknown"
    assert "close to" in undecided.reason
    assert replace(undecided, counterexample=between._replace(height=claim.least)).verdict == "falsified"


@pytest.mark.gate
def test_a_set_that_cuts_the_funnel_is_named(P):
    small = Box(torch.tensor([-1.1, -0.8]), torch.tensor([1.1, 0.8]))
    assert "boundary of D" in certify(loop(P), states=small).reason


PUSHED = torch.tensor([0.0, 0.05])


@cache
def pushed_claim():
    return certify(loop(riccati()), delta=0.1, disturbance=PUSHED)


def after_pushes(push):
    """(the highest V − δt, cost) of closed loops from the funnel's boundary under the worst such disturbance."""
    claim, V, about = pushed_claim(), stationary(riccati()), problem()
    angle = torch.linspace(0, 2 * math.pi, 60)
    x = torch.stack([angle.cos(), angle.sin()], -1)
    x = x * (claim.rho / V(torch.zeros(()), x)).sqrt()[:, None] * (1 - 1e-9)
    law, P, dt, cost, highest = HJBPolicy(about, V), torch.as_tensor(riccati()), 1e-3, torch.zeros(60), 0.0
    for k in range(int(DURATION / dt)):
        t = torch.tensor(k * dt)
        highest = max(highest, float((V(t, x) - claim.delta * t).max()))
        u = law(t.expand(60), x).detach()
        cost = cost + dt * about.cost.running(x, u)
        x = x + dt * (about.system.dynamics(x, u) + push * (x @ P).sign())
    return highest, cost.detach() + about.cost.terminal(x).detach()


@pytest.mark.gate
def test_a_funnel_holds_whatever_pushes_there_are_up_to_those_it_is_proved_for():
    claim = pushed_claim()
    assert claim.verdict == "certified"
    highest, cost = after_pushes(PUSHED)
    assert highest <= claim.rho
    assert (cost <= claim.guaranteed_cost(torch.full((60,), claim.rho * (1 - 1e-9)))).all()


@pytest.mark.gate
def test_larger_pushes_leave_the_funnel_and_are_not_proved():
    assert after_pushes(100 * PUSHED)[0] > pushed_claim().rho
    few = Budget(AMPLE, boxes=4 * pushed_claim().boxes)
    assert certify(loop(riccati()), delta=0.1, disturbance=100 * PUSHED, budget=few).verdict != "certified"


def test_disturbances_that_are_none_are_refused():
    for w, expected in ((torch.tensor([0.0, -1.0]), "≥ 0"), (torch.tensor([math.nan, 0.0]), "≥ 0")):
        with pytest.raises(UsageError, match=f"Expected disturbances {expected}"):
            certify(loop(riccati()), disturbance=w)

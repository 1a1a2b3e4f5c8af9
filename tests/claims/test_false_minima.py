"""Fifty false claims with other costs of controls, or in a ball: none is certified; and claims refused at once.

Each false claim has a state in its funnel where V falls too slowly. The law keeps V from rising only where its controls
are cheap enough, or large enough, and the claims differ from true ones in how far that reaches.
"""

import pytest
import torch
from torch.testing import assert_close

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.claims.funnel import prove_funnel
from lyapnet.loop.rollout import ClosedLoop
from lyapnet.prover.branch_and_bound import Budget
from lyapnet.prover.condition import DecreaseCondition
from lyapnet.task.ball import ControlBall
from lyapnet.task.cost import QuadraticCost
from lyapnet.task.cost.control_costs import (
    AbsoluteCost,
    ControlCosts,
    EntropyCost,
    LogCosCost,
    NormCost,
    PowerCost,
    PseudoHuberControlCost,
    SeparableCost,
)
from lyapnet.task.sets import Box, ControlBox, Unbounded
from lyapnet.task.systems import Linear
from lyapnet.value.policy import HJBPolicy, SampledPolicy
from tests.marks import sample
from tests.problems import AMPLE, Formula, problem_of

ALPHA, DELTA, BOXES = 0.9, 0.01, 3000
KINDS = {
    "absolute": ([AbsoluteCost(0.4)], lambda a: ControlBox(-a, a)),
    "absolute of each": ([AbsoluteCost([0.3, 0.5])], lambda a: ControlBox(-a, a)),
    "power 1.5": ([PowerCost(0.3, 1.5)], lambda a: ControlBox(-a, a)),
    "power 3": ([PowerCost(0.3, 3)], lambda a: ControlBox(-a, a)),
    "pseudo-Huber": ([PseudoHuberControlCost(0.3, 0.1)], lambda a: ControlBox(-a, a)),
    "log-cos": ([LogCosCost(0.2, 4.0)], lambda a: ControlBox(-a, a)),
    "entropy": ([EntropyCost(0.2, 4.0)], lambda a: ControlBox(-a, a)),
    "absolute and entropy": ([AbsoluteCost(0.2), EntropyCost(0.2, 4.0)], lambda a: ControlBox(-a, a)),
    "norm in a ball": ([NormCost(0.3)], ControlBall),
    "ball": ([], ControlBall),
}


def parts(kind, a, growth, rest=None, controls=None, strength=1.0):
    """(problem, loop) of ẋ = growth x + strength u, V = 2‖x‖², with limits or a radius a."""
    costs, limits = KINDS[kind]
    system = Linear([[growth, 0.3], [-0.3, growth]], [[strength, 0.0], [0.0, strength]])
    cost = QuadraticCost(0.2 * torch.eye(2), 0.5 * torch.eye(2), torch.eye(2))
    cost.nonquadratic = ControlCosts(costs) if costs else None
    cost.rest = rest
    controls = limits(a) if controls is None else controls
    problem = problem_of(system, cost, 20, initial_states=Box([-0.5, -0.5], [0.5, 0.5]), controls=controls)
    V = Formula(lambda t, x: 2 * (x * x).sum(-1) + 0 * t)
    return problem, ClosedLoop(problem, HJBPolicy(problem, V)).double()


def claimed(kind, a, growth, boxes=BOXES):
    problem, loop = parts(kind, a, growth)
    D = Box([-0.8, -0.8], [0.8, 0.8])
    return prove_funnel(loop, problem, ALPHA, DELTA, D, Budget(AMPLE, boxes=boxes)), loop


def largest_condition(loop, found, delta=DELTA):
    """The largest V̇ + αℓ − δ at states of the funnel of X₀, from f, g, ℓ and u alone, and the largest with ρ."""
    angle = 2 * torch.pi * torch.rand(20_000)
    size = (found.wanted / 2) ** 0.5 * torch.rand(20_000).sqrt()
    x = size[:, None] * torch.stack([angle.cos(), angle.sin()], -1)
    with torch.no_grad():
        u = loop.policy(torch.zeros(len(x)), x)
        rate = (4 * x * loop.system.dynamics(x, u)).sum(-1)
        return float((rate + ALPHA * loop.cost.running(x, u) - delta).max())


LIMITS, GROWTH = 4.0, -0.2  # with which the claim is true
FALSE = [
    (kind, a, growth) for kind in KINDS for a, growth in ((0.05, 0.5), (0.2, 0.7), (4.0, 3.5), (0.3, 0.9), (0.4, 1.2))
]


@pytest.mark.parametrize("kind", sample(KINDS, 20))
def test_its_twin_is_certified(kind):
    found, loop = claimed(kind, LIMITS, GROWTH)
    assert found.verdict == "certified"
    assert largest_condition(loop, found) <= 0
    assert "minimiser" in found.assumed


@pytest.mark.parametrize(("kind", "a", "growth"), sample(FALSE, 20))
def test_no_false_claim_is_certified(kind, a, growth):
    found, loop = claimed(kind, a, growth, 300)
    assert largest_condition(loop, found) > 1e-3, "the claim is false"
    assert found.verdict != "certified"
    assert found.rho < found.wanted


def test_they_are_fifty():
    assert len(FALSE) == 50


@pytest.mark.parametrize("rest", [None, torch.tensor([0.2, -0.1])])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("alpha", [0.3, 1.0])
def test_the_condition_of_a_minimum_is_that_of_f_g_and_the_cost(kind, rest, alpha):
    _, loop = parts(kind, 0.7, 0.2, rest)
    t, x = torch.zeros(1000), torch.randn(1000, 2)
    with torch.no_grad():
        paid, most = DecreaseCondition(loop, alpha, DELTA).decrease(t, x)
        u = loop.policy(t, x)
        fall = (4 * x * loop.system.dynamics(x, u)).sum(-1)
        assert_close(paid, fall + alpha * loop.cost.running(x, u))
        assert bool((most >= fall - 1e-12).all())


def test_a_law_that_minimises_another_cost_is_no_minimum_of_this_one():
    (_, loop), (problem, _) = parts("absolute", 1.0, 0.1), parts("power 3", 1.0, 0.1)
    mixed = ClosedLoop(problem, loop.policy).double()
    t, x = torch.zeros(100), torch.randn(100, 2)
    with torch.no_grad():
        u = mixed.policy(t, x)
        paid = (4 * x * mixed.system.dynamics(x, u)).sum(-1) + mixed.cost.running(x, u)
        assert_close(DecreaseCondition(mixed, 1.0, DELTA).decrease(t, x)[0], paid)


@pytest.mark.gate
@pytest.mark.parametrize(("delta", "verdict"), [(0.68, "falsified"), (0.9, "certified")])
def test_a_control_that_costs_nothing_away_from_zero_counts(delta, verdict):
    """u* = 0.1 lies on the other side of zero than all of U, which makes each control cost more."""
    problem, loop = parts("absolute", 1.0, -0.5, torch.tensor([0.1, 0.1]), ControlBox([-1.0] * 2, [-0.5] * 2), 0.01)
    D = Box([-1.5, -1.5], [1.5, 1.5])
    found = prove_funnel(loop, problem, ALPHA, delta, D, Budget(AMPLE, boxes=60_000))
    assert found.verdict == verdict
    assert (largest_condition(loop, found, delta) > 1e-3) == (verdict == "falsified")


# Claims that are refused at once


class FourthPower(SeparableCost):
    def forward(self, u):
        return (self.weight * u**4).sum(-1)


def controller(costs, controls, law=HJBPolicy):
    cost = QuadraticCost(torch.eye(2), torch.eye(2), torch.eye(2))
    cost.nonquadratic = ControlCosts(costs) if costs else None
    system = Linear([[-1.0, 0.3], [0.0, -1.0]], [[1.0, 0.0], [0.0, 1.0]])
    problem = problem_of(system, cost, controls=controls)
    V = Formula(lambda t, x: 2 * (x * x).sum(-1) + 0 * t)
    return lyapnet.Controller(problem, V, policy=law)


@pytest.mark.parametrize("claim", [lyapnet.Region(), lyapnet.Tube(), lyapnet.NoisyFunnel(), lyapnet.LowerBound()])
@pytest.mark.parametrize(
    ("costs", "controls", "names"),
    [([NormCost(0.3)], ControlBall(1.0), "NormCost in ControlBall"), ([], ControlBall(1.0), "uᵀRu in ControlBall")],
)
def test_claims_without_bounds_of_a_minimum_name_cost_and_set(claim, costs, controls, names):
    with pytest.raises(UsageError, match=r"^Expected controls that cost uᵀRu.*; .+\.$") as error:
        lyapnet.certify(controller(costs, controls), claim)
    if claim.kind != "lower":
        assert names in str(error.value)
        assert claim.kind in str(error.value)


def test_a_funnel_refuses_costs_and_laws_that_it_does_not_know():
    with pytest.raises(UsageError, match=r"got FourthPower in Unbounded; take one of them"):
        lyapnet.certify(controller([FourthPower(0.3)], Unbounded()), lyapnet.Funnel())
    with pytest.raises(UsageError, match=r"with NormCost in ControlBall, got SampledPolicy and QuadraticCost; train"):
        lyapnet.certify(controller([NormCost(0.3)], ControlBall(1.0), SampledPolicy), lyapnet.Funnel())
    with pytest.raises(UsageError, match=r"powers of at least 2 .* got less in PowerCost .*; take pseudo_huber"):
        lyapnet.certify(controller([PowerCost(0.3, 1.5)], ControlBox(-1, 1)), lyapnet.Funnel())

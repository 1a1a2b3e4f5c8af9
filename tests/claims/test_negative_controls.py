"""Claims that must never be certified: planted violations, unstable loops, wrong signs, wrong α; and error messages."""

import math

import pytest
import torch

from lyapnet.base.errors import UsageError
from lyapnet.claims import funnel
from lyapnet.claims.funnel import prove_funnel
from lyapnet.loop.rollout import ClosedLoop
from lyapnet.prover.branch_and_bound import Budget
from lyapnet.prover.condition import DecreaseCondition
from lyapnet.prover.proof import prove
from lyapnet.task.sets import Box
from lyapnet.task.systems import Linear
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.policy import HJBPolicy, SontagPolicy
from tests.claims.planted import Planted
from tests.marks import sample
from tests.problems import AMPLE, problem_of

DURATION = 2.0
LOWER, UPPER = torch.tensor([0.0, -1.0, -1.0]).double(), torch.tensor([DURATION, 1.0, 1.0]).double()
STABLE = [[-1.0, 0.3], [0.0, -1.0]]
UNSTABLE = [[2.0, 0.0], [0.3, 1.0]]


@pytest.fixture(autouse=True)
def _little_time_for_levels(monkeypatch):
    """The levels of a V that cannot be certified take all the time that is allowed."""
    monkeypatch.setattr(funnel, "MAX_LEVEL_SECONDS", 5.0)


class Bowl(ValueFunction):
    """V = p ‖x‖² + a bump of height h and width s at (t₀, x₀), of which V̇ fails beside its top."""

    def __init__(self, p=2.0, bump=None):
        super().__init__()
        self.p, self.bump = p, bump

    def forward(self, t, x):
        value = self.p * (x**2).sum(-1) + 0 * t
        if self.bump is None:
            return value
        point, side, height = self.bump
        distance = (t - point[0]) ** 2 + ((x - point[1:]) ** 2).sum(-1)
        return value + height * torch.exp(-distance / side**2)


def loop(V, A=STABLE, law=HJBPolicy, gain=1.0):
    system = Linear(A, [[0.0], [gain]])
    problem = problem_of(system)
    return ClosedLoop(problem, law(problem, V)).double()


def X0(half=0.5):
    return Box(torch.full((2,), -half).double(), torch.full((2,), half).double())


def claim(closed_loop, *arguments, **options):
    """The sound claim of a loop on X₀ for 2 s."""
    problem = problem_of(closed_loop.system, steps=20, dt=DURATION / 20, initial_states=X0())
    return prove_funnel(closed_loop, problem, *arguments, **options)


def planted_at_random(seed):
    """(a condition with a violation at a random place, of width 0.3 to 0.01, in c or in V; its place)."""
    generator = torch.Generator().manual_seed(seed)
    point = LOWER + (UPPER - LOWER) * torch.rand(3, generator=generator).double()
    side = 0.3 * (0.01 / 0.3) ** ((seed % 10) / 9)
    if seed % 2:
        return Planted(loop(Bowl()), 0.5, 0.02).plant(point, side, 0.01), point, side
    return DecreaseCondition(loop(Bowl(bump=(point, side, 20 * side))), 0.5, 0.02), point, side


def proof_of(condition, seed, boxes=200):
    budget = Budget(AMPLE, boxes=boxes, chunk=100)
    generator = torch.Generator().manual_seed(seed)
    return prove(condition, (LOWER, UPPER), budget=budget, stop_at_counterexample=False, generator=generator)


def refuted(condition, point, side):
    """A point near the planted one where c > 0, by plain arithmetic."""
    offsets = side * torch.cartesian_prod(*[torch.linspace(-1.5, 1.5, 13).double()] * 3)
    points = (point + offsets).clamp(LOWER, UPPER)
    with torch.no_grad():
        c, W = condition(points[:, 0], points[:, 1:]), condition.height(points[:, 0], points[:, 1:])
    return float(W[c > 0].min()) if (c > 0).any() else None


def controls(seeds):
    """Verdicts on planted violations; each true counterexample lies above the proved level."""
    verdicts = []
    for seed in seeds:
        condition, point, side = planted_at_random(seed)
        height = refuted(condition, point, side)
        assert height is not None, "nothing was planted"
        proof = proof_of(condition, seed)
        assert proof.level <= height
        if proof.counterexample is not None:
            t, x = torch.tensor(proof.counterexample.t), torch.tensor(proof.counterexample.x)
            with torch.no_grad():
                assert float(condition(t, x)) > 0
        verdicts.append(proof.verdict)
    return verdicts


def test_what_nothing_is_planted_in_is_certified():
    """The counterpart of all tests below, with the same budget."""
    assert proof_of(DecreaseCondition(loop(Bowl()), 0.5, 0.02), 0).verdict == "certified"


@pytest.mark.parametrize("first", sample(range(0, 100, 4), 25))
def test_a_hundred_planted_violations_are_never_certified(first):
    assert "certified" not in controls(range(first, first + 4))


@pytest.mark.gate
@pytest.mark.parametrize("seed", sample(range(2), 2))
def test_unstable_loops_are_falsified_with_true_counterexamples(seed):
    """Their states grow, and V grows from the counterexample along a short step, in plain arithmetic."""
    torch.manual_seed(seed)
    closed_loop = loop(Bowl(0.2), A=(torch.tensor(UNSTABLE) + 0.1 * torch.randn(2, 2)).tolist(), gain=0.1)
    found = claim(closed_loop, 0.5, 0.01, Box(LOWER[1:], UPPER[1:]), Budget(AMPLE, boxes=2000))
    assert found.verdict == "falsified"
    t, x = torch.tensor(found.counterexample.t), torch.tensor(found.counterexample.x)
    u = closed_loop.policy(t, x).detach()
    V, dt = closed_loop.policy.V, 1e-6
    rate = (V(t + dt, x + dt * closed_loop.system.dynamics(x, u)) - V(t, x)) / dt
    violation = float(rate + 0.5 * closed_loop.cost.running(x, u) - 0.01)
    assert violation > 0
    assert violation == pytest.approx(found.counterexample.condition, rel=1e-4)


@pytest.mark.gate
@pytest.mark.parametrize("V", [Bowl(-2.0), Bowl(0.05)], ids=["wrong sign", "too small"])
def test_a_wrong_value_function_is_falsified(V, monkeypatch):
    monkeypatch.setattr(funnel, "MAX_LEVEL_SECONDS", 0.5)
    found = claim(loop(V), 0.5, 0.02, Box(LOWER[1:], UPPER[1:]), Budget(AMPLE, boxes=2000))
    assert found.verdict == "falsified"


def test_too_large_an_alpha_is_falsified():
    proofs = [proof_of(DecreaseCondition(loop(Bowl(0.4)), alpha, 0.02), 0) for alpha in (0.5, 1.0)]
    assert [proof.verdict for proof in proofs] == ["certified", "falsified"]


class Jump(Bowl):
    """V that jumps up by 1 where x₁ becomes negative, which its gradient does not show."""

    def forward(self, t, x):
        return super().forward(t, x) + (x[..., 0] < 0).to(x)


class Bent(Bowl):
    """V with kinks, and without jumps."""

    def forward(self, t, x):
        return super().forward(t, x) + torch.relu(x[..., 0]) ** 2 + 0.1 * torch.maximum(x[..., 0], x[..., 1]) ** 2


class Opaque(Bowl):
    def forward(self, t, x):
        return super().forward(t, x) + torch.special.bessel_j0(x[..., 0]) ** 2


class Undecided(Bowl):
    def forward(self, t, x):
        return super().forward(t, x) if bool(x.sum() > 0) else 2 * super().forward(t, x)


@pytest.mark.parametrize(
    ("V", "options", "message"),
    [
        (Jump(), {}, r"continuous V, got aten\.lt\.Scalar"),
        (Opaque(), {}, r"operators with a rule for bounds, got aten\.special_bessel_j0"),
        (Undecided(), {}, "control flow that does not depend on values"),
        (Bowl(), {"alpha": 0.0}, "0 < alpha ≤ 1, got 0.0"),
        (Bowl(), {"alpha": math.nan}, "0 < alpha ≤ 1, got nan"),
        (Bowl(), {"delta": -1.0}, "delta ≥ 0, got -1.0"),
        (Bowl(), {"delta": math.nan}, "delta ≥ 0, got nan"),
        (Bowl(), {"states": X0(0.4)}, "a set around X₀"),
    ],
)
def test_what_cannot_be_certified_is_refused_in_one_line(V, options, message):
    options = {"alpha": 0.5, "delta": 0.02, "states": Box(LOWER[1:], UPPER[1:]), "budget": Budget(5), **options}
    with pytest.raises(UsageError, match=message) as error:
        claim(loop(V), **options)
    assert "\n" not in str(error.value)


@pytest.mark.gate
def test_kinks_are_certified():
    found = claim(loop(Bent()), 0.5, 0.05, budget=Budget(120, boxes=20_000))
    assert found.verdict == "certified"


@pytest.mark.gate
def test_a_law_with_branches_is_certified_off_the_goal():
    """At the goal itself the gain of Sontag's law is 0/0, and has no bound."""
    condition = DecreaseCondition(loop(Bowl(), law=SontagPolicy), 0.5, 0.05)
    off = torch.tensor([0.0, 0.2, -0.5]).double(), torch.tensor([DURATION, 0.8, 0.5]).double()
    assert prove(condition, off, budget=Budget(120, boxes=20_000)).verdict == "certified"
    assert proof_of(condition, 0).verdict == "unknown"

"""Levels below which no closed loop violates constraints, against closed forms and violating closed loops."""

import pytest
import torch

from lyapnet.base.errors import UsageError
from lyapnet.claims.checking import check
from lyapnet.claims.crossing import crossing_level, find_violation, initial_violation_level
from lyapnet.claims.funnel import prove_funnel
from lyapnet.claims.sound_certificate import SoundCertificate
from lyapnet.controller.controller import Controller
from lyapnet.prover.branch_and_bound import Budget
from lyapnet.prover.condition import DecreaseCondition, bounded_condition, own_constraints
from lyapnet.task.constraints import Ball, Constraints, StateLimits
from lyapnet.task.sets import Box
from lyapnet.task.systems import DoubleIntegrator
from tests.claims.planted import cost, domain, loop, problem, riccati, stationary
from tests.problems import Formula, hjb_loop

ENOUGH = 1e6  # far above the levels in these tests


def position(limit, side=1.0):
    return StateLimits([0], [side * limit], [side], [1.0], [f"position within {limit}"])


def speed(limit):
    return StateLimits([1], [limit], [1.0], [1.0], ["speed"])


def level(constraints, delta=0.0, enough=ENOUGH):
    condition = DecreaseCondition(loop(riccati()), 0.9, delta, constraints)
    return crossing_level(condition, domain(), Budget(20), enough)


@pytest.mark.gate
def test_the_level_of_a_limit_of_the_position():
    """h = x − b crosses with v ≥ 0, where xᵀPx is least at v = 0: P₁₁b²; beyond the shell it only grows."""
    P, b = torch.as_tensor(riccati()), 1.2
    expected = float(P[0, 0]) * b**2
    assert expected * (1 - 5e-3) <= level(position(b)) <= expected
    assert expected * (1 - 5e-3) <= level(position(b, side=-1.0)) <= expected
    assert level(position(0.9)) < 0.6 * expected
    assert level(position(b), delta=0.5) == pytest.approx(expected - 0.5 * 2.0, rel=5e-3), "W = V − δt, at T"


@pytest.mark.gate
def test_the_level_of_a_limit_of_the_speed():
    """h = v − b crosses with u = −(p₁₂x + p₂₂v) ≥ 0, so that x ≤ −p₂₂b/p₁₂: xᵀPx is least at its end or minimum."""
    P, b = torch.as_tensor(riccati()), 0.3
    p11, p12, p22 = P[0, 0], P[0, 1], P[1, 1]
    x = torch.minimum(-p22 * b / p12, -p12 * b / p11)
    expected = float(p11 * x**2 + 2 * p12 * x * b + p22 * b**2)
    assert expected * (1 - 3e-2) <= level(speed(b)) <= expected * (1 + 1e-9)


def test_what_no_closed_loop_reaches_has_no_level():
    outside = Ball([0, 1], [0.0, 9.0], 0.5, inside=False)
    assert level(outside) == float("inf"), "the ball lies beyond D"
    assert level(position(1.2), enough=1.0) >= 1.0, "no more is asked for"


class Bent(Constraints):
    """|x| ≤ 1: not smooth."""

    names = ("bent",)

    def forward(self, x):
        return x[..., :1].abs() - 1


class Lying(Constraints):
    """x ≤ 1.2 with a wrong gradient."""

    names = ("lying",)

    def forward(self, x):
        return _Backwards.apply(x)


class _Backwards(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x):
        return x[..., :1] - 1.2

    @staticmethod
    def backward(ctx, gradient):
        return torch.cat([-gradient, torch.zeros_like(gradient)], -1)


def test_constraints_have_gradients_and_these_are_their_own():
    with pytest.raises(UsageError, match=r"smooth constraints, got aten.abs.default; write a maximum as several"):
        level(Bent())
    P = torch.as_tensor(riccati())
    as_it_says = 1.2**2 * float(P[0, 0] - P[0, 1] ** 2 / P[1, 1])  # the least xᵀPx with x = b and v ≤ 0
    assert as_it_says < 0.6 * level(Lying()) < 0.6 * float(P[0, 0]) * 1.2**2


def task_within(constraints):
    return problem().replaced(constraints=constraints)


def claim(constraints, **options):
    return prove_funnel(
        loop(riccati()), task_within(constraints), **{"alpha": 0.9, "delta": 0.02, "budget": Budget(20), **options}
    )


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """The file of the proof of the safe claim."""
    return tmp_path_factory.mktemp("kept") / "proof"


@pytest.fixture(scope="module")
def safe(kept):
    return claim(position(1.35), keep=kept)


@pytest.fixture(scope="module")
def unsafe():
    return claim(position(1.03))


def certificate(limit, claimed):
    return SoundCertificate(Controller(task_within(limit), loop(riccati()).V), claimed, {"seconds": 30.0})


@pytest.mark.gate
def test_a_safe_set_is_proved_and_another_falsified(safe, unsafe):
    """From the corner of X₀ the position rises to 1.06 m; the funnel that X₀ needs reaches 1.31 m."""
    between = claim(position(1.2))
    assert safe.verdict == "certified"
    assert safe.violation is None
    assert safe.constraints == ("position within 1.35",)
    assert safe.crossing > safe.wanted
    assert unsafe.verdict == "falsified"
    assert unsafe.violation.constraint == "position within 1.03"
    assert unsafe.violation.h > 0
    assert between.verdict == "unknown", "no closed loop violates it, but the level of V does not prove this"
    assert between.rho <= between.crossing < between.wanted
    assert "satisfy the constraints" in between.reason
    assert 0 < between.volume_share < 1


@pytest.mark.gate
def test_a_kept_proof_is_about_its_constraints(safe, kept):
    again = claim(position(1.35), keep=kept, replay=True, budget=Budget(60))
    assert safe.verdict == again.verdict == "certified"
    assert safe.fingerprint == again.fingerprint
    with pytest.raises(UsageError):
        claim(position(1.4), keep=kept)
    with pytest.raises(UsageError):
        claim(None, keep=kept)


class Counting(Constraints):
    """x ≤ 1.35 in the first calls, and no limit later."""

    names = ("counting",)
    calls = 0

    def forward(self, x):
        self.calls += 1
        return x[..., :1] / 1.35 - (1 if self.calls < 60 else 9)


@pytest.mark.gate
def test_constraints_that_change_with_the_calls_are_refused_or_what_they_were(safe):
    try:
        found = claim(Counting())
    except UsageError:
        return
    assert found.crossing <= safe.crossing * 1.01


@pytest.mark.gate
def test_a_violation_is_one():
    task = task_within(position(1.03))
    found = find_violation(loop(riccati()), task, torch.Generator().manual_seed(0))
    x0 = torch.tensor(found.x0)
    assert task.initial_states.contains(x0)
    A = torch.tensor([[0.0, 1.0], [0.0, 0.0]]) - torch.tensor([[0.0], [1.0]]) @ torch.as_tensor(riccati())[1:]
    x = torch.matrix_exp(A * found.t) @ x0
    assert float(x[0] - 1.03) == pytest.approx(found.h, rel=1e-4)
    assert find_violation(loop(riccati()), task_within(position(1.35)), None) is None


@pytest.mark.gate
def test_the_condition_is_not_asked_for_where_a_constraint_excludes_the_state():
    """V rises on one side of a bump at a speed that no closed loop reaches from below, within the level of X₀."""
    quadratic, place = stationary(riccati()), torch.tensor([-0.2, 0.72])
    bumped = Formula(lambda t, x: quadratic(t, x) + 0.05 * torch.exp(-1500 * ((x - place) ** 2).sum(-1)))
    closed_loop = hjb_loop(DoubleIntegrator(), cost(), bumped)
    task, box = problem().replaced(initial_states=Box([-0.25, -0.25], [0.25, 0.25])), Box([-0.8, -1.2], [0.8, 1.2])
    assert prove_funnel(closed_loop, task, 0.9, 0.02, box, Budget(60, boxes=2000)).verdict == "falsified"
    slow = task.replaced(constraints=speed(0.65))
    assert prove_funnel(closed_loop, slow, 0.9, 0.02, box, Budget(60)).verdict == "certified"


@pytest.mark.gate
def test_the_report_says_what_is_kept(safe, unsafe):
    proved, failed = certificate(position(1.35), safe), certificate(position(1.03), unsafe)
    assert "or violates a constraint (position within 1.35), up to T = 2 s" in proved.in_words()
    assert "h(x(t)) ≤ 0" in proved.in_formulas()[1]
    assert "h(x₀) ≤ 0" in proved.in_formulas()[1]
    assert proved.numbers()["constraints"] == ["position within 1.35"]
    assert "no closed loop from X₀ violates a constraint: the one from x₀ = (" in failed.verdict_text()
    assert failed.numbers()["violation"]["constraint"] == "position within 1.03"


class Fickle(Constraints):
    """x ≤ 1.35 in batches, and violated by every single state."""

    names = ("fickle",)

    def forward(self, x):
        return 1 + x[..., :1] ** 2 if x.ndim == 1 else x[..., :1] - 1.35


class Forgotten(Constraints):
    """Two limits under one name."""

    names = ("x ≤ 1.35",)

    def forward(self, x):
        return torch.stack([x[..., 0] - 1.35, x[..., 0] - 1.03], -1)


@pytest.mark.parametrize(("hostile", "message"), [(Fickle(), "each state by itself"), (Forgotten(), "for each name")])
def test_constraints_are_one_function_with_a_name_for_each_number(hostile, message):
    with pytest.raises(UsageError, match=message):
        claim(hostile)


def test_constraints_are_traced_once():
    """The same trace excludes states and bounds the crossing."""
    declared = position(1.35)
    own = own_constraints(declared, domain())
    declared.limits.fill_(-100.0)
    condition = DecreaseCondition(loop(riccati()), 0.9, 0.0, own)
    *_, h = bounded_condition(condition, domain()).bounds(*(torch.tensor([[0.0, 1.0, 0.0]]).double(),) * 2)
    assert float(h[1]) < 0
    assert own_constraints(own, domain()) is own


@pytest.mark.gate
def test_states_of_X0_between_the_samples_are_checked():
    """A sliver of X₀ that is 2e-6 wide is excluded."""

    class Sliver(Constraints):
        names = ("sliver",)

        def forward(self, x):
            return (x[..., :1] - 0.9 - 1e10 * (x[..., 1:] - 0.1234) ** 2) / 1.0

    task = problem()
    at = tuple(torch.tensor([[0.0, *side]]).double() for side in ((-1.0, -0.7), (1.0, 0.7)))
    sliver = task.replaced(constraints=Sliver())
    assert find_violation(loop(riccati()), sliver, torch.Generator().manual_seed(0)) is None
    least = [
        initial_violation_level(DecreaseCondition(loop(riccati()), 0.9, 0.0, h), at, Budget(5), ENOUGH)
        for h in (Sliver(), position(1.0), None)
    ]
    P, x = torch.as_tensor(riccati()), torch.tensor([0.9, 0.1234]).double()
    assert least[0] <= float(x @ P @ x) * 1.01
    assert least[1:] == [float("inf"), float("inf")], "X₀ may touch a limit"


@pytest.mark.gate
def test_a_kept_proof_is_checked_with_its_constraints(safe, kept):
    V = loop(riccati()).V
    verdicts = [check(Controller(task_within(h), V), kept)["verdict"] for h in (position(1.35), position(1.36), None)]
    assert verdicts == ["certified", "refused", "refused"]

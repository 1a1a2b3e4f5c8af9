"""Claims about laws that are read at times and held: against closed forms, and loops of an independent integrator."""

import json
import math
from functools import cache

import pytest
import torch

from lyapnet.base.errors import UsageError
from lyapnet.claims.certify import certify
from lyapnet.claims.checking import check
from lyapnet.claims.funnel import prove_funnel
from lyapnet.claims.kept_regions import kept_region
from lyapnet.claims.kinds import Funnel, Region
from lyapnet.claims.region import prove_region
from lyapnet.controller.controller import Controller
from lyapnet.loop.rollout.closed_loop import ClosedLoop
from lyapnet.prover.branch_and_bound import Budget
from lyapnet.prover.condition import DecreaseCondition, bounded_condition
from lyapnet.prover.counterexamples import violations
from lyapnet.prover.kept_proofs import read_proofs, write_proofs
from lyapnet.prover.readings import Readings
from lyapnet.task.constraints import StateLimits
from lyapnet.task.sets import Box
from lyapnet.task.systems import Linear
from lyapnet.task.varying_limits import VaryingLimits
from lyapnet.value.policy import HJBPolicy, SampledPolicy
from tests.claims import planted
from tests.claims.held_loops import held_loops
from tests.marks import sample
from tests.problems import AMPLE, Formula, problem_of

ALPHA = 0.5


def integrator():
    """ẋ = u, ℓ = x² + u², V = x² for ever: u = −x. X₀ = [−1, 1], T = 2 s."""
    about = problem_of(Linear([[0.0]], [[1.0]]), steps=20)
    return about, ClosedLoop(about, HJBPolicy(about, Formula(lambda t, x: (x**2).sum(-1) + 0 * t))).double()


def held(interval, delay=0.0, error=0.0, control_error=0.0, duration=2.0):
    return Readings(interval, delay, (error,), (control_error,), duration)


def longest_hold(alpha=ALPHA):
    """After s seconds x = (1 − s) x̂: V̇ + αℓ = (−2y + α(y² + 1)) x̂² with y = 1 − s, ≤ 0 up to this s."""
    return 1 - (1 - math.sqrt(1 - alpha**2)) / alpha


def proved(readings, delta=1e-3, boxes=20_000, alpha=ALPHA):
    about, loop = integrator()
    return prove_funnel(
        loop, about, alpha, delta, Box([-1.6], [1.6]), Budget(AMPLE, boxes=boxes), torch.Generator().manual_seed(0),
        readings=readings,
    )  # fmt: skip


def test_up_to_the_longest_hold_in_closed_form_it_is_certified():
    assert longest_hold() == pytest.approx(0.7321, abs=1e-4)
    claim = proved(held(0.97 * longest_hold()))
    assert claim.verdict == "certified"
    assert claim.volume_share == 1


@pytest.mark.gate
def test_beyond_it_the_run_that_fails_is_named():
    readings = held(1.05 * longest_hold())
    claim = proved(readings)
    assert claim.verdict == "falsified"
    found = claim.counterexample
    assert found.after > longest_hold()
    y, x = 1 - found.after, found.x[0]
    assert found.condition == pytest.approx((-2 * y + ALPHA * (y**2 + 1)) * x**2 - 1e-3, rel=1e-6)
    assert proved(None).verdict == "certified", "read at every t it holds"


def controller():
    about, _ = integrator()
    return Controller(about, Formula(lambda t, x: (x**2).sum(-1) + 0 * t), policy=HJBPolicy)


def claimed(budget=20_000, keep=None, **options):
    claim = Funnel(alpha=ALPHA, delta=1e-3, states=Box([-1.6], [1.6]), **options)
    return certify(controller(), claim, budget=Budget(AMPLE, boxes=budget), keep=keep)


@pytest.mark.gate
def test_a_jitter_is_a_longer_hold():
    assert claimed(time="held", jitter=6.0).verdict == "certified"  # 0.7 s
    certificate = claimed(time="held", jitter=6.7)  # 0.77 s
    assert certificate.verdict == "falsified"
    assert certificate.result["read_within"] == pytest.approx(0.77)
    assert "s later" in certificate.verdict_text()


@pytest.mark.gate
def test_the_claim_says_when_u_is_read():
    words = claimed(jitter=0.1, delay=0.05, measured={"x1": 0.01}, quantised={"u1": 0.02}).in_words()
    assert "with u read at any times at most 0.11 s apart, used in this order, at most 0.05 s later" in words
    assert "with an error of at most 0.01 of the measured x1, with an error of at most 0.01 of u1" in words
    assert "with u read at every t" in claimed().in_words()


@pytest.mark.gate
def test_a_law_that_is_made_to_be_held_is_held_in_the_claim():
    about, _ = integrator()
    V = Formula(lambda t, x: (x**2).sum(-1) + 0 * t)
    claim = Funnel(alpha=ALPHA, delta=0.1, states=Box([-1.6], [1.6]))
    for law, expected in ((SampledPolicy, 0.1), (HJBPolicy, None)):
        made = certify(Controller(about, V, policy=law), claim, budget=Budget(AMPLE, boxes=2000))
        assert made.result.get("read_within") == expected
    limited = about.replaced(constraints=StateLimits([0], [1.5], [1.0], [1.0]))
    assert "read_within" not in certify(Controller(limited, V, policy=SampledPolicy), claim, budget=2).result


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"time": "continuous", "jitter": 0.1}, "Expected --time held with --jitter, got continuous"),
        ({"measured": {"x2": 0.1}}, "Expected the error of x1, got 'x2=0.1'"),
        ({"quantised": {"x1": 0.1}}, "Expected steps of u1, got 'x1'"),
        ({"measured": {"x1": -0.1}}, "Expected errors as numbers ≥ 0"),
        ({"time": "often"}, "Expected time as continuous, held or steps, got 'often'"),
        ({"delay": -0.1}, "Expected delay ≥ 0"),
    ],
)
def test_options_that_do_not_fit_are_refused(options, message):
    with pytest.raises(UsageError, match=message):
        claimed(**options)


def test_constraints_need_a_law_that_is_read_at_every_t():
    about, _ = integrator()
    limited = about.replaced(constraints=StateLimits([0], [1.5], [1.0], [1.0]))
    made = Controller(limited, Formula(lambda t, x: (x**2).sum(-1) + 0 * t), policy=HJBPolicy)
    with pytest.raises(UsageError, match="Expected no state constraints for a law that is held, got some"):
        certify(made, Funnel(delay=0.1))


@pytest.mark.gate
def test_limits_that_follow_the_state_need_a_law_that_is_read_at_every_t():
    class Falling(VaryingLimits):
        def limits_at(self, x):
            room = 2 + 0.1 * x.cos()
            return -room, room

    about = problem_of(Linear([[0.0]], [[1.0]]), steps=20, controls=Falling())
    made = Controller(about, Formula(lambda t, x: (x**2).sum(-1) + 0 * t), policy=SampledPolicy)
    with pytest.raises(UsageError, match="Expected limits that do not depend on the state for a law that is held"):
        certify(made, Funnel(delay=0.1))
    assert "read_within" not in certify(made, Funnel(alpha=ALPHA, delta=0.1), budget=2).result


@pytest.mark.gate
def test_a_kept_proof_is_of_its_readings(tmp_path):
    kept = tmp_path / "held.proof"
    assert claimed(keep=kept, time="held", jitter=0.5, delay=0.02).verdict == "certified"
    result = check(controller(), kept)
    assert result["verdict"] == "certified"
    assert (result["read_within"], result["used_within"]) == (pytest.approx(0.15), 0.02)
    proofs = read_proofs(kept)
    weaker = (("interval", 0.1), ("delay", 0.0))  # other claims, which the same leaves prove too, and which then say so
    for name, value in (*weaker, ("errors", [0.1]), ("errors", []), ("interval", -1.0), ("interval", math.nan)):
        forged = json.loads(json.dumps(proofs["above"]["of"][0]))
        forged["readings"][name] = value
        write_proofs(kept, {"above": {**proofs["above"], "of": [forged, *proofs["above"]["of"][1:]]}})
        forgery = check(controller(), kept)
        assert forgery["verdict"] == "refused" or (name, value) in weaker
        if forgery["verdict"] == "certified":
            assert {"interval": forgery["read_within"], "delay": forgery["used_within"]}[name] == value


def plane():
    """(problem, closed loop, Riccati solution) of the double integrator of tests.claims.planted."""
    return planted.problem(), planted.loop(planted.riccati())


HARD = {"interval": 0.02, "delay": 0.015, "errors": (0.01, 0.007), "control_errors": (0.02,)}


@cache
def hard_claim():
    about, loop = plane()
    readings = Readings(**HARD, duration=about.horizon.duration)
    return prove_funnel(
        loop, about, 0.8, 0.15, None, Budget(AMPLE, boxes=400_000), torch.Generator().manual_seed(0), readings=readings,
        disturbance=torch.tensor([0.0, 0.01], dtype=torch.float64),
    )  # fmt: skip


def edge_of(claim, V, many):
    """States on the edge of the mouth {V(0, x) ≤ ρ}."""
    angle = torch.linspace(0, 2 * math.pi, many + 1)[:-1]
    x = torch.stack([angle.cos(), angle.sin()], -1)
    return x * (claim.rho / V(torch.zeros(()), x)).sqrt()[:, None] * (1 - 1e-9)


@pytest.mark.gate
def test_loops_with_jitter_delay_errors_and_pushes_stay_in_the_funnel():
    claim, (about, loop) = hard_claim(), plane()
    assert claim.verdict == "certified"
    V, x0 = loop.V, edge_of(claim, loop.V, 400)
    with torch.no_grad():
        guaranteed = claim.guaranteed_cost(V(torch.zeros(()), x0))
        cost, x = x0.new_zeros(len(x0)), x0
        for t, now, paid in held_loops(loop, x0, about.horizon.duration, **HARD, push=(0.0, 0.01)):
            assert (V(t, now) <= claim.rho + claim.delta * t).all()
            assert claim.states.contains(now).all()
            cost, x = paid, now
    assert (cost + about.cost.terminal(x) <= guaranteed).all()


@pytest.mark.gate
@pytest.mark.parametrize(
    ("delay", "error", "width"), sample([(0.0, 0.0, 0.02), (0.0, 0.02, 0.3), (0.03, 0.0, 0.3), (0.03, 0.02, 0.02)], 3)
)
def test_bounds_hold_along_every_run(delay, error, width):
    """c at what independent loops meet lies in the bounds of the box of readings; those of a shorter hold miss some."""
    about, loop = plane()
    spans = {"interval": 0.05, "delay": delay, "errors": (error, error), "control_errors": (error,)}
    domain = planted.domain()
    condition = DecreaseCondition(loop, 0.9, 0.02, readings=Readings(**spans, duration=about.horizon.duration))
    shorter = DecreaseCondition(
        loop, 0.9, 0.02, readings=Readings(0.02, 0.0, (0.0, 0.0), (0.0,), about.horizon.duration)
    )
    bounds = [bounded_condition(each, domain, level=100.0) for each in (condition, shorter)]
    generator, missed = torch.Generator().manual_seed(1), 0
    for _ in range(20):
        center = torch.tensor([0.5, 0.0, 0.0]) + torch.tensor([0.3, 0.6, 0.6]) * (
            2 * torch.rand(3, generator=generator) - 1
        )
        low, high = (
            torch.cat([center + side * width / 2, torch.tensor([0.0 if side < 0 else 1.0])])[None] for side in (-1, 1)
        )
        c = along_loops(condition, loop, spans, low[0, :3], high[0, :3], generator)
        (c_low, c_high), *_ = (form.interval() for form in bounds[0].forms(low, high))
        assert float(c_low) <= float(c.min())
        assert float(c.max()) <= float(c_high)
        (_, shorter_high), *_ = (form.interval() for form in bounds[1].forms(low, high))
        missed += float(c.max()) > float(shorter_high)
    if width < 0.1:
        assert missed, "bounds of a shorter hold would pass as well"


def along_loops(condition, loop, spans, low, high, generator, many=200):
    """c of closed loops while a control read in a box of (t, x) is in use, for earlier controls that fit it."""
    point = low + (high - low) * torch.rand(many, 3, generator=generator)
    t, x, (interval, delay) = point[:, 0], point[:, 1:], (spans["interval"], spans["delay"])
    e, r = torch.tensor(spans["errors"]), torch.tensor(spans["control_errors"])

    def sign(*shape):
        return 2.0 * torch.randint(2, shape, generator=generator) - 1

    with torch.no_grad():
        u = loop.policy(t, x + e * sign(many, 2)) + r * sign(many, 1)
        waits = delay * torch.rand(many, generator=generator)
        if delay:  # the control in use before: read `interval` earlier, where the state was on its way here
            before = x - interval * loop.system.dynamics(x, u)
            other = loop.policy((t - interval).clamp_min(0), before + e * sign(many, 2)) + r * sign(many, 1)
            for _ in range(8):
                x = x + waits[:, None] / 8 * loop.system.dynamics(x, other)
            t = t + waits
        use, found = (interval + delay - waits) * torch.rand(many, generator=generator), []
        for _ in range(16):
            found.append(condition.parts_under(t, x, u)[0])
            x, t = (
                x + use[:, None] / 16 * loop.system.dynamics(x + use[:, None] / 32 * loop.system.dynamics(x, u), u),
                t + use / 16,
            )
        found.append(condition.parts_under(t, x, u)[0])
    return torch.stack(found)


def region_claim(readings, decay=0.01):
    from tests.claims import test_region

    about = test_region.problem()
    V = planted.stationary(planted.riccati())
    loop = test_region.loop_of(V, about)
    return about, loop, prove_region(
        loop, about, decay, test_region.D, Budget(AMPLE, boxes=100_000), readings=readings
    )  # fmt: skip


@cache
def held_region():
    return region_claim(Readings(0.02, 0.01, (0.002, 0.002), (0.0,), None))


@pytest.mark.gate
def test_a_held_law_keeps_its_region_and_enters_the_ultimate_set():
    _, loop, claim = held_region()
    assert claim.rho > 0.99 * claim.rim
    assert 0 < claim.hole < 1e-2 * claim.rho
    x0 = edge_of(claim, loop.V, 200)
    with torch.no_grad():
        for t, x, _ in held_loops(
            loop, x0, 12.0, 0.02, 0.01, (0.002, 0.002), receding=True, generator=torch.Generator().manual_seed(2)
        ):
            assert (loop.V(0 * t, x) <= claim.rho).all()
    assert (loop.V(0 * t, x) <= claim.hole).all()
    assert claim.extent.contains(x).all()


def test_where_the_held_law_is_unstable_no_region_is_claimed():
    """With u = −Kx held for Δt the eigenvalues of the sampled system leave the unit circle at some Δt."""
    A, B = torch.tensor([[0.0, 1.0], [0.0, 0.0]]), torch.tensor([[0.0], [1.0]])
    K = (torch.from_numpy(planted.riccati())[1:]).to(A)

    def radius(dt):
        F = torch.linalg.matrix_exp(torch.cat([torch.cat([A, B], 1) * dt, torch.zeros(1, 3)]))
        return float(torch.linalg.eigvals(F[:2, :2] - F[:2, 2:] @ K).abs().max())

    unstable = next(dt for dt in (0.1 * k for k in range(1, 60)) if radius(dt) > 1.001)
    *_, claim = region_claim(Readings(unstable, 0.0, (0.0, 0.0), (0.0,), None))
    assert claim.rho == -math.inf or claim.volume_share == 0
    assert claim.verdict != "certified"


@pytest.mark.gate
def test_a_kept_region_is_of_its_readings(tmp_path):
    about, *_ = held_region()
    kept = tmp_path / "region.proof"
    from tests.claims import test_region

    made = Controller(about, planted.stationary(planted.riccati()), policy=HJBPolicy)
    options = {"time": "held", "decay": 0.01, "states": test_region.D, "measured": {"position": 0.002}}
    assert certify(made, Region(**options), budget=Budget(AMPLE, boxes=100_000), keep=kept).verdict == "certified"
    assert kept_region(kept).readings.errors == (0.002, 0.0)
    result = check(made, kept)
    assert result["verdict"] == "certified"
    assert result["read_within"] == about.horizon.dt
    other = Region(**{**options, "measured": None})
    with pytest.raises(UsageError, match=r"Expected the readings of .*, got others"):
        certify(made, other, budget=Budget(AMPLE, boxes=1000), keep=kept)


@pytest.mark.gate
def test_parameters_and_readings_together():
    from tests.claims.test_plants import leaky

    options = {"states": [[-1], [1]], "parameters": {"gain": (2, 3)}}
    certificate = certify(leaky(), Region(**options, interval=0.1, measured={"x": 0.001}), budget=30)
    assert certificate.verdict == "certified"
    assert certificate.result["measured"] == {"x": 0.001}
    assert "read at any times at most 0.1 s apart" in certificate.in_words()


@pytest.mark.parametrize("V", sample([lambda t, x: 0 * t + 0 * x.sum(-1), lambda t, x: 5 - (x**2).sum(-1) + 0 * t], 2))
def test_where_the_level_set_is_empty_nothing_is_claimed(V):
    about, _ = integrator()
    loop = ClosedLoop(about, HJBPolicy(about, Formula(V))).double()
    claim = prove_funnel(
        loop, about, 0.5, 1e-3, Box([-1.6], [1.6]), Budget(10, boxes=2000), readings=held(0.1, 0.05)
    )  # fmt: skip
    assert claim.verdict != "certified"


@pytest.mark.gate
def test_what_failed_after_a_reading_goes_into_training():
    certificate = claimed(budget=4000, interval=0.8)
    assert certificate.verdict == "falsified"
    points = violations(*certificate.searched_condition(), 100, torch.Generator().manual_seed(0))
    assert points.shape[-1] == 2
    assert len(points)

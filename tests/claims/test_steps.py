"""Claims about the steps of a model against maps whose regions are known, and maps that only look stable."""

import copy
import json
import math

import pytest
import torch
from scipy.linalg import solve_discrete_are

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.claims.checking import check
from lyapnet.claims.contraction import contraction_around
from lyapnet.claims.kinds import Funnel, LowerBound, Region
from lyapnet.claims.region import prove_region
from lyapnet.claims.region_certificate import RegionCertificate
from lyapnet.claims.stepped_decrease import SteppedDecrease
from lyapnet.cli import main
from lyapnet.controller.controller import Controller
from lyapnet.loop.programs import RegionProgram
from lyapnet.loop.rollout import ClosedLoop
from lyapnet.prover import kept_proofs
from lyapnet.prover.branch_and_bound import Budget
from lyapnet.task.constraints import StateLimits
from lyapnet.task.cost import QuadraticCost
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box, ControlBox
from lyapnet.task.systems import ControlAffineSystem, DoubleIntegrator, Linear, Pendulum
from lyapnet.value.policy import HJBPolicy, SampledPolicy
from tests.marks import at_the_gate
from tests.problems import AMPLE, Formula, problem_of
from tests.runs import tiny_checkpoint

DT = 0.1
SIZE, TURN = 0.9, math.pi / 4  # of the map that turns and shrinks


def square(t, x):
    return (x**2).sum(-1) + 0 * t


def map_of(F, dt=DT, small=0.2, method="euler"):
    """The problem whose step is x⁺ = F x, with Euler steps, and whose control does nothing."""
    F = torch.tensor(F, dtype=torch.float64)
    A = (F - torch.eye(len(F))) / dt
    box = Box([-small] * len(F), [small] * len(F))
    return problem_of(Linear(A.tolist(), [[0.0]] * len(F)), None, 100, dt, box, method=method)


def turning():
    c, s = SIZE * math.cos(TURN), SIZE * math.sin(TURN)
    return map_of([[c, -s], [s, c]])


def claimed(about, states, V=square, decay=None, boxes=4000, policy=HJBPolicy, steps=True, seconds=AMPLE, **options):
    V = Formula(V) if not isinstance(V, Formula) else V
    loop = ClosedLoop(about, policy(about, V))
    ends = Box(*(torch.tensor(side, dtype=torch.float64) for side in states))
    return prove_region(loop, about, decay, ends, Budget(seconds, boxes, chunk=256), steps=steps, **options)


UNIT = ([-1.0, -1.0], [1.0, 1.0])


def test_of_a_turning_map_the_largest_level_is_proved_beyond_the_circle_in_the_square():
    """A step leaves [−1, 1]² first at the corners' directions, at ‖x‖ = 1/0.9: ρ = 1/0.81, above 1 on the sides."""
    claim = claimed(turning(), UNIT)
    largest = 1 / SIZE**2
    assert claim.verdict == "certified"
    assert 0.985 * largest < claim.rho < largest
    beyond = math.sqrt(claim.rho - 1)  # half of the side that the circle cuts off
    angle = math.atan2(1, beyond) - math.pi / 4
    area = 4 * beyond + 4 * angle * claim.rho  # triangles to the sides, and the sectors between
    assert claim.volume == pytest.approx(area, rel=0.02)
    assert claim.volume <= area


@pytest.mark.gate
def test_its_contraction_is_that_of_the_map():
    """‖F(x) − F(x')‖ = 0.9 ‖x − x'‖, so that κΔt is (1 − 0.81)/2, at least as little as 1 − 0.9."""
    found = claimed(turning(), UNIT).contraction
    assert found.rate * DT == pytest.approx((1 - SIZE**2) / 2, rel=1e-3)
    assert found.offset < 1e-12


@pytest.mark.gate
def test_a_map_of_the_set_into_itself_has_all_of_it():
    claim = claimed(map_of([[0.9, 0.0], [0.0, -0.5]]), UNIT)
    assert claim.verdict == "certified"
    assert claim.region_share > 0.999


@pytest.mark.gate
def test_the_rate_that_is_asked_is_the_rate_of_the_steps():
    """x⁺ = 0.9 x lets x² fall by 0.19 of itself in a step of 0.1 s."""
    about = map_of([[0.9]], small=0.8)
    assert claimed(about, ([-1.0], [1.0]), decay=1.89).verdict == "certified"
    assert claimed(about, ([-1.0], [1.0]), decay=1.91).verdict == "falsified"


@pytest.mark.parametrize(
    "A", [[[-25.0]], at_the_gate([[-0.1, 5.0], [-5.0, -0.1]])], ids=["a step that is too long", "a slow spiral"]
)
def test_euler_steps_that_diverge_are_not_certified_though_continuous_time_is(A):
    n = len(A)
    about = problem_of(Linear(A, [[0.0]] * n), None, 100, DT, Box([-0.2] * n, [0.2] * n))
    states = [-1.0] * n, [1.0] * n
    assert claimed(about, states, steps=False).verdict == "certified"
    claim = claimed(about, states)
    assert claim.verdict == "unknown"
    assert claim.rho == -math.inf
    assert "a step with an eigenvalue of size" in claim.reason
    finer = problem_of(about.system, None, 1000, 0.001, about.initial_states)
    assert claimed(finer, states).verdict == "certified"


@pytest.mark.gate
def test_the_method_of_the_steps_counts():
    """With Δt = 0.1 the slow spiral grows in Euler steps, and shrinks in those of Runge and Kutta."""
    A = [[-0.1, 5.0], [-5.0, -0.1]]
    about = problem_of(Linear(A, [[0.0], [0.0]]), None, 100, DT, Box([-0.2] * 2, [0.2] * 2), method="rk4")
    claim = claimed(about, UNIT)
    assert claim.verdict == "certified"
    assert claim.steps.method == "rk4"


@pytest.mark.gate
def test_an_unstable_continuous_loop_whose_steps_are_stable_is_certified():
    """A held control may stabilise what the same gain read at every t does not need to: claims are not mixed up."""
    A, B = torch.tensor([[1.0, DT], [0.0, 1.0]]), torch.tensor([[0.0], [DT]])
    P = torch.from_numpy(solve_discrete_are(A.numpy(), B.numpy(), DT * torch.eye(2).numpy(), DT * torch.eye(1).numpy()))
    V = Formula(lambda t, x: ((x @ P) * x).sum(-1) + 0 * t)
    about = problem_of(DoubleIntegrator(), None, 100, DT, Box([-0.2] * 2, [0.2] * 2))
    claim = claimed(about, ([-3.0, -4.0], [3.0, 4.0]), V, policy=SampledPolicy)
    assert claim.verdict == "certified"
    law = SampledPolicy(about, V)
    x = torch.tensor([[-3.0, -4.0]]) + torch.rand(
        400_000, 2, generator=torch.Generator().manual_seed(0)
    ) * torch.tensor([[6.0, 8.0]])
    t = torch.zeros(())
    with torch.no_grad():
        value = V(t, x)
        after = about.step(x, law(t, x))[0]
        leaves = (after.abs() > torch.tensor([3.0, 4.0])).any(-1)
        first = float(value[leaves].min())
    assert 0.94 * first < claim.rho <= first * (1 + 1e-9), "the least V from which a step leaves D"


@pytest.mark.gate
def test_a_fixed_point_beside_the_goal_is_not_taken_for_the_hole():
    """V = x²(x − 2)² has a second well, where the steps stay too."""
    about = problem_of(Linear([[0.0]], [[1.0]]), None, 100, 0.02, Box([-0.2], [0.2]))
    V = Formula(lambda t, x: (x[..., 0] * (x[..., 0] - 2)) ** 2 + 0 * t)
    assert claimed(about, ([-1.0], [3.0]), V, seconds=5).rho == -math.inf, "where V has no lower bound above 0"
    assert claimed(about, ([-0.9], [0.9]), V).verdict == "certified"


def test_the_hole_has_to_lie_in_the_box_that_contracts():
    """A step may jump over the boundary of B: V > c is needed on all of D without B."""
    about = turning()
    loop = ClosedLoop(about, HJBPolicy(about, Formula(square))).double()
    D = Box([-1.0, -1.0], [1.0, 1.0]).double()
    around, _ = contraction_around(loop, torch.zeros(2), D, [0, 1], steps=about)
    condition = SteppedDecrease(loop, 0.1, about)
    side = float(around.box.upper[0])
    condition.open_hole(around, D, [0, 1], 10.0, Budget(10))
    assert 0.99 * side**2 < condition.hole < side**2
    with pytest.raises(UsageError, match=r"Expected V > c = .* around the hole, got V ≥ .*[;:,] .+\."):
        condition.open_hole(around, D, [0, 1], 10.0, Budget(10), proposed=1.01 * side**2)


@pytest.mark.gate
def test_a_jump_over_a_wall_is_no_way_around_it():
    """A constraint bounds the region wherever it is violated in D, also where no step leads."""
    wall = StateLimits([0], [0.5], [0.5], [1.0], ["first ≤ 0.5"])
    free = turning()
    about = Problem(free.system, free.cost, free.controls, free.initial_states, free.horizon, wall)
    claim = claimed(about, UNIT)
    assert 0.2 < claim.rho <= 0.25
    assert claim.constraints == ("first ≤ 0.5",)


@pytest.mark.gate
def test_what_ascent_and_many_steps_reach_stays_in_the_region():
    """The law between limits on the pendulum that Euler's steps make: 20 000 sequences, none rises above ρ."""

    A, B = torch.tensor([[1.0, DT], [9.81 * DT, 1.0]]), torch.tensor([[0.0], [DT]])
    P = torch.from_numpy(solve_discrete_are(A.numpy(), B.numpy(), DT * torch.eye(2).numpy(), DT * torch.eye(1).numpy()))
    V = Formula(lambda t, x: ((x @ P) * x).sum(-1) + 0 * t)
    about = problem_of(Pendulum(), None, 100, DT, Box([-0.05] * 2, [0.05] * 2), ControlBox(-8.0, 8.0))
    claim = claimed(about, ([-1.5, -6.0], [1.5, 6.0]), V, policy=SampledPolicy)
    assert claim.rho > 0
    law, t, D = SampledPolicy(about, V), torch.zeros(()), claim.states
    x = D.sample(400_000, torch.Generator().manual_seed(0))
    with torch.no_grad():
        x = x[V(t, x) <= claim.rho][:20_000]
        start = V(t, x)
        for k in range(100):
            x = about.step(x, law(t, x))[0]
            bound = torch.maximum((1 - claim.decay * DT) ** (k + 1) * start, torch.tensor(claim.hole))
            assert bool((V(t, x) <= bound * (1 + 1e-9)).all())
            assert bool(((x >= D.lower) & (x <= D.upper)).all())
    assert float(x.norm(dim=-1).max()) < 1e-3


def controller():
    about = turning()
    return Controller(about, Formula(square))


@pytest.mark.gate
def test_the_first_sentence_says_that_it_is_about_steps():
    claim = claimed(turning(), UNIT)
    certificate = RegionCertificate(controller(), claim, {"seed": 0})
    first = certificate.in_words().partition(": no sequence")[0]
    assert "in discrete time, proved about the steps of this model (euler, Δt = 0.1 s, u held over each)" in first
    assert "not about the plant between them" in first
    assert "continuous" not in certificate.in_words()
    formulas = certificate.in_formulas()
    assert formulas[0].startswith("V(F(x)) ≤ (1 − 0.1 · ")
    assert "and F(x) ∈ D" in formulas[0]
    assert certificate.result["steps"] == "0.1 s, euler"
    json.dumps(certificate.result, allow_nan=False)
    assert certificate.is_complete


@pytest.mark.gate
def test_a_kept_proof_is_of_its_steps(tmp_path):
    path, about = tmp_path / "steps.proof", turning()
    claim = claimed(about, UNIT, keep=path)
    result = check(controller(), path)
    assert (result["verdict"], result["rho"], result["steps"]) == ("certified", claim.rho, "0.1 s, euler")
    assert result["region_volume_proved"] == pytest.approx(claim.volume, rel=1e-3)
    finer = problem_of(about.system, None, 100, 0.05, about.initial_states)
    refused = check(Controller(finer, Formula(square)), path)
    assert refused["verdict"] == "refused"
    assert "Expected the steps of" in refused["reason"]
    with pytest.raises(UsageError, match=r"Expected the steps of .*, or none, got others; choose another file\."):
        claimed(about, UNIT, keep=path, steps=False)
    proofs = kept_proofs.read_proofs(path)
    del proofs["region"]["of"][0]["steps"]
    kept_proofs.write_proofs(path, proofs)
    assert check(controller(), path)["verdict"] == "refused"


@pytest.mark.parametrize("claim", [Region, Funnel])
@pytest.mark.parametrize("option", [{"jitter": 0.1}, {"delay": 0.01}, {"interval": 0.1}, {"measured": {"x1": 0.1}}])
def test_options_of_held_laws_are_refused_for_steps(claim, option):
    from lyapnet.claims.held_laws import readings_of

    (name,) = option
    with pytest.raises(
        UsageError, match=rf"Expected --time held with --{name}, got steps; u is then read in each step"
    ):
        readings_of(claim(time="steps", **option), controller(), "continuous")


def payer(factor=1.0, dt=DT, law=SampledPolicy):
    """The double integrator in Euler steps, with V as `factor` times the infinite cost of these steps, and φ = V."""
    A, B = torch.tensor([[1.0, dt], [0.0, 1.0]]), torch.tensor([[0.0], [dt]])
    P = torch.from_numpy(solve_discrete_are(A.numpy(), B.numpy(), dt * torch.eye(2).numpy(), dt * torch.eye(1).numpy()))
    cost = QuadraticCost(torch.eye(2), torch.eye(1), factor * P)
    about = problem_of(DoubleIntegrator(), cost, 20, dt, Box([-0.5] * 2, [0.5] * 2))
    V = Formula(lambda t, x: factor * ((x @ P) * x).sum(-1) + 0 * t)
    return Controller(about, V, policy=law)


def funnel(of, **options):
    claim = Funnel(**{"time": "steps", "alpha": 0.95, "delta": 1e-3, "states": [[-3, -3], [3, 3]]} | options)
    return lyapnet.certify(of, claim, budget=Budget(AMPLE, 4000, chunk=256))


@pytest.mark.gate
def test_V_that_pays_for_each_step_bounds_what_the_steps_cost():
    """V(x_n) − V(x_{n+1}) = Δt ℓ: certified for α < 1, and the bound is (V + δT)/α + κ above the cost of the steps."""
    own = payer()
    found = funnel(own)
    assert (found.verdict, found.claim.volume_share) == ("certified", 1.0)
    x0 = own.initial_states.sample(100, torch.Generator().manual_seed(0))
    bound = found.claim.guaranteed_cost(own.value(0.0, x0))
    cost = own.rollout(x0).cost
    assert bool((cost <= bound).all())
    assert float((bound / cost).median()) < 1.1
    assert "in discrete time about the steps of this model (euler, Δt = 0.1 s, u held over each)" in found.in_words()
    assert found.result["steps"] == "0.1 s, euler"


@pytest.mark.gate
def test_V_that_pays_for_too_little_of_a_step_is_falsified():
    assert funnel(payer(0.9)).verdict == "falsified"
    assert funnel(payer(0.9), alpha=0.8, delta=0.1).verdict == "certified"


def test_a_law_that_diverges_in_steps_has_no_funnel_of_steps():
    """The law −½R⁻¹gᵀV_x read at every t, in steps of 1.5 s."""
    own = payer(2.0, 1.5, HJBPolicy)
    assert funnel(own, alpha=0.1).verdict == "falsified"


@pytest.mark.gate
def test_a_kept_funnel_is_of_its_steps(tmp_path):
    path, own = tmp_path / "funnel.proof", payer()
    claim = Funnel(time="steps", alpha=0.95, delta=1e-3, states=[[-3, -3], [3, 3]])
    found = lyapnet.certify(own, claim, budget=Budget(AMPLE, 4000, chunk=256), keep=path)
    assert found.verdict == "certified"
    result = check(own, path)
    assert (result["verdict"], result["steps"], result["rho"]) == ("certified", "0.1 s, euler", found.claim.rho)
    assert check(payer(dt=0.05), path)["verdict"] == "refused"


@pytest.mark.parametrize("option", [{"disturbance": {"velocity": 0.1}}, {"two_sided": True}])
def test_claims_about_continuous_time_are_refused_beside_a_funnel_of_steps(option):
    two_sided, own = option.pop("two_sided", False), payer()
    claims = [Funnel(time="steps", **option), *([LowerBound()] if two_sided else [])]
    with pytest.raises(UsageError, match=r"Expected --time steps alone, got --(disturbance|two-sided), .+[;:,] .+\."):
        lyapnet.certify(own, *claims, budget=5)


def test_pushes_are_refused_for_steps():
    with pytest.raises(UsageError, match=r"Expected --time steps alone, got --disturbance, .+; .+\."):
        Region(time="steps", disturbance={"x1": 0.1}).about_steps(controller())


def test_a_rate_faster_than_all_of_V_in_a_step_is_refused():
    with pytest.raises(UsageError, match=r"Expected decay < 1/Δt = 10, got 11"):
        claimed(turning(), UNIT, decay=11.0)


def test_a_law_trained_for_steps_is_claimed_about_steps():
    own = controller()
    assert not Region().about_steps(own)
    own.program = RegionProgram(steps=True)
    assert Region().about_steps(own)
    assert not Region(time="continuous").about_steps(own)
    assert not Region(disturbance={"x1": 0.1}).about_steps(own)


@pytest.mark.gate
@pytest.mark.usefixtures("few_seconds_for_levels")
def test_the_command_takes_steps(tmp_path, capsys):
    checkpoint = tiny_checkpoint(tmp_path / "logs")
    assert main(["certify", "region", str(checkpoint), "--time", "steps", "--seconds", "3", "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["steps"].endswith("s, euler")


# Practical stability


class Cubic(ControlAffineSystem):
    """Whose step of 1 s is x⁺ = 1.5 x − 0.5 x³: 0 is unstable, and all steps from |x| < √5 come to [−1, 1]."""

    state_names, control_names = ("x",), ("u",)

    def f(self, x):
        return 0.5 * x - 0.5 * x**3

    def g(self, x):
        return torch.zeros_like(x)[..., None]


class Leap(ControlAffineSystem):
    """Whose step of 1 s halves x, and from near 0.25 leads up to 0.85 farther."""

    state_names, control_names = ("x",), ("u",)

    def f(self, x):
        return -0.5 * x + 0.85 * torch.exp(-200 * (x - 0.25) ** 2)

    def g(self, x):
        return torch.zeros_like(x)[..., None]


def steps_of_one_second(system):
    return problem_of(system, None, 100, 1.0, Box([-0.5], [0.5]))


@pytest.mark.gate
def test_steps_that_only_come_near_the_goal_are_practically_stable():
    """V = x² falls where 1 < x² < 5, and |F| ≤ 1 on [−1, 1]: c = 1."""
    about, states = steps_of_one_second(Cubic()), ([-2.2], [2.2])
    claim = claimed(about, states, decay=1e-4, practical=True)
    assert claim.verdict == "certified"
    assert claim.is_practical
    assert claim.contraction is None
    assert 1 <= claim.hole < 1.02
    assert claim.rho == pytest.approx(2.2**2, rel=0.05)
    assert float(claim.extent.upper) == pytest.approx(1, rel=0.03)
    assert claimed(about, states, decay=1e-4).verdict == "unknown", "without it, convergence is claimed"


def test_a_leap_out_of_a_set_on_which_V_rises_counts():
    """V rises near x = 0.25, where V is 0.06; from there a step leads to 0.975."""
    about, states = steps_of_one_second(Leap()), ([-2.0], [2.0])
    x = torch.linspace(-2, 2, 400_001, dtype=torch.float64)[:, None]
    after = x + about.system.f(x)
    rises = after.abs() > x.abs()
    farthest = float(after[rises].max())
    assert float(x[rises].max()) < 0.5 * farthest
    claim = claimed(about, states, decay=1e-4, practical=True)
    assert claim.rho > claim.hole
    assert farthest**2 < claim.hole < 1.05 * farthest**2


def test_V_that_rises_at_most_levels_has_no_practical_region():
    away = map_of([[1.1]], small=0.4)
    assert claimed(away, ([-1.0], [1.0]), practical=True).rho == -math.inf


@pytest.mark.gate
def test_the_certificate_of_practical_steps_claims_no_convergence():
    claim = claimed(turning(), UNIT, practical=True)
    assert claim.verdict == "certified"
    assert claim.contraction is None
    certificate = RegionCertificate(controller(), claim, {"seed": 0})
    words, result = certificate.in_words(), certificate.result
    assert "in discrete time, proved about the steps of this model" in words
    assert f"c = {claim.hole!r}, within {claim.entered_within!r} s and stays there (practical stability" in words
    assert "is not claimed" in words
    assert "read at every t" not in words
    assert result["ultimate_level"] == claim.hole
    assert "contraction_box" not in result
    (falls,) = certificate.in_formulas()
    assert f"max(V(x), {claim.hole!r}) and F(x) ∈ D" in falls
    condition, _, _ = certificate.searched_condition()
    x = Box([-1.0, -1.0], [1.0, 1.0]).sample(2000, torch.Generator().manual_seed(0)).double()
    c, V = condition.values(torch.cat([torch.zeros(2000, 1), x], -1))
    assert bool((c[claim.rho >= V] <= 0).all())


@pytest.mark.gate
def test_a_kept_proof_of_practical_steps_is_that_claim_alone(tmp_path):
    path, about = tmp_path / "steps.proof", turning()
    claim = claimed(about, UNIT, keep=path, practical=True)
    result = check(controller(), path)
    assert (result["verdict"], result["rho"], result["ultimate_level"]) == ("certified", claim.rho, claim.hole)
    assert "contraction_rate" not in result
    with pytest.raises(UsageError, match=r"Expected practical stability as in .*, got convergence; .+\."):
        claimed(about, UNIT, keep=path)
    proofs = kept_proofs.read_proofs(path)
    for edit in ({"practical": False}, {"practical": "yes"}, {"hole": 1e-30}, {"hole": 5.0}, {"disturbance": [0.1, 0]}):
        changed = copy.deepcopy(proofs)
        changed["region"]["of"][0].update(edit)
        kept_proofs.write_proofs(path, changed)
        refused = check(controller(), path)
        assert refused["verdict"] == "refused"
        assert "\n" not in refused["reason"]

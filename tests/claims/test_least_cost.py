"""Lower bounds of the optimum, against Riccati's solution and brute force over controls; and claims that must fail."""

import dataclasses
import io
import json
import math
from functools import cache

import pytest
import torch
from scipy.linalg import solve_continuous_are

from lyapnet.base.errors import UsageError
from lyapnet.claims.certify import certify
from lyapnet.claims.figures import two_sided
from lyapnet.claims.from_below import LowerBoundCertificate
from lyapnet.claims.kinds import Funnel, LowerBound
from lyapnet.claims.least_cost import RiseCondition, least_over_controls, least_pivot, prove_lower_bound
from lyapnet.cli import main
from lyapnet.controller.controller import Controller
from lyapnet.loop.rollout import ClosedLoop
from lyapnet.prover.branch_and_bound import Budget
from lyapnet.prover.proof import prove
from lyapnet.task.cost import Cost, QuadraticCost, TargetCost, is_quadratic_about_target
from lyapnet.task.sets import Box, ControlBox, Unbounded
from lyapnet.task.systems import DoubleIntegrator, Linear
from lyapnet.value.policy import HJBPolicy
from tests.claims.planted import X0, Q, riccati, stationary
from tests.marks import sample
from tests.problems import Formula, problem_of
from tests.runs import tiny_checkpoint

pytestmark = pytest.mark.usefixtures("one_closed_loop")

DURATION, STEPS = 2.0, 200
D = Box([-1.5, -2.5], [1.5, 2.5]).double()


def problem(controls=None, cost=None, system=None):
    """The double integrator with φ = xᵀPx, so that the optimum is xᵀPx at every t."""
    cost = cost or QuadraticCost(Q, [[1.0]], riccati().tolist())
    return problem_of(system or DoubleIntegrator(), cost, STEPS, DURATION / STEPS, X0(), controls)


def claimed(V=None, about=None, beta=0.95, delta=0.02, states=None, boxes=6000, **options):
    about = about or problem()
    loop = ClosedLoop(about, HJBPolicy(about, stationary(riccati()) if V is None else V))
    return prove_lower_bound(loop, about, beta, delta, states, Budget(100, boxes, chunk=512), **options)


@cache
def plain_claim():
    return claimed()


def optimum(x):
    return stationary(riccati())(torch.zeros(()), x)


@pytest.mark.gate
def test_the_riccati_solution_bounds_the_optimum_from_below_and_closely():
    claim = plain_claim()
    assert claim.verdict == "certified"
    assert claim.everywhere
    assert claim.counterexample is None
    x0 = X0().sample(1000, torch.Generator().manual_seed(0))
    least, best = claim.least_cost(optimum(x0)), optimum(x0)
    assert (least <= best).all()
    assert (least >= 0.95 * best - 0.02 * DURATION - 1e-3).all()


def test_no_control_is_cheaper():
    """Random controls and perturbed optimal ones, by an independent integrator."""
    generator, about, dt = torch.Generator().manual_seed(0), problem(), DURATION / STEPS
    x = X0().sample(2000, generator)
    least, paid, P = plain_claim().least_cost(optimum(x)), torch.zeros(2000), torch.as_tensor(riccati())
    noise = torch.randn(2000, 1, generator=generator) * torch.linspace(0, 3, 2000)[:, None]
    for _ in range(STEPS):
        u = -(x @ P)[:, 1:] + noise
        paid = paid + dt * about.cost.running(x, u)
        x = x + dt * about.system.dynamics(x, u) + dt**2 / 2 * torch.cat([u, 0 * u], 1)
    assert (paid + about.cost.terminal(x) >= least).all()
    assert (paid + about.cost.terminal(x)).min() < 2 * least.max()


DOMAIN = torch.tensor([0.0, -1.5, -2.5]), torch.tensor([DURATION, 1.5, 2.5])


def proved(V, beta, delta, boxes=600):
    """The proof of the condition on all of DOMAIN."""
    about = problem()
    condition = RiseCondition(ClosedLoop(about, HJBPolicy(about, V)), beta, delta, about)
    return prove(condition.requires_grad_(False), DOMAIN, 40.0, Budget(100, boxes, chunk=128))


@pytest.mark.parametrize("factor", sample([1.06, 1.1, 1.2, 1.5, 3.0], 3))
@pytest.mark.parametrize("beta", [0.96, 0.97, 0.98, 0.99, 1.0])
def test_a_value_that_is_too_high_is_not_certified(factor, beta):
    """β · factor · J* > J* by more than δT on most of X₀."""
    V = Formula(lambda t, x: factor * optimum(x) + 0 * t)
    proof = proved(V, beta, 1e-3)
    assert proof.verdict != "certified"
    assert not proof.level > 0.04 * 40


@pytest.mark.gate
def test_what_is_said_of_a_value_that_is_too_high_is_true_all_the_same():
    claim = claimed(Formula(lambda t, x: 1.2 * optimum(x) + 0 * t), states=D, boxes=1500)
    assert claim.verdict == "falsified"
    x0 = X0().sample(1000, torch.Generator().manual_seed(0))
    assert (claim.least_cost(1.2 * optimum(x0)) <= optimum(x0) + 1e-12).all()


@pytest.mark.parametrize("place", sample(range(25), 8))
def test_a_planted_violation_is_never_certified(place):
    """A bump that lifts V by little within a ball of 0.3 to 0.02 around a random point: V rises too fast on its rim."""
    generator = torch.Generator().manual_seed(place)
    middle = torch.rand(3, generator=generator) * torch.tensor([1.6, 1.2, 1.0]) + torch.tensor([0.2, -0.6, -0.5])
    width = 0.3 * 0.07 ** (place / 24)

    def V(t, x):
        distance = ((t - middle[0]) ** 2 + ((x - middle[1:]) ** 2).sum(-1)) / width**2
        return optimum(x) + width * torch.exp(-distance)

    assert proved(Formula(V), 0.98, 0.01).verdict != "certified"


def test_the_same_without_a_bump_is_certified():
    assert proved(stationary(riccati()), 0.98, 0.01, 20_000).verdict == "certified"


def test_the_least_over_controls_is_what_brute_force_finds():
    """With and without limits, and with another u*; where the law is wrong, the bound is lower."""
    generator = torch.Generator().manual_seed(0)
    b = 3 * torch.randn(200, 2, generator=generator)
    R = torch.tensor([[1.0, 0.4], [0.4, 0.5]]).expand(200, 2, 2)
    rest = torch.tensor([0.3, -0.2])
    grid = torch.cartesian_prod(*[torch.linspace(-1, 1, 201)] * 2)
    away = grid - rest
    cost = ((away @ R[0]) * away).sum(-1) + b @ grid.mT
    found = least_over_controls(R, b, rest, ControlBox(-1.0, 1.0))
    assert (found <= cost.amin(1) + 1e-9).all()
    torch.testing.assert_close(found, cost.amin(1), rtol=0, atol=2e-3)

    class Erring(ControlBox):
        def minimise(self, R, b):
            return super().minimise(R, b).flip(-1)

    erring = least_over_controls(R, b, rest, Erring(-1.0, 1.0))
    assert (erring <= found + 1e-9).all()
    assert (erring < found - 0.1).any()
    free = least_over_controls(R, b, rest, Unbounded())
    u = rest - 0.5 * torch.linalg.solve(R[0], b.mT).mT
    torch.testing.assert_close(free, (((u - rest) @ R[0]) * (u - rest)).sum(-1) + (b * u).sum(-1))
    assert (free <= found + 1e-9).all()


@pytest.mark.gate
def test_limits_make_the_bound_higher_and_are_not_left_out():
    """From (1, 0.7) with |u| ≤ 1 the optimum exceeds Riccati's: a V between the two is right only with limits."""
    P = torch.as_tensor(
        solve_continuous_are([[0.0]], [[1.0]], [[1.0]], [[1.0]])
    )  # ẋ = u, q = x²: J* = x² without limits
    about = {
        limit: problem_of(
            Linear([[0.0]], [[1.0]]), QuadraticCost([[1.0]], [[1.0]], P.tolist()), 20, 0.1, Box([-4.0], [4.0]), controls
        )
        for limit, controls in ((None, None), (1.0, ControlBox(-1.0, 1.0)))
    }

    def V(t, x):  # x² up to |x| = 1; beyond, it rises by 1 + x² for each unit of distance, the cost of |u| = 1
        return x[..., 0] ** 2 + torch.relu(x[..., 0].abs() - 1) ** 3 / 3 + 0 * t

    found = {limit: claimed(Formula(V), one, 0.97, 0.02, Box([-4.5], [4.5]).double()) for limit, one in about.items()}
    assert found[1.0].level > 20
    assert found[None].verdict == "falsified"
    assert found[None].level < 4


def test_r_has_to_be_positive_definite_where_it_is_asked():
    """R = −1 at one state in a thousand: without the check any V would be certified."""
    torch.testing.assert_close(least_pivot(torch.tensor([[4.0, 2.0], [2.0, 3.0]])), torch.tensor(2.0))
    cost = QuadraticCost(Q, lambda x: (1 - 2 * torch.relu(1 - 50 * (x[..., 0] - 0.503).abs()))[..., None, None], Q)
    condition = RiseCondition(
        ClosedLoop(problem(cost=cost), HJBPolicy(problem(cost=cost), stationary(0 * riccati()))), 1.0, 0.1,
        problem(cost=cost),
    )  # fmt: skip
    domain = torch.tensor([0.0, 0.2, -0.5]), torch.tensor([DURATION, 1.0, 0.5])
    proof = prove(condition, domain, 1.0, Budget(5, 3000, chunk=512))
    assert proof.verdict != "certified"


def test_what_is_no_claim_is_refused():
    class Own(QuadraticCost):
        def running(self, x, u):
            return super().running(x, u) - 5

    with pytest.raises(UsageError, match=r"ℓ = q \+ \(u − u\*\)ᵀR\(u − u\*\), got Own with its own `running`"):
        claimed(about=problem(cost=Own(Q, [[1.0]], Q)))
    with pytest.raises(UsageError, match="with two finite limits each"):
        claimed(about=problem(ControlBox(0.0, math.inf)))


class Costly(Cost):
    """q = x² with a pit of width 0.002 at x = 2, R = 1 and φ = x²; subclasses change this."""

    def __init__(self, depth=0.0):
        super().__init__()
        self.depth = depth

    def state(self, x):
        return x[..., 0] ** 2 - self.depth * torch.relu(1 - (x[..., 0] - 2).abs() / 0.002)

    def R(self, x):
        return torch.ones(*x.shape[:-1], 1, 1)

    def terminal(self, x):
        return x[..., 0] ** 2


def of_one_state(cost):
    about = problem_of(Linear([[0.0]], [[1.0]]), cost, 20, 0.1, Box([-1.0], [1.0]))
    V = Formula(lambda t, x: x[..., 0] ** 2 + 0 * t)
    return claimed(V, about, 0.95, 0.02, Box([-3.0], [3.0]).double())


@pytest.mark.gate
def test_a_running_cost_that_falls_below_zero_beyond_the_level_is_part_of_the_excess():
    """No sample meets the pit, where a control could rest at negative cost; a shallow pit enters e."""
    assert of_one_state(Costly()).verdict == "certified"
    assert of_one_state(Costly(1e4)).verdict != "certified"
    assert of_one_state(Costly(4.001)).excess == pytest.approx(0.001 * 2.0, abs=1e-3)


def test_a_goal_that_the_terminal_cost_is_not_about_is_none():
    """For a target cost with another φ, or a goal away from the target, nothing is known outside of D."""
    plain = QuadraticCost(Q, [[1.0]], Q)
    assert is_quadratic_about_target(TargetCost(plain, [1.0, 0.0], [0.0]))
    other = TargetCost(plain, [1.0, 0.0], [0.0])
    object.__setattr__(other, "terminal", lambda x: plain.terminal(x))
    assert not is_quadratic_about_target(other)
    named = QuadraticCost(Q, [[1.0]], Q)
    named.goal = torch.tensor([1.0, 0.0])
    assert not is_quadratic_about_target(named)


def test_constants_that_a_control_moves_are_refused():
    class Moved(Linear):
        constants = (1,)

    system = Moved([[0.0, 0.0], [0.0, 0.0]], [[1.0, 0.0], [0.0, 1.0]])
    cost = QuadraticCost([[1.0, 0.0], [0.0, 0.0]], [[1.0, 0.0], [0.0, 1.0]], [[1.0, 0.0], [0.0, 0.0]])
    about = problem_of(system, cost, 20, 0.1, Box([-1.0, 0.5], [1.0, 1.5]))
    with pytest.raises(UsageError, match="for the constants of a system under any control"):
        claimed(Formula(lambda t, x: x[..., 0] ** 2 + 0 * t), about)


def test_a_certificate_needs_an_excess_that_leaves_something():
    claim = plain_claim()
    without = dataclasses.replace(claim, excess=claim.wanted)
    assert dataclasses.replace(claim, excess=math.inf).verdict == without.verdict == "unknown"
    controller = Controller(problem(), stationary(riccati()))
    reasons = [LowerBoundCertificate(controller, each, {}).proved()["lower_reason"] for each in (claim, without)]
    assert reasons[0] is None
    assert "e is as large as the bound" in reasons[1]


def test_where_nothing_is_proved_from_below_the_figure_is_drawn_all_the_same():
    value = torch.tensor([1.0, 2.0, 0.0])
    for least in (value - 0.1, torch.full((3,), -math.inf)):
        two_sided(value, value + 0.1, least, value, "unknown").savefig(io.BytesIO(), format="png")


@pytest.mark.gate
def test_a_small_set_speaks_of_the_controls_that_stay_in_it():
    claim = claimed(states=Box([-1.1, -0.8], [1.1, 0.8]).double())
    assert claim.verdict == "certified"
    assert not claim.everywhere


@pytest.mark.gate
def test_about_a_target():
    """The same task moved to (2, 0): the same bound."""
    target = torch.tensor([2.0, 0.0])
    cost = TargetCost(QuadraticCost(Q, [[1.0]], riccati().tolist()), target, [0.0])
    box = Box(target + X0().lower, target + X0().upper).double()
    about = problem_of(DoubleIntegrator(), cost, STEPS, DURATION / STEPS, box)
    V = Formula(lambda t, x: optimum(x - target) + 0 * t)
    claim = prove_lower_bound(
        ClosedLoop(about, HJBPolicy(about, V)), about, 0.95, 0.02, budget=Budget(100, 6000, chunk=512)
    )
    assert claim.verdict == "certified"
    assert claim.everywhere
    assert claim.level == pytest.approx(plain_claim().level, rel=1e-2)


@pytest.mark.gate
def test_where_nothing_is_proved_nothing_is_said():
    claim = claimed(boxes=0)
    assert claim.verdict == "unknown"
    assert (claim.least_cost(torch.tensor([0.0, 1.0])) < 0.02).all()


@pytest.mark.gate
def test_both_sides_of_the_riccati_solution():
    """The ratio of the means follows from α, β and δT; every optimum lies between the bounds."""
    result = certify(Controller(problem(), stationary(riccati())), Funnel(alpha=0.95, delta=0.02), LowerBound()).result
    assert result["verdict"] == "certified"
    assert result["holds_for"] == "every control"
    assert result["optima_between"] == 1
    mean = float(optimum(X0().sample(4000, torch.Generator().manual_seed(0))).mean())
    expected = ((mean + 0.04) / 0.95) / (0.95 * mean - 0.04)
    assert result["certified_ratio"] == pytest.approx(expected, rel=0.02)
    assert result["guaranteed_cost_ratio"] / result["lower_cost_ratio"] == pytest.approx(result["certified_ratio"])


@pytest.mark.gate
def test_one_false_side_is_enough_for_no_certificate():
    """V = 0.9 J* is too low to pay for its law, V = 1.1 J* too high for the optimum."""
    for factor in (0.9, 1.1):
        V = Formula(lambda t, x, factor=factor: factor * optimum(x) + 0 * t)
        certificate = certify(Controller(problem(), V), Funnel(alpha=0.97, delta=0.02), LowerBound(), budget=4)
        assert certificate.verdict != "certified"


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    return tiny_checkpoint(tmp_path_factory.mktemp("logs"))


@pytest.mark.gate
@pytest.mark.usefixtures("few_seconds_for_levels")
def test_the_command_prints_both_sides(checkpoint, capsys, tmp_path):
    arguments = ["certify", "sound", str(checkpoint), "--two-sided", "--seconds", "3"]
    assert main([*arguments, "--json", "--figure", str(tmp_path / "b.png"), "--report", str(tmp_path / "r")]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["kind"] == "sound"
    assert {"lower_level", "lower_level_wanted", "holds_for", "lower_boxes"} <= result.keys()
    assert (tmp_path / "b.png").stat().st_size > 1000
    report = (tmp_path / "r" / "report.md").read_text()
    assert "--two-sided" in report.rsplit("## To repeat it", 1)[1]
    for other in ("--refine=1", "--disturbance=velocity=1"):
        assert main([*arguments, other]) == 2
        assert "Expected --two-sided alone" in capsys.readouterr().err

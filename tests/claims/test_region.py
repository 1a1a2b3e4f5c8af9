"""Regions of attraction against known truths: Riccati solutions, grids, closed loops, and claims that must fail."""

import json
import math
import re
from functools import cache, partial

import pytest
import torch

from lyapnet.base.errors import UsageError
from lyapnet.claims.contraction import contraction_around
from lyapnet.claims.region import prove_region
from lyapnet.claims.region_certificate import RegionCertificate
from lyapnet.cli import main
from lyapnet.controller.controller import Controller
from lyapnet.loop.rollout import ClosedLoop
from lyapnet.prover.branch_and_bound import Budget
from lyapnet.task.constraints import StateLimits
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box, ControlBox
from lyapnet.task.systems import ControlAffineSystem, DoubleIntegrator, Linear
from lyapnet.value.policy import HJBPolicy
from tests.claims.planted import cost, riccati, stationary
from tests.problems import Formula, problem_of
from tests.runs import tiny_checkpoint

D = Box([-3.0, -4.0], [3.0, 4.0]).double()
X0 = Box([-0.2, -0.2], [0.2, 0.2]).double()
LIMITED = ControlBox(-1.5, 1.5)


def problem(system=None, controls=None, constraints=None):
    one = problem_of(system or DoubleIntegrator(), cost(), 100, 0.02, X0, controls)
    return Problem(one.system, one.cost, one.controls, X0, one.horizon, constraints)


def loop_of(V, about):
    return ClosedLoop(about, HJBPolicy(about, V))


def claimed(V=None, about=None, states=D, boxes=4000, seconds=100, **options):
    about = about or problem()
    return prove_region(loop_of(stationary(riccati()) if V is None else V, about), about, None, states,
                        Budget(seconds, boxes, chunk=512), **options)  # fmt: skip


@cache
def plain_claim():
    return claimed()


@cache
def limited_claim():
    return claimed(about=problem(controls=LIMITED))


def after(about, x0, seconds=30.0, dt=0.01):
    """x(t) under u(0, x), by Runge-Kutta steps."""
    law, t = HJBPolicy(about, stationary(riccati())), torch.zeros(())

    def F(x):
        return about.system.dynamics(x, law(t, x))

    x = x0
    with torch.no_grad():
        for _ in range(int(seconds / dt)):
            k1 = F(x)
            k2 = F(x + dt / 2 * k1)
            k3 = F(x + dt / 2 * k2)
            x = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + F(x + dt * k3))
    return x


def test_of_a_linear_law_the_largest_ellipse_in_the_set_is_proved():
    """min of xᵀPx on the face x_i = b is b²/(P⁻¹)_ii; the ellipse's area is πρ/√det P."""
    claim, P = plain_claim(), torch.from_numpy(riccati())
    largest = float((D.upper**2 / P.inverse().diagonal()).min())
    assert claim.verdict == "certified"
    assert claim.reason is None
    assert largest * (1 - 2e-3) < claim.rho < largest
    assert claim.volume == pytest.approx(math.pi * claim.rho / math.sqrt(P.det()), rel=0.02)
    assert claim.volume <= math.pi * claim.rho / math.sqrt(P.det())
    assert claim.volume_share == 1


def test_its_contraction_is_that_of_the_linear_law():
    """κ is at most the rate of the slowest eigenvalue, and the offset is rounding."""
    A = torch.tensor([[0.0, 1.0], [0.0, 0.0]]) - torch.tensor([[0.0], [1.0]]) @ torch.from_numpy(riccati())[1:]
    slowest = -float(torch.linalg.eigvals(A).real.max())
    found = plain_claim().contraction
    assert 0.1 * slowest < found.rate < slowest
    assert found.offset < 1e-12
    assert 0 < plain_claim().hole < plain_claim().rho


@pytest.mark.gate
def test_between_limits_the_region_is_what_a_grid_says():
    """The least V where V does not fall, on 400 × 400 states outside the hole: ρ is below it, and above 90 % of it."""
    claim, V, t = limited_claim(), stationary(riccati()), torch.zeros(())
    about = problem(controls=LIMITED)
    x = torch.cartesian_prod(*(torch.linspace(-float(side), float(side), 400) for side in D.upper))
    slope = 2 * x @ torch.from_numpy(riccati())
    V_dot = (slope * about.system.dynamics(x, HJBPolicy(about, V)(t, x))).sum(-1)
    bad = V(t, x)[(V_dot >= 0) & (V(t, x) > claim.hole)].min()
    rim = min(plain_claim().rim, float(bad))
    assert 0.9 * rim < claim.rho <= rim
    assert claim.rho < 0.9 * plain_claim().rho, "limits cost something here"


@pytest.mark.gate
def test_closed_loops_from_its_edge_go_to_the_goal():
    claim, about = limited_claim(), problem(controls=LIMITED)
    x = D.sample(20_000, torch.Generator().manual_seed(0))
    V = stationary(riccati())(torch.zeros(()), x)
    edge = x[((V / claim.rho) <= 1) & ((V / claim.rho) > 0.97)]
    assert len(edge) > 30
    assert after(about, edge).norm(dim=-1).max() < 1e-6


@pytest.mark.gate
def test_a_law_that_leaves_the_goal_has_no_region():
    claim = claimed(stationary(-riccati()), states=Box([-1.0, -1.0], [1.0, 1.0]), seconds=3)
    assert claim.verdict == "unknown"
    assert claim.rho == -math.inf
    assert claim.volume == claim.volume_share == 0
    assert "does not stabilise the goal: its linearisation has an eigenvalue with real part" in claim.reason


@pytest.mark.gate
def test_a_law_that_leaves_further_out_is_falsified():
    """With V = x₁² + x₂² − x₂⁴/2 and u = −x₂ + x₂³, V̇ > 0 beyond |x₂| = 1.2."""
    system = Linear([[-1.0, 0.0], [0.0, -1.0]], [[0.0], [1.0]])
    V = Formula(lambda t, x: x[..., 0] ** 2 + x[..., 1] ** 2 - x[..., 1] ** 4 / 2 + 0 * t)
    about = problem_of(system, cost(), 100, 0.02, Box([-1.5, -1.5], [1.5, 1.5]))
    claim = prove_region(loop_of(V, about), about, None, Box([-2.0, -2.0], [2.0, 2.0]), Budget(100, 2000, chunk=512))
    assert claim.verdict != "certified"
    assert claim.rho < 0.5, "V at (0, 1), beyond which V falls as |x₂| grows"


@pytest.mark.gate
def test_a_second_well_is_not_taken_for_the_hole():
    """V = x²(x − 2)² is low around the equilibrium 2 too, where a closed loop stays: {V ≤ ρ} holds it for every ρ."""
    system = Linear([[0.0]], [[1.0]])
    V = Formula(lambda t, x: (x[..., 0] * (x[..., 0] - 2)) ** 2 + 0 * t)
    about = problem_of(system, None, 100, 0.02, Box([-0.2], [0.2]))
    claim = prove_region(loop_of(V, about), about, None, Box([-1.0], [3.0]), Budget(100, 1000, chunk=64))
    assert claim.rho == -math.inf
    alone = prove_region(loop_of(V, about), about, None, Box([-0.9], [0.9]), Budget(100, 1000, chunk=64))
    assert alone.verdict == "certified"


class Lying(torch.autograd.Function):
    """x/2 with the derivative of −5x."""

    @staticmethod
    def forward(ctx, x):
        return 0.5 * x

    @staticmethod
    def backward(ctx, slope):
        return -5 * slope


class Liar(Linear):
    def __init__(self):
        super().__init__([[0.0, 0.0], [0.0, 0.0]], [[0.0], [1.0]])

    def f(self, x):
        return Lying.apply(x)

    def dynamics(self, x, u):
        return self.f(x) + u * self.g(x)[..., 0]


def test_the_jacobian_is_that_of_the_operations_that_run():
    """A backward pass that claims stability does not make a law contract."""
    V = Formula(lambda t, x: (x**2).sum(-1) + 0 * t)
    about = problem(Liar())
    assert contraction_around(loop_of(V, about).double(), torch.zeros(2), D, [0, 1])[0] is None


class Rubbing(Linear):
    """A body with Coulomb friction: it stops wherever |u| is smaller than the friction."""

    dynamics = ControlAffineSystem.dynamics

    def __init__(self):
        super().__init__([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])

    def f(self, x):
        return super().f(x) - 0.5 * torch.stack([0 * x[..., 1], torch.sign(x[..., 1])], -1)


def test_friction_that_jumps_at_the_goal_is_no_contraction():
    """Its Jacobian is that of the body without friction almost everywhere, and closed loops stop beside the goal."""
    about = problem(Rubbing())
    found, slowest = contraction_around(loop_of(stationary(riccati()), about), torch.zeros(2), D, [0, 1])
    assert slowest < 0
    assert found is None


class Shifted(Linear):
    """ẋ₁ = 0.01 − x₁, which rests at 0.01."""

    dynamics = ControlAffineSystem.dynamics

    def __init__(self):
        super().__init__([[-1.0, 0.0], [0.0, -2.0]], [[0.0], [1.0]])

    def f(self, x):
        return super().f(x) + torch.tensor([0.01, 0.0]).to(x)


def test_where_the_goal_is_no_equilibrium_it_says_how_far_closed_loops_end():
    V = Formula(lambda t, x: (x**2).sum(-1) + 0 * t)
    about = problem(Shifted())
    found, _ = contraction_around(loop_of(V, about), torch.zeros(2), D, [0, 1])
    assert 0.01 <= found.offset < 0.1
    small = Box([-0.05, -0.05], [0.05, 0.05]).double()
    near, _ = contraction_around(loop_of(V, about), torch.zeros(2), small, [0, 1])
    assert 0.01 <= near.offset <= float(torch.linalg.vector_norm(near.box.widths / 2))


def test_a_certificate_does_not_say_the_goal_where_it_is_another_equilibrium():
    V = Formula(lambda t, x: (x**2).sum(-1) + 0 * t)
    about = problem(Shifted())
    claim = claimed(V, about)
    assert claim.verdict == "certified"
    words = RegionCertificate(Controller(about, V), claim, {"seed": 0}).in_words()
    (within,) = re.findall(r"one equilibrium exponentially, which is within (\S+) of the goal", words)
    assert 0.01 <= float(within) < 0.1


@pytest.mark.gate
@pytest.mark.parametrize("well", [lambda x: x**2 - 1, lambda x: (x * (x - 2)) ** 2 - 5])
def test_a_hole_below_zero_is_none(well):
    """V̇ ≤ −λ max(V, c) lets V rise there."""
    about = problem_of(Linear([[0.0]], [[1.0]]), None, 100, 0.02, Box([-0.2], [0.2]))
    V = Formula(lambda t, x: well(x[..., 0]) + 0 * t)
    claim = prove_region(loop_of(V, about), about, None, Box([-1.0], [1.0]), Budget(5, 1000, chunk=64))
    assert claim.verdict != "certified"
    assert claim.rho == -math.inf
    assert "not positive around the goal" in claim.reason


@pytest.mark.gate
def test_a_rate_that_is_asked_in_vain_is_not_called_unstable():
    """ẋ = −x with V = x² falls at the rate 2, and no faster."""
    about = problem_of(Linear([[-1.0]], [[0.0]]), None, 100, 0.02, Box([-0.8], [0.8]))
    V = Formula(lambda t, x: (x**2).sum(-1) + 0 * t)
    at = partial(prove_region, loop_of(V, about), about, states=Box([-1.0], [1.0]), budget=Budget(100, 1000, chunk=64))
    assert at(1.9).verdict == "certified"
    claim = at(2.1)
    assert claim.verdict != "certified"
    words = RegionCertificate(Controller(about, V), claim, {"seed": 0}).verdict_text()
    assert "closed loops may still go to the goal" in words


class Switched(Linear):
    """ẋ = −x, and −2x beyond 1.9."""

    dynamics = ControlAffineSystem.dynamics

    def __init__(self):
        super().__init__([[-1.0]], [[0.0]])

    def f(self, x):
        return torch.where(x > 1.9, -2 * x, -x)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_what_jumps_far_from_the_goal_is_no_obstacle_there(dtype):
    """The counterpart of friction: comparisons are constant on B, which does not reach the jump."""
    about = problem_of(Switched(), None, 100, 0.02, Box([-0.5], [0.5]))
    V = Formula(lambda t, x: (x**2).sum(-1) + 0 * t)
    default = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        states = Box(torch.tensor([-8.0]).double(), torch.tensor([8.0]).double())
        found, _ = contraction_around(loop_of(V, about).double(), torch.zeros(1).double(), states, [0])
    finally:
        torch.set_default_dtype(default)
    assert 1.0 < float(found.box.upper) < 1.9


@pytest.mark.gate
def test_a_constraint_bounds_the_region():
    wall = StateLimits([0], [1.0], [1.0], [1.0], ["position ≤ 1"])
    claim, P = claimed(about=problem(constraints=wall)), torch.from_numpy(riccati())
    largest = float(1 / P.inverse()[0, 0])
    assert 0.8 * largest < claim.rho <= largest
    assert claim.constraints == ("position ≤ 1",)


@pytest.mark.gate
def test_what_is_no_claim_is_refused():
    with pytest.raises(UsageError, match=r"Expected decay > 0, got -1\."):
        prove_region(loop_of(stationary(riccati()), problem()), problem(), -1.0, D)
    with pytest.raises(UsageError, match=r"Expected a set around X₀"):
        claimed(states=Box([-0.1, -4.0], [3.0, 4.0]))
    beside = Box([0.2, -0.2], [0.3, 0.2]).double()
    away = Problem(problem().system, problem().cost, problem().controls, beside, problem().horizon)
    with pytest.raises(UsageError, match=r"Expected a set around the goal, got \[0\.1, 3\] around 0 at index 0"):
        claimed(about=away, states=Box([0.1, -4.0], [3.0, 4.0]))


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    return tiny_checkpoint(tmp_path_factory.mktemp("logs"))


@pytest.mark.gate
@pytest.mark.usefixtures("few_seconds_for_levels")
def test_the_command_prints_what_was_claimed(checkpoint, capsys, tmp_path):
    arguments = ["certify", "region", str(checkpoint), "--seconds", "2", "--json", "--figure", str(tmp_path / "r.png")]
    assert main(arguments) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["kind"] == "region"
    assert result["verdict"] in ("certified", "falsified", "unknown")
    assert (tmp_path / "r.png").stat().st_size > 1000


@pytest.mark.parametrize("option", ["--decay=0", "--set=1:2", "--seconds=0"])
def test_bad_options_are_refused(option, checkpoint, capsys):
    assert main(["certify", "region", str(checkpoint), option]) == 2
    assert "Expected" in capsys.readouterr().err

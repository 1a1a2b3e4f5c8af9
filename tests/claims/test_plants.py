"""Regions of plants with unknown parameters, against closed forms, simulated plants, and laws that depend on them."""

import dataclasses
import math
from functools import cache

import numpy as np
import pytest
import torch

from lyapnet.base.errors import UsageError
from lyapnet.claims import contraction, region
from lyapnet.claims.certify import certify
from lyapnet.claims.checking import check
from lyapnet.claims.contraction import contraction_around
from lyapnet.claims.kinds import Region
from lyapnet.claims.plants import plants_of
from lyapnet.claims.receding_decrease import RecedingDecrease
from lyapnet.claims.region import prove_region
from lyapnet.claims.region_certificate import RegionCertificate
from lyapnet.cli import main
from lyapnet.cli.options import read_intervals
from lyapnet.controller.controller import Controller
from lyapnet.prover import kept_proofs
from lyapnet.prover.boxes import divide_box
from lyapnet.prover.branch_and_bound import Budget
from lyapnet.task.cost import QuadraticCost
from lyapnet.task.sets import Box
from lyapnet.task.systems import Acrobot, ControlAffineSystem, DoubleIntegrator, Pendulum
from lyapnet.value.policy import HJBPolicy
from tests.claims.planted import cost, riccati, stationary
from tests.marks import sample
from tests.problems import Formula, problem_of

pytestmark = pytest.mark.usefixtures("one_closed_loop")

LAMBDA = 0.01 / 2  # 1 % of 1/T
K0 = 2.0  # u = −K0 x of V = x² with R = ½, g = 1


class Leaky(ControlAffineSystem):
    """ẋ = −decay · x + gain · u + drift."""

    state_names, state_units, control_names, control_units = ("x",), ("",), ("u",), ("",)

    def __init__(self, decay: float = 1.0, gain: float = 1.0, drift: float = 0.0):
        super().__init__()
        self.decay, self.gain, self.drift = decay, gain, drift

    def f(self, x):
        return (self.drift - self.decay * x[..., 0])[..., None]

    def g(self, x):
        return (self.gain + torch.zeros_like(x[..., 0]))[..., None, None]

    def inverse_mass(self, x):
        """R, in tests where the law must not depend on the gain."""
        return self.g(x)


class Spring(ControlAffineSystem):
    """m q̈ = u − k q."""

    state_names, state_units = ("position", "velocity"), ("m", "m/s")
    control_names, control_units = ("force",), ("N",)

    def __init__(self, mass: float = 1.0, stiffness: float = 0.0):
        super().__init__()
        self.mass, self.stiffness = mass, stiffness

    def f(self, x):
        return torch.stack([x[..., 1], -self.stiffness / self.mass * x[..., 0]], -1)

    def g(self, x):
        zero = torch.zeros_like(x[..., 0])
        return torch.stack([zero, zero + 1 / self.mass], -1)[..., None]


class Bumpy(Leaky):
    """ẋ = −x, except for parameters in a slice of width 2e-4, where states |x| > edge diverge."""

    edge = 0.0

    def f(self, x):
        beyond = torch.relu(x[..., 0] - self.edge) - torch.relu(-x[..., 0] - self.edge)
        slice_of_few = torch.relu(1 - (self.decay - 1.2345 + 0 * beyond).abs() / 1e-4)
        return -x + (50 * slice_of_few * beyond)[..., None]


class BumpyFarOut(Bumpy):
    edge = 0.6


def leaky(system=None, x0=0.5):
    """The controller of ẋ = −x + u with V = x²: u = −2x."""
    system = system or Leaky()
    about = problem_of(system, QuadraticCost([[1.0]], [[0.5]], [[1.0]]), 100, 0.02, Box([-x0], [x0]))
    return Controller(about, Formula(lambda t, x: (x**2).sum(-1) + 0 * t))


def spring():
    return Controller(problem_of(Spring(), cost(), 100, 0.02, Box([-0.2] * 2, [0.2] * 2)), stationary(riccati()))


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Skip volumes, and test one size of B, since these laws are linear."""
    monkeypatch.setattr(region, "share_of", lambda *_: 0.5)
    monkeypatch.setattr(contraction, "SIZES", 1)


def claimed(controller, ranges, states=None, boxes=3000, **options):
    D = Box([-1.0] * controller.system.n, [1.0] * controller.system.n) if states is None else states
    return prove_region(
        controller.closed_loop, controller.problem, None, D, Budget(60, boxes, chunk=64),
        plants=plants_of(controller, ranges) if ranges else None, **options,
    )  # fmt: skip


@cache
def springs():
    """Parameters in 0.9 of the interval in which V = xᵀPx falls."""
    stiff, soft = (edge(lambda k: excess(1.0, k), 0.0, far) for far in (9.0, -9.0))
    return claimed(spring(), {"stiffness": [0.9 * soft, 0.9 * stiff]})


# Closed forms


@pytest.mark.gate
@pytest.mark.parametrize("share", [0.999, 1.001])
def test_of_one_state_the_largest_interval_is_known(share):
    """V̇ = 2(−1 − 2 gain)x² ≤ −λx² where gain ≥ λ/4 − ½. A law that depends on the gain has no such limit."""
    claim = claimed(leaky(), {"gain": [share * (LAMBDA / 4 - 0.5), 3.0]})
    assert (claim.verdict == "certified") == (share < 1)
    assert share < 1 or claim.rho == -math.inf


def excess(mass, stiffness):
    """The largest eigenvalue of PA + AᵀP + λP for the spring under the law u = −Kx of mass 1 and stiffness 0."""
    P = riccati()
    A = np.array([[0.0, 1.0], [-(stiffness + P[1, 0]) / mass, -P[1, 1] / mass]])
    return np.linalg.eigvalsh(P @ A + A.T @ P + LAMBDA * P).max()


def edge(function, inside, outside):
    """The edge of an interval where a function becomes positive, by bisection."""
    for _ in range(60):
        middle = (inside + outside) / 2
        inside, outside = (middle, outside) if function(middle) <= 0 else (inside, middle)
    return inside


@pytest.mark.gate
def test_of_two_states_the_largest_interval_is_that_of_the_matrix_inequality():
    assert springs().verdict == "certified"
    mass = edge(lambda m: excess(m, 0.0), 1.0, 9.0)
    assert claimed(spring(), {"mass": [1.0, 1.01 * mass]}).rho == -math.inf


@pytest.mark.gate
def test_where_the_equilibrium_moves_it_says_how_far():
    """ẋ = drift − (decay + 2)x rests at drift/(decay + 2), for each plant; V = x² falls beyond |x| = 0.2/(3 − λ/2)."""
    claim = claimed(leaky(), {"drift": [-0.1, 0.2]})
    assert claim.verdict == "certified"
    assert 0.2 / 3 <= claim.contraction.offset < 1.01 * 0.2 / 3
    assert claim.hole > (0.2 / (3 - LAMBDA / 2)) ** 2


@pytest.mark.gate
def test_with_pushes_the_ultimate_bound_is_that_of_the_worst_plant():
    """|x| ≤ W/(decay + 2 − λ/2), decay ≥ 0.5."""
    claim = claimed(leaky(), {"decay": [0.5, 3.0]}, disturbance=torch.tensor([0.3]))
    assert claim.verdict == "certified"
    assert claim.disturbance.tolist() == [0.3]
    assert 1 < claim.hole / (0.3 / (2.5 - LAMBDA / 2)) ** 2 < 1.05
    assert claim.extent.dimension == claim.states.dimension == 1
    assert float(claim.extent.upper) == pytest.approx(math.sqrt(claim.hole), rel=0.025)
    assert "for each plant of this model with constant decay ∈ [0.5, 3.0], under all" in words(leaky(), claim)


def words(controller, claim):
    return RegionCertificate(controller, claim, {"seed": 0}).in_words()


@pytest.mark.gate
def test_without_width_the_claim_is_that_of_the_one_plant():
    one, other = claimed(leaky(), {}), claimed(leaky(), {"gain": [1.0, 1.0]})
    assert other.plants.ranges == {"gain": [1.0, 1.0]}
    for name in ("rho", "hole", "rim", "wanted", "slowest"):
        assert getattr(other, name) == pytest.approx(getattr(one, name), rel=1e-6)
    assert (other.verdict, other.proof.boxes) == (one.verdict, one.proof.boxes) == ("certified", one.proof.boxes)
    assert other.states.lower.equal(one.states.lower)


# Plants


@pytest.mark.gate
def test_no_plant_leaves_and_each_goes_to_the_goal():
    """Closed loops from the region's edge, for plants at the ends of P and inside."""
    claim, about = springs(), spring()
    angle = torch.linspace(0, 2 * math.pi, 25)
    x = torch.stack([angle.cos(), angle.sin()], -1)
    V, t = about.V, torch.zeros(())
    x = x * (claim.rho / V(t, x)).sqrt()[:, None] * (1 - 1e-9)
    box = claim.plants.box
    p = torch.cat([box.corners(), box.sample(8, torch.Generator().manual_seed(0))])
    x, stiffness = x.repeat_interleave(len(p), 0), p[:, 0].repeat(len(x))
    before, dt = V(t, x), 2e-2
    for _ in range(5000):
        force = -(x @ torch.from_numpy(riccati())[1]) - stiffness * x[:, 0]
        x = x + dt * torch.stack([x[:, 1], force], -1)
        assert (V(t, x) <= before.clamp(min=1e-12)).all()
        before = V(t, x)
    assert x.norm(dim=-1).max() < 1e-5


def test_the_law_and_V_are_told_x_alone():
    """Nothing in the law depends on p, not even R = g of the nominal plant; in a family, the counterpart, it does."""
    system = Leaky()
    paid = QuadraticCost([[1.0]], system.inverse_mass, [[1.0]])
    about = Controller(problem_of(system, paid, 100, 0.02, Box([-0.5], [0.5])), leaky().V)
    found = plants_of(about, {"gain": [0.5, 2.0], "decay": [0.0, 3.0]})
    loop, inside = found.all_of(about.closed_loop, about.problem)
    x, p, t = torch.linspace(-1, 1, 9)[:, None], found.box.sample(9, torch.Generator().manual_seed(0)), torch.zeros(())
    z = torch.cat([x, p], -1)
    with torch.no_grad():
        assert loop.policy(t, z).equal(about.policy(0.0, x))
        assert loop.V(t, z).equal(about.V(t, x))
        assert loop.control(t, z).u.equal(about.policy(0.0, x))
        told = HJBPolicy(inside, loop.V)(t, z)
        assert not torch.allclose(told, about.policy(0.0, x)), "g(x; p) and R(x) in the law: u = −gain x"
        gain, decay = p.unbind(-1)
        u = -x[:, 0]
        assert torch.allclose(loop.system.dynamics(z, u[:, None])[:, 0], -decay * x[:, 0] + gain * u)
    condition = RecedingDecrease(loop, LAMBDA)
    value, slope = x[:, 0] ** 2, 2 * x[:, 0]
    assert torch.allclose(condition(t.expand(9), z), slope * (-decay * x[:, 0] + gain * u) + LAMBDA * value)
    assert (about.system.gain, about.system.decay) == (1.0, 1.0), "the comparison does not change the plant"


@pytest.mark.gate
@pytest.mark.parametrize("system", sample([Bumpy, BumpyFarOut], 2))
def test_what_fails_in_a_thin_slice_of_plants_is_found(system):
    """In the slice nothing contracts at the goal, and V rises far from it. Without the slice there is a region."""
    at = leaky(system(), x0=0.7)
    claim = claimed(at, {"decay": [1.0, 1.5]})
    assert claim.verdict != "certified"
    assert claim.rho < 0.37
    if system is BumpyFarOut:
        assert claimed(at, {"decay": [1.24, 1.5]}).verdict == "certified"


def test_the_jacobian_is_bounded_for_each_plant_and_the_metric_that_of_V():
    """For stiffness −3 to 3, the metric of the middle gives no common rate; V_xx does."""
    found = plants_of(spring(), {"stiffness": [-3.0, 3.0]})
    loop, inside = found.all_of(spring().closed_loop, spring().problem)
    contracts, slowest = contraction_around(loop, inside.goal, found.around(Box([-1.0] * 2, [1.0] * 2)), [0, 1])
    P = contracts.coordinates.mT @ contracts.coordinates
    assert torch.allclose(P / P[0, 0], torch.from_numpy(riccati() / riccati()[0, 0]))
    rates = []
    for k in (-3.0, 3.0):
        A = torch.tensor([[0.0, 1.0], [-k - riccati()[1, 0], -riccati()[1, 1]]])
        M = contracts.coordinates @ A @ contracts.coordinates.inverse()
        rates.append(-float(torch.linalg.eigvalsh((M + M.mT) / 2).max()))
        assert torch.linalg.eigvals(A).real.max() <= slowest + 1e-9
    assert 0 < contracts.rate <= min(rates)
    assert contracts.box.dimension == 2


def test_pieces_cover_a_box():
    lower, upper = torch.tensor([0.0, -1.0, 0.3, 2.0]), torch.tensor([0.0, 1.0, 0.7, 2.0])
    low, high = divide_box(lower, upper, [2, 3], 7)
    assert len(low) == 7
    assert low[0].equal(lower)
    assert high[-1].equal(upper)
    assert low[1:, 2].equal(high[:-1, 2])
    low, high = divide_box(lower, upper, [1, 2], 16)
    assert float((high - low)[:, 1:3].prod(-1).sum()) == pytest.approx(0.8)
    assert [len(side) for side in divide_box(lower, upper, [])] == [1, 1]


# Words and files


@pytest.mark.gate
def test_the_certificate_says_which_plants_and_what_the_law_was_made_for(tmp_path):
    at, path = leaky(), tmp_path / "plants.proof"
    claim = Region(states=[[-1], [1]], parameters={"gain": (2, 3)})
    certificate = certify(at, claim, budget=20, keep=path)
    assert certificate.verdict == "certified", "the nominal plant need not be in P"
    about = "for each plant of this model with constant gain ∈ [2.0, 3.0] with u read at every t: no closed loop"
    assert about in certificate.in_words()
    assert "u and V are those made for gain = 1.0: they do not depend" in certificate.in_words()
    assert "all converge to one equilibrium of their plant exponentially" in certificate.in_words()
    assert sum("for each p = (gain) ∈ P = [[2.0, 3.0]]" in line for line in certificate.in_formulas()) == 2
    assert certificate.result["parameters"] == {"gain": [2.0, 3.0]}
    assert certificate.result["nominal_parameters"] == {"gain": 1.0}
    assert certificate.result["set"] == [[-1.0], [1.0]]
    assert "--parameter=gain=2:3" in certificate.command("run.ckpt")
    condition, (lower, upper), _ = certificate.searched_condition()
    assert (lower.tolist(), upper.tolist()) == ([0.0, -1.0, 2.0], [0.0, 1.0, 3.0])
    assert float(condition(torch.zeros(()), torch.tensor([0.9, 2.5])).detach()) < 0
    assert certificate.figure().axes

    result = check(at, path)
    assert (result["verdict"], result["reason"], result["rho"]) == ("certified", None, certificate.result["rho"])
    assert result["parameters"] == {"gain": [2.0, 3.0]}
    whole = path.read_bytes()
    for others in ({"gain": (2, 3.1)}, {}):
        with pytest.raises(UsageError, match=r"Expected the parameters of .*, got others; choose another file"):
            certify(at, dataclasses.replace(claim, parameters=others), budget=20, keep=path)
    for name, (change, word) in EDITS.items():
        path.write_bytes(whole)
        proofs = kept_proofs.read_proofs(path)
        change(proofs["region"]["of"][0])
        kept_proofs.write_proofs(path, proofs)
        result = check(at, path)
        assert (result["verdict"], "\n" in (result["reason"] or "")) == (word, False), name
    assert result["parameters"] == {"gain": [2.0, 2.5]}, "another claim, about the parameters that it names"


def of(**values):
    return lambda about: about.update(values)


def ends(lower, upper):
    def change(about):
        about["lower"][2], about["upper"][2] = lower, upper

    return change


EDITS = {  # the forger computes the digest again; the fingerprint does not depend on P
    "another parameter": (of(parameters=["decay"]), "refused"),
    "none of the system": (of(parameters=["mass"]), "refused"),
    "no list": (of(parameters="g"), "refused"),
    "no name": (of(parameters=[3]), "refused"),
    "too many": (of(parameters=["gain", "decay"]), "refused"),
    "twice": (of(parameters=["gain", "gain"]), "refused"),
    "no parameter": (of(parameters=[]), "refused"),
    "one plant": (lambda about: about.pop("parameters"), "refused"),
    "no number": (ends(math.nan, 3.0), "refused"),
    "endless": (ends(2.0, math.inf), "refused"),
    "reversed": (ends(3.0, 2.0), "refused"),
    "plants that do not hold": (ends(-0.6, 3.0), "refused"),
    "fewer plants": (ends(2.0, 2.5), "certified"),
}


# Refusals


@pytest.mark.parametrize(
    ("named", "expected"),
    [
        ("mass", "Expected --parameter NAME=LOWER:UPPER with two numbers, got 'mass'; for example mass=0.9:1.1."),
        ("mass=1", "with two numbers, got 'mass=1'"),
        ("mass=a:b", "with two numbers"),
        ("mass=1:2:3", "with two numbers"),
        ("mass=2:1", "by name, with lower ≤ upper, got {'mass': (2.0, 1.0)}"),
        ("mass=1:inf", "as finite numbers (lower, upper)"),
        ("mass=nan:1", "as finite numbers (lower, upper)"),
    ],
)
def test_what_is_no_interval_is_refused(named, expected):
    with pytest.raises(UsageError) as refused:
        Region(parameters=read_intervals([named]))
    assert expected in str(refused.value)


def test_an_interval_is_named_once():
    assert read_intervals(["mass=1:2", "length=-1e-3:0"]) == {"mass": (1.0, 2.0), "length": (-1e-3, 0.0)}
    with pytest.raises(UsageError, match="Expected --parameter once for each parameter, got mass twice"):
        read_intervals(["mass=1:2", "mass=1:3"])


@pytest.mark.parametrize(
    ("system", "ranges", "expected"),
    [
        (
            Pendulum(),
            {"mas": [1, 2]},
            r"among the arguments of Pendulum \(mass, length, damping, gravity\), got mas; did",
        ),
        (Acrobot(), {"mass": [1, 2]}, r"Expected parameters among the numbers that Acrobot keeps"),
        (Pendulum(), {"mass": [-1, 2]}, r"parameters: Expected mass > 0, got -1\.0"),
        (DoubleIntegrator(), {"mass": [0.9, 1.1]}, r"Expected DoubleIntegrator\.f or g to read mass, got the same"),
        (Pendulum(length=2.0), {"mass": [1, 2]}, r"got another f than that of Pendulum built with \["),
    ],
)
def test_what_does_not_make_another_plant_is_refused(system, ranges, expected):
    """Parameters that a constructor derives from or that nothing reads, and values that it refuses."""
    V = Formula(lambda t, x: (x**2).sum(-1) + 0 * t)
    with pytest.raises(UsageError, match=expected) as refused:
        plants_of(Controller(problem_of(system), V), ranges)
    assert "\n" not in str(refused.value)


def test_a_set_of_other_states_and_a_family_are_refused():
    with pytest.raises(UsageError, match="Expected a set of 1 states, got 2"):
        claimed(leaky(), {"gain": [1.0, 2.0]}, states=Box([-1.0] * 2, [1.0] * 2))
    found = plants_of(leaky(), {"gain": [1.0, 2.0]})
    _, inside = found.all_of(leaky().closed_loop, leaky().problem)
    with pytest.raises(UsageError, match="Expected one system, got a family; choose one member"):
        plants_of(Controller(inside, leaky().V), {"gain": [1.0, 2.0]})


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ([], "Expected DoubleIntegrator.f or g to read mass"),
        (["--refine", "1"], "Expected --refine with one checkpoint and one disturbance, got --parameter"),
        (["--disturbance", "velocity=0,1"], "Expected DoubleIntegrator.f or g to read mass"),
    ],
)
def test_the_command_says_so_in_a_line(options, expected, capsys):
    assert main(["certify", "region", "zoo:double_integrator", "--parameter", "mass=0.9:1.1", *options]) == 2
    assert expected in capsys.readouterr().err

"""Regions under disturbances, against closed forms, the worst disturbances and larger ones; and forged files."""

import json
import math
import shutil
from functools import cache

import pytest
import torch

from lyapnet.base.errors import UsageError
from lyapnet.claims import region
from lyapnet.claims.certify import certify
from lyapnet.claims.checking import check
from lyapnet.claims.disturbances.regions import DisturbedRegions
from lyapnet.claims.kinds import Region
from lyapnet.claims.preconditions import over_time
from lyapnet.claims.receding_decrease import RecedingDecrease
from lyapnet.claims.region import prove_region
from lyapnet.claims.region_certificate import RegionCertificate
from lyapnet.cli import main
from lyapnet.cli.claims import read_disturbances_of_one_state
from lyapnet.controller.controller import Controller
from lyapnet.prover import kept_proofs
from lyapnet.prover.branch_and_bound import Budget
from lyapnet.prover.condition import bounded_condition
from lyapnet.task.constraints import StateLimits
from lyapnet.task.sets import Box
from lyapnet.task.systems import ControlAffineSystem, Linear
from lyapnet.value.policy import HJBPolicy
from tests.claims.planted import Q, riccati, stationary
from tests.claims.test_region import D, claimed, loop_of, plain_claim, problem
from tests.problems import Formula, problem_of
from tests.runs import tiny_checkpoint

pytestmark = pytest.mark.usefixtures("one_closed_loop")

W = torch.tensor([0.0, 0.2], dtype=torch.float64)
LAMBDA = 0.01 / 2  # 1 % of 1/T


def P():
    return torch.from_numpy(riccati())


@cache
def pushed_claim():
    return claimed(disturbance=W)


def highest_rise(w):
    """max xᵀPx where V̇ = −xᵀ(Q + PBBᵀP)x + 2w|pᵀx| ≥ −λ xᵀPx, p = PB: on the ellipse xᵀMx = 2w pᵀx."""
    p = P()[:, 1]
    M = torch.tensor(Q) + torch.outer(p, p) - LAMBDA * P()
    angle = torch.linspace(0, 2 * math.pi, 100_001)
    circle = torch.stack([angle.cos(), angle.sin()])
    root = torch.linalg.cholesky(M.inverse())
    x = w * (M.inverse() @ p)[:, None] + w * (p @ M.inverse() @ p).sqrt() * root @ circle
    return float(((P() @ x) * x).sum(0).max())


def pushed(x, push, seconds=6.0, dt=2e-3, kind="worst"):
    """(the highest V, V in the end) of closed loops under u(0, x), by Euler steps, with a disturbed velocity."""
    about, t, V, X = problem(), torch.zeros(()), stationary(riccati()), P()
    generator, highest = torch.Generator().manual_seed(0), torch.tensor(-math.inf)
    assert torch.allclose(HJBPolicy(about, V)(t, x), -(x @ X)[:, 1:]), "the law in closed form"
    with torch.no_grad():
        for k in range(int(seconds / dt)):
            slope = x @ X
            highest = torch.maximum(highest, (slope * x).sum(-1).max())
            w = torch.full((len(x),), 1.0 if kind == "constant" else math.copysign(1.0, math.sin(3.0 * k * dt)))
            if kind == "worst":
                w = slope[:, 1].sign()
            elif kind == "random":
                w = 2 * torch.rand(len(x), generator=generator) - 1
            x = x + dt * (about.system.dynamics(x, -slope[:, 1:]) + w[:, None] * push)
    return float(highest), V(t, x)


def start(claim):
    """States in the region, a third of them on its edge."""
    x = D.sample(3000, torch.Generator().manual_seed(0))
    V = stationary(riccati())(torch.zeros(()), x)
    edge = x[:200] * (claim.rho / V[:200]).sqrt()[:, None] * (1 - 1e-9)
    return torch.cat([edge, x[claim.rho >= V][:400]])


# Closed forms


@pytest.mark.gate
@pytest.mark.parametrize("w", [1e-3, 0.1, 0.9])
def test_of_one_state_the_ultimate_bound_is_known(w):
    """ẋ = −x + w(t) with V = x²: V̇ ≤ −λV where |x| ≥ 2W/(2 − λ)."""
    about = problem_of(Linear([[-1.0]], [[0.0]]), None, 100, 0.02, Box([-0.8], [0.8]))
    V = Formula(lambda t, x: (x**2).sum(-1) + 0 * t)
    claim = prove_region(
        loop_of(V, about), about, None, Box([-1.0], [1.0]), Budget(100, 1000, chunk=64), disturbance=torch.tensor([w])
    )
    least = 2 * w / (2 - LAMBDA)
    assert least**2 < claim.hole < 1.02 * least**2
    assert claim.rho == pytest.approx(1, rel=1e-6)
    assert claim.verdict == "certified"
    assert claim.volume == pytest.approx(2, rel=1e-2)
    assert float(claim.extent.upper) >= math.sqrt(claim.hole)
    assert float(claim.extent.upper) == pytest.approx(math.sqrt(claim.hole), rel=0.025)
    assert claim.entered_within == pytest.approx(math.log(claim.rho / claim.hole) / LAMBDA)


@pytest.mark.gate
def test_of_a_linear_law_region_and_ultimate_bound_are_those_of_the_ellipses():
    claim, c = pushed_claim(), highest_rise(float(W[1]))
    largest = float((D.upper**2 / P().inverse().diagonal()).min())
    assert c < claim.hole < 1.02 * c
    assert claim.rho == pytest.approx(plain_claim().rho, rel=1e-6)
    assert claim.rho < largest
    assert claim.volume == pytest.approx(math.pi * claim.rho / math.sqrt(P().det()), rel=0.02)
    reach = (claim.hole * P().inverse().diagonal()).sqrt()
    for side in (claim.extent.upper, -claim.extent.lower):
        assert (side >= reach * (1 - 1e-9)).all()
        assert (side <= 1.03 * reach).all()


@pytest.mark.gate
def test_the_ultimate_bound_grows_with_the_square_of_the_push():
    """A linear closed loop scales: c(2W) = 4c(W)."""
    assert claimed(disturbance=2 * W).hole == pytest.approx(4 * pushed_claim().hole, rel=5e-3)


# Pushes


@pytest.mark.parametrize("kind", ["worst", "constant", "resonant", "random"])
def test_under_any_disturbance_closed_loops_stay_and_end_in_the_ultimate_set(kind):
    claim = pushed_claim()
    assert claim.verdict == "certified"
    highest, end = pushed(start(claim), W, kind=kind)
    assert highest <= claim.rho * (1 + 1e-6)
    assert float(end.max()) <= claim.hole


def test_none_leaves_the_ultimate_set_and_the_worst_pushes_come_close_to_its_edge():
    claim, x = pushed_claim(), D.sample(2000, torch.Generator().manual_seed(1))
    V = stationary(riccati())(torch.zeros(()), x)
    highest, _ = pushed(x * (claim.hole / V).sqrt()[:, None] * (1 - 1e-9), W)
    assert highest <= claim.hole * (1 + 1e-2), "up to a step across its edge"
    assert highest > 0.3 * claim.hole


def test_a_hundred_times_larger_pushes_leave_it_and_nothing_is_proved_of_them():
    claim = pushed_claim()
    assert pushed(start(claim), 100 * W, seconds=3)[0] > claim.rho
    none = claimed(disturbance=100 * W)
    assert (none.verdict, none.rho, none.volume, none.extent) == ("unknown", -math.inf, 0.0, None)
    assert none.entered_within == math.inf
    assert none.reason.startswith("no levels c < ρ were found between which V(0, ·) falls under every disturbance")
    assert "\n" not in none.reason


@pytest.mark.gate
def test_nothing_is_proved_of_a_hole_that_is_too_small(monkeypatch):
    """The counterpart of the search for c: a wrong c proves nothing."""
    hole = 0.5 * pushed_claim().hole
    monkeypatch.setattr(region, "ultimate_level", lambda *_: hole)
    claim = claimed(disturbance=W)
    assert claim.rho == -math.inf
    assert claim.verdict != "certified"
    hole = 2 * pushed_claim().hole
    monkeypatch.setattr(region, "ultimate_level", lambda *_: hole)
    assert claimed(disturbance=W).verdict == "certified"


@pytest.mark.gate
def test_without_pushes_the_claim_is_what_it_was():
    one, other = plain_claim(), claimed(disturbance=0 * W)
    for name in ("rho", "hole", "verdict", "volume_share", "region_share", "disturbance", "extent"):
        assert getattr(one, name) == getattr(other, name)
    assert one.contraction.fingerprint == other.contraction.fingerprint
    assert one.proof.fingerprint == other.proof.fingerprint != pushed_claim().proof.fingerprint


@pytest.mark.gate
def test_pushes_end_in_every_well():
    """V = x²(x − 2)² is low around 0 and 2; the claim does not say to which of the two a closed loop goes."""
    about = problem_of(Linear([[0.0]], [[1.0]]), None, 100, 0.02, Box([-0.2], [0.2]))
    V = Formula(lambda t, x: (x[..., 0] * (x[..., 0] - 2)) ** 2 + 0 * t)
    claim = prove_region(
        loop_of(V, about), about, None, Box([-1.0], [3.0]), Budget(100, 2000, chunk=64),
        disturbance=torch.tensor([0.05]),
    )  # fmt: skip
    assert claim.hole < claim.rho < 1, "V at 1, where it does not fall"
    assert float(claim.extent.lower) < 0
    assert float(claim.extent.upper) > 2


@pytest.mark.gate
def test_a_constraint_bounds_the_region():
    wall = StateLimits([0], [1.0], [1.0], [1.0], ["position ≤ 1"])
    claim = claimed(about=problem(constraints=wall), disturbance=W)
    largest = float(1 / P().inverse()[0, 0])
    assert claim.hole < 0.8 * largest < claim.rho <= largest


@pytest.mark.parametrize("w", [[0.0, -1.0], [math.nan, 0.0], [math.inf, 0.0], [0.1], [0.1, 0.1, 0.1]])
def test_what_is_no_disturbance_is_refused(w):
    with pytest.raises(UsageError, match="Expected disturbances ≥ 0 of 2 states"):
        claimed(disturbance=torch.tensor(w))


@pytest.mark.gate
def test_the_certificate_claims_no_more_than_practical_stability():
    claim = pushed_claim()
    certificate = RegionCertificate(Controller(problem(), stationary(riccati())), claim, {"seed": 0})
    words, formulas = certificate.in_words(), "\n".join(certificate.in_formulas())
    for part in (f"c = {claim.hole!r}", "of at most 0.2 on d(velocity)/dt", "practical stability", "is not claimed"):
        assert part in words
    assert "equilibrium" not in words
    assert "attraction" not in words
    assert "Σ w_i |∂V/∂x_i|" in formulas
    assert "Jacobian" not in formulas
    numbers = certificate.numbers()
    assert numbers["disturbance"] == {"velocity": 0.2}
    assert numbers["ultimate_level"] == claim.hole
    assert "contraction_rate" not in numbers
    plain = RegionCertificate(Controller(problem(), stationary(riccati())), plain_claim(), {"seed": 0})
    assert "region of attraction" in plain.in_words()
    assert "ultimate_level" not in plain.numbers()


# Kept proofs


def kept_at(path, w=W):
    return claimed(keep=path, disturbance=w)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("kept")
    kept_at(folder / "pushed.proof")
    claimed(keep=folder / "plain.proof")
    return folder


@pytest.fixture
def kept(files, tmp_path):
    return shutil.copy(files / "pushed.proof", tmp_path / "pushed.proof")


@pytest.fixture
def plain(files, tmp_path):
    return shutil.copy(files / "plain.proof", tmp_path / "plain.proof")


def checked(path):
    return check(Controller(problem(), stationary(riccati())), path)


def of_itself(of):
    """Set the fingerprint to that of the changed file, as a forger could."""
    w = torch.tensor(of["disturbance"])
    condition = RecedingDecrease(loop_of(stationary(riccati()), problem()).requires_grad_(False), of["decay"], w)
    domain = over_time(Box(of["lower"][1:], of["upper"][1:]).double(), 0.0)
    condition.open_everywhere(of["hole"])
    of["fingerprint"] = bounded_condition(condition, domain).fingerprint


def rewritten(path, change, again=True):
    proofs = kept_proofs.read_proofs(path)
    change(proofs["region"])
    if again:
        of_itself(proofs["region"]["of"][0])
    kept_proofs.write_proofs(path, proofs)


@pytest.mark.gate
def test_a_kept_proof_is_checked_with_its_disturbance(kept):
    result = checked(kept)
    assert (result["verdict"], result["reason"], result["of"]) == ("certified", None, "region")
    assert (result["rho"], result["ultimate_level"]) == (pushed_claim().rho, pushed_claim().hole)
    assert result["disturbance"] == {"velocity": 0.2}
    rewritten(kept, lambda content: None)
    assert checked(kept)["verdict"] == "certified", (
        "the counterpart: the fingerprint that the tests compute is that of the file"
    )


def test_it_goes_on_by_the_same_disturbance_alone(kept, plain):
    before = kept.read_bytes()
    for w in (0.5 * W, 2 * W, 0 * W, None):
        with pytest.raises(UsageError, match=r"Expected the disturbance of .*, got another; choose another file"):
            kept_at(kept, w)
    assert kept.read_bytes() == before
    assert kept_at(kept).rho == pushed_claim().rho
    with pytest.raises(UsageError, match=r"Expected the disturbance of .*, got another; choose another file"):
        kept_at(plain)


def set_of(**values):
    return lambda content: content["of"][0].update(values)


def higher(content):
    content["of"][1] = content["proved"] = 30.0


EDITS = {
    "a larger push": set_of(disturbance=[0.0, 0.3]),
    "a push on another state": set_of(disturbance=[0.2, 0.2]),
    "a smaller hole": set_of(hole=0.03),
    "no hole": set_of(hole=0.0),
    "a hole below 0": set_of(hole=-1.0),
    "a hole beyond ρ": set_of(hole=40.0),
    "a rate that V does not fall at": set_of(decay=3.0),
    "a ρ beyond the boundary of D": higher,
}


@pytest.mark.gate
@pytest.mark.parametrize("name", EDITS)
def test_an_edited_file_is_refused(name, kept):
    """The forger computes the digest and the fingerprint again."""
    rewritten(kept, EDITS[name])
    result = checked(kept)
    assert result["verdict"] == "refused"
    assert "\n" not in result["reason"]


BROKEN = {
    "a push that is none": set_of(disturbance=[0.0, 0.0]),
    "a push below 0": set_of(disturbance=[0.0, -0.2]),
    "a push that is no number": set_of(disturbance=[0.0, math.nan]),
    "an endless push": set_of(disturbance=[0.0, math.inf]),
    "a push on one state": set_of(disturbance=[0.2]),
    "a hole that is no number": set_of(hole=math.nan),
    "no push": lambda content: content["of"][0].pop("disturbance"),
    "a smaller push, by the old fingerprint": set_of(disturbance=[0.0, 0.1]),
}


@pytest.mark.gate
@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_file_is_refused(name, kept):
    rewritten(kept, BROKEN[name], again=False)
    result = checked(kept)
    assert result["verdict"] == "refused"
    assert "\n" not in result["reason"]


@pytest.mark.gate
def test_a_plain_proof_is_none_of_pushes(plain):
    rewritten(plain, set_of(disturbance=[0.0, 0.2]))
    assert checked(plain)["verdict"] == "refused"


# Pushes of several sizes


def controller():
    return Controller(problem(), stationary(riccati()))


@pytest.mark.gate
def test_for_each_size_there_is_a_claim():
    about, pushes = controller(), [0.0, 0.2, 0.4, 30.0]
    claims = [Region(states=D, disturbance={"velocity": w}) for w in pushes]
    regions = DisturbedRegions(about, "velocity", pushes, [certify(about, claim) for claim in claims])
    still, small, large, none = (each.claim for each in regions.certificates)
    assert still.contraction is not None
    assert small.hole == pytest.approx(pushed_claim().hole, rel=1e-3)
    assert small.hole < large.hole < small.rho
    assert none.rho == -math.inf
    result = regions.result
    assert result["disturbed"] == "velocity"
    assert [row["w"] for row in result["rows"]] == [0, 0.2, 0.4, 30]
    assert json.loads(json.dumps(result, allow_nan=False)) == result
    figure = regions.figure()
    volumes, plane = figure.axes
    assert volumes.get_xlabel() == "largest disturbance of d(velocity)/dt, w_max (m/s²)"
    assert volumes.get_ylabel() == "certified volume (m · m/s)"
    assert [float(y) for y in volumes.lines[0].get_ydata()] == [c.volume for c in (still, small, large, none)]
    assert "none proved" in [text.get_text() for text in volumes.texts]
    assert plane.get_xlabel() == "position (m)"
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert "w_max = 0.2 m/s²" in names
    assert "w_max = 30 m/s²" not in names


def test_pushes_of_several_sizes_are_of_one_state():
    assert read_disturbances_of_one_state(["velocity=0.2,0.4,0,30,0.2"]) == ("velocity", [0, 0.2, 0.4, 30])
    for named, expected in (
        (["velocity=0,1", "position=1"], "Expected a single --disturbance .* got 2"),
        (["velocity=0,a"], "with a number"),
        (["velocity=0,"], "with a number"),
        (["velocity=0,-1"], "Expected disturbances ≥ 0"),
    ):
        with pytest.raises(UsageError, match=expected):
            read_disturbances_of_one_state(named)


def test_another_state_than_those_of_the_system_is_refused():
    with pytest.raises(UsageError, match="of position, velocity, got 'speed=1'; name one of them"):
        certify(controller(), Region(disturbance={"speed": 1}))


@pytest.mark.gate
def test_a_certificate_names_its_disturbance_among_its_options():
    certificate = certify(controller(), Region(states=D, disturbance={"velocity": 0.2}))
    assert "--disturbance=velocity=0.2" in certificate.command("best.ckpt")
    assert certificate.claim.hole == pytest.approx(pushed_claim().hole, rel=1e-3)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    return str(tiny_checkpoint(tmp_path_factory.mktemp("logs")))


@pytest.mark.gate
@pytest.mark.usefixtures("few_seconds_for_levels")
def test_the_command_takes_one_push_and_several(checkpoint, capsys, tmp_path):
    line = ["certify", "region", checkpoint, "--seconds=2"]
    assert main([*line, "--disturbance=velocity=0.01", "--json", "--report", str(tmp_path)]) == 0
    assert json.loads(capsys.readouterr().out)["disturbance"] == {"velocity": 0.01}
    assert "--disturbance=velocity=0.01" in (tmp_path / "report.md").read_text()
    assert main([*line, "--disturbance=velocity=0,0.01", "--figure", str(tmp_path / "pushes.png")]) == 0
    assert "ends in: a box around" in capsys.readouterr().out
    assert (tmp_path / "pushes.png").stat().st_size > 1000
    for wrong, expected in (
        ("--keep=proof", "Expected one disturbance"), ("--report=folder", "Expected one disturbance"),
        ("--disturbance=position=1", "Expected a single --disturbance"),
    ):  # fmt: skip
        assert main([*line, "--disturbance=velocity=0,0.01", wrong]) == 2
        assert expected in capsys.readouterr().err


# Without disturbances


class Cubic(ControlAffineSystem):
    """ẋ = x − x³: the goal 0 is unstable, and all closed loops from x ≠ 0 go to ±1."""

    state_names, control_names = ("x",), ("u",)

    def f(self, x):
        return x - x**3

    def g(self, x):
        return torch.zeros_like(x)[..., None]


def test_a_loop_that_only_comes_near_the_goal_is_practically_stable():
    """With V = x² is V̇ = 2x²(1 − x²), which is at most −λx² where x² ≥ 1 + λ/2."""
    about = problem_of(Cubic(), None, 100, 0.02, Box([-0.8], [0.8]))
    loop = loop_of(Formula(lambda t, x: (x**2).sum(-1) + 0 * t), about)
    claim = prove_region(loop, about, 0.2, Box([-2.0], [2.0]), Budget(100, 1000, chunk=64), practical=True)
    assert claim.verdict == "certified"
    assert claim.contraction is None
    assert 1.1 <= claim.hole < 1.1 * 1.02
    assert claim.rho == pytest.approx(4, rel=1e-6)
    assert float(claim.extent.upper) == pytest.approx(math.sqrt(claim.hole), rel=0.025)
    alone = prove_region(loop, about, 0.2, Box([-2.0], [2.0]), Budget(100, 1000, chunk=64))
    assert alone.rho == -math.inf
    assert "does not stabilise the goal" in alone.reason


@pytest.mark.gate
def test_without_disturbances_the_claim_says_how_u_is_read():
    claim = claimed(practical=True)
    certificate = RegionCertificate(controller(), claim, {"seed": 0})
    words = certificate.in_words()
    assert "with u read at every t: no closed loop that starts in it leaves it" in words
    assert "practical stability" in words
    assert "under all disturbances" not in words
    assert claim.rho == pytest.approx(plain_claim().rho, rel=1e-6)
    names = [text.get_text() for text in certificate.figure().legends[0].get_texts()]
    assert "V(0, x) ≤ c: entered, then never left" in names
    assert not any("attracted" in name for name in names)
    condition, _, _ = certificate.searched_condition()
    x = D.sample(2000, torch.Generator().manual_seed(0)).double()
    c, V = condition.values(torch.cat([torch.zeros(2000, 1), x], -1))
    assert bool((c[(claim.rho >= V) & (claim.hole <= V)] <= 0).all())


def test_the_option_is_a_switch():
    region = Region(practical=True)
    assert region.options["practical"] is True
    command = RegionCertificate(controller(), None, region.options).command("best.ckpt")
    assert "--practical" in command.split()
    assert "practical" not in RegionCertificate(controller(), None, Region().options).command("best.ckpt")

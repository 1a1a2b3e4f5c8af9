"""Kept proofs of regions of attraction: they are resumed, and checked without a search and without trust."""

import math
import shutil

import pytest
import torch

from lyapnet.base.errors import UsageError
from lyapnet.claims.certify import certify
from lyapnet.claims.checking import check, kept_funnel
from lyapnet.claims.kept_regions import KeptRegion
from lyapnet.claims.kinds import Funnel, LowerBound, Region
from lyapnet.claims.preconditions import over_time
from lyapnet.claims.receding_decrease import OutsideTheHole, RecedingDecrease
from lyapnet.claims.region import prove_region
from lyapnet.controller.controller import Controller
from lyapnet.prover import kept_proofs
from lyapnet.prover.branch_and_bound import Budget
from lyapnet.prover.condition import bounded_condition
from lyapnet.task.sets import Box
from tests.claims import planted
from tests.claims.planted import riccati, stationary
from tests.claims.test_region import LIMITED, D, loop_of, problem
from tests.problems import AMPLE

pytestmark = [pytest.mark.gate, pytest.mark.usefixtures("one_closed_loop")]
ABOUT = problem(controls=LIMITED)


def V_of(factor=1.0):
    return stationary(factor * riccati())


def claimed(path, boxes=4000, V=None, decay=None, states=D):
    V = V_of() if V is None else V
    return prove_region(loop_of(V, ABOUT), ABOUT, decay, states, Budget(AMPLE, boxes, chunk=256), keep=path)


def checked(path, V=None):
    return check(Controller(ABOUT, V_of() if V is None else V), path)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """(the claim, the file of its proof)."""
    path = tmp_path_factory.mktemp("kept") / "whole.proof"
    return claimed(path), path


@pytest.fixture
def kept(whole, tmp_path):
    return shutil.copy(whole[1], tmp_path / "region.proof")


def read(path):
    return kept_proofs.read_proofs(path)["region"]


def rewritten(path, change):
    """Change the proof in a file and compute its digest again."""
    proofs = kept_proofs.read_proofs(path)
    change(proofs["region"])
    kept_proofs.write_proofs(path, proofs)


def of_itself(content):
    """Set the fingerprint to that of the changed file, as a forger could."""
    of = content["of"][0]
    states = Box(of["lower"][1:], of["upper"][1:]).double()
    condition = RecedingDecrease(loop_of(V_of(), ABOUT).double().requires_grad_(False), of["decay"])
    domain = over_time(states, 0.0)
    condition.hole = of["hole"]
    condition.constraints = OutsideTheHole(condition.V, Box(*map(torch.tensor, of["box"])), condition.hole)
    of["fingerprint"] = bounded_condition(condition, domain).fingerprint


def test_a_region_is_confirmed_by_its_leaves_alone(whole, kept):
    claim, result = whole[0], checked(kept)
    assert (result["kind"], result["of"], result["verdict"], result["reason"]) == ("check", "region", "certified", None)
    assert (result["rho"], result["hole"], result["volume_share"]) == (claim.rho, claim.hole, 1.0)
    assert result["region_volume_proved"] == pytest.approx(claim.volume, rel=1e-3)
    assert result["contraction_rate"] == claim.contraction.rate
    assert result["boxes"] == len(read(kept)["node"]) + 1 < claim.proof.boxes
    assert result["share_of_search"] > 0


def test_stopped_and_continued_it_ends_as_in_one_go(whole, tmp_path):
    path = tmp_path / "proof"
    stopped = [claimed(path, boxes) for boxes in (100, 400)]
    assert all(claim.rho < whole[0].rho for claim in stopped)
    ended = claimed(path)
    assert (ended.rho, ended.proof.boxes, ended.hole) == (whole[0].rho, whole[0].proof.boxes, whole[0].hole)
    assert whole[0].proof.boxes > stopped[1].proof.boxes > stopped[0].proof.boxes


def test_a_region_that_was_not_come_to_is_none_and_a_smaller_one_is_one(whole, tmp_path):
    """Boxes of lowest V come first, so that an unfinished proof also gives a region."""
    early, late = tmp_path / "early", tmp_path / "late"
    assert claimed(early, 60).rho == -math.inf
    assert "resume it with lyapnet certify region CKPT --keep" in checked(early)["reason"]
    claim = claimed(late, whole[0].proof.boxes - 400)
    assert claim.hole < claim.rho < whole[0].rho
    assert claim.proof.remaining_volume > 0
    result = checked(late)
    assert (result["verdict"], result["rho"]) == ("certified", claim.rho)
    assert result["region_volume_proved"] < whole[0].volume


def test_another_rate_set_or_value_does_not_go_on(kept):
    before = kept.read_bytes()
    for options in ({"decay": 0.01}, {"states": Box([-3.0, -4.0], [3.0, 4.1]).double()}, {"V": V_of(0.999)}):
        with pytest.raises(UsageError, match=r"choose another file\.$"):
            claimed(kept, **options)
    assert kept.read_bytes() == before
    assert claimed(kept).verdict == "certified"


def test_another_value_is_refused(kept):
    for factor in (0.999, 1.001):
        result = checked(kept, V_of(factor))
        assert result["verdict"] == "refused"
        assert "\n" not in result["reason"]
    assert checked(kept)["verdict"] == "certified"


def test_changed_and_broken_files_are_refused(kept):
    content = kept.read_bytes()
    flipped = bytearray(content)
    flipped[len(content) // 2] ^= 4
    for broken, why in (
        (bytes(flipped), "changed or damaged"),
        (content[:-40], "changed or damaged"),
        (b"", "another"),
    ):
        kept.write_bytes(broken)
        assert checked(kept)["verdict"] == "refused"
        assert why in checked(kept)["reason"]
        with pytest.raises(UsageError, match=why):
            claimed(kept)
    kept.unlink()
    assert "got no file" in checked(kept)["reason"]


def set_of(name, value):
    def change(content):
        content["of"][0][name] = value

    return change


def without_cuts(content):
    content["node"], content["axis"] = content["node"][:40], content["axis"][:40]
    content["closed"] = torch.arange(81)


def closed(content):
    """It claims a level up to which V was found not to fall."""
    content["worst"], content["proved"] = None, content["of"][1]


def beyond_the_rim(content):
    content["of"][1] = content["proved"] = 30.0


def endless(content):
    content["proved"] = math.inf


def no_number(content):
    content["proved"] = content["of"][1] = math.nan


def narrow(content):
    """B is a line on which the law contracts; V is above c at both of its ends."""
    content["of"][0].update(box=[[0.0, -0.1], [0.0, 0.1]], hole=0.001)


CHANGES = {
    "fewer cuts": without_cuts,
    "a higher ρ, not proved": closed,
    "a ρ beyond the boundary of D": beyond_the_rim,
    "ρ = ∞": endless,
    "ρ no number": no_number,
    "a smaller D": lambda content: (set_of("lower", [0.0, -1.0, -1.0])(content), set_of("upper", [0.0, 1, 1])(content)),
    "D without the goal": set_of("lower", [0.0, 0.1, -4.0]),
    "D of one state": set_of("lower", [0.0, -3.0]),
    "D at another time": set_of("lower", [-1.0, -3.0, -4.0]),
    "a rate that V does not fall at": set_of("decay", 3.0),
    "λ = 0": set_of("decay", 0.0),
    "λ < 0": set_of("decay", -1.0),
    "a hole wider than B": set_of("hole", 3.0),
    "no hole": set_of("hole", 0.0),
    "a hole below 0": set_of("hole", -1.0),
    "B beyond where it contracts": set_of("box", [[-2.9, -3.9], [2.9, 3.9]]),
    "B beyond D": set_of("box", [[-3.1, -0.1], [0.1, 0.1]]),
    "B beside the goal": set_of("box", [[0.1, -0.1], [0.2, 0.1]]),
    "B that the goal is on the boundary of": set_of("box", [[0.0, -0.1], [0.2, 0.1]]),
    "B without width": set_of("box", [[0.0, -0.1], [0.0, 0.1]]),
    "B without width, around a hole as small": narrow,
    "B of one state": set_of("box", [[-0.1], [0.1]]),
    "Y singular": set_of("Y", [[1.0, 1.0], [1.0, 1.0]]),
    "Y all but singular": set_of("Y", [[1.0, 1.0], [1.0, 1.0 + 1e-12]]),
    "Y in which it does not contract": set_of("Y", [[1.0, 0.0], [0.0, 1.0]]),
    "Y of one state": set_of("Y", [[1.0]]),
    "Y no numbers": set_of("Y", [[math.nan, 0.0], [0.0, 1.0]]),
    "a V of another checkpoint": set_of("fingerprint", "0" * 64),
}


BARE = ["a V of another checkpoint", "D without the goal", "D of one state", "λ = 0", "λ < 0"]
"""Changes after which there is no condition to take the fingerprint of, or that are one of it."""


@pytest.mark.parametrize("name", CHANGES)
def test_an_edited_file_is_refused(name, kept):
    """The forger computes the digest and the fingerprint again."""
    rewritten(kept, CHANGES[name])
    if name not in BARE:
        rewritten(kept, of_itself)
    result = checked(kept)
    assert result["verdict"] == "refused"
    assert result["reason"]
    assert "\n" not in result["reason"]


@pytest.mark.parametrize("name", [name for name in CHANGES if not name.startswith(("λ", "D ", "a V"))])
def test_nothing_more_is_proved_from_an_edited_file(name, whole, kept):
    """A search that resumes from it refuses it, or gives a true result."""
    rewritten(kept, CHANGES[name])
    rewritten(kept, of_itself)
    try:
        rho = claimed(kept).rho
    except UsageError:
        rho = -math.inf
    assert rho < 1.05 * whole[0].rho


def test_the_old_fingerprint_is_that_of_another_condition(kept):
    """Even if the changed numbers are true: a smaller hole and a slower rate need another fingerprint."""
    before = kept.read_bytes()
    for name, value in (("hole", 0.05), ("decay", 0.002)):
        rewritten(kept, set_of(name, value))
        assert "got another; name its checkpoint" in checked(kept)["reason"]
        rewritten(kept, of_itself)
        assert checked(kept)["verdict"] == "certified"
        kept.write_bytes(before)


def test_the_same_edits_of_nothing_are_certified(kept):
    """The counterpart: the digest and the fingerprint that the tests compute are those of the file."""
    before = read(kept)["of"][0]["fingerprint"]
    rewritten(kept, of_itself)
    assert read(kept)["of"][0]["fingerprint"] == before
    assert checked(kept)["verdict"] == "certified"


def test_what_waits_and_is_called_closed_is_refused(tmp_path):
    path = tmp_path / "stopped"
    claim = claimed(path, 300)

    def called_closed(content):
        content["closed"] = torch.cat([content["closed"], content["frontier"]])
        content["frontier"], content["key"] = content["frontier"][:0], content["key"][:0]
        content["proved"] = 3.6

    rewritten(path, called_closed)
    assert claim.rho < 3.6
    assert checked(path)["verdict"] == "refused"


def test_a_smaller_region_in_the_same_set_may_be_claimed(kept):
    """The counterpart of a raised ρ: the smaller claim is checked, and its volume is computed again."""
    full = checked(kept)
    rewritten(kept, lambda content: content.update(proved=1.0))
    result = checked(kept)
    assert (result["verdict"], result["rho"]) == ("certified", 1.0)
    assert result["region_volume_proved"] == pytest.approx(full["region_volume_proved"] / full["rho"], rel=0.02)


@pytest.mark.parametrize("name", ["above", "below"])
def test_a_region_is_no_funnel(name, kept):
    proofs = kept_proofs.read_proofs(kept)
    for other in ({name: proofs["region"]}, {"region": proofs["region"], name: proofs["region"]}, {"other": {}}, {}):
        kept_proofs.write_proofs(kept, other)
        result = checked(kept)
        assert result["verdict"] == "refused"
        assert "\n" not in result["reason"]
    kept_proofs.write_proofs(kept, proofs)
    assert checked(kept)["verdict"] == "certified"


def test_a_funnel_is_no_region(kept, tmp_path):
    """One line names the kind of the file, and the file is not changed."""
    funnel, about = tmp_path / "funnel", Controller(planted.problem(), V_of())
    claim = Funnel(alpha=0.9, delta=0.05, states=[[-2.5, -4.5], [2.5, 4.5]])
    assert certify(about, claim, keep=funnel).verdict == "certified"
    before = kept.read_bytes(), funnel.read_bytes()
    with pytest.raises(
        UsageError, match=r"^Expected the proof of a region in .*, got that of a funnel; choose another"
    ):
        certify(about, Region(), keep=funnel)
    for claims in ([claim], [claim, LowerBound()]):
        with pytest.raises(
            UsageError, match=r"^Expected the proof of a funnel in .*, got that of a region; take a new"
        ):
            certify(about, *claims, keep=kept)
    with pytest.raises(UsageError, match=r"^Expected the proof of a funnel in .*, got that of a region; name another"):
        kept_funnel(about, kept)
    assert before == (kept.read_bytes(), funnel.read_bytes())
    assert check(about, funnel)["of"] == "sound"


def believing_c(self, around, states, seen, level, budget, proposed=None):
    self.around, self.hole = around, proposed
    self.constraints = OutsideTheHole(self.V, around.box, proposed)


@pytest.mark.parametrize(
    ("name", "of", "method", "believing"),
    [
        ("a hole wider than B", RecedingDecrease, "open_hole", believing_c),
        ("a smaller D", KeptRegion, "level", lambda self, *_: self.wanted),
    ],
)
def test_without_that_check_it_would_certify_what_is_not_proved(name, of, method, believing, kept, monkeypatch):
    """The counterparts: closed loops would leave the hole, or D."""
    rewritten(kept, CHANGES[name])
    rewritten(kept, of_itself)
    assert checked(kept)["verdict"] == "refused"
    monkeypatch.setattr(of, method, believing)
    assert checked(kept)["verdict"] == "certified"

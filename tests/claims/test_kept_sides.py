"""Kept proofs of both sides in one file: they are resumed, and checked without a search and without trust."""

import os
import shutil
import signal

import pytest
import torch

from lyapnet.base.errors import Interrupted, UsageError
from lyapnet.claims.certify import certify
from lyapnet.claims.checking import check, kept_funnel
from lyapnet.claims.kinds import Funnel, LowerBound
from lyapnet.controller.controller import Controller
from lyapnet.prover import kept_proofs
from tests.claims.planted import riccati, stationary
from tests.claims.test_least_cost import problem
from tests.problems import Formula

pytestmark = [pytest.mark.gate, pytest.mark.usefixtures("one_closed_loop")]
SET = [[-2.5, -4.5], [2.5, 4.5]]


def controller(factor=1.0):
    """A controller whose V is the optimum plus a ripple, so that the proof needs some boxes."""
    optimum = stationary(factor * riccati())
    return Controller(problem(), Formula(lambda t, x: optimum(t, x) * (1 + 0.002 * torch.sin(4 * t + 3 * x[..., 0]))))


def both(path, alpha=0.95, delta=0.02, seconds=60.0, states=SET, factor=1.0, report=None):
    claim = Funnel(alpha=alpha, delta=delta, states=states)
    return certify(controller(factor), claim, LowerBound(), budget=seconds, keep=path, report=report)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """(the certificate, the file of its proofs)."""
    path = tmp_path_factory.mktemp("kept") / "whole.proof"
    return both(path), path


@pytest.fixture
def kept(whole, tmp_path):
    return shutil.copy(whole[1], tmp_path / "both.proof")


def rewritten(path, change):
    """Change the proofs in a file and compute its digest again."""
    proofs = kept_proofs.read_proofs(path)
    change(proofs)
    kept_proofs.write_proofs(path, proofs)


def test_both_sides_are_confirmed_by_their_leaves_alone(whole, kept):
    certificate, result, proofs = whole[0], check(controller(), kept), kept_proofs.read_proofs(kept)
    assert certificate.verdict == "certified"
    assert (result["of"], result["verdict"], result["reason"]) == ("two-sided", "certified", None)
    same = ("alpha", "delta", "set", "rho", "lower_set", "lower_level", "holds_for", "certified_ratio", "fingerprint")
    assert {name: result[name] for name in same} == {name: certificate.result[name] for name in same}
    assert result["boxes"] == len(proofs["above"]["node"]) + 1 <= certificate.result["boxes"]
    assert result["lower_boxes"] == len(proofs["below"]["node"]) + 1 <= certificate.result["lower_boxes"]
    assert kept_funnel(controller(), kept).rho >= certificate.claim.rho


def test_stopped_on_either_side_it_goes_on(whole, kept, monkeypatch):
    """It is stopped after the bound from above, and in the middle of the one from below."""
    found, calls = whole[0].result, []
    rewritten(kept, lambda proofs: proofs.pop("below"))
    alone = check(controller(), kept)
    assert (alone["of"], alone["verdict"]) == ("sound", "certified"), "the file proves the funnel"
    original = kept_proofs.KeptProof.write
    monkeypatch.setattr(
        kept_proofs.KeptProof, "write",
        lambda self, proof: (calls.append(self.about["proves"]), original(self, proof)),
    )  # fmt: skip
    result = both(kept).result
    assert calls == ["above", "below"]
    assert {name: result[name] for name in ("verdict", "rho", "lower_level")} == {
        name: found[name] for name in ("verdict", "rho", "lower_level")
    }
    assert check(controller(), kept)["of"] == "two-sided"


def test_ctrl_c_in_the_middle_of_the_second_side_keeps_both(whole, tmp_path):
    path = tmp_path / "stopped.proof"

    def stop(progress):
        if path.exists() and progress.boxes:  # the first side is complete, and the second is in progress
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(Interrupted, match=r"the proof so far is kept in .*stopped\.proof"):
        both(path, report=stop)
    proofs = kept_proofs.read_proofs(path)
    assert (len(proofs["above"]["frontier"]), len(proofs["below"]["frontier"]) > 0) == (0, True)
    result = check(controller(), path)
    assert result["verdict"] == "refused"
    assert "got an unfinished one" in result["reason"]
    assert both(path).result["lower_level"] == whole[0].result["lower_level"]
    assert check(controller(), path)["verdict"] == "certified"


def test_another_question_does_not_go_on(kept):
    before = kept.read_bytes()
    for options in ({"alpha": 0.94}, {"delta": 0.06}, {"states": [[-2.5, -4.5], [2.5, 4.6]]}, {"factor": 0.999}):
        with pytest.raises(UsageError, match=r"take a new file\.$"):
            both(kept, **options)
    with pytest.raises(UsageError, match=r"take a new file\.$"):  # Taylor forms of another degree
        certify(controller(), Funnel(alpha=0.95, delta=0.02, states=SET), keep=kept)
    assert kept.read_bytes() == before


def waiting(name):
    """One leaf waits."""

    def change(proofs):
        proof = proofs[name]
        proof["frontier"], proof["closed"], proof["key"] = proof["closed"][:1], proof["closed"][1:], torch.ones(1)

    return change


def cut_less(name):
    def change(proofs):
        proof = proofs[name]
        proof["node"], proof["axis"], proof["closed"] = proof["node"][:1], proof["axis"][:1], torch.arange(1, 3)

    return change


def of_another(name, part):
    def change(proofs):
        proofs[part]["of"][0][name] = {"alpha": 0.9, "delta": 0.2, "disturbance": [0.0, 0.0], "degree": 1}[name]

    return change


def exchanged(proofs):
    proofs["above"], proofs["below"] = proofs["below"], proofs["above"]


def twice(proofs):
    proofs["below"] = proofs["above"]


def as_a_region(proofs):
    proofs["region"] = proofs.pop("above")
    del proofs["below"]


def from_below_alone(proofs):
    del proofs["above"]


CHANGES = {
    "a leaf waits above": waiting("above"),
    "a leaf waits below": waiting("below"),
    "exchanged": exchanged,
    "twice": twice,
    "a region": as_a_region,
    "alone": from_below_alone,
    **{
        f"{name} {part}": of_another(name, part) for name in ("alpha", "delta", "degree") for part in ("above", "below")
    },
    "pushed": of_another("disturbance", "above"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_an_edited_file_is_refused(name, kept):
    rewritten(kept, CHANGES[name])
    result = check(controller(), kept)
    assert result["verdict"] == "refused"
    assert result["reason"].endswith(".")
    assert "\n" not in result["reason"]


def test_leaves_that_are_not_proved_are_refused_on_either_side(kept, tmp_path):
    """Waiting leaves are recorded as closed: all cuts of a finished proof but the first are removed."""
    for name in ("above", "below"):
        changed = shutil.copy(kept, tmp_path / name)
        rewritten(changed, cut_less(name))
        few = len(kept_proofs.read_proofs(kept)[name]["node"])
        assert few > 150, "more than a check may cut again"
        assert check(controller(), changed)["verdict"] == "refused"


def test_sides_of_two_questions_are_no_claim(kept, tmp_path):
    """Each side is proved, but with another δ."""
    other = tmp_path / "other.proof"
    assert both(other, delta=0.06).verdict == "certified"
    rewritten(kept, lambda proofs: proofs.update(below=kept_proofs.read_proofs(other)["below"]))
    result = check(controller(), kept)
    assert result["verdict"] == "refused"
    assert "two proofs with the same α and δ" in result["reason"]
    assert check(controller(), other)["verdict"] == "certified"


def test_another_value_is_refused(kept):
    for factor in (0.999, 1.001):
        assert "name its checkpoint" in check(controller(factor), kept)["reason"]
    assert check(controller(), kept)["verdict"] == "certified"

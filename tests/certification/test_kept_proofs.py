"""Proofs that are kept in a file and go on, in several threads, and report how far they are."""

import math
import pickle
import shutil
from pathlib import Path

import pytest
import torch

from lyapnet.certification import (
    Budget,
    DecreaseCondition,
    branch_and_bound,
    condition,
    kept_proofs,
    proof,
    prove,
    violations,
)
from lyapnet.certification.boxes import CutTree
from lyapnet.errors import UsageError
from lyapnet.graphs import bound_rules, bounds, simplification, taylor, tracing
from tests.certification.planted import Planted, domain, loop, riccati


@pytest.fixture
def P():
    return riccati()


@pytest.fixture
def kept(P, tmp_path):
    """The file of a proof that was stopped early."""
    path = tmp_path / "proof.pt"
    assert go_on(dipped(P), path, boxes=60).verdict == "unknown"
    return path


def dipped(P, alpha=0.9, delta=0.05):
    """A condition that holds, with a dip, which takes some boxes."""
    return Planted(loop(P), alpha, delta).plant(torch.tensor([1.1, 0.1, 0.2]), 0.8, -3.0)


def violated(P):
    return Planted(loop(P), 0.9, 0.05).plant(torch.tensor([1.0, 0.6, 0.3]), 0.15, 0.3)


def go_on(condition, path, boxes=100_000, wanted=2.0, box=None, **options):
    return prove(
        condition, box or domain(), wanted, Budget(60, boxes=boxes, chunk=64, workers=options.pop("workers", 1)), False,
        torch.Generator().manual_seed(0), keep=path, **options,
    )  # fmt: skip


@pytest.mark.parametrize(("condition", "wanted"), [(dipped, 2.0), (violated, 6.0)])
def test_stopped_and_continued_a_proof_ends_as_in_one_go(P, condition, wanted, tmp_path):
    condition, path = condition(P), tmp_path / "proof.pt"
    whole = go_on(condition, None, wanted=wanted)
    stopped = [go_on(condition, path, boxes, wanted) for boxes in (60, 120)]
    assert all(proof.level < whole.level for proof in stopped)
    told = []
    proof = go_on(condition, path, wanted=wanted, report=told.append)
    assert (proof.verdict, proof.level, proof.boxes) == (whole.verdict, whole.level, whole.boxes)
    assert proof.counterexample == whole.counterexample
    assert proof.remaining_volume == whole.remaining_volume == 0
    assert whole.boxes > stopped[1].boxes > stopped[0].boxes
    assert told[0].boxes == stopped[1].boxes + 64, "it starts where it stood"
    assert told[0].seconds > stopped[1].seconds
    assert [one.boxes for one in told] == sorted(one.boxes for one in told)
    assert told[-1].remaining == 0


OTHERS = {  # proofs of something else
    "V": lambda P, path: go_on(dipped(0.999 * P), path),
    "α": lambda P, path: go_on(dipped(P, alpha=0.901), path),
    "δ": lambda P, path: go_on(dipped(P, delta=0.0501), path),
    "level": lambda P, path: go_on(dipped(P), path, wanted=2.01),
    "set": lambda P, path: go_on(dipped(P), path, box=(domain()[0], domain()[1] + 1e-9)),
}


@pytest.mark.parametrize("other", OTHERS)
def test_the_proof_of_something_else_is_refused(other, P, kept):
    before = kept.read_bytes()
    with pytest.raises(UsageError, match=r"got another; take a new file\.$"):
        OTHERS[other](P, kept)
    assert kept.read_bytes() == before
    assert go_on(dipped(P), kept).verdict == "certified"


def test_without_that_check_it_would_certify_what_fails(P, kept, monkeypatch):
    """A violation where the other proof was done; the twin."""
    monkeypatch.setattr(kept_proofs.KeptProof, "identity", [])
    kept.unlink()
    go_on(dipped(P), kept, boxes=200)
    content = kept_proofs.read_content(kept)
    leaves = CutTree(content["node"], content["axis"]).leaves(*domain())
    lower, upper, _, _ = leaves[torch.isin(leaves.node, content["frontier"].long())]
    corners = torch.cartesian_prod(*(torch.linspace(0.1, 0.9, 9) for _ in range(3)))
    points = domain()[0] + (domain()[1] - domain()[0]) * corners
    points = points[(loop(P).policy.V(points[:, 0], points[:, 1:]) < 1.5)]
    done = points[~((points[:, None] >= lower) & (points[:, None] <= upper)).all(-1).any(1)]
    bad = Planted(loop(P), 0.9, 0.05).plant(done[0], 0.02, 0.1)
    assert go_on(bad, kept).verdict == "certified"
    monkeypatch.undo()
    assert go_on(bad, None, boxes=2000).verdict == "falsified"


# The rules that a proof was made by


def test_the_rules_are_those_of_the_search_and_of_the_bounds():
    assert {folder.name for folder in kept_proofs.SOURCES} == {"certification", "graphs"}
    for module in (proof, branch_and_bound, condition, bounds, bound_rules, taylor, tracing, simplification):
        assert any(Path(module.__file__).is_relative_to(folder) for folder in kept_proofs.SOURCES)


def test_a_changed_byte_in_any_of_them_is_another_key(tmp_path):
    folders = [shutil.copytree(folder, tmp_path / folder.name) for folder in kept_proofs.SOURCES]
    key = kept_proofs.hash_of_sources(folders)
    assert key == kept_proofs.hash_of_sources(folders) == kept_proofs.hash_of_sources()
    files = [path for folder in folders for path in folder.rglob("*.py")]
    assert len(files) > 15
    for path in files:
        content = path.read_bytes()
        path.write_bytes(content[:-1] + b" ")
        assert kept_proofs.hash_of_sources(folders) != key, path
        path.write_bytes(content)
    files[0].rename(files[0].with_name("renamed.py"))
    assert kept_proofs.hash_of_sources(folders) != key


def test_the_proof_of_other_rules_is_refused(P, kept, monkeypatch):
    monkeypatch.setattr(kept_proofs, "hash_of_sources", lambda: "of another version")
    with pytest.raises(UsageError, match=r"and version in .* got another; take a new file\.$"):
        go_on(dipped(P), kept)


def broken(path):
    content = path.read_bytes()
    return {
        "empty": b"",
        "truncated": content[: len(content) // 2],
        "words": b"proof",
        "of something": pickle.dumps({"frontier": []}),
        "with code": pickle.dumps(print),
    }


@pytest.mark.parametrize("kind", ["empty", "truncated", "words", "of something", "with code"])
def test_a_broken_file_is_refused(kind, P, kept):
    kept.write_bytes(broken(kept)[kind])
    with pytest.raises(UsageError, match=r"^Expected a proof in .*proof.pt', got another file; name a new one\.$"):
        go_on(dipped(P), kept)


def test_a_kept_proof_is_plain_data(kept):
    content = kept_proofs.read_content(kept)
    lists = {"node", "axis", "closed", "frontier", "key"}
    assert content.keys() == {"of", "worst", "proved", "boxes", "seconds", "given_up", *lists}
    assert content["boxes"] >= 60
    assert all(isinstance(content[name], torch.Tensor) for name in lists)


# Threads


def test_threads_come_to_the_same_verdict_and_level(P):
    true = dipped(P)
    one, two = (go_on(true, None, workers=workers) for workers in (1, 2))
    assert one.verdict == two.verdict == "certified"
    assert one.level == two.level == 2.0
    assert min(one.boxes, two.boxes) > 100
    assert go_on(violated(P), None, 200, 6.0, workers=2).verdict == "falsified"


# Where a condition fails


def test_violations_are_the_worst_points_found(P):
    condition = violated(P)
    points = violations(condition, domain(), 6.0, 40, torch.Generator().manual_seed(0))
    with torch.no_grad():
        c, W = condition(points[:, 0], points[:, 1:]), condition.height(points[:, 0], points[:, 1:])
    assert len(points) == 40
    assert (c > 0).all()
    assert (W <= 6.0).all()
    assert c.max() > 0.25, "of 0.3 at the top"
    assert (c.diff() <= 0).all()
    low = float(condition.height(condition.point[0], condition.point[1:])) * 0.2
    assert len(violations(condition, domain(), low, 40, torch.Generator().manual_seed(0))) == 0
    assert len(violations(DecreaseCondition(loop(P), 0.9, 0.05), domain(), math.inf, 40)) == 0

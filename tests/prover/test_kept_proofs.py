"""Proofs in files: they continue after a stop, are checked, and report their progress."""

import math
import pickle
import shutil
from pathlib import Path

import pytest
import torch

from lyapnet.base.errors import UsageError
from lyapnet.prover import (
    bound_rules,
    bounds,
    branch_and_bound,
    condition,
    counterexamples,
    kept_proofs,
    proof,
    simplification,
    taylor,
)
from lyapnet.prover.boxes import CutTree, root_box
from lyapnet.prover.branch_and_bound import Budget
from lyapnet.prover.condition import DecreaseCondition
from lyapnet.prover.counterexamples import violations
from lyapnet.prover.proof import prove
from tests.claims.planted import Planted, domain, loop, riccati
from tests.marks import sample
from tests.problems import AMPLE


@pytest.fixture
def P():
    return riccati()


@pytest.fixture
def kept(P, tmp_path):
    """The file of a proof that was stopped early."""
    path = tmp_path / "proof.pt"
    assert go_on(dipped(P), path, boxes=60).verdict == "unknown"
    return path


def read(path):
    """The content of the one proof in a file."""
    return kept_proofs.read_proofs(path)["above"]


def dipped(P, alpha=0.9, delta=0.05):
    """A condition that holds; it has a dip, so that its proof needs many boxes."""
    return Planted(loop(P), alpha, delta).plant(torch.tensor([1.1, 0.1, 0.2]), 0.8, -3.0)


def violated(P):
    return Planted(loop(P), 0.9, 0.05).plant(torch.tensor([1.0, 0.6, 0.3]), 0.15, 0.3)


def go_on(condition, path, boxes=100_000, wanted=2.0, box=None, **options):
    return prove(
        condition, box or domain(), wanted,
        Budget(AMPLE, boxes=boxes, chunk=64, workers=options.pop("workers", 1)), False,
        torch.Generator().manual_seed(0), keep=path, **options,
    )  # fmt: skip


@pytest.mark.parametrize("interval", [0.0, math.inf])
def test_a_proof_is_kept_during_its_search(P, tmp_path, monkeypatch, interval):
    """The twin: not before the interval has passed."""
    monkeypatch.setattr(proof, "SAVE_INTERVAL", interval)
    path, found = tmp_path / "proof.pt", list[bool]()
    go_on(dipped(P), path, boxes=300, report=lambda _: found.append(path.exists()))
    assert len(found) > 1
    assert any(found) is (interval == 0)
    assert path.exists()


@pytest.mark.gate
@pytest.mark.parametrize(("condition", "wanted"), sample([(dipped, 2.0), (violated, 6.0)], 2))
def test_stopped_and_continued_a_proof_ends_as_in_one_go(P, condition, wanted, tmp_path):
    condition, path = condition(P), tmp_path / "proof.pt"
    whole = go_on(condition, None, wanted=wanted)
    stopped = [go_on(condition, path, boxes, wanted) for boxes in (60, 120)]
    assert all(proof.level < whole.level for proof in stopped)
    reports = []
    proof = go_on(condition, path, wanted=wanted, report=reports.append)
    assert (proof.verdict, proof.level, proof.boxes) == (whole.verdict, whole.level, whole.boxes)
    assert proof.counterexample == whole.counterexample
    assert proof.remaining_volume == whole.remaining_volume == 0
    assert whole.boxes > stopped[1].boxes > stopped[0].boxes
    assert 0 < reports[0].boxes - stopped[1].boxes <= 64, "it continues from the last state, with a batch or its rest"
    assert reports[0].seconds > stopped[1].seconds
    assert [one.boxes for one in reports] == sorted(one.boxes for one in reports)
    assert reports[-1].remaining == 0


OTHERS = {  # proofs of something else
    "V": lambda P, path: go_on(dipped(0.999 * P), path),
    "α": lambda P, path: go_on(dipped(P, alpha=0.901), path),
    "δ": lambda P, path: go_on(dipped(P, delta=0.0501), path),
    "level": lambda P, path: go_on(dipped(P), path, wanted=2.01),
    "set": lambda P, path: go_on(dipped(P), path, box=(domain()[0], domain()[1] + 1e-9)),
}


@pytest.mark.gate
def test_the_proof_of_something_else_is_refused(P, kept):
    before = kept.read_bytes()
    for other in OTHERS.values():
        with pytest.raises(UsageError, match=r"got another; take a new file\.$"):
            other(P, kept)
    assert kept.read_bytes() == before
    assert go_on(dipped(P), kept).verdict == "certified"


@pytest.mark.gate
def test_without_that_check_it_would_certify_what_fails(P, kept, monkeypatch):
    """The twin: a condition that fails on boxes that the other proof had closed."""
    monkeypatch.setattr(kept_proofs.KeptProof, "identity", [])
    kept.unlink()
    go_on(dipped(P), kept, boxes=200)
    content = read(kept)
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


# The code that a proof depends on


def test_the_rules_are_those_of_the_search_and_of_the_bounds():
    assert {folder.name for folder in kept_proofs.SOURCES} == {"prover"}
    for module in (proof, branch_and_bound, condition, bounds, bound_rules, taylor, simplification):
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


@pytest.mark.parametrize("module", kept_proofs.SINGLE_FILES, ids=lambda module: module.__name__)
def test_a_changed_byte_in_a_single_file_is_another_key(module, tmp_path, monkeypatch):
    key, changed = kept_proofs.hash_of_sources(), tmp_path / "changed.py"
    changed.write_bytes(Path(module.__file__).read_bytes() + b"#")
    monkeypatch.setattr(module, "__file__", str(changed))
    assert kept_proofs.hash_of_sources() != key


def test_proofs_of_other_compiler_flags_have_another_key(monkeypatch):
    key = kept_proofs.hash_of_sources()
    monkeypatch.setattr(kept_proofs, "FLAGS", (*kept_proofs.FLAGS, "-ffast-math"))
    assert kept_proofs.hash_of_sources() != key


def test_the_proof_of_other_rules_is_refused(P, kept, monkeypatch):
    monkeypatch.setattr(kept_proofs, "hash_of_sources", lambda: "of another version")
    with pytest.raises(UsageError, match=r"and version by the same options in .* got another; take a new file\.$"):
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


@pytest.mark.parametrize("kind", sample(["empty", "truncated", "words", "of something", "with code"], 4))
def test_a_broken_file_is_refused(kind, P, kept):
    kept.write_bytes(broken(kept)[kind])
    expected = {"truncated": r"^Expected the proof that was written, got .*proof.pt', which was changed or damaged"}
    with pytest.raises(
        UsageError, match=expected.get(kind, r"^Expected a proof in .*, got another file; name another")
    ):
        go_on(dipped(P), kept)


def test_a_kept_proof_is_plain_data(kept):
    content = read(kept)
    lists = {"node", "axis", "closed", "frontier", "key"}
    assert content.keys() == {"of", "worst", "proved", "boxes", "seconds", "given_up", *lists}
    assert content["boxes"] >= 60
    assert all(isinstance(content[name], torch.Tensor) for name in lists)


# What a changed file does


def rewritten(path, change):
    """Change the content of a file, with a correct digest."""
    proofs = kept_proofs.read_proofs(path)
    change(proofs["above"])
    kept_proofs.write_proofs(path, proofs)


def checked(condition, path, wanted=2.0):
    return prove(condition, domain(), wanted, Budget(AMPLE, chunk=64), keep=path, replay=True)


@pytest.fixture
def finished(P, kept):
    assert go_on(dipped(P), kept).verdict == "certified"
    return kept


def test_no_flipped_bit_is_used(P, finished):
    content, generator = finished.read_bytes(), torch.Generator().manual_seed(0)
    places = torch.randint(8 * len(content), (40,), generator=generator).tolist()
    for bit in [0, 8 * len(content) - 1, *places]:
        changed = bytearray(content)
        changed[bit // 8] ^= 1 << bit % 8
        finished.write_bytes(changed)
        expected = "another file; name another" if bit < 8 * len(kept_proofs.FORMAT) else "changed or damaged since"
        with pytest.raises(UsageError, match=expected):
            read(finished)
    finished.write_bytes(content)
    assert read(finished)["proved"] == 2.0


def test_one_of_version_0_1_is_refused(P, kept):
    content = {"of": [], "frontier": [], "boxes": 0, "given_up": 0.0, "level": 2.0, "worst": None, "seconds": 0.0}
    torch.save(content, kept)
    with pytest.raises(UsageError, match="this version's format"):
        go_on(dipped(P), kept)


def emptied(content):
    content["frontier"], content["key"] = content["frontier"][:0], content["key"][:0]


def called_closed(content):
    content["closed"] = torch.cat([content["closed"], content["frontier"]])
    emptied(content)


def without_a_leaf(content):
    content["closed"] = content["closed"][1:]


def without_a_cut(content):
    content["node"], content["axis"] = content["node"][:-1], content["axis"][:-1]


def cut_twice(content):
    content["node"][-1] = content["node"][-2]


def raised(content):
    content["worst"], content["proved"] = None, 6.0


def with_another_counterexample(content):
    content["worst"] = {"t": 1.0, "x": [0.0, 0.0], "condition": 1.0, "height": 5.9}


def of_another_key(content):
    content["key"] = content["key"] + 100


def of_another_v(content):
    content["of"][0]["fingerprint"] = "0" * 64


@pytest.mark.parametrize(
    "change",
    sample(
        [emptied, without_a_leaf, without_a_cut, cut_twice, with_another_counterexample, of_another_key, of_another_v],
        3,
    ),
)
def test_resuming_refuses_what_does_not_fit_together(change, P, kept):
    rewritten(kept, change)
    with pytest.raises(UsageError, match=r"got another(?: file)?; (?:name another|take a new file)\.$"):
        go_on(dipped(P), kept)


@pytest.mark.gate
def test_a_counterexample_that_is_left_out_is_met_again(P, tmp_path):
    path, condition = tmp_path / "proof.pt", violated(P)
    whole = go_on(condition, path, wanted=6.0)
    assert whole.level < 6.0
    rewritten(path, raised)
    again = go_on(condition, path, wanted=6.0)
    assert (again.verdict, again.level) == ("falsified", pytest.approx(whole.level, rel=0.05))


def test_a_file_that_says_finished_is_bounded_again(P, kept):
    """All waiting leaves are listed as closed, as if the proof were finished."""
    rewritten(kept, called_closed)
    before = read(kept)["boxes"]
    proof = go_on(dipped(P), kept)
    assert proof.verdict == "certified"
    assert proof.boxes > before + 60, "its leaves, and what was left to cut"


# Checking without a search


def test_a_finished_proof_is_confirmed_by_its_leaves_alone(P, finished):
    """With K cuts, the search bounds 2K + 1 boxes, and the check bounds the K + 1 leaves."""
    content = read(finished)
    confirmed = checked(dipped(P), finished)
    assert (confirmed.verdict, confirmed.level, confirmed.remaining_volume) == ("certified", 2.0, 0.0)
    assert confirmed.boxes == len(content["node"]) + 1
    assert content["boxes"] == 2 * len(content["node"]) + 1


@pytest.mark.parametrize("change", sample([without_a_cut, raised, called_closed, emptied], 2), ids=lambda f: f.__name__)
def test_a_check_believes_neither_lists_nor_levels(change, P, kept):
    """The file of an unfinished proof is changed to look finished, with a correct digest."""
    rewritten(kept, emptied)
    rewritten(kept, change)
    assert checked(dipped(P), kept, 6.0 if change is raised else 2.0).verdict != "certified"


def test_a_check_refuses_an_unfinished_proof_at_once(P, kept, monkeypatch):
    waiting = len(read(kept)["frontier"])
    assert waiting > 0
    monkeypatch.setattr("lyapnet.prover.proof.ProvedLevel.find_undecided", None)
    with pytest.raises(
        UsageError, match=f"got an unfinished one .undecided boxes: {waiting}.; go on with .*--keep .*proof.pt"
    ):
        checked(dipped(P), kept)


@pytest.mark.gate
def test_a_check_refuses_other_cuts_and_another_v(P, finished):
    rewritten(finished, lambda content: content["axis"].zero_())
    assert checked(dipped(P), finished).verdict != "certified"
    with pytest.raises(UsageError, match=r"got another; name its checkpoint\.$"):
        checked(dipped(1.001 * P), finished)
    rewritten(finished, cut_twice)
    with pytest.raises(UsageError, match="another file"):
        checked(dipped(P), finished)


def test_leaves_cover_their_box_exactly():
    generator, tree, (lower, upper) = torch.Generator().manual_seed(0), CutTree(), domain()
    boxes = root_box(lower, upper)
    for _ in range(6):
        boxes = tree.cut(boxes, torch.randint(3, (len(boxes.key),), generator=generator))
        boxes = boxes[torch.rand(len(boxes.key), generator=generator) < 0.8]
    leaves = CutTree(*tree.cuts).leaves(lower, upper)
    assert len(leaves.key) == tree.size + 1 > 20
    assert float(leaves.volumes(lower, upper).sum()) == 1.0, "powers of two add exactly"
    points = lower + (upper - lower) * torch.rand(500, 1, 3, generator=generator)
    assert (((leaves.lower <= points) & (points < leaves.upper)).all(-1).sum(-1) == 1).all()
    assert torch.isin(boxes.node, leaves.node).all()


# Threads


@pytest.mark.gate
def test_threads_come_to_the_same_verdict_and_level(P):
    true = dipped(P)
    one, two = (go_on(true, None, workers=workers) for workers in (1, 2))
    assert one.verdict == two.verdict == "certified"
    assert one.level == two.level == 2.0
    assert min(one.boxes, two.boxes) > 100
    assert go_on(violated(P), None, 200, 6.0, workers=2).verdict == "falsified"


# Where a condition fails


def test_violations_are_the_worst_points_found(P, monkeypatch):
    monkeypatch.setattr(counterexamples, "STEPS", 40)  # conftest.py has fewer
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


@pytest.mark.parametrize("value", [math.inf, -math.inf])
def test_the_margin_of_a_level_leaves_infinite_ones(value):
    assert branch_and_bound.just_below(value) == branch_and_bound.just_above(value) == value
    assert branch_and_bound.just_below(-2.0) < -2.0 < branch_and_bound.just_above(-2.0)

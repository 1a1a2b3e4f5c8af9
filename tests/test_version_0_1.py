"""What version 0.1 left behind: its checkpoints load and measure as they did, its runs resume to the same end.

The fixtures were made by version 0.1 itself. In its files, what later versions added is missing: loggers, callbacks,
controls, the cost's name.
"""

import csv
import io
import json
import shutil
from pathlib import Path

import pytest
import torch
from rich.console import Console

import lyapnet
from lyapnet.cli import main
from lyapnet.evaluation import evaluate
from lyapnet.experiment.checkpoint import read_checkpoint
from tests.marks import at_the_gate, sample

FIXTURES = Path(__file__).parent / "fixtures" / "version_0.1"
EVALUATED = sorted(FIXTURES.rglob("evaluate_*.json"))
OPTIONS = {"sampled": ["--samples", "100"], "statistical": ["--samples", "200"], "sound": ["--alpha", "0.95"]}


def named(path):
    return str(path.relative_to(FIXTURES))


def approximately(expected, rel=1e-9):
    """The same JSON, but for rounding."""
    if isinstance(expected, dict):
        return {key: approximately(value, rel) for key, value in expected.items()}
    if isinstance(expected, list):
        return [approximately(value, rel) for value in expected]
    return pytest.approx(expected, rel=rel, abs=1e-12) if isinstance(expected, float) else expected


def known_then(evaluation):
    """An evaluation, or that of several seeds, without what later versions measure besides."""
    if isinstance(evaluation, list):
        return [known_then(each) for each in evaluation]
    if isinstance(evaluation, dict):
        return {key: known_then(value) for key, value in evaluation.items() if not key.startswith(LATER)}
    return evaluation


LATER = (
    "worst_corner",
    "worst_found",
    "worst_ratio",
    "lost_fraction",
    "falling_fraction",
    "program",
    "largest_rise",
    "held_cost",
    "lqr_cost",
    "optimum_of",
    "at_goal",
    "after_T",
)


@pytest.mark.parametrize("path", sample(EVALUATED, 3), ids=named)
def test_checkpoint_is_measured_as_by_version_0_1(path):
    expected = json.loads(path.read_text())
    name = path.stem.removeprefix("evaluate_")
    controller = lyapnet.load(path.parent / "checkpoints" / f"{name}.ckpt")
    assert known_then(evaluate(controller, expected["samples"], expected["seed"])) == approximately(expected)


@pytest.mark.parametrize("kind", ["sampled", "statistical", "sound"])
def test_checkpoint_is_certified_as_by_version_0_1(kind, capsys):
    folder = FIXTURES / "certified"
    expected = json.loads((folder / f"certify_{kind}.json").read_text())
    main(["certify", kind, str(folder / "checkpoints/best.ckpt"), *OPTIONS[kind], "--json", "--debug"])
    found = json.loads(capsys.readouterr().out)
    assert found.pop("seconds", 0) >= 0
    found.pop("fingerprint", None)  # of what was bounded: 0.1 did not name it
    for new in ("draws", "confidence_over_draws", "caveat", "disturbance"):  # what a claim may be chosen from, or stand
        found.pop(new, None)
    expected.pop("seconds", None)
    for each in (found, expected):
        each.pop("boxes", None)  # of a proof: another bound since, which divides the same set into more of them
    assert found == approximately(expected, 1e-9 if kind != "sound" else 1e-6)


def resumed(name, tmp_path, monkeypatch, *overrides):
    """A copy of a stopped run, resumed to its end."""
    monkeypatch.chdir(tmp_path)
    experiment = {"lyapunov_stopped": "small", "ensemble_stopped": "ensemble"}[name]
    copy = tmp_path / "logs" / experiment / "version_0"
    shutil.copytree(FIXTURES / name, copy)
    quiet = Console(file=io.StringIO())
    run = lyapnet.train(copy / "config.yaml", ["loggers=[csv]", *overrides], resume="last", console=quiet)
    assert run.folder.resolve() == copy
    return run


def weights(path):
    return read_checkpoint(path)["state_dict"]


def distance(new, old):
    """The largest relative difference between weights; version 0.1 kept each of them under two names."""
    assert old.keys() - new.keys() == {key for key in old if ".policy.V." in key}
    return max(float((new[key] - old[key]).norm() / old[key].norm()) for key in new)


@pytest.mark.parametrize(("name", "members"), [("lyapunov", ["."]), at_the_gate(("ensemble", ["seed_0", "seed_1"]))])
def test_stopped_run_goes_on_to_the_end_that_it_had_under_version_0_1(name, members, tmp_path, monkeypatch):
    run, end = resumed(f"{name}_stopped", tmp_path, monkeypatch), FIXTURES / f"{name}_finished"
    assert distance(weights(run.last), weights(end / "checkpoints/last.ckpt")) < 1e-9
    assert known_then(run.evaluation) == approximately(json.loads((end / "evaluation.json").read_text()))
    curves = json.loads((FIXTURES / "curves.json").read_text())
    for member in members:
        expected = curves[f"{name}_finished" + ("" if member == "." else f"/{member}")]
        with (run.folder / member / "metrics.csv").open() as file:
            rows = {int(row["step"]): row for row in csv.DictReader(file)}
        for tag, curve in expected.items():
            known = {step: value for step, value in curve if step in rows}
            assert known
            assert {step: float(rows[step][tag]) for step in known} == pytest.approx(known, rel=1e-9)


@pytest.mark.gate
def test_another_end_is_found(tmp_path, monkeypatch):
    """The twin: one step less is not the same end."""
    run = resumed("lyapunov_stopped", tmp_path, monkeypatch, "training.iterations=31")
    last = torch.load(run.last, weights_only=True)["state_dict"]
    assert distance(last, weights(FIXTURES / "lyapunov_finished/checkpoints/last.ckpt")) > 1e-4

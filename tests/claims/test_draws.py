"""Draws of one checkpoint: each is recorded, and a claim counts all of them."""

import json
import shutil
from pathlib import Path

import pytest

from lyapnet.claims.draws import DRAWS, draws_of
from lyapnet.cli import main

FIXTURE = Path("tests/fixtures/version_0.1/certified")


@pytest.fixture
def run(tmp_path):
    shutil.copytree(FIXTURE / "checkpoints", tmp_path / "run/checkpoints")
    (tmp_path / "run/run.json").write_text("{}")
    return tmp_path / "run"


def certified(run, capsys, *options, kind="statistical"):
    capsys.readouterr()
    few = ("--samples", "20") if "--samples" not in options else ()
    assert main(["certify", kind, str(run / "checkpoints/best.ckpt"), *few, *options, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.gate
def test_each_further_seed_counts_and_the_same_one_does_not(run, capsys):
    first = certified(run, capsys, "--confidence", "0.99")
    assert (first["draws"], first["confidence_over_draws"]) == (1, pytest.approx(0.99))
    second = certified(run, capsys, "--confidence", "0.99", "--seed", "1")
    assert (second["draws"], second["confidence_over_draws"]) == (2, pytest.approx(0.98))
    assert certified(run, capsys, "--confidence", "0.99", "--seed", "1") == second
    assert certified(run, capsys, "--confidence", "0.99")["draws"] == 2
    assert certified(run, capsys, "--samples", "30")["draws"] == 3, (
        "repeating the draw until it succeeds is a choice too"
    )
    lines = [json.loads(line) for line in (run / DRAWS).read_text().splitlines()]
    assert [(line["kind"], line["seed"], line["samples"]) for line in lines] == [
        ("statistical", 0, 20), ("statistical", 1, 20), ("statistical", 0, 30)
    ]  # fmt: skip
    assert all(line["verdict"] for line in lines)


def test_a_look_by_a_sampled_claim_counts_for_other_seeds_only(run, capsys):
    certified(run, capsys, "--seed", "3", kind="sampled")
    assert certified(run, capsys, "--seed", "3")["draws"] == 1
    assert certified(run, capsys, "--seed", "4")["draws"] == 3


def test_other_checkpoints_and_other_claims_are_no_draws_of_this_one(run, capsys):
    """The counterpart: other draws are not counted."""
    certified(run, capsys, "--seed", "1")
    assert certified(run, capsys, "--seed", "2", "--radius", "5")["draws"] == 1
    changed = run / "checkpoints/other.ckpt"
    changed.write_bytes((run / "checkpoints/best.ckpt").read_bytes() + b" ")
    assert draws_of(changed, radius=None).others(2, 20) == 0


def test_the_verdict_is_held_to_the_confidence_over_all_draws(run, capsys):
    options = ("--confidence", "0.9", "--share", "0.85", "--samples", "20")  # 0.1 ** (1 / 20) = 0.891
    assert certified(run, capsys, *options)["verdict"] == "certified"
    for seed in range(1, 4):
        certified(run, capsys, "--seed", str(seed))
    about = draws_of(run / "checkpoints/best.ckpt", system=None, network=None, cost=None, controls=None, program=None,
                     radius=None)  # fmt: skip
    assert about.others(0, 20) == 3
    result = certified(run, capsys, *options)
    assert result["draws"] == 4
    assert result["verdict"] == "unknown", "0.025 ** (1 / 20) = 0.832"


def test_a_line_that_cannot_be_read_counts(run, capsys):
    (run / DRAWS).write_text('{"checkpoint": \n[]\n')
    assert certified(run, capsys)["draws"] == 3


def test_what_cannot_be_recorded_is_said(run, tmp_path, capsys):
    assert "caveat" not in certified(run, capsys)
    (run / DRAWS).unlink()
    (run / DRAWS).mkdir()  # which no one can append to, root included
    assert "not recorded" in certified(run, capsys)["caveat"]
    (run / "run.json").unlink()
    assert "outside a run's folder" in certified(run, capsys)["caveat"]


def test_table_and_report_say_it(run, tmp_path, capsys):
    certified(run, capsys, "--seed", "1")
    report = tmp_path / "report"
    assert main(["certify", str(run / "checkpoints/best.ckpt"), "--samples", "20", "--report", str(report)]) == 0
    assert "draws of this checkpoint" in capsys.readouterr().out
    text = (report / "report.md").read_text()
    assert "With confidence 1 − 2e-06" in text
    assert "chosen among 2 draws of this checkpoint" in text

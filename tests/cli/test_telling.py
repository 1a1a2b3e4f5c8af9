"""What commands say on stderr while one waits, which leaves their results as they are."""

import contextlib
import io
import json
import os
import pty
import subprocess
import sys
import time

import pytest

from lyapnet.claims.certify import certify
from lyapnet.claims.kinds import Funnel
from lyapnet.claims.tables import progress_reporter
from lyapnet.cli import main
from lyapnet.cli.options import make_stages
from lyapnet.controller.loading import load
from lyapnet.training.plan import plan_run
from tests.runs import tiny_checkpoint


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    return str(tiny_checkpoint(tmp_path_factory.mktemp("logs")))


@pytest.fixture
def telling(monkeypatch):
    """Commands that say after a tenth of a second what they are doing."""
    monkeypatch.setattr("lyapnet.cli.options.FIRST", 0.1)


def loading_for(monkeypatch, seconds):
    def slowly(*arguments, **options):
        time.sleep(seconds)
        return load(*arguments, **options)

    monkeypatch.setattr("lyapnet.controller.loading.load", slowly)


@pytest.mark.gate
def test_a_command_that_loads_slowly_says_so_and_its_result_stays(checkpoint, monkeypatch, capsys, telling):
    arguments = ["certify", "sampled", checkpoint, "--samples", "10", "--json"]
    loading_for(monkeypatch, 1.0)
    assert main(arguments) == 0
    slow = capsys.readouterr()
    assert slow.err.startswith(f"sampled: loading {checkpoint}")
    monkeypatch.setattr("lyapnet.cli.options.FIRST", 60.0)
    loading_for(monkeypatch, 0.0)
    assert main(arguments) == 0
    quick = capsys.readouterr()
    assert not quick.err
    assert json.loads(quick.out) == json.loads(slow.out)


def test_it_is_said_while_an_oracle_hides_what_others_say(capsys, telling):
    with make_stages("evaluate") as report, contextlib.redirect_stderr(io.StringIO()) as hidden:
        report("optima of states", 3, 64)
        time.sleep(1.0)
    assert capsys.readouterr().err.startswith("evaluate: optima of states, 3 of 64")
    assert not hidden.getvalue()


@pytest.mark.gate
def test_training_says_what_it_waits_for(tmp_path, monkeypatch, capsys, telling):
    def slowly(*arguments):
        time.sleep(1.0)
        return plan_run(*arguments)

    monkeypatch.setattr("lyapnet.training.plan.plan_run", slowly)
    tiny_checkpoint(tmp_path)
    assert capsys.readouterr().err.startswith("train: ")


@pytest.mark.gate
def test_a_certificate_tells_its_stages_before_its_boxes(checkpoint, few_seconds_for_levels):
    told, seen = [], []
    report = progress_reporter(lambda stage, detail: seen.append((stage, detail)), "sound")

    def both(progress):
        told.append(progress)
        report(progress)

    certify(checkpoint, Funnel(delta=0.5), budget=2, report=both)
    boxes = [progress.boxes > 0 for progress in told]
    assert not boxes[0]
    assert not boxes[-1]
    assert len({progress.stage for progress in told if not progress.boxes}) == 6
    assert all(bool(detail) is counted for (_, detail), counted in zip(seen, boxes, strict=True))
    assert all(detail.endswith("of [0, T] × D undecided") for _, detail in seen if detail)


def first_line(arguments, terminal):
    """(seconds, text) of the first that a command says, with a terminal or without."""
    ours, theirs = pty.openpty() if terminal else os.pipe()
    began = time.monotonic()
    command = [sys.executable, "-m", "lyapnet", *arguments]
    process = subprocess.Popen(command, stdout=theirs, stderr=theirs, stdin=subprocess.DEVNULL)
    os.close(theirs)
    text = os.read(ours, 4096).decode()
    seconds = time.monotonic() - began
    process.kill()
    process.wait()
    os.close(ours)
    return seconds, text


@pytest.mark.parametrize("terminal", [True, False])
def test_the_first_line_comes_before_torch(checkpoint, terminal):
    seconds, text = first_line(["certify", "sound", checkpoint], terminal)
    assert seconds < 10  # two at most, but where others share the machine
    if not terminal:
        assert "sound: importing torch" in text

"""What is said while one waits."""

import io
import time

import pytest
from rich.console import Console

from lyapnet.training.stage_messages import StageMessages, StageReport, silent


@pytest.fixture
def log():
    return io.StringIO()


def wait_for(log, lines):
    until = time.monotonic() + 10
    while log.getvalue().count("\n") < lines and time.monotonic() < until:
        time.sleep(0.01)
    return log.getvalue().splitlines()


def test_a_log_has_a_line_for_each_stage_and_never_is_silent_for_long(monkeypatch, log):
    monkeypatch.setattr("lyapnet.training.stage_messages.LOG_INTERVAL", 0.02)
    with StageMessages(Console(file=log, width=20), "start") as report:
        report("optima from 96 states of X₀")
        report("fitting", 0, 2000)
        report("fitting", 7, 2000)
        first, second, *others = wait_for(log, 4)
    assert first == "start: optima from 96 states of X₀ …"
    assert second == "start: fitting, 0 of 2000 …"
    assert others[-1] == "start: fitting, 7 of 2000 …"
    assert isinstance(report, StageReport)


@pytest.mark.gate
def test_a_stage_that_takes_long_has_a_line_and_a_quick_one_has_none(log):
    with StageMessages(Console(file=log), "sound", patience=0.6, first=0.3) as report:
        report("importing torch")
        report("the largest V on X₀")
        wait_for(log, 1)
        report("quick")
        report("bounding boxes", detail="12 boxes")
        lines = wait_for(log, 2)
    assert lines == ["sound: the largest V on X₀ …", "sound: bounding boxes, 12 boxes …"]


def test_what_is_quickly_done_says_nothing(log):
    with StageMessages(Console(file=log), "sound", patience=4.0, first=1.0) as report:
        report("importing torch")
        report("bounding boxes")
    assert not log.getvalue()


def test_nothing_is_said_at_rest(monkeypatch, log):
    monkeypatch.setattr("lyapnet.training.stage_messages.LOG_INTERVAL", 0.02)
    with StageMessages(Console(file=log), "sound", patience=0.02) as report:
        report("bounding boxes")
        wait_for(log, 1)
        report.rest()
        said = log.getvalue()
        time.sleep(0.6)
        assert log.getvalue() == said
        report("drawing")
        assert wait_for(log, said.count("\n") + 1)[-1] == "sound: drawing …"


def test_a_terminal_has_one_line_that_changes():
    screen = io.StringIO()
    with StageMessages(Console(file=screen, force_terminal=True, width=60), "check") as report:
        report("optima from 96 states of X₀, which is longer than the screen is wide", 3, 96)
        assert report.now.endswith("wide, 3 of 96 …")
        report.rest()
        report("fitting")
    assert screen.getvalue().rstrip("\n").count("\n") <= 2
    silent("nothing", 1, 2)

"""What is said while one waits."""

import io
import time

from rich.console import Console

from lyapnet.training.stages import Report, Stages, silent


def test_a_log_has_a_line_for_each_stage_and_never_is_silent_for_long(monkeypatch):
    monkeypatch.setattr("lyapnet.training.stages.QUIET", 0.02)
    log = io.StringIO()
    with Stages(Console(file=log, width=20), "start") as report:
        report("optima from 96 states of X₀")
        report("fitting", 0, 2000)
        report("fitting", 7, 2000)
        until = time.monotonic() + 10
        while log.getvalue().count("\n") < 4 and time.monotonic() < until:
            time.sleep(0.01)
    first, second, *others = log.getvalue().splitlines()
    assert first == "start: optima from 96 states of X₀ …"
    assert second == "start: fitting, 0 of 2000 …"
    assert others[-1] == "start: fitting, 7 of 2000 …"
    assert isinstance(report, Report)


def test_a_terminal_has_one_line_that_changes():
    screen = io.StringIO()
    with Stages(Console(file=screen, force_terminal=True, width=60), "check") as report:
        report("optima from 96 states of X₀, which is longer than the screen is wide", 3, 96)
        assert report.now.endswith("wide, 3 of 96 …")
    assert screen.getvalue().rstrip("\n").count("\n") <= 1
    silent("nothing", 1, 2)

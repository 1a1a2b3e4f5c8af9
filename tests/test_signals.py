"""Ctrl-C and SIGTERM: what is in progress ends within seconds, and says what is kept."""

import os
import signal
import threading
import time

import pytest
import torch

from lyapnet.base.errors import Interrupted, signals_taken
from lyapnet.claims import funnel
from lyapnet.cli import main
from lyapnet.prover.branch_and_bound import Budget
from tests.problems import untrained

CERTIFIED = "tests/fixtures/version_0.1/certified/checkpoints/best.ckpt"


def told_after(seconds, number):
    threading.Timer(seconds, os.kill, (os.getpid(), number)).start()


@pytest.mark.gate
@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.gate)])
def test_a_certificate_stops_with_its_proof_kept(number, tmp_path, few_seconds_for_levels):
    kept, reports = tmp_path / "proof", []

    def progress(state):
        if state.boxes:  # the search has begun
            reports.append(time.monotonic())
            if len(reports) == 1:
                os.kill(os.getpid(), number)

    controller = untrained("double_integrator", "network.hidden=[8]")
    with pytest.raises(Interrupted, match=f"the proof so far is kept in {kept}") as stop:
        funnel.prove_funnel(controller.closed_loop, controller.problem, budget=Budget(60), report=progress, keep=kept)
    assert stop.value.exit_status == 130
    assert time.monotonic() - reports[0] < 2
    assert kept.stat().st_size > 0


def test_what_waits_in_a_command_stops_at_once(monkeypatch, capsys):
    monkeypatch.setattr("lyapnet.cli.options.read_checkpoint", lambda *_: time.sleep(60), raising=False)
    monkeypatch.setattr("lyapnet.controller.loading.read_checkpoint", lambda *_: time.sleep(60))
    before = signal.getsignal(signal.SIGTERM)
    told_after(0.5, signal.SIGTERM)
    started = time.monotonic()
    assert main(["evaluate", CERTIFIED]) == 130
    assert time.monotonic() - started < 5
    assert capsys.readouterr().err == "SIGTERM: stopped at once.\n"
    assert signal.getsignal(signal.SIGTERM) is before


def test_an_oracle_stops_although_casadi_keeps_signals_to_itself(capfd):
    pytest.importorskip("casadi")
    from lyapnet.evaluation.oracles.transcription import Transcription

    controller = untrained("cartpole_balancing", "horizon.steps=10")
    oracle = Transcription(controller.problem)
    x0 = controller.initial_states.sample(300)
    for seconds in (0.3, 0.301, 0.302, 0.303, 0.304):  # wherever it is then: inside CasADi, or between
        done = []

        def progress(count, _, seconds=seconds, done=done):
            done.append(count)
            if not count:
                told_after(seconds, signal.SIGINT)

        with pytest.raises(Interrupted, match="Stopped while seeking optima"):
            oracle.solve(x0, progress=progress)
        assert 0 < len(done) < len(x0)
    assert "CasADi" not in capfd.readouterr().err


def test_without_a_signal_nothing_stops():
    """A twin."""
    with signals_taken(lambda *_: pytest.fail("Expected no signal.")):
        assert float(torch.ones(())) == 1


@pytest.mark.nightly  # by the clock: on a machine that has nothing else to do
@pytest.mark.parametrize("seconds", [12.0])
def test_seconds_hold_for_all_of_a_certificate(seconds):
    """For a condition that no budget decides."""
    controller = untrained("cartpole_balancing")
    started = time.monotonic()
    claim = funnel.prove_funnel(controller.closed_loop, controller.problem, budget=Budget(seconds))
    assert time.monotonic() - started < 1.1 * seconds + 1
    assert claim.verdict != "certified"

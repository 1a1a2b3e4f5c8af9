"""When a training compiles its closed loop, and what it says and records of it."""

import json
import os
import time
from pathlib import Path
from typing import ClassVar

import pytest
import torch

from lyapnet.build import Parts
from lyapnet.calculus import ValueFunction
from lyapnet.cli import main
from lyapnet.config import load_config
from lyapnet.errors import CompilationError
from lyapnet.graphs import compilation
from lyapnet.networks import FCN, NETWORKS
from lyapnet.training import start
from lyapnet.training.build import build_module
from lyapnet.training.compilation import earns_compilation
from lyapnet.training.compiling_ahead import CompilingAhead
from lyapnet.training.start import choose_start

CONFIG = Path(__file__).parents[2] / "conf" / "from_scratch" / "double_integrator.yaml"
SMALL = ["network.hidden=[4,4]", "horizon.steps=6", "training.batch_size=3", "training.iterations=1"]
SHORT = [*SMALL, "evaluation.validation_states=2", "evaluation.test_states=2"]
LONG = "training.iterations=10000000"


@pytest.fixture(autouse=True)
def _cache(tmp_path, monkeypatch):
    """A cache of its own, empty; and no figures, whose drawing takes most of the time of a short run."""
    monkeypatch.setenv("LYAPNET_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("lyapnet.training.figure_logger.figures_of", lambda learner: {})


def test_without_a_compiler_a_run_says_so_and_goes_on(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(compilation, "has_compiler", lambda: False)
    arguments = ["train", "--config", str(CONFIG), *SHORT, f"logs={tmp_path}", "rollout.compile=on"]
    assert main(arguments) == 0
    notice = "Expected a C++ compiler ($CXX, g++ or clang++), got none; running without compilation."
    assert capsys.readouterr().out.splitlines().count(notice) == 1


@pytest.fixture
def machine_code(monkeypatch):
    """Compilation that succeeds at once, or fails as it is told to; what was asked for."""

    class Asked(list):
        failure = None

    asked = Asked()

    def compile(self, x0, theta=None):
        asked.append(tuple(x0.shape))
        if asked.failure:
            raise CompilationError(asked.failure)

    monkeypatch.setattr("lyapnet.rollout.discrete_adjoint.DiscreteAdjoint.compile", compile)
    return asked


def train(tmp_path, capsys, *overrides, resume=()):
    """One iteration of a short run: the run's record, and what was printed about compiling."""
    arguments = ["train", "--config", str(CONFIG), *SHORT, f"logs={tmp_path}", *overrides, *resume]
    assert main(arguments) == 0, capsys.readouterr().err
    shown = [line for line in capsys.readouterr().out.splitlines() if str(tmp_path) not in line]
    lines = [line for line in shown if "compilation" in line or "machine code" in line]
    (record,) = tmp_path.glob("double_integrator_from_scratch/*/run.json")
    return json.loads(record.read_text())["compiled"], lines


@pytest.mark.parametrize(
    ("overrides", "compiled"),
    [
        ([], False),
        (["rollout.compile=on"], True),
        (["long", "rollout.compile=auto"], True),
        (["long", "rollout.compile=off"], False),
        (["long", "rollout.gradient=backprop"], False),
    ],
)
def test_auto_compiles_where_a_run_is_long(tmp_path, overrides, compiled, machine_code, capsys, monkeypatch):
    monkeypatch.setattr("lyapnet.training.trainer.earns_compilation", lambda config: "long" in overrides)
    assert train(tmp_path, capsys, *(override for override in overrides if override != "long"))[0] is compiled
    assert machine_code == ([(3, 2)] if compiled else [])


@pytest.mark.parametrize(("overrides", "long"), [([], False), ([LONG], True)])
def test_a_run_is_long_where_it_saves_more_than_compiling_takes(overrides, long):
    assert earns_compilation(load_config(CONFIG, [*SMALL, *overrides])) is long


@pytest.mark.parametrize("compiled", [True, False])
def test_resumed_runs_go_on_as_they_were(tmp_path, compiled, machine_code, capsys, monkeypatch):
    """Machine code rounds differently."""
    monkeypatch.setattr("lyapnet.training.trainer.earns_compilation", lambda config: compiled)
    train(tmp_path, capsys)
    machine_code.clear()
    monkeypatch.setattr("lyapnet.training.trainer.earns_compilation", lambda config: not compiled)
    record, _ = train(tmp_path, capsys, "training.iterations=2", resume=("--resume", "last"))
    assert record is compiled
    assert bool(machine_code) is compiled


def test_a_compilation_that_fails_is_not_on_record(tmp_path, machine_code, capsys):
    machine_code.failure = "Expected luck, got none"
    compiled, lines = train(tmp_path, capsys, "rollout.compile=on")
    assert compiled is False
    assert lines[-1] == "Expected luck, got none; running without compilation."


@pytest.mark.parametrize("gradient", ["adjoint", "backprop"])
def test_compiling_what_does_not_compile_is_refused(gradient, tmp_path, capsys):
    arguments = ["train", "--config", str(CONFIG), f"logs={tmp_path}", f"rollout.gradient={gradient}"]
    assert main([*arguments, "rollout.compile=on"]) == 2
    assert f"rollout.gradient=discrete for rollout.compile=on, got {gradient}" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


class Branching(FCN):
    """A network whose control flow depends on tensor values."""

    def forward(self, t, x):
        return super().forward(t, x) if x.sum() < 1e9 else x.sum(-1)

    value_and_state_gradient = ValueFunction.value_and_state_gradient


def test_what_cannot_be_traced_says_so_once(tmp_path, monkeypatch, capsys, caplog):
    monkeypatch.setitem(NETWORKS, "fcn", Branching)
    assert train(tmp_path, capsys, "network.name=fcn", "rollout.compile=on") == (False, [])
    (record,) = (record for record in caplog.records if record.name.startswith("lyapnet"))
    assert "runs as it is written" in record.getMessage()


class Noting:
    """A module whose compilation leaves a note, and may fail or take long."""

    def __init__(self, path, known=False, fails=False, seconds=0):
        self.path, self.known, self.fails, self.seconds = path, known, fails, seconds

    def compiled_before(self, batch_size):
        return self.known

    def compile_for(self, batch_size):
        time.sleep(self.seconds)
        if self.fails:
            raise CompilationError("Expected luck, got none")
        self.path.write_text(f"{batch_size} {torch.get_num_threads()} {os.getpid()}")


@pytest.fixture
def cores(monkeypatch):
    monkeypatch.setattr("lyapnet.training.compiling_ahead.usable_cores", lambda: 2)


def test_compiling_ahead_happens_in_another_process(tmp_path, cores):
    ahead = CompilingAhead(Noting(tmp_path / "note"), 7)
    ahead.wait()
    batch_size, threads, process = (tmp_path / "note").read_text().split()
    assert (batch_size, threads) == ("7", str(torch.get_num_threads()))
    assert int(process) != os.getpid()
    ahead.stop()


@pytest.mark.slow
def test_compiling_ahead_may_fail_or_be_needless(tmp_path, cores, capfd):
    for note in (Noting(tmp_path / "note", fails=True), Noting(tmp_path / "note", known=True)):
        CompilingAhead(note, 7).wait()
        assert not (tmp_path / "note").exists()
    assert capfd.readouterr() == ("", ""), "the run compiles it itself, and says what is wrong"


def test_what_no_other_process_can_have_is_not_compiled_ahead(cores):
    assert CompilingAhead(Noting(lambda: None), 7)._process is None


def test_compiling_ahead_ends_with_what_it_is_beside(tmp_path, cores):
    ahead = CompilingAhead(Noting(tmp_path / "note", seconds=600), 7)
    ahead.stop()
    ahead.wait()
    assert not (tmp_path / "note").exists()


def test_without_a_core_for_it_nothing_is_compiled_ahead(tmp_path, monkeypatch):
    monkeypatch.setattr("lyapnet.training.compiling_ahead.usable_cores", torch.get_num_threads)
    assert CompilingAhead(Noting(tmp_path / "note"), 7)._process is None


class Recorded:
    """In the place of CompilingAhead: what became of it."""

    events: ClassVar[list] = []

    def __init__(self, module, batch_size):
        self.events.append(batch_size)

    def wait(self):
        self.events.append("waited")

    def stop(self):
        self.events.append("stopped")


@pytest.mark.parametrize(
    ("overrides", "events"),
    [
        (["network={name: expansion, hidden: [4]}"], [3, "waited", "stopped"]),
        (["network={name: expansion, hidden: [4]}", "rollout.compile=off"], []),
        ([], []),  # no start to seek meanwhile
    ],
)
def test_a_run_compiles_beside_its_start(overrides, events, tmp_path, machine_code, capsys, monkeypatch):
    monkeypatch.setattr(Recorded, "events", [])
    monkeypatch.setattr("lyapnet.training.compilation.CompilingAhead", Recorded)
    monkeypatch.setattr(start, "OPTIMA", 4)
    train(tmp_path, capsys, "rollout.compile=on", *overrides)
    assert Recorded.events == events


@pytest.mark.slow
def test_what_is_compiled_ahead_is_what_the_run_takes(tmp_path, cores):
    """Another process traces the same function, whatever the start puts into its buffers meanwhile."""
    module = build_module(load_config(CONFIG, [*SMALL, "network={name: expansion, hidden: [4]}"]), Parts())
    ahead = CompilingAhead(module, 3)
    choose_start(list(module.members))
    assert not module.compiled_before(3) or ahead._process is None
    ahead.wait()
    assert module.compiled_before(3)

"""When a training compiles its closed loop, and what it says and records of it."""

import json
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import torch
from lightning.pytorch import LightningModule, Trainer
from rich.console import Console

from lyapnet.base.errors import CompilationError
from lyapnet.cli import main
from lyapnet.graphs import compilation
from lyapnet.graphs.number_kernel import assembly
from lyapnet.training.compilation import Compilation
from lyapnet.training.stage_messages import PATIENCE, StageMessages
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.networks import FCN, NETWORKS
from tests.marks import sample

CONFIG = Path(__file__).parents[2] / "conf" / "from_scratch" / "double_integrator.yaml"
SMALL = ["network.hidden=[4,4]", "horizon.steps=6", "training.batch_size=3", "training.iterations=1"]
SHORT = [*SMALL, "evaluation.validation_states=2", "evaluation.test_states=2"]
LONG = "training.iterations=10000000"


@pytest.fixture(autouse=True)
def _cache(tmp_path, monkeypatch):
    """A cache of its own, empty; and no figures, whose drawing takes most of the time of a short run."""
    monkeypatch.setenv("LYAPNET_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("lyapnet.training.figure_logger.figures_of", lambda learner: {})


@pytest.mark.gate
def test_without_a_compiler_a_run_says_so_and_goes_on(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(compilation, "has_compiler", lambda: False)
    assembly.library.cache_clear()
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

    def compile(self, x0):
        asked.append(tuple(x0.shape))
        if asked.failure:
            raise CompilationError(asked.failure)

    monkeypatch.setattr("lyapnet.loop.rollout.discrete_adjoint.DiscreteAdjoint.compile", compile)
    return asked


def train(tmp_path, capsys, *overrides, resume=()):
    """One iteration of a short run: the run's record, and what was printed about compiling."""
    arguments = ["train", "--config", str(CONFIG), *SHORT, f"logs={tmp_path}", *overrides, *resume]
    assert main(arguments) == 0, capsys.readouterr().err
    shown = [line for line in capsys.readouterr().out.splitlines() if str(tmp_path) not in line]
    lines = [line for line in shown if "compilation" in line or "machine code" in line]
    (record,) = tmp_path.glob("double_integrator_from_scratch/*/run.json")
    return json.loads(record.read_text())["compiled"], lines


@pytest.mark.gate
@pytest.mark.parametrize(
    ("overrides", "compiled"),
    sample(
        [
            ([], True),
            (["rollout.compile=on"], True),
            (["rollout.compile=off"], False),
            (["rollout.gradient=backprop"], False),
        ],
        4,
    ),
)
def test_a_run_compiles_where_it_may(tmp_path, overrides, compiled, machine_code, capsys):
    assert train(tmp_path, capsys, *overrides)[0] is compiled
    assert machine_code == ([(3, 2)] if compiled else [])


@pytest.mark.gate
@pytest.mark.parametrize("compiled", [True, False])
def test_resumed_runs_go_on_as_they_were(tmp_path, compiled, machine_code, capsys):
    """Machine code rounds differently."""
    machine_code.failure = "" if compiled else "Expected luck, got none"
    train(tmp_path, capsys)
    machine_code.clear()
    machine_code.failure = ""
    record, _ = train(tmp_path, capsys, "training.iterations=2", resume=("--resume", "last"))
    assert record is compiled
    assert bool(machine_code) is compiled


@pytest.mark.gate
def test_a_compilation_that_fails_is_not_on_record(tmp_path, machine_code, capsys):
    machine_code.failure = "Expected luck, got none"
    compiled, lines = train(tmp_path, capsys, "rollout.compile=on")
    assert compiled is False
    assert lines[-1] == "Expected luck, got none; running without compilation."


@pytest.mark.parametrize(
    ("trained_on", "devices", "seen_before_training"), [("cpu", ["cpu"], 1), ("cuda", ["cpu", "cuda"], 0)]
)
def test_the_start_is_compiled_for_on_the_cpu_wherever_the_training_runs(trained_on, devices, seen_before_training):
    compiled, records, stages, device = [], [], [], torch.device(trained_on)
    module = Mock(spec=LightningModule, device=torch.device("cpu"))
    module.compile_for = lambda size: compiled.append(module.device.type)
    trainer = Mock(spec=Trainer, strategy=SimpleNamespace(root_device=device), is_global_zero=True)
    callback = Compilation(StageMessages(Console(), "training", PATIENCE), 3, lambda **facts: records.append(facts))
    callback.before_start(trainer, module, stages.append)
    assert stages[0].startswith("tracing the closed loop")
    assert len(records) == seen_before_training
    module.device = device
    callback.on_train_start(trainer, module)
    assert compiled == devices
    assert [record["compiled"] for record in records] == [True]


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


@pytest.mark.gate
def test_what_cannot_be_traced_says_so_once(tmp_path, monkeypatch, capsys, caplog):
    monkeypatch.setitem(NETWORKS, "fcn", Branching)
    assert train(tmp_path, capsys, "network.name=fcn", "rollout.compile=on") == (False, [])
    (record,) = (record for record in caplog.records if record.name.startswith("lyapnet"))
    assert "runs without being traced" in record.getMessage()

"""Machine code: the same numbers, once per machine; without a compiler, a line and no code."""

import copy
import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from lyapnet import compilation
from lyapnet.build import build_program, build_rollout, build_task, build_value_function
from lyapnet.cli import main
from lyapnet.config import load_config
from lyapnet.errors import CompilationError, UntraceableError
from lyapnet.experiment import _earns_compilation
from lyapnet.networks import FCN, NETWORKS

CONFIG = Path(__file__).parents[1] / "conf" / "double_integrator.yaml"
SMALL = ["network.hidden=[4,4]", "horizon.steps=6", "training.batch_size=3", "training.iterations=1"]
SHORT = [*SMALL, "evaluation.validation_states=2", "evaluation.test_states=2"]


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """A cache of its own, empty."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("LYAPNET_CACHE", str(folder))
    return folder


@pytest.fixture
def no_compiler(monkeypatch):
    monkeypatch.setattr(compilation, "has_compiler", lambda: False)


def rollout_of(*overrides):
    config = load_config(CONFIG, [*SMALL, *overrides])
    task = build_task(config)
    return build_rollout(config, task, build_value_function(config, task)), build_program(config), task.initial_states


def gradient(rollout, program, x0):
    loss = program(rollout(x0)).loss
    return torch.cat([g.flatten() for g in torch.autograd.grad(loss, rollout.discrete.trained())])


@pytest.mark.skipif(not compilation.has_compiler(), reason="needs a C++ compiler")
def test_machine_code_computes_the_same_and_is_kept(cache):
    """In a process of its own: the shape checks of the tests are not for a compiler."""
    found = json.loads(subprocess.run([sys.executable, __file__], capture_output=True, text=True, check=True).stdout)
    assert found["before"] is False
    assert found["after"] is True
    assert len(list(cache.iterdir())) == 3  # nothing is left of the compilation but its results
    assert found["gradient_error"] < 1e-10
    assert found["error_in_slices"] < 1e-10
    assert found["error_from_a_transposed_batch"] < 1e-10
    assert found["error_after_the_weights_were_frozen"] < 1e-10
    assert found["difference_after_a_change_of_weights"] > 1e-3
    assert found["error_without_a_compiler"] < 1e-10
    assert found["on_disk"] == {
        "system.parameters.mass=2": True,  # a buffer, and so an argument of the code
        "rollout.method=midpoint": False,
        "training.batch_size=4": False,
        "seed=1": True,
    }


def measure_machine_code():
    """What the test above needs to know, of a cache that is empty."""
    rollout, program, X0 = rollout_of()
    replayed = copy.deepcopy(rollout)
    x0, others = (X0.sample(b, torch.Generator().manual_seed(b)) for b in (3, 7))
    found: dict = {"before": rollout.discrete.is_on_disk(x0)}
    rollout.discrete.compile(x0)
    found["after"] = rollout.discrete.is_on_disk(x0)
    exact = gradient(replayed, program, x0)
    found["gradient_error"] = float((gradient(rollout, program, x0) - exact).norm() / exact.norm())
    with torch.no_grad():
        found["error_in_slices"] = float((rollout(others).x - replayed(others).x).abs().max())
        rollout.closed_loop.policy.V.network.weights.weight.mul_(1.5)  # parameters are arguments of the code
        found["difference_after_a_change_of_weights"] = float((rollout(x0).value - replayed(x0).value).abs().max())
    transposed = x0.mT.contiguous().mT  # its rows do not lie one after the other in memory
    difference = gradient(rollout, program, transposed) - gradient(rollout, program, x0)
    found["error_from_a_transposed_batch"] = float(difference.norm() / exact.norm())
    compilation.has_compiler = lambda: False  # what is on disk needs none
    again, *_ = rollout_of()
    again.discrete.compile(x0)
    found["error_without_a_compiler"] = float((again(x0).x - replayed(x0).x).abs().max())
    for p in again.parameters():
        p.requires_grad_(False)
    found["error_after_the_weights_were_frozen"] = float((again(x0).x - rollout_of()[0](x0).x).abs().max())
    found["on_disk"] = {
        change: rollout_of(change)[0].discrete.is_on_disk(torch.zeros(4 if "batch" in change else 3, 2).double())
        for change in ("system.parameters.mass=2", "rollout.method=midpoint", "training.batch_size=4", "seed=1")
    }
    print(json.dumps(found))


def test_without_a_compiler_a_run_says_so_and_goes_on(tmp_path, no_compiler, capsys):
    arguments = ["train", "--config", str(CONFIG), *SHORT, f"logs={tmp_path}", "rollout.compile=on"]
    assert main(arguments) == 0
    notice = "Expected a C++ compiler ($CXX, g++ or clang++), got none; running without compilation."
    assert capsys.readouterr().out.splitlines().count(notice) == 1
    with pytest.raises(CompilationError, match="got none"):
        rollout_of()[0].discrete.compile(torch.zeros(3, 2))


def test_a_loop_that_cannot_be_traced_says_so(monkeypatch):
    rollout, _, _ = rollout_of()
    dynamics = rollout.closed_loop.system.dynamics
    monkeypatch.setattr(
        type(rollout.closed_loop.system),
        "dynamics",
        lambda self, x, u: dynamics(x, u) * (2 if float(x.sum()) > 9 else 1),
    )
    with pytest.raises(UntraceableError, match="Expected a closed loop that can be traced"):
        rollout.discrete.compile(torch.zeros(3, 2))


class Branching(FCN):
    """A network whose course depends on values."""

    def forward(self, t, x):
        return super().forward(t, x) if x.sum() < 1e9 else x.sum(-1)

    value_and_state_gradient = None


def test_what_cannot_be_traced_says_so_once(tmp_path, monkeypatch, capsys, caplog):
    monkeypatch.setitem(NETWORKS, "fcn", Branching)
    assert train(tmp_path, capsys, "network.name=fcn", "rollout.compile=on") == (False, [])
    (record,) = (record for record in caplog.records if record.name.startswith("lyapnet"))
    assert "runs as it is written" in record.getMessage()


LONG = "training.iterations=10000000"


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

    monkeypatch.setattr("lyapnet.discrete_adjoint.DiscreteAdjoint.compile", compile)
    return asked


def train(tmp_path, capsys, *overrides, resume=()):
    """One iteration of a short run: the run's record, and what was printed about compiling."""
    arguments = ["train", "--config", str(CONFIG), *SHORT, f"logs={tmp_path}", *overrides, *resume]
    assert main(arguments) == 0, capsys.readouterr().err
    shown = [line for line in capsys.readouterr().out.splitlines() if str(tmp_path) not in line]
    lines = [line for line in shown if "compilation" in line or "machine code" in line]
    (record,) = tmp_path.glob("double_integrator/*/run.json")
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
    monkeypatch.setattr("lyapnet.experiment._earns_compilation", lambda config: "long" in overrides)
    assert train(tmp_path, capsys, *(override for override in overrides if override != "long"))[0] is compiled
    assert machine_code == ([(3, 2)] if compiled else [])


@pytest.mark.parametrize(("overrides", "long"), [([], False), ([LONG], True)])
def test_a_run_is_long_where_it_saves_more_than_compiling_takes(overrides, long):
    assert _earns_compilation(load_config(CONFIG, [*SMALL, *overrides])) is long


@pytest.mark.parametrize("compiled", [True, False])
def test_resumed_runs_go_on_as_they_were(tmp_path, compiled, machine_code, capsys, monkeypatch):
    """Machine code rounds differently."""
    monkeypatch.setattr("lyapnet.experiment._earns_compilation", lambda config: compiled)
    train(tmp_path, capsys)
    machine_code.clear()
    monkeypatch.setattr("lyapnet.experiment._earns_compilation", lambda config: not compiled)
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


def test_a_file_of_machine_code_that_was_cut_short_is_replaced(cache, monkeypatch):
    """Without a compiler, it is missed instead."""
    rollout, _, _ = rollout_of()
    x0 = torch.zeros(3, 2)
    (module, arguments), *_ = rollout.discrete._work(x0, rollout.discrete.trained()).pieces()
    cache.mkdir()
    path = compilation._file(module, arguments)
    path.write_bytes(b"PK\x03\x04 cut short")
    assert rollout.discrete.is_on_disk(x0) is False, "two of three are missing"
    monkeypatch.setattr(compilation, "has_compiler", lambda: False)
    with pytest.raises(CompilationError, match=r"C\+\+ compiler"):
        compilation.compiled(module, arguments)
    assert not path.exists()


if __name__ == "__main__":
    measure_machine_code()

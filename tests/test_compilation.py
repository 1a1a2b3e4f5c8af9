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
from lyapnet.errors import CompilationError
from lyapnet.experiment import plan_run
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
    compilation.has_compiler = lambda: False  # what is on disk needs none
    again, *_ = rollout_of()
    again.discrete.compile(x0)
    found["error_without_a_compiler"] = float((again(x0).x - replayed(x0).x).abs().max())
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
    with pytest.raises(CompilationError, match="Expected a closed loop to compile"):
        rollout.discrete.compile(torch.zeros(3, 2))


class Branching(FCN):
    """A network whose course depends on values."""

    def forward(self, t, x):
        return super().forward(t, x) if x.sum() < 1e9 else x.sum(-1)

    value_and_state_gradient = None


def test_auto_leaves_what_cannot_be_traced_alone(tmp_path, monkeypatch):
    monkeypatch.setitem(NETWORKS, "fcn", Branching)
    assert plan_run(CONFIG, [*SMALL, f"logs={tmp_path}", "network.name=fcn"]).compile is False


@pytest.mark.parametrize(
    ("overrides", "compiled"),
    [
        (["training.iterations=1"], False),
        (["training.iterations=100000"], True),
        (["training.iterations=1", "rollout.compile=on"], True),
        (["training.iterations=100000", "rollout.compile=off"], False),
        (["training.iterations=100000", "rollout.gradient=backprop"], False),
    ],
)
def test_auto_compiles_where_a_run_is_long(tmp_path, overrides, compiled):
    plan = plan_run(CONFIG, [*SMALL[:-1], f"logs={tmp_path}", *overrides])
    assert plan.compile is compiled
    assert plan.run.compiled is compiled  # so that a resumed run rounds alike


if __name__ == "__main__":
    measure_machine_code()

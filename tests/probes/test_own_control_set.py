"""A control set from a user's module: trained by YAML and by Python, loaded, and kept to."""

import importlib
import json
import sys

import lightning
import numpy as np
import pytest
import torch
import yaml
from torch.testing import assert_close

import lyapnet
from lyapnet.base.errors import OracleError, UsageError
from lyapnet.cli import main
from lyapnet.evaluation.oracles import oracle_of
from lyapnet.experiment.checkpoint import KEY, read_checkpoint
from lyapnet.value.networks import FCN, Scaling
from lyapnet.value.policy import HJBPolicy
from tests.pages import ROOT, blocks

(EXAMPLE,) = [block for block in blocks("python", ROOT / "docs" / "own_system.md") if "class Limits(" in block]
MODULE = f"""{EXAMPLE}

class Tight(Limits):
    def __init__(self):
        super().__init__(0.05)
"""

YAML = """
experiment: limited
program: {name: value, constraint: 0, cost_to_go: 1, trajectory_cost: 1}
system: {name: double_integrator}
cost: {Q: [10, 0.1], R: [1], Q_T: [10, 0.1]}
controls: {name: "limits:Limits", parameters: {limit: 0.05}}
initial_states: {lower: [-1, -1], upper: [1, 1]}
horizon: {steps: 10, dt: 0.1}
network: {name: anchored, hidden: [8]}
rollout: {gradient: discrete}
training: {iterations: 3, batch_size: 8}
evaluation: {validation_states: 4, test_states: 4}
"""
LIMIT = 0.05
pytestmark = [
    pytest.mark.gate,
    # Lightning's own, of torch, and on machines with more than three cores
    pytest.mark.filterwarnings("ignore:.*LeafSpec:FutureWarning"),
    pytest.mark.filterwarnings("ignore:.*does not have many workers"),
]


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A working directory with the user's module, a config and a finished run."""
    folder = tmp_path_factory.mktemp("own_control_set")
    (folder / "limits.py").write_text(MODULE, encoding="utf-8")
    (folder / "limited.yaml").write_text(YAML, encoding="utf-8")
    torch.set_default_dtype(torch.float64)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        patch.chdir(folder)
        assert main(["train", "--config", "limited.yaml"]) == 0
        yield folder


@pytest.fixture
def checkpoint(home):
    return home / "logs" / "limited" / "version_0" / "checkpoints" / "best.ckpt"


@pytest.fixture
def limits(home):
    return importlib.import_module("limits").Limits


@pytest.fixture
def x0():
    return np.array([[1.0, 1.0], [-1.0, -1.0], [0.0, 0.0]])


def test_a_loaded_controller_keeps_to_the_limits(checkpoint, limits, x0):
    """At them somewhere; the same V without limits passes them."""
    u = lyapnet.load(checkpoint, controls=limits(LIMIT)).rollout(x0).u
    assert np.abs(u).max() == LIMIT
    free = lyapnet.load(checkpoint, controls=lyapnet.Unbounded()).rollout(x0).u
    assert np.abs(free).max() > 1.5 * LIMIT
    assert np.array_equal(u[0], free[0].clip(-LIMIT, LIMIT))


def test_a_checkpoint_never_imports_the_control_set_that_it_names(checkpoint):
    with pytest.raises(UsageError, match=r"Expected controls=… for .*trained with limits:Limits.*pass controls=…"):
        lyapnet.load(checkpoint)


def test_the_command_measures_within_the_limits_and_refuses_without(checkpoint, capsys):
    arguments = ["evaluate", str(checkpoint), "--samples", "3", "--json"]
    assert main(arguments) == 2
    assert "--controls to the command" in capsys.readouterr().err
    assert main([*arguments, "--controls", "limits:Limits"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["cost_mean"] > 0
    assert result["cost_ratio"] is None, "no oracle knows the optimum under limits"


def test_a_set_of_ones_own_in_the_place_of_limits(limits, tmp_path, capsys):
    """Of a checkpoint that was trained with limits; a config that names both is refused."""
    task = yaml.safe_load(YAML)
    task["controls"], task["logs"] = {"lower": -1, "upper": 1}, str(tmp_path)
    run = lyapnet.train(task)
    assert main(["evaluate", str(run.best), "--samples", "3", "--json", "--controls", "limits:Tight"]) == 0
    with pytest.raises(UsageError, match="Expected limits or a controls"):
        lyapnet.train({**task, "controls": {"lower": -1, "name": "limits:Tight"}})


def test_no_system_is_imported_for_a_control_set(checkpoint, limits, tmp_path, capsys, monkeypatch):
    """A file that names a class of its own is not to be believed, whatever else is passed."""
    (tmp_path / "tripwire.py").write_text("raise SystemExit('imported')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    content = read_checkpoint(checkpoint)
    content[KEY]["config"]["system"]["name"] = "tripwire:System"
    torch.save(content, tmp_path / "foreign.ckpt")
    assert main(["evaluate", "foreign.ckpt", "--controls", "limits:Limits"]) == 2
    assert "Expected system=…" in capsys.readouterr().err
    assert "tripwire" not in sys.modules


def test_the_oracles_say_that_they_know_no_limits(checkpoint, limits):
    problem = lyapnet.load(checkpoint, controls=limits(LIMIT)).problem
    for limited in (problem, problem.replaced(system=lyapnet.SYSTEMS["cartpole"](), initial_states=cube(4))):
        with pytest.raises(OracleError, match=r"Expected controls without limits, or .*, got Limits"):
            oracle_of(limited)
    assert oracle_of(problem.replaced(controls=lyapnet.Unbounded()))(torch.ones(1, 2)).isfinite().all()


def cube(n):
    return lyapnet.Box([-1.0] * n, [1.0] * n)


def problem_of(controls):
    cost = lyapnet.QuadraticCost(10 * torch.eye(2), [[1.0]], torch.eye(2))
    return lyapnet.Problem(lyapnet.SYSTEMS["double_integrator"](), cost, controls, cube(2), lyapnet.Horizon(10, 0.1))


def network():
    torch.manual_seed(0)
    return FCN(Scaling([1.0, 1.0], 1.0, 10.0), hidden=(8,))


def test_both_exact_gradients_agree_where_the_limits_are_active(limits):
    V, x0, gradients = network(), cube(2).sample(16, torch.Generator()), []
    free = problem_of(lyapnet.Unbounded())
    limit = float(lyapnet.Rollout(free, HJBPolicy(free, V))(x0).u.abs().median())
    problem = problem_of(limits(limit))
    for route in ("discrete", "backprop"):
        trajectory = lyapnet.Rollout(problem, HJBPolicy(problem, V), gradient=route)(x0)
        active = trajectory.u.abs() == limit
        assert active.any()
        assert not active.all()
        gradients.append(torch.autograd.grad(trajectory.cost.mean(), list(V.parameters()), materialize_grads=True))
    for discrete, backprop in zip(*gradients, strict=True):
        assert_close(discrete, backprop, rtol=1e-9, atol=1e-12)


def test_the_same_set_from_python(limits):
    problem, V = problem_of(limits(1.0)), network()
    module = lyapnet.ValueModule(problem, V, lyapnet.ValueProgram(constraint=0, cost_to_go=1, trajectory_cost=1))
    trainer = lightning.Trainer(
        max_epochs=15, logger=False, accelerator="cpu", enable_checkpointing=False, enable_progress_bar=False,
        enable_model_summary=False, limit_val_batches=0,
    )  # fmt: skip
    states = problem.initial_states.sample(64, torch.Generator())
    with torch.no_grad():
        before = module.rollout(states)
    assert before.u.abs().max() == 1
    trainer.fit(module, lyapnet.InitialStateDataModule(problem, batch_size=16))
    trajectory = lyapnet.Controller(problem, V).rollout(states)
    assert trajectory.cost.mean() < before.cost.mean() - 0.1
    assert problem.controls.contains(trajectory.u).all()


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("rollout.policy=sontag", "Expected controls without limits for Sontag's formula, got Limits"),
        ("controls.parameters.limits=1", "Expected parameters of limits:Limits (limit), got"),
        ("controls.name=limits:Nothing", "Expected controls.name as a class of limits, got 'limits:Nothing'"),
        ("controls.name=limits:Limit", "did you mean limits:Limits?"),
        (
            "controls.name=nothing",
            "Expected controls.name as one of unbounded, ball, ellipsoid, polytope, table, or module:Class, got ",
        ),
        ("controls.name=absent:Limits", "Expected controls.name as module:Class, got 'absent:Limits' (ModuleNotFound"),
        ("controls.name=pathlib:Path", "Expected controls.name as a subclass of ControlSet"),
    ],
)
def test_what_does_not_fit_is_refused_before_the_training(override, message, home, capsys):
    before = sorted((home / "logs" / "limited").iterdir())
    assert main(["train", "--config", "limited.yaml", override]) == 2
    assert message in capsys.readouterr().err
    assert sorted((home / "logs" / "limited").iterdir()) == before

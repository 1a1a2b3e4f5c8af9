"""A cost from a user's module: trained by YAML and by Python, loaded, measured, held against its optimum."""

import importlib
import json

import lightning
import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from torch.testing import assert_close

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.cli import main
from lyapnet.evaluation.oracles import oracle_of
from lyapnet.evaluation.oracles.transcription import Transcription
from lyapnet.value.networks import FCN, Scaling
from tests.pages import ROOT, blocks

(EXAMPLE,) = [block for block in blocks("python", ROOT / "docs" / "own_system.md") if "class Swing(" in block]
MODULE = f"""{EXAMPLE}

class Reward(Swing):
    def state(self, x):
        return -super().state(x)
"""

YAML = """
experiment: swing
program: {name: value, constraint: 0, cost_to_go: 1, trajectory_cost: 1}
system: {name: double_integrator}
cost: {name: "swing_cost:Swing", parameters: {angle_weight: 8, effort: 0.4}}
initial_states: {lower: [-2, -0.5], upper: [2, 0.5]}
horizon: {steps: 8, dt: 0.1}
network: {name: fcn, hidden: [8], value_scale: 10}
rollout: {gradient: discrete}
training: {iterations: 3, batch_size: 8}
evaluation: {validation_states: 4, test_states: 4}
"""
STEPS, DT = 8, 0.1
pytestmark = [
    pytest.mark.gate,
    # Lightning's own, of torch, and on machines with more than three cores
    pytest.mark.filterwarnings("ignore:.*LeafSpec:FutureWarning"),
    pytest.mark.filterwarnings("ignore:.*does not have many workers"),
]


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A working directory with the user's module, a config and a finished run."""
    folder = tmp_path_factory.mktemp("own_cost")
    (folder / "swing_cost.py").write_text(MODULE, encoding="utf-8")
    (folder / "swing.yaml").write_text(YAML, encoding="utf-8")
    torch.set_default_dtype(torch.float64)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        patch.chdir(folder)
        assert main(["train", "--config", "swing.yaml"]) == 0
        yield folder


@pytest.fixture
def checkpoint(home):
    return home / "logs" / "swing" / "version_0" / "checkpoints" / "best.ckpt"


@pytest.fixture
def cost(home):
    return importlib.import_module("swing_cost").Swing(angle_weight=8.0, effort=0.4)


def by_hand(x0, u):
    """J_N of the controls (N,) from x₀, in numpy."""
    (angle, rate), J = x0, 0.0
    for control in u:
        J += DT * (8 * (1 - np.cos(angle)) + 0.1 * rate**2 + 0.4 * control**2)
        angle, rate = angle + DT * rate, rate + DT * control
    return J + 5 * (1 - np.cos(angle)) + rate**2


def test_a_loaded_controller_pays_the_users_cost(checkpoint, cost):
    controller = lyapnet.load(checkpoint, cost=cost)
    x0 = np.array([[1.0, 0.2], [-1.5, 0.0]])
    trajectory = controller.rollout(x0)
    for i in range(2):
        assert trajectory.cost[i] == pytest.approx(by_hand(x0[i], trajectory.u[:, i, 0]), rel=1e-12)
        assert trajectory.cost[i] != pytest.approx(by_hand(x0[i], 1.1 * trajectory.u[:, i, 0]), rel=1e-3)


def test_a_checkpoint_never_imports_the_cost_that_it_names(checkpoint):
    with pytest.raises(UsageError, match=r"Expected cost=… for .*trained with swing_cost:Swing.*pass cost=… to load"):
        lyapnet.load(checkpoint)


def test_the_command_measures_with_the_cost_and_refuses_without(checkpoint, capsys):
    arguments = ["evaluate", str(checkpoint), "--samples", "3", "--json"]
    assert main(arguments) == 2
    assert "--cost to the command" in capsys.readouterr().err
    assert main([*arguments, "--cost", "swing_cost:Swing"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["cost_ratio"] >= 1 - 1e-6


def test_the_optimum_of_the_users_cost_against_scipy(checkpoint, cost):
    """Minimised over the controls by another method, in numpy; the optimum of another weight is another."""
    problem = lyapnet.load(checkpoint, cost=cost).problem
    oracle, x0 = oracle_of(problem), torch.tensor([[1.0, 0.2], [-0.7, 0.4]])
    assert isinstance(oracle, Transcription)
    expected = [minimize(lambda u, y=y: by_hand(y, u), np.zeros(STEPS), tol=1e-12).fun for y in x0.numpy()]
    assert_close(oracle(x0), torch.tensor(expected), rtol=1e-6, atol=0)
    other = oracle_of(problem.replaced(cost=type(cost)(angle_weight=7.0, effort=0.4)))
    assert not torch.allclose(other(x0), oracle(x0), rtol=1e-2)


def test_the_same_cost_from_python(cost):
    """A plain Lightning training: the loss falls."""
    torch.manual_seed(0)
    system, box = lyapnet.SYSTEMS["double_integrator"](), lyapnet.Box([-2.0, -0.5], [2.0, 0.5])
    problem = lyapnet.Problem(system, cost, lyapnet.Unbounded(), box, lyapnet.Horizon(STEPS, DT))
    V = FCN(Scaling([2.0, 0.5], problem.horizon.duration, 10.0), hidden=(8,))
    module = lyapnet.ValueModule(problem, V, lyapnet.ValueProgram(constraint=0, cost_to_go=1, trajectory_cost=1))
    data, states = lyapnet.InitialStateDataModule(problem, batch_size=16), box.sample(64, torch.Generator())

    def mean_cost():
        with torch.no_grad():
            return float(module.rollout(states).cost.mean())

    before = mean_cost()
    trainer = lightning.Trainer(
        max_epochs=15, logger=False, accelerator="cpu", enable_checkpointing=False, enable_progress_bar=False,
        enable_model_summary=False, limit_val_batches=0,
    )  # fmt: skip
    trainer.fit(module, data)
    assert mean_cost() < before - 0.1
    assert lyapnet.Controller(problem, V).cost is cost


def test_a_cost_that_rewards_has_no_goal(home, capsys):
    arguments = ["train", "--config", "swing.yaml", "cost.name=swing_cost:Reward"]
    assert main([*arguments, "evaluation.optimum=false"]) == 0
    assert "certify tube" in capsys.readouterr().out
    assert main([*arguments, "program={name: lyapunov, constraint: 1, cost_to_go: null}"]) == 2
    assert "Expected a task with a goal, to which V falls, got none: q is negative" in capsys.readouterr().err
    assert main([*arguments, "cost.name=swing_cost:Swing", "cost.parameters.angle=3"]) == 2
    assert "cost.parameters.angle" in capsys.readouterr().err

"""Several processes share a batch: theirs is the gradient of one process with the joint batch; runs change hands."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch

import lyapnet
from lyapnet.experiment.checkpoint import read_checkpoint
from lyapnet.experiment.config import load_config
from lyapnet.loop.rollout import GRADIENTS
from lyapnet.training.build import build_module
from lyapnet.training.data import InitialStateDataModule

ROOT = Path(__file__).parents[2]
SCRATCH = ROOT / "conf" / "from_scratch"
SMALL = [
    "horizon.steps=5", "network.hidden=[8,8]", "training.batch_size=3", "training.beta1=0", "training.validate_every=1",
    "evaluation.validation_states=2", "evaluation.test_states=2", "evaluation.figures_every=99",
    "trainer.gradient_clip_val=null", "loggers=[csv]", "evaluation.optimum=false",
]  # fmt: skip
TWO = ("trainer.devices=2", "trainer.strategy=ddp")
FORKED = ("trainer.devices=2", "trainer.strategy=ddp_fork")  # which does not import everything once more


def train(folder, name, *arguments):
    """One run from the command line; the content of its last checkpoint."""
    command = [
        sys.executable,
        "train.py",
        "--config",
        str(SCRATCH / f"{name}.yaml"),
        *SMALL,
        f"logs={folder}",
        *arguments,
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=180)
    assert done.returncode == 0, done.stderr
    return read_checkpoint(folder / f"{name}_from_scratch" / "version_0" / "checkpoints" / "last.ckpt")


def gradient_on(name, *overrides, processes):
    """The gradient of the first step on the joint batch of these processes, in one process."""
    config = load_config(SCRATCH / f"{name}.yaml", [*SMALL, *overrides])
    module = build_module(config)
    data = InitialStateDataModule(module.problem, config.training.batch_size, 1, config.seed)
    x0 = torch.cat([data.batch(0, process) for process in range(processes)])
    loss = module.program(module.rollout(x0)).loss
    return torch.cat([g.flatten() for g in torch.autograd.grad(loss, list(module.V.parameters()))])


@pytest.mark.gate
@pytest.mark.parametrize(
    ("name", "gradient", "two"),
    [
        ("double_integrator", "discrete", FORKED),
        ("double_integrator_value", "adjoint", TWO),
        pytest.param("double_integrator", "discrete", TWO, marks=pytest.mark.nightly),
    ],
)
def test_two_processes_have_the_gradient_of_the_joint_batch(tmp_path, name, gradient, two):
    """Normalised by the mean cost of the whole batch. With β₁ = 0, Adam keeps the gradient itself."""
    assert gradient in GRADIENTS
    route = f"rollout.gradient={gradient}"
    state = train(tmp_path, name, route, "training.iterations=1", *two)["optimizer_states"][0]["state"]
    taken = torch.cat([parameter["exp_avg"].flatten() for _, parameter in sorted(state.items())])
    joint, alone = (gradient_on(name, route, processes=n) for n in (2, 1))
    assert (taken - joint).norm() / joint.norm() < 1e-6
    assert (taken - alone).norm() / joint.norm() > 1e-3


@pytest.mark.gate
def test_a_run_goes_on_with_another_number_of_processes(tmp_path):
    name, options = "double_integrator", ["rollout.gradient=adjoint", f"logs={tmp_path}", "training.iterations=1"]
    lyapnet.train(SCRATCH / f"{name}.yaml", [*SMALL, *options])
    resumed = train(tmp_path, name, options[0], "training.iterations=2", *TWO, "--resume", "last")
    assert resumed["global_step"] == 2

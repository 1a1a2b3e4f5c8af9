"""Trainings on a GPU: they come to their end, and their checkpoints are used without one."""

import pytest
import torch

import lyapnet
from lyapnet.cli import main
from tests.runs import TINY

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")
LOST = "training.lost_share=0.5"


@pytest.mark.parametrize(
    "config", ["double_integrator", "double_integrator_two_sided", "double_integrator_certified", "cartpole_balancing"]
)
def test_it_trains_goes_on_and_is_loaded_on_the_cpu(config, tmp_path):
    command = ["train", "--config", f"conf/{config}.yaml", f"logs={tmp_path}", *TINY, LOST]
    assert main([*command, "trainer.accelerator=gpu"]) == 0
    assert main([*command, "trainer.accelerator=gpu", "--resume", "last", "training.iterations=4"]) == 0
    (best,) = tmp_path.rglob("version_0/checkpoints/best.ckpt")
    controller = lyapnet.load(best)
    x0 = controller.initial_states.sample(3, torch.Generator().manual_seed(0))
    assert controller.rollout(x0).cost.isfinite().all()
    assert controller.rollout(x0).cost.device.type == "cpu"


def test_an_ensemble(tmp_path):
    command = ["train", "--config", "conf/double_integrator.yaml", f"logs={tmp_path}", *TINY, LOST]
    assert main([*command, "seeds=2", "trainer.accelerator=gpu"]) == 0

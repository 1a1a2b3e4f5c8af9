"""What a run knows of its task comes from its config: not from weights, not from a precision, not from a device."""

from pathlib import Path

import pytest
import torch

import lyapnet
from lyapnet.base.errors import CheckpointError, DivergenceError
from lyapnet.cli import main
from lyapnet.experiment.checkpoint import KEY, read_checkpoint, write_checkpoint
from lyapnet.experiment.config import load_config
from lyapnet.task.systems import Cartpole
from lyapnet.training.build import build_module

ROOT = Path(__file__).parents[2]
SCRATCH = ROOT / "conf" / "from_scratch"
SHORT = ["training.iterations=1", "horizon.steps=4", "evaluation.validation_states=2", "evaluation.test_states=2",
         "evaluation.animate=false", "rollout.gradient=backprop"]  # fmt: skip


def trained(name, folder, *overrides):
    """The best checkpoint of a run of one step."""
    assert main(["train", "--config", str(SCRATCH / f"{name}.yaml"), *SHORT, f"logs={folder}", *overrides]) == 0
    return max((folder / f"{name}_from_scratch").glob("version_*")) / "checkpoints" / "best.ckpt"


@pytest.fixture
def without_figures(monkeypatch):
    """Drawing takes most of the time of a short run."""
    monkeypatch.setattr("lyapnet.training.figure_logger.figures_of", lambda learner: {})


def module_of(name):
    return build_module(load_config(SCRATCH / f"{name}.yaml"))


@pytest.mark.gate
def test_finetuning_keeps_the_new_cost_and_system(without_figures, tmp_path):
    source = trained("double_integrator_value", tmp_path)
    new = ["cost.Q=[1, 1]", "cost.Q_T=[100, 1]", "system.parameters.mass=2"]
    controller = lyapnet.load(trained("double_integrator_value", tmp_path, *new, "--finetune", str(source)))
    assert controller.cost.Q.diagonal().tolist() == [1, 1]
    assert controller.cost.Q_T.diagonal().tolist() == [100, 1]
    assert controller.cost.R(torch.zeros(2)).item() == 0.5
    assert lyapnet.load(source).cost.R(torch.zeros(2)).item() == 1


@pytest.mark.parametrize("name", ["cartpole_balancing", "reacher", "double_integrator_value"])
def test_checkpoint_holds_the_weights_of_V_and_nothing_else(name):
    module = module_of(name)
    assert set(module.state_dict()) == {f"V.{name}" for name, _ in module.V.named_parameters()}


@pytest.mark.parametrize("name", ["double_integrator", "cartpole_swingup", "reacher"])
def test_everything_follows_the_module_to_a_device(name):
    module = module_of(name).to("meta")
    tensors = [*module.problem.buffers(), *module.V.parameters(), *module.rollout.buffers()]
    assert {t.device.type for t in tensors} == {"meta"}
    assert module.problem.initial_states.sample(3).device.type == "meta"


@pytest.mark.gate
def test_passed_system_takes_the_precision_of_the_run_and_stays_as_it_was(without_figures, tmp_path):
    path = trained("cartpole_balancing", tmp_path)
    parameters = lyapnet.load(path).config.system.parameters
    torch.set_default_dtype(torch.float32)
    mine = Cartpole(**parameters)
    x0 = [0.1, 0.2, 0.0, 0.0]
    passed = lyapnet.load(path, system=mine).rollout(x0).cost
    assert abs(passed - lyapnet.load(path).rollout(x0).cost) < 1e-6
    assert mine.B.dtype == torch.float32


@pytest.mark.parametrize("key", ["experiment", "logs"])
def test_interpolation_in_a_checkpoint_is_refused_unresolved(key, without_figures, tmp_path, monkeypatch):
    monkeypatch.setenv("SECRET", "told")
    content = read_checkpoint(trained("double_integrator", tmp_path))
    content[KEY]["config"][key] = "${oc.env:SECRET}"
    write_checkpoint(content, tmp_path / "curious.ckpt")
    with pytest.raises(CheckpointError, match="interpolation") as refused:
        lyapnet.load(tmp_path / "curious.ckpt")
    assert "told" not in str(refused.value)


def test_numbers_with_exponents_mean_the_same_in_file_and_command(tmp_path):
    text = (SCRATCH / "double_integrator.yaml").read_text(encoding="utf-8").replace("Q: [10, 0.1]", "Q: [1e1, 1e-1]")
    (tmp_path / "exponents.yaml").write_text(text, encoding="utf-8")
    assert load_config(tmp_path / "exponents.yaml").cost.Q == load_config(SCRATCH / "double_integrator.yaml").cost.Q


@pytest.mark.parametrize("option", ["accelerator=banana", "devices=0", "gradient_clip_val=much"])
def test_trainer_values_are_refused_before_there_is_a_folder(option, tmp_path, capsys):
    arguments = ["train", "--config", str(SCRATCH / "reacher.yaml"), f"logs={tmp_path / 'logs'}", f"trainer.{option}"]
    assert main(arguments) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "logs").exists()


def test_copy_of_a_checkpoint_is_not_resumed_where_it_lies(without_figures, tmp_path, capsys):
    source = trained("double_integrator", tmp_path / "logs")
    copied = tmp_path / "backup" / "deep" / "mine.ckpt"
    copied.parent.mkdir(parents=True)
    copied.write_bytes(source.read_bytes())
    config = str(SCRATCH / "double_integrator.yaml")
    assert main(["train", "--config", config, *SHORT, f"logs={tmp_path / 'logs'}", "--resume", str(copied)]) == 2
    assert "--finetune" in capsys.readouterr().err
    assert sorted(p.name for p in (tmp_path / "backup").rglob("*")) == ["deep", "mine.ckpt"]


def test_figure_that_cannot_be_drawn_does_not_stop_a_run(tmp_path, monkeypatch):
    def diverges(*_):
        raise DivergenceError("a corner of X₀ leaves the finite numbers")

    monkeypatch.setattr("lyapnet.evaluation.figures.certified_region", diverges)
    with pytest.warns(UserWarning, match="No figures at step"):
        trained("double_integrator", tmp_path)

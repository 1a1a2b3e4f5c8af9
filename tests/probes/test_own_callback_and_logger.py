"""A callback from a user's module through YAML, and what another logger than TensorBoard is given."""

import importlib

import lightning
import pytest
from matplotlib.figure import Figure

import lyapnet
from lyapnet.experiment.checkpoint import read_checkpoint
from lyapnet.training import figure_logger, loggers
from tests.probes.own_parts import ListLogger
from tests.runs import SMALL

NAME = "tests.probes.own_parts:CostOfValidations"
CONFIG = {
    **SMALL,
    "training": {"iterations": 6, "batch_size": 6, "validate_every": 2},
    "evaluation": {"validation_states": 6, "test_states": 6, "figures_every": 1},
    "loggers": ["csv"],
    "callbacks": [NAME],
}


def costs(run):
    """What the callback kept in the last checkpoint."""
    states = read_checkpoint(run.last)["callbacks"]
    return states["CostOfValidations"]["costs"]


@pytest.mark.gate
def test_callback_runs_and_is_resumed(tmp_path):
    home = f"logs={tmp_path}"
    run = lyapnet.train(CONFIG, [home, "training.iterations=4"])
    assert len(costs(run)) == 2
    again = lyapnet.train(CONFIG, [home], resume="last")
    assert again == run
    assert len(costs(again)) == 3
    assert costs(again)[-1] > 0


@pytest.mark.gate
def test_another_logger_gets_curves_figures_and_config(tmp_path, monkeypatch):
    made = []

    def list_logger(config, run, resumed_at):
        made.append(ListLogger())
        return made[-1]

    monkeypatch.setitem(loggers.LOGGERS, "wandb", list_logger)
    monkeypatch.setitem(loggers.LIBRARIES, "wandb", "lightning")
    monkeypatch.setattr(figure_logger, "figures_of", lambda learner: {"picture": Figure()})
    lyapnet.train(CONFIG, [f"logs={tmp_path}", "loggers=[wandb]", "training.iterations=3"])
    (logger,) = made
    assert [step for step, _ in logger.metrics["loss/train"]] == [1, 2, 3]
    assert [step for step, _ in logger.metrics["trajectory_cost/val"]] == [0, 2, 3]
    assert [step for step, _ in logger.metrics["hp/cost_mean"]] == [4]
    assert [step for step, _ in logger.images["picture"]] == [0, 2, 3]
    assert logger.params["training"]["iterations"] == 3


def test_lightning_brings_callbacks_too(tmp_path):
    name = "lightning.pytorch.callbacks:Timer"
    run = lyapnet.train(CONFIG, [f"logs={tmp_path}", "training.iterations=1", f"callbacks=['{name}']"])
    assert issubclass(importlib.import_module("lightning.pytorch.callbacks").Timer, lightning.Callback)
    assert any("Timer" in key for key in read_checkpoint(run.last)["callbacks"])


@pytest.mark.parametrize("name", ["tests.probes.own_parts:Pendulum", "tests.probes.own_parts:Nothing", "nonsense"])
def test_what_is_no_callback_is_refused_before_there_is_a_folder(name, tmp_path):
    with pytest.raises(lyapnet.LyapnetError, match=r"^Expected callbacks as"):
        lyapnet.train(CONFIG, [f"logs={tmp_path / 'none'}", f"callbacks=['{name}']"])
    assert not (tmp_path / "none").exists()

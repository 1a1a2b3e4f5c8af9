"""Checkpoints of any trainer: a plain one's carry the digest, and are verified and executed nowhere on reading."""

import os

import lightning as L
import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.plugins.io import TorchCheckpointIO

from lyapnet import InitialStateDataModule, LyapunovProgram, ValueModule
from lyapnet.base.errors import CheckpointError
from lyapnet.experiment.assembly import build_problem, build_value_function
from lyapnet.experiment.checkpoint import DIGEST, read_checkpoint
from lyapnet.experiment.config import config_from_plain
from lyapnet.training.checkpoint_files import CheckpointFiles
from tests.runs import SMALL


@pytest.fixture
def parts():
    config = config_from_plain(SMALL)
    problem = build_problem(config)
    return {"problem": problem, "V": build_value_function(config, problem), "program": LyapunovProgram()}


class Late(L.Callback):
    """Adds to a checkpoint after everyone else, as a module of the user's own may."""

    def on_save_checkpoint(self, trainer, pl_module, checkpoint):
        checkpoint["late"] = {"noted": torch.ones(2)}


def fit(parts, folder, epochs, resume=None, **options):
    options = {
        "max_epochs": epochs,
        "logger": False,
        "enable_progress_bar": False,
        "enable_model_summary": False,
    } | options
    callbacks = [ModelCheckpoint(folder, "one", save_last=True), Late()]
    trainer = L.Trainer(accelerator="cpu", default_root_dir=folder, callbacks=callbacks, **options)
    trainer.fit(ValueModule(**parts), InitialStateDataModule(parts["problem"], batch_size=4), ckpt_path=resume)
    return folder / "last.ckpt"


pytestmark = [
    pytest.mark.filterwarnings("ignore:.*does not have many workers"),
    pytest.mark.filterwarnings("ignore:.*LeafSpec"),
    pytest.mark.filterwarnings("ignore:Checkpoint directory .* exists"),
]


def notes(caplog):
    return [record for record in caplog.records if record.name.startswith("lyapnet")]


def change(path):
    content = torch.load(path, weights_only=True)
    content["optimizer_states"][0]["state"][0]["exp_avg"].view(-1)[0] += 1e-12
    torch.save(content, path)


@pytest.mark.gate
def test_plain_trainer_writes_the_digest_and_verifies_it(parts, tmp_path, caplog):
    path = fit(parts, tmp_path, 2)
    assert DIGEST in torch.load(path, weights_only=True)
    assert {"late", "callbacks", "optimizer_states"} <= read_checkpoint(path).keys()
    ValueModule.load_from_checkpoint(path, **parts)
    fit(parts, tmp_path, 3, path)
    assert read_checkpoint(path)["global_step"] == 3
    assert not notes(caplog)
    change(path)
    for read in (lambda: ValueModule.load_from_checkpoint(path, **parts), lambda: fit(parts, tmp_path, 4, path)):
        with pytest.raises(CheckpointError, match="changed or damaged"):
            read()


class Own(TorchCheckpointIO):
    """Files of the user's own."""


def test_files_of_the_users_own_stay_as_they_are(parts, tmp_path, caplog):
    path = fit(parts, tmp_path, 1, plugins=[Own()])
    assert DIGEST not in torch.load(path, weights_only=True)
    read_checkpoint(path)
    assert len(notes(caplog)) == 1


class Malice:
    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return os.mkdir, (str(self.marker),)


def test_loading_a_module_executes_nothing(parts, tmp_path):
    path, marker = fit(parts, tmp_path, 1), tmp_path / "executed"
    torch.save({**torch.load(path, weights_only=True), "further": Malice(marker)}, path)
    for read in (lambda: ValueModule.load_from_checkpoint(path, **parts), lambda: fit(parts, tmp_path, 2, path)):
        with pytest.raises(CheckpointError):
            read()
    assert not marker.exists()
    torch.load(path, weights_only=False)  # the twin
    assert marker.exists()


def test_weights_alone_as_a_forked_process_hands_them_over(tmp_path):
    files, weights = CheckpointFiles(), {"V.scale": torch.tensor(2.0)}
    files.save_checkpoint(weights, tmp_path / "weights.ckpt")
    assert files.load_checkpoint(tmp_path / "weights.ckpt") == weights

"""Files that run something when a careless program reads them, given to every verb: nothing in them runs."""

import importlib
import io
import json
import os
import pickle
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from lyapnet.cli import main
from lyapnet.experiment.checkpoint import KEY, read_checkpoint, write_checkpoint
from tests.runs import TINY, tiny_checkpoint

pytestmark = pytest.mark.usefixtures("few_seconds_for_levels")
CONFIG = str(Path("conf/from_scratch/double_integrator.yaml").absolute())
BRIEF = ["--samples", "3"]
VERBS = {  # a checkpoint ↦ the arguments that read it
    "evaluate": lambda file: ["evaluate", file, *BRIEF, "--no-optimum"],
    "sampled": lambda file: ["certify", "sampled", file, *BRIEF],
    "statistical": lambda file: ["certify", "statistical", file, *BRIEF],
    "sound": lambda file: ["certify", "sound", file, "--seconds", "0.1"],
    "refine": lambda file: ["certify", "sound", file, "--seconds", "0.1", "--refine", "1"],
    "check": lambda file: ["certify", "check", "some.proof", file],
    "resume": lambda file: ["train", "--resume", file],
    "finetune": lambda file: ["train", "--finetune", file, "--config", CONFIG, "network.hidden=[8]", *TINY],
}

PROVE = {"sound", "refine"}  # of these verbs, those that take seconds


class Malice:
    """Unpickling this makes a folder."""

    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return os.mkdir, (str(self.marker),)


FORMS = {
    "zip": lambda content, file: torch.save(content, file),
    "legacy": lambda content, file: torch.save(content, file, _use_new_zipfile_serialization=False),
    "pickle": lambda content, file: file.write_bytes(pickle.dumps(content)),
}
PLACES = {
    "whole": lambda content, evil: evil,
    "callbacks": lambda content, evil: {**content, "callbacks": evil},
    "weights": lambda content, evil: {**content, "state_dict": {**content["state_dict"], "V.x": evil}},
    "config": lambda content, evil: {**content, KEY: {**content[KEY], "config": evil}},
}
OWN = {  # what a checkpoint's config can name, in a module that leaves a mark when it is imported
    "system": {"system": {"name": "trap:Class"}},
    "network": {"network": {"name": "trap:Class"}},
    "program": {"program": {"name": "trap:Class"}},
    "cost": {"cost": {"name": "trap:Class"}},
    "controls": {"controls": {"name": "trap:Class"}},
    "callbacks": {"callbacks": ["trap:Class"]},
    "loggers": {"loggers": ["trap:Class"]},
}
TAGS = {
    "apply": "!!python/object/apply:os.mkdir [{}]",
    "new": "!!python/object/new:os.mkdir [{}]",
    "in a list": "[1, !!python/object/apply:os.mkdir [{}]]",
    "as a key": "{{!!python/object/apply:os.mkdir [{}] : 1}}",
}
RECORDS = ("run.json", "config.yaml", "evaluation.json", "draws.jsonl", "metrics.csv")


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    return tiny_checkpoint(tmp_path_factory.mktemp("logs"))


@pytest.fixture
def marker(tmp_path, monkeypatch):
    """What none of the files may make; in a folder of its own, beside a module that makes it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    (tmp_path / "trap.py").write_text("import os\nos.mkdir('executed')\nclass Class: pass\n")
    importlib.invalidate_caches()
    yield tmp_path / "executed"
    sys.modules.pop("trap", None)


def innocent_after(arguments, marker, capsys):
    """What a command says; nothing ran, and there is no traceback."""
    status = main(arguments)
    assert not marker.exists(), arguments
    said = capsys.readouterr().err
    assert "Traceback" not in said
    return status, said


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("place", PLACES)
def test_pickles_in_checkpoints(place, form, marker, capsys):
    file = Path("evil.ckpt")
    FORMS[form](PLACES[place](read_checkpoint("zoo:double_integrator"), Malice(marker)), file)
    for arguments in VERBS.values():
        status, said = innocent_after(arguments(str(file)), marker, capsys)
        assert status
        assert said.count("\n") == 1
    with file.open("rb") as opened:  # the twin
        pickle.load(opened) if form == "pickle" else torch.load(opened, weights_only=False)
    assert marker.exists()


@pytest.mark.gate
@pytest.mark.parametrize("named", OWN)
def test_modules_that_checkpoints_name(named, trained, marker, capsys):
    content = read_checkpoint(trained)
    content[KEY]["config"].update(OWN[named])
    write_checkpoint(content, Path("evil.ckpt"))
    for verb, arguments in VERBS.items():
        status, said = innocent_after(arguments("evil.ckpt"), marker, capsys)
        # fine-tuning takes the weights of V alone, and the others have no use for callbacks and loggers
        assert status or verb == "finetune" or named in ("callbacks", "loggers"), said
        assert verb != "finetune" or bool(status) == (named in ("system", "network", "loggers")), said
    importlib.import_module("trap")  # the twin
    assert marker.exists()


def as_numpy(evil):
    with io.BytesIO() as file:
        np.save(file, np.array([evil], dtype=object), allow_pickle=True)
        return file.getvalue()


PROOFS = {
    "pickle": pickle.dumps,
    "numpy": as_numpy,
    "JSON": lambda evil: json.dumps({"py/reduce": [{"py/function": "os.mkdir"}, [str(evil.marker)]]}).encode(),
}


@pytest.mark.gate
@pytest.mark.parametrize("kind", PROOFS)
def test_kept_proofs(kind, trained, marker, capsys):
    evil = PROOFS[kind](Malice(marker))
    kept = [[kind, str(trained), "--keep", "evil.proof"] for kind in ("sound", "region")]
    for arguments in (["check", "evil.proof", str(trained)], [*kept[0], "--two-sided"], *kept):
        Path("evil.proof").write_bytes(evil)
        assert innocent_after(["certify", *arguments], marker, capsys)[0]
    if kind == "pickle":
        pickle.loads(evil)  # the twin
        assert marker.exists()


@pytest.mark.parametrize("tag", TAGS)
def test_tags_in_configs(tag, marker, capsys):
    Path("evil.yaml").write_text(f"experiment: {TAGS[tag].format(marker)}\n")
    for command in ("train", "sweep", "compare"):
        assert innocent_after([command, "--config", "evil.yaml"], marker, capsys)[0] == 2
    override = [f"experiment={TAGS[tag].format(marker)}"]
    assert innocent_after(["train", "--config", CONFIG, *override], marker, capsys)[0] == 2
    if tag == "apply":
        yaml.unsafe_load(Path("evil.yaml").read_text())  # the twin
        assert marker.exists()


@pytest.mark.gate
@pytest.mark.parametrize("names", [*((name,) for name in RECORDS), RECORDS], ids=" ".join)
def test_records_of_a_run(names, trained, marker, capsys):
    """Each file alone; then all of them at once, with the verbs that prove something too, which go on to their end."""
    run = marker.parent / "double_integrator_from_scratch/version_0"
    shutil.copytree(trained.parents[1], run)
    for name in names:
        evil = TAGS["apply"].format(marker).encode() if name.endswith("yaml") else pickle.dumps(Malice(marker))
        (run / name).write_bytes(evil)
    for verb, arguments in VERBS.items():
        if names == RECORDS or verb not in PROVE:
            status, said = innocent_after(arguments(str(run / "checkpoints/best.ckpt")), marker, capsys)
            assert not status or verb not in PROVE, said

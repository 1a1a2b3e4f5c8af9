"""Checkpoint files: whole or refused, never executed, written all or nothing."""

import errno
import importlib
import io
import os
import pickle
import resource
import signal
import subprocess
import sys
import zipfile
from collections import OrderedDict
from pathlib import Path

import pytest
import torch

import lyapnet
from lyapnet.build import build_problem, build_value_function
from lyapnet.checkpoint import KEY, read_checkpoint, write_checkpoint
from lyapnet.config import load_config, to_plain
from lyapnet.errors import CheckpointError, LyapnetError, UsageError

CONF = Path(__file__).parents[1] / "conf"
SMALL = ["network.hidden=[4, 4]", "horizon.steps=5"]


def content_of(config):
    """What a checkpoint of a run with this config holds, with fresh weights."""
    V = build_value_function(config, build_problem(config))
    weights = {f"V.{name}": tensor for name, tensor in V.state_dict().items()}
    return {"state_dict": weights, "global_step": 7, KEY: {"config": to_plain(config), "version": "0"}}


@pytest.fixture
def content():
    return content_of(load_config(CONF / "double_integrator.yaml", SMALL))


@pytest.fixture
def path(tmp_path, content):
    """A checkpoint that loads."""
    path = tmp_path / "good.ckpt"
    write_checkpoint(content, path)
    return path


def is_one_line_that_names(path, error):
    message = str(error)
    assert "\n" not in message
    assert message.startswith("Expected")
    assert str(path) in message


def test_what_was_written_is_read(path, content):
    read = read_checkpoint(path)
    assert read.keys() == content.keys()
    assert read[KEY] == content[KEY]
    for name, tensor in content["state_dict"].items():
        assert torch.equal(read["state_dict"][name], tensor)
    assert lyapnet.load(path).config == load_config(CONF / "double_integrator.yaml", SMALL)


def test_missing_file_is_refused(tmp_path):
    with pytest.raises(UsageError) as raised:
        lyapnet.load(tmp_path / "nothing.ckpt")
    is_one_line_that_names(tmp_path / "nothing.ckpt", raised.value)


@pytest.mark.parametrize("share", [0.0, 0.001, 0.1, 0.5, 0.9, 0.99, 0.999])
def test_truncated_file_is_refused(share, path):
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(CheckpointError) as raised:
        lyapnet.load(path)
    is_one_line_that_names(path, raised.value)


def zip_of(names):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name in names:
            archive.writestr(name, "nothing")
    return buffer.getvalue()


def saved(content, **options):
    buffer = io.BytesIO()
    torch.save(content, buffer, **options)
    return buffer.getvalue()


FOREIGN = {
    "text": b"experiment: double_integrator\n",
    "zeros": bytes(4096),
    "zip": zip_of(["readme.txt"]),
    "zip that looks like torch's": zip_of(["archive/data.pkl", "archive/version"]),
    "pickle": pickle.dumps({KEY: {"config": {}}, "state_dict": {}}),
    "tensor": saved(torch.zeros(3)),
    "torch file of another program": saved({"state_dict": {"weight": torch.zeros(3)}, "epoch": 3}),
    "the same in the legacy format": saved({"model": OrderedDict()}, _use_new_zipfile_serialization=False),
    "another meaning of the key": saved({KEY: "0.1", "state_dict": {}}),
    "no config": saved({KEY: {"version": "0"}, "state_dict": {}}),
    "a config of another kind": saved({KEY: {"config": [1, 2]}, "state_dict": {}}),
    "an empty config": saved({KEY: {"config": {}}, "state_dict": {}}),
    "a config with an unknown key": saved({KEY: {"config": {"experimentt": "x"}}, "state_dict": {}}),
}


@pytest.mark.parametrize("kind", FOREIGN)
def test_foreign_file_is_refused(kind, tmp_path):
    path = tmp_path / "foreign.ckpt"
    path.write_bytes(FOREIGN[kind])
    with pytest.raises(CheckpointError) as raised:
        lyapnet.load(path)
    is_one_line_that_names(path, raised.value)


def test_weights_that_are_no_dictionary_are_refused(tmp_path, content):
    path = tmp_path / "foreign.ckpt"
    write_checkpoint({**content, "state_dict": [1, 2]}, path)
    with pytest.raises(CheckpointError) as raised:
        lyapnet.load(path)
    is_one_line_that_names(path, raised.value)


def test_folder_is_refused(tmp_path):
    with pytest.raises(UsageError) as raised:
        lyapnet.load(tmp_path)
    is_one_line_that_names(tmp_path, raised.value)


# A checkpoint is data: nothing in it runs.


class Malice:
    """Unpickling this makes a file."""

    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return os.mkdir, (str(self.marker),)


def as_zip(content, path):
    torch.save(content, path)


def as_legacy(content, path):
    torch.save(content, path, _use_new_zipfile_serialization=False)


def as_pickle(content, path):
    path.write_bytes(pickle.dumps(content))


PLACES = {
    "at the top": lambda content, malice: malice,
    "beside the weights": lambda content, malice: {**content, "callbacks": malice},
    "among the weights": lambda content, malice: {**content, "state_dict": {**content["state_dict"], "V.x": malice}},
    "in the config": lambda content, malice: {**content, KEY: {**content[KEY], "config": malice}},
}


@pytest.mark.parametrize("write", [as_zip, as_legacy, as_pickle])
@pytest.mark.parametrize("place", PLACES)
def test_malicious_pickle_executes_nothing(place, write, tmp_path, content):
    path, marker = tmp_path / "malicious.ckpt", tmp_path / "executed"
    write(PLACES[place](content, Malice(marker)), path)
    with pytest.raises(CheckpointError) as raised:
        lyapnet.load(path)
    is_one_line_that_names(path, raised.value)
    assert not marker.exists()
    # the twin: the same file is malicious indeed
    with path.open("rb") as file:
        pickle.load(file) if write is as_pickle else torch.load(file, weights_only=False)
    assert marker.exists()


@pytest.fixture
def trap(tmp_path, monkeypatch):
    """The name of a module that leaves a mark when it is imported, and the mark."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    marker = tmp_path / "imported"
    (tmp_path / "trap.py").write_text(
        f"import os\nos.mkdir({str(marker)!r})\nfrom lyapnet.systems import DoubleIntegrator as Class\n"
        "from lyapnet.networks import FCN as Network\n"
    )
    importlib.invalidate_caches()
    yield "trap", marker
    sys.modules.pop("trap", None)


@pytest.mark.parametrize(("section", "cls"), [("system", "Class"), ("network", "Network")])
def test_class_that_a_checkpoint_names_is_not_imported(section, cls, trap, tmp_path, content):
    module, marker = trap
    path = tmp_path / "own.ckpt"
    content[KEY]["config"][section]["name"] = f"{module}:{cls}"
    write_checkpoint(content, path)
    with pytest.raises(UsageError, match=f"Expected {section}=") as raised:
        lyapnet.load(path)
    assert f"{module}:{cls}" in str(raised.value)
    assert not marker.exists()
    # the twin: building what the config names does import it
    config = load_config(CONF / "double_integrator.yaml", [*SMALL, f"{section}.name={module}:{cls}"])
    build_value_function(config, build_problem(config))
    assert marker.exists()


@pytest.mark.parametrize("key", ["rollout.policy", "program.name", "cost.R", "network.activation", "trainer"])
def test_no_other_name_in_a_checkpoint_is_imported(key, trap, tmp_path, content):
    module, marker = trap
    *sections, name = key.split(".")
    section = content[KEY]["config"]
    for part in sections:
        section = section[part]
    section[name] = {"callbacks": f"{module}:Class"} if name == "trainer" else f"{module}:Class"
    write_checkpoint(content, tmp_path / "own.ckpt")
    if name == "trainer":  # not read here
        lyapnet.load(tmp_path / "own.ckpt")
    else:
        with pytest.raises(LyapnetError):
            lyapnet.load(tmp_path / "own.ckpt")
    assert not marker.exists()


# All or nothing


def finds_no_space(descriptor):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def assert_untouched(path, before):
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == [path.name]
    lyapnet.load(path)


def test_failed_write_keeps_the_previous_checkpoint(path, content, monkeypatch):
    before = path.read_bytes()
    monkeypatch.setattr(os, "fsync", finds_no_space)
    with pytest.raises(CheckpointError) as raised:
        write_checkpoint({**content, "global_step": 8}, path)
    is_one_line_that_names(path, raised.value)
    assert "No space left on device" in str(raised.value)
    assert_untouched(path, before)
    monkeypatch.undo()
    write_checkpoint({**content, "global_step": 8}, path)
    assert read_checkpoint(path)["global_step"] == 8


def test_file_that_outgrows_the_disk_keeps_the_previous_checkpoint(path, content):
    """The kernel itself refuses the write: a limit on the size of files stands for the full disk."""
    before = path.read_bytes()
    _, hard = limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) // 2, hard))
    try:
        with pytest.raises(CheckpointError) as raised:
            write_checkpoint({**content, "global_step": 8}, path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    is_one_line_that_names(path, raised.value)
    assert_untouched(path, before)


def test_folder_that_cannot_be_made_is_one_line(tmp_path, content):
    (tmp_path / "file").touch()
    with pytest.raises(CheckpointError) as raised:
        write_checkpoint(content, tmp_path / "file" / "last.ckpt")
    is_one_line_that_names(tmp_path / "file" / "last.ckpt", raised.value)


KILLED_WHILE_WRITING = """
import os, signal, sys, torch
from lyapnet.checkpoint import write_checkpoint
os.fsync = lambda descriptor: os.kill(os.getpid(), signal.SIGKILL)
write_checkpoint({"state_dict": {"V.x": torch.zeros(9)}}, sys.argv[1])
"""


def test_kill_while_writing_keeps_the_previous_checkpoint_and_the_next_write_tidies_up(path, content):
    before = path.read_bytes()
    killed = subprocess.run([sys.executable, "-c", KILLED_WHILE_WRITING, path], check=False)
    assert killed.returncode == -signal.SIGKILL
    assert path.read_bytes() == before
    write_checkpoint(content, path)
    assert_untouched(path, path.read_bytes())


# Weights that do not fit


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        (["network.hidden=[4, 6]"], ["network.through.1.weight has shape (4, 2) in the checkpoint and (6, 2)"]),
        (["network.hidden=[4]"], ["network.shift.1.weight is only in the checkpoint"]),
        (["network.hidden=[4, 4, 4]"], ["network.shift.2.weight is only in the config"]),
        (["network.name=fcn"], ["hidden.0.weight is only in the config", "is only in the checkpoint"]),
    ],
)
def test_weights_that_do_not_fit_are_named(changes, named, tmp_path, content):
    path = tmp_path / "other.ckpt"
    config = load_config(CONF / "double_integrator.yaml", [*SMALL, *changes])
    write_checkpoint({**content, KEY: {"config": to_plain(config), "version": "0"}}, path)
    with pytest.raises(CheckpointError) as raised:
        lyapnet.load(path)
    is_one_line_that_names(path, raised.value)
    for name in named:
        assert name in str(raised.value)


def test_states_that_are_ignored_are_so_after_loading(tmp_path):
    names = ["network.ignored_states=[cart position]", "network.name=anchored", *SMALL]
    content = content_of(load_config(CONF / "cartpole_balancing.yaml", names))
    path, x = tmp_path / "ignoring.ckpt", torch.randn(5, 4)
    write_checkpoint(content, path)
    V = lyapnet.load(path).V.double()
    assert torch.equal(V(torch.tensor(0.1), x), V(torch.tensor(0.1), x + torch.tensor([9.0, 0.0, 0.0, 0.0])))
    assert not torch.allclose(V(torch.tensor(0.1), x), V(torch.tensor(0.1), x + torch.tensor([0.0, 9.0, 0.0, 0.0])))
    weights = {f"V.{name}": weight for name, weight in V.state_dict().items()}
    assert all(torch.equal(weights[name], weight.double()) for name, weight in content["state_dict"].items())
    content[KEY]["config"]["network"]["ignored_states"] = []
    write_checkpoint(content, path)
    with pytest.raises(CheckpointError, match="only in the config"):
        lyapnet.load(path)

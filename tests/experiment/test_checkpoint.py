"""Checkpoint files: whole or refused, never executed, written all or nothing."""

import errno
import importlib
import io
import logging
import os
import pickle
import random
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
from lyapnet.base.errors import CheckpointError, LyapnetError, UsageError
from lyapnet.experiment.assembly import build_problem, build_value_function
from lyapnet.experiment.checkpoint import DIGEST, KEY, digest_of, read_checkpoint, write_checkpoint
from lyapnet.experiment.config import load_config, to_plain

CONF = Path(__file__).parents[2] / "conf"
SMALL = ["network.hidden=[4, 4]", "horizon.steps=5"]


def content_of(config):
    """What a checkpoint of a run with this config holds, with fresh weights."""
    V = build_value_function(config, build_problem(config))
    weights = {f"V.{name}": tensor for name, tensor in V.state_dict().items()}
    return {"state_dict": weights, "global_step": 7, KEY: {"config": to_plain(config), "version": "0"}}


@pytest.fixture
def content():
    return content_of(load_config(CONF / "from_scratch" / "double_integrator.yaml", SMALL))


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
    assert lyapnet.load(path).config == load_config(CONF / "from_scratch" / "double_integrator.yaml", SMALL)


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


def test_a_config_in_the_place_of_a_checkpoint_is_refused(tmp_path):
    """By its name, before it is read: an empty one is no damaged checkpoint either."""
    for content in ("horizon: {steps: 10}", ""):
        (tmp_path / "experiment.yaml").write_text(content)
        with pytest.raises(
            UsageError, match=r"Expected a checkpoint file, got '.*experiment.yaml', which is a config; "
        ):
            read_checkpoint(tmp_path / "experiment.yaml")


def test_folder_is_refused(tmp_path):
    with pytest.raises(UsageError) as raised:
        lyapnet.load(tmp_path)
    is_one_line_that_names(tmp_path, raised.value)


# A changed bit is noticed


@pytest.fixture
def trained(content):
    """The content with what a training adds: the state of an optimizer, of callbacks, of loops."""
    weights = list(content["state_dict"].values())
    state = {i: {"step": torch.tensor(7.0), "exp_avg": w / 3, "exp_avg_sq": w * w} for i, w in enumerate(weights)}
    groups = [{"lr": 1e-3, "betas": (0.9, 0.99), "weight_decay": 0, "params": list(state)}]
    callbacks = {"Checkpoints": {"best_loss": 0.25}, "Stopwatch": {"seconds": 1.5}}
    return {**content, "optimizer_states": [{"state": state, "param_groups": groups}], "callbacks": callbacks}


def flip(whole, bit):
    flipped = bytearray(whole)
    flipped[bit // 8] ^= 1 << bit % 8
    return bytes(flipped)


def bits_of_tensors(whole):
    """Where the bits of tensors are in a torch file."""
    with zipfile.ZipFile(io.BytesIO(whole)) as archive:
        for entry in archive.infolist():
            if "/data/" in entry.filename:
                begin = whole.index(archive.read(entry), entry.header_offset)
                yield range(8 * begin, 8 * (begin + entry.file_size))


def used(path, whole):
    """Whether a file is read, and then whether its content is that of the whole one."""
    before = digest_of(read_checkpoint(whole))
    try:
        return True, digest_of(read_checkpoint(path)) == before
    except CheckpointError as error:
        is_one_line_that_names(path, error)
        return False, False


@pytest.mark.parametrize("digest", [True, False])
def test_flipped_bits_are_never_used_in_silence(digest, trained, tmp_path):
    """40 anywhere, and 20 in tensors. A file without a digest has the checksums of its archive at least."""
    good, bad, chance = tmp_path / "good.ckpt", tmp_path / "bad.ckpt", random.Random(0)
    write_checkpoint(trained, good) if digest else torch.save(trained, good)
    whole = good.read_bytes()
    tensors = list(bits_of_tensors(whole))
    anywhere = [chance.randrange(8 * len(whole)) for _ in range(40)]
    for bit in anywhere:
        bad.write_bytes(flip(whole, bit))
        read, equal = used(bad, good)
        assert equal or not read, bit
    for bit in [chance.choice(chance.choice(tensors)) for _ in range(20)]:
        bad.write_bytes(flip(whole, bit))
        assert used(bad, good) == (False, False), bit
        assert torch.load(bad, weights_only=True).keys() >= trained.keys(), "the twin: torch itself takes it"


def test_an_entry_that_says_it_is_a_folder_is_refused(trained, tmp_path):
    """Without a digest: torch would read what was in memory for its tensor. The checksums hold."""
    good, bad = tmp_path / "good.ckpt", tmp_path / "bad.ckpt"
    torch.save(trained, good)
    whole = bytearray(good.read_bytes())
    entry = whole.rindex(b"PK\x01\x02", 0, whole.rindex(b"/data/3"))
    whole[entry + 38] = 0x10
    bad.write_bytes(whole)
    assert zipfile.ZipFile(bad).testzip() is None
    assert used(good, good) == (True, True)
    assert used(bad, good) == (False, False)


CHANGES = {
    "a weight": lambda c: c["state_dict"][next(iter(c["state_dict"]))].view(-1)[0].add_(1e-15),
    "a sign of zero": lambda c: c["optimizer_states"][0]["param_groups"][0].update(weight_decay=-0.0),
    "a type": lambda c: c["optimizer_states"][0]["param_groups"][0].update(weight_decay=False),
    "a tuple": lambda c: c["optimizer_states"][0]["param_groups"][0].update(betas=[0.9, 0.99]),
    "an optimizer's state": lambda c: c["optimizer_states"][0]["state"][1]["exp_avg_sq"].mul_(2),
    "a callback's state": lambda c: c["callbacks"]["Checkpoints"].update(best_loss=0.26),
    "the config": lambda c: c[KEY]["config"]["system"].update(name="pendulum"),
    "a further key": lambda c: c.update(further=1),
    "a shape": lambda c: c["state_dict"].update({k: w.reshape(-1) for k, w in c["state_dict"].items()}),
    "a dtype": lambda c: c["state_dict"].update({k: w.view(torch.int64) for k, w in c["state_dict"].items()}),
    "the digest": lambda c: c.update({DIGEST: "0" * 64}),
    "the digest's type": lambda c: c.update({DIGEST: 0}),
}


@pytest.mark.parametrize("change", CHANGES)
def test_content_that_was_changed_is_refused(change, trained, path):
    write_checkpoint(trained, path)
    content = torch.load(path, weights_only=True)
    torch.save(content, path)
    read_checkpoint(path)  # the twin: saved again as it was
    CHANGES[change](content)
    torch.save(content, path)
    with pytest.raises(CheckpointError, match="changed or damaged") as raised:
        lyapnet.load(path)
    is_one_line_that_names(path, raised.value)


def test_checkpoint_without_a_digest_loads_with_a_note(content, path, caplog):
    with caplog.at_level(logging.WARNING):
        read_checkpoint(path)
        assert not caplog.messages
        torch.save(content, path)
        lyapnet.load(path)
        lyapnet.load(path)
    (note,) = caplog.messages
    assert str(path) in note
    assert "no digest" in note


def test_digest_is_of_the_content_alone():
    """Not of the order of keys, of strides or of a device; expanded tensors take no memory for it."""
    a, b = torch.arange(6.0).view(2, 3), torch.arange(6.0).view(2, 3).mT.contiguous().mT
    assert digest_of({"x": 1, "y": a}) == digest_of({"y": b, "x": 1})
    assert digest_of(a) != digest_of(a.mT)
    assert digest_of([a]) != digest_of((a,))
    assert digest_of({"x": [1, 2], "y": []}) != digest_of({"x": [1], "y": [2]})
    assert len({digest_of(torch.ones(1, dtype=torch.int8).expand(n)) for n in (2, 10**15)}) == 2
    for value in (
        torch.zeros(0),
        torch.tensor(1j),
        torch.tensor(True),
        torch.ones(2).bfloat16(),
        torch.eye(2).to_sparse(),
    ):
        assert digest_of(value) == digest_of(value.clone()) != digest_of(torch.zeros(9))


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
        f"import os\nos.mkdir({str(marker)!r})\nfrom lyapnet.task.systems import DoubleIntegrator as Class\n"
        "from lyapnet.value.networks import FCN as Network\n"
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
    config = load_config(CONF / "from_scratch" / "double_integrator.yaml", [*SMALL, f"{section}.name={module}:{cls}"])
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
from lyapnet.experiment.checkpoint import write_checkpoint
os.fsync = lambda descriptor: os.kill(os.getpid(), signal.SIGKILL)
write_checkpoint({"state_dict": {"V.x": torch.zeros(9)}}, sys.argv[1])
"""


def test_writes_at_the_same_time_do_not_meet(content, path, monkeypatch):
    """A second write begins while the first has yet to be named: both end, and the file is one of theirs."""
    fsync = os.fsync

    def meanwhile(descriptor):
        monkeypatch.setattr(os, "fsync", fsync)
        write_checkpoint({**content, "global_step": 8}, path)
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", meanwhile)
    write_checkpoint({**content, "global_step": 9}, path)
    assert read_checkpoint(path)["global_step"] == 9
    assert [p.name for p in path.parent.iterdir()] == [path.name]


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
    config = load_config(CONF / "from_scratch" / "double_integrator.yaml", [*SMALL, *changes])
    write_checkpoint({**content, KEY: {"config": to_plain(config), "version": "0"}}, path)
    with pytest.raises(CheckpointError) as raised:
        lyapnet.load(path)
    is_one_line_that_names(path, raised.value)
    for name in named:
        assert name in str(raised.value)


def test_states_that_are_ignored_are_so_after_loading(tmp_path):
    names = ["network.ignored_states=[cart position]", "network.name=anchored", *SMALL]
    content = content_of(load_config(CONF / "from_scratch" / "cartpole_balancing.yaml", names))
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


# What is said of files


def test_an_empty_checkpoint_says_so(tmp_path):
    (tmp_path / "empty.ckpt").write_bytes(b"")
    with pytest.raises(CheckpointError, match=r"empty\.ckpt', which is empty; use another"):
        read_checkpoint(tmp_path / "empty.ckpt")


def test_a_full_disk_claims_no_checkpoint_that_is_not_there(tmp_path, monkeypatch):
    def full(path, content):
        raise OSError(28, "No space left on device")

    path = tmp_path / "last.ckpt"
    monkeypatch.setattr("lyapnet.experiment.checkpoint.write_atomically", full)
    with pytest.raises(CheckpointError, match=r"No space left .*: there is no earlier one yet\.$"):
        write_checkpoint({}, path)
    path.touch()
    with pytest.raises(CheckpointError, match=r"No space left .*: the previous checkpoint is untouched\.$"):
        write_checkpoint({}, path)

"""Files that hang, kill or mislead a careless reader: each is refused in one line and two seconds, and runs nothing."""

import hashlib
import io
import os
import pickle
import signal
import socket
import sys
import time
import zipfile
from contextlib import chdir
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch

import lyapnet
from lyapnet.base.files import open_for_appending
from lyapnet.cli import main
from lyapnet.exchange.importing.onnx_file import read_onnx
from lyapnet.experiment.checkpoint import KEY, read_checkpoint
from lyapnet.prover.boxes import CutTree
from lyapnet.prover.kept_proofs import FORMAT, read_proofs, write_proofs
from tests.exchange.importing.models import linear, onnx
from tests.marks import sample

SECONDS = 2.0  # of this process, which other work of the machine does not lengthen
HANGS = 60  # wall seconds after which it is taken to wait for ever
ZOO = "zoo:double_integrator"
READERS = {  # what reads FILE
    "config": ["train", "--config", "FILE"],
    "checkpoint": ["evaluate", "FILE", "--samples", "2"],
    "proof": ["view", ZOO, "--out", "page.html", "--proof", "FILE"],
    "onnx": ["certify", "region", "task.yaml", "--value", "FILE", "--law", "FILE", "--seconds", "1"],
    "measurements": ["identify", "plant.yaml", "FILE", "--out", "found.yaml"],
    "points": ["train", "--config", "small.yaml", "pointwise.weight=1", "pointwise.counterexamples=FILE"],
}
TASK = """
system: {name: pendulum}
initial_states: {lower: [-0.1, -0.1], upper: [0.1, 0.1]}
"""
SMALL = """
experiment: small
system: {name: double_integrator}
cost: {Q: [1, 1], R: [1], Q_T: [1, 1]}
initial_states: {lower: [-1, -1], upper: [1, 1]}
horizon: {steps: 4, dt: 0.1}
"""
PLANT = f"{TASK}horizon: {{steps: 4, dt: 0.1}}\n"


class Answer(NamedTuple):
    """What came of a command."""

    status: int
    lines: list[str]
    left: set[str]  # names that were not there


@pytest.fixture(scope="module", autouse=True)
def _imported(tmp_path_factory):
    """What the commands import takes its seconds once, before they are counted."""
    from lyapnet.claims import checking
    from lyapnet.training import experiment

    assert checking, experiment
    lyapnet.load(ZOO)
    with chdir(tmp_path_factory.mktemp("first")):
        Path("task.yaml").write_text(TASK)
        Path("foreign").write_bytes(b"\x00nothing")
        assert main([argument.replace("FILE", "foreign") for argument in READERS["onnx"]]) != 0


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with configs that are sound, and a module that leaves a mark when it is imported."""
    (tmp_path / "task.yaml").write_text(TASK)
    (tmp_path / "small.yaml").write_text(SMALL)
    (tmp_path / "plant.yaml").write_text(PLANT)
    (tmp_path / "trap.py").write_text("import os\nos.mkdir('executed')\nclass Class: pass\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    yield tmp_path
    sys.modules.pop("trap", None)


def answer(reader, name, capsys):
    """What a command makes of the file of that name, alone with it in a folder."""
    before, began = {path.name for path in Path().iterdir()}, time.process_time()
    earlier = signal.signal(signal.SIGALRM, _hangs)
    signal.alarm(HANGS)
    try:
        status = main([argument.replace("FILE", name) for argument in READERS[reader]])
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, earlier)
    assert time.process_time() - began < SECONDS
    return Answer(status, capsys.readouterr().err.splitlines(), {path.name for path in Path().iterdir()} - before)


def _hangs(number, frame):
    raise TimeoutError(f"no answer within {HANGS} s")


def assert_refused(got):
    assert got.status in (1, 2), got
    assert not got.left - {"__pycache__"}, got
    (line,) = got.lines
    assert line.startswith("error: Expected"), line
    assert ", got" in line
    assert line.isprintable()


# What is no file


def make_socket(path):
    here = Path.cwd()
    with socket.socket(socket.AF_UNIX) as opened:  # its path may be no longer than 107 bytes
        os.chdir(path.parent)
        opened.bind(path.name)
        os.chdir(here)


def make_loop(path):
    path.symlink_to("other")
    path.with_name("other").symlink_to(path.name)


def make_sparse(path):
    with path.open("wb") as file:
        file.truncate(2**43)


NO_FILES = {
    "fifo": os.mkfifo,
    "link to a fifo": lambda path: (os.mkfifo("pipe"), path.symlink_to("pipe")),
    "socket": make_socket,
    "/dev/zero": lambda path: path.symlink_to("/dev/zero"),
    "/dev/null": lambda path: path.symlink_to("/dev/null"),
    "folder": Path.mkdir,
    "loop of links": make_loop,
    "8 TB of nothing": make_sparse,
    "empty": Path.touch,
    "one byte": lambda path: path.write_bytes(b"\x00"),
}


@pytest.mark.parametrize("reader", sample(READERS, 3))
@pytest.mark.parametrize("kind", NO_FILES)
def test_what_is_no_file_is_refused_at_once(kind, reader, folder, capsys):
    NO_FILES[kind](folder / "thing")
    assert_refused(answer(reader, "thing", capsys))


# Texts


def lines_of(first, line):
    """Twelve lines, each of which names the one before nine times."""
    named = (line.format(i + 1, ", ".join([f"*a{i}"] * 9)) for i in range(12))
    return "\n".join([first, *named])


YAMLS = {
    "billion laughs": lines_of("a0: &a0 [x, x]", "a{0}: &a{0} [{1}]"),
    "merged laughs": lines_of("a0: &a0 {x: 1}", "a{0}: &a{0} {{<<: [{1}]}}"),
    "in itself": "experiment: &a [*a]\n",
    "deep": "experiment: " + "[" * 5000,
    "deep and closed": "experiment: " + "[" * 5000 + "]" * 5000,
    "deep mappings": "experiment: " + "{a: " * 5000,
    "cut": SMALL[:-12],
    "huge number": f"{SMALL}seed: {'9' * 5000}\n",
    "python": "experiment: !!python/object/apply:os.mkdir [executed]\n",
    "module": "experiment: !!python/module:trap\n",
    "environment": f"{SMALL}logs: ${{oc.env:NO_SUCH_VARIABLE}}\n",
    "out of its folder": SMALL.replace("small", "../../small"),
    "absolute": SMALL.replace("small", "/tmp/small"),
    "control characters": SMALL.replace("small", '"a\\u001b[31m\\nb"'),
    "two documents": f"{SMALL}---\n{SMALL}",
    "latin": SMALL.replace("small", "\udce9"),
    "no text": SMALL.replace("small", "\x00\x01"),
    "binary key": f"{SMALL}? !!binary aGVsbG8=\n: 1\n",
    "17 MB": SMALL + "#" * 17_000_000,
}  # fmt: skip
POINTS = {
    "a huge field": "t,a,b\n" + "9" * 200_000,
    "a quote": 't,a,b\n"' + "1," * 100_000,
    "ragged": "t,a,b\n1,2,3\n1,2\n",
    "not finite": "t,a,b\nnan,inf,1\n",
    "no text": "\udce9",
    "a formula": "t,a,b\n=cmd|'/C calc'!A0,1,1\n",
}


@pytest.mark.parametrize(
    ("reader", "text"),
    [*(("config", text) for text in YAMLS.values()), *(("points", text) for text in POINTS.values())],
    ids=[*YAMLS, *(f"points, {name}" for name in POINTS)],
)
def test_texts(reader, text, folder, capsys):
    (folder / "text").write_bytes(text.encode(errors="surrogateescape"))
    assert_refused(answer(reader, "text", capsys))


# Measurements

STEADY = "".join(f"{0.1 * k:g},0,0\n" for k in range(40))
MEASUREMENTS = {  # a file ↦ what is said of it
    "a huge field": (POINTS["a huge field"], "larger than field limit"),
    "a quote": (POINTS["a quote"], "separate numbers by commas"),
    "ragged": (POINTS["ragged"], "Expected 3 numbers in row 3"),
    "no text": ("\udce9", "a CSV file of text"),
    "41 million rows": ("t,torque,angle\n" + "\n" * 41_000_000, "more than 4e+07"),
    "too many rows": ("t,torque,angle\n" + "0,0,0\n" * 200_001, "200002 rows and more"),
    "three rows": ("t,torque,angle\n0,0,0\n1,0,0\n2,0,0\n", "Expected 8 samples or more in each file"),
    "no time": (f"a,torque,angle\n{STEADY}", "a column for t in"),
    "no control": (
        f"t,torq,angle\n{STEADY}",
        "a column for torque in 'text', got 't, torq, angle'; did you mean torq?",
    ),
    "no reading": (f"t,torque,angel\n{STEADY}", "a column for one of angle, velocity"),
    "a state twice": (f"t,angle,angle [deg],torque\n{STEADY.replace(',0,', ',0,0,')}", "Expected angle once"),
    "unsorted": (f"t,torque,angle\n{STEADY}0.5,0,0\n", "got 0.5 s after 3.9 s in row 42"),
    "a time twice": (f"t,torque,angle\n0,0,0\n{STEADY}", "got 0 s after 0 s in row 3"),
    "another unit": (f"t,torque,angle [m]\n{STEADY}", "in a unit of its kind (rad, deg, °, rev), got 'm'"),
    "not a number": (f"t,torque,angle\n{STEADY}9,0,nan\n", "got 'nan' for angle in row 42"),
    "infinite": (f"t,torque,angle\n{STEADY}9,-inf,0\n", "got '-inf' for torque in row 42"),
    "nothing": (f"t,torque,angle\n{STEADY}9,0,\n", "got '' for angle in row 42"),
    "beyond": (f"t,torque,angle\n{STEADY}9,0,1e308\n", "numbers below 1e+30 for angle"),
    "a step of years": (f"t,torque,angle\n-1e29,1e9,0\n{STEADY}", "Expected data that the config's model"),
    "control characters": (f"t,torque,\x1b[31m\x07\n{STEADY}", "one of angle, velocity"),
    "names": (",".join(map(str, range(100_000))), "got 1 rows"),
}


@pytest.mark.parametrize("kind", MEASUREMENTS)
def test_measurements(kind, folder, capsys):
    text, expected = MEASUREMENTS[kind]
    (folder / "text").write_bytes(text.encode(errors="surrogateescape"))
    got = answer("measurements", "text", capsys)
    assert_refused(got)
    assert expected in got.lines[0]


# Archives


class Malice:
    """Unpickling this makes a folder."""

    def __reduce__(self):
        return os.mkdir, ("executed",)


def saved(content):
    with io.BytesIO() as file:
        torch.save(content, file)
        return file.getvalue()


def changed(change):
    """The bytes of a checkpoint with something else in it."""
    content = read_checkpoint(ZOO)
    change(content)
    return saved(content)


def archive(pickled, compression=zipfile.ZIP_STORED, **more):
    """A torch archive of this pickle and further entries, without their checksums."""
    with io.BytesIO() as file:
        with zipfile.ZipFile(file, "w", compression) as opened:
            for name, entry in {"data.pkl": pickled, "byteorder": b"little", "version": b"3\n", **more}.items():
                opened.writestr(f"archive/{name}", entry)
        return file.getvalue()


def laughs():
    shared = ["x"]
    for _ in range(40):
        shared = [shared] * 9
    return shared


def in_itself():
    found = []
    found.append(found)
    return found


def lying_about_sizes():
    """An archive whose directory says that its first entry has 2 GB."""
    content = bytearray(saved(read_checkpoint(ZOO)))
    at = content.find(b"PK\x01\x02")
    content[at + 20 : at + 28] = (2**31 - 1).to_bytes(4, "little") * 2
    return bytes(content)


def deep():
    found = ["x"]
    for _ in range(300):
        found = [found]
    pickled = pickle.dumps({KEY: {}, "state_dict": {}})
    return pickled[:-1] + b"]" * 100_000 + b"a" * 99_999 + b"."


TENSOR = torch.zeros(1).expand(10**6, 10**6)
CHECKPOINTS = {
    "a pickle": lambda: pickle.dumps(Malice()),
    "malice": lambda: archive(pickle.dumps(Malice())),
    "malice in weights": lambda: changed(lambda c: c["state_dict"].update({"V.x": Malice()})),
    "malice in the config": lambda: changed(lambda c: c[KEY].update(config=Malice())),
    "a module in the config": lambda: changed(lambda c: c[KEY]["config"]["system"].update(name="trap:Class")),
    "the environment": lambda: changed(lambda c: c[KEY]["config"].update(logs="${oc.env:HOME}")),
    "a bomb": lambda: archive(bytes(3 * 10**7), zipfile.ZIP_DEFLATED),
    "lying sizes": lying_about_sizes,
    "laughs": lambda: changed(lambda c: c.update(x=laughs())),
    "laughs in the config": lambda: changed(lambda c: c[KEY].update(config=laughs())),
    "in itself": lambda: changed(lambda c: c.update(x=in_itself())),
    "deep": lambda: archive(deep()),
    "a tensor of 10¹²": lambda: changed(lambda c: c.update(x=TENSOR)),
    "weights of 10¹²": lambda: changed(lambda c: c.update(state_dict=dict.fromkeys(c["state_dict"], TENSOR))),
    "no storage": lambda: archive(pickle.dumps({KEY: {}, "state_dict": {}}), data=b""),
    "a name that leaves": lambda: archive(pickle.dumps({}), **{"../../../left": b"x"}),
    "cut": lambda: saved(read_checkpoint(ZOO))[:-3000],
    "numpy": lambda: npz(),
}  # fmt: skip


def npz():
    with io.BytesIO() as file:
        np.savez(file, x=np.array([Malice()], dtype=object))
        return file.getvalue()


@pytest.mark.parametrize("kind", CHECKPOINTS)
def test_checkpoints(kind, folder, capsys):
    (folder / "evil.ckpt").write_bytes(CHECKPOINTS[kind]())
    assert_refused(answer("checkpoint", "evil.ckpt", capsys))
    assert not (folder / "executed").exists()


# Proofs


def chained(payload):
    """A proof with the digest that belongs to it."""
    return FORMAT + hashlib.sha256(payload).digest() + payload


PROOFS = {
    "another digest": lambda: FORMAT + bytes(32) + saved({}),
    "only a head": lambda: FORMAT + hashlib.sha256(b"").digest(),
    "a pickle": lambda: chained(pickle.dumps(Malice())),
    "malice": lambda: chained(archive(pickle.dumps(Malice()))),
    "malice in a proof": lambda: chained(saved({"above": Malice()})),
    "a bomb": lambda: chained(archive(bytes(3 * 10**7), zipfile.ZIP_DEFLATED)),
    "laughs": lambda: chained(saved({"above": laughs()})),
    "in itself": lambda: chained(saved({"above": in_itself()})),
    "a tensor of 10¹²": lambda: chained(saved({"above": {"node": TENSOR, "of": []}})),
    "a list": lambda: chained(saved([])),
    "no proof by name": lambda: chained(saved({"os": {}})),
    "an empty proof": lambda: chained(saved({"above": {}})),
    "of nothing": lambda: chained(saved({"above": {"of": [{}], "node": torch.zeros(3), "axis": torch.zeros(9)}})),
}


@pytest.mark.parametrize("kind", sample(PROOFS, 3))
def test_proofs(kind, folder, capsys):
    (folder / "evil.proof").write_bytes(PROOFS[kind]())
    assert_refused(answer("proof", "evil.proof", capsys))
    assert not (folder / "executed").exists()


def test_a_proof_of_boxes_cut_without_end_is_refused():
    node = torch.cat([torch.zeros(1), 1 + 2 * torch.arange(30_000)]).long()
    lower, upper = torch.zeros(2).double(), torch.ones(2).double()
    with pytest.raises(ValueError, match="Expected cuts"):
        CutTree(node, torch.zeros(len(node))).leaves(lower, upper)
    assert len(CutTree(node[:500], torch.zeros(500)).leaves(lower, upper).key) == 501  # the twin


# ONNX files and what lies beside them


def beside(location, *, offset=0, length=16, attribute=False):
    """A law whose gains lie in a file that it names."""
    model = linear([[1.0], [1.0]])
    (gains,) = model.graph.initializer
    shape = [*gains.dims]
    gains.ClearField("raw_data")
    gains.data_location = onnx.TensorProto.EXTERNAL
    for key, value in {"location": location, "offset": offset, "length": length}.items():
        gains.external_data.add(key=key, value=str(value))
    if attribute:
        node = onnx.helper.make_node("Constant", [], [gains.name], value=gains)
        del model.graph.initializer[:]
        model.graph.node.insert(0, node)
    assert shape
    return model.SerializeToString()


def lying(dims, data=bytes(16)):
    model = linear([[1.0], [1.0]])
    (gains,) = model.graph.initializer
    gains.dims[:], gains.raw_data = dims, data
    return model.SerializeToString()


ONNX = {
    "above its folder": lambda: beside("../secret"),
    "far above": lambda: beside("../" * 30 + "etc/passwd"),
    "absolute": lambda: beside("/etc/passwd"),
    "a link that leaves": lambda: beside("link"),
    "a fifo": lambda: beside("fifo"),
    "a fifo of a node": lambda: beside("fifo", attribute=True),
    "zeros without end": lambda: beside("zeros"),
    "zeros of a node": lambda: beside("zeros", attribute=True),
    "a folder": lambda: beside("."),
    "nothing": lambda: beside(""),
    "a line": lambda: beside("a\nb"),
    "beyond its end": lambda: beside("short", offset=10**15),
    "before its beginning": lambda: beside("short", offset=-8),
    "longer than it is": lambda: beside("short", length=10**15),
    "another length": lambda: beside("short", length=8),
    "itself": lambda: beside("evil.onnx"),
    "10¹² numbers": lambda: lying([10**6, 10**6]),
    "10¹² numbers of none": lambda: lying([10**6, 10**6], b""),
    "fewer than none": lambda: lying([-2, 1]),
    "a pickle": lambda: pickle.dumps(Malice()),
    "a torch file": lambda: archive(pickle.dumps(Malice())),
    "cut": lambda: linear([[1.0], [1.0]]).SerializeToString()[:-40],
    "noise": lambda: np.random.default_rng(0).bytes(5000),
    "deep": lambda: b"\x3a\xff\xff\x03" * 20_000,
}


@pytest.mark.parametrize("kind", sample(ONNX, 3))
def test_onnx_files(kind, folder, capsys):
    (folder.parent / "secret").write_bytes(bytes(16))
    (folder / "link").symlink_to("../secret")
    (folder / "zeros").symlink_to("/dev/zero")
    (folder / "short").write_bytes(bytes(16))
    os.mkfifo(folder / "fifo")
    (folder / "evil.onnx").write_bytes(ONNX[kind]())
    assert_refused(answer("onnx", "evil.onnx", capsys))
    assert not (folder / "executed").exists()


# Names

NAMES = ["a\nb", "\x1b[31mred", "<script>alert(1)<", "[bold]", "a\rb", "%s%n", "$(touch executed)",
         "'; touch executed'", "\u202egnp", "x" * 250, "${oc.env:HOME}", "a=b"]  # fmt: skip


@pytest.mark.parametrize("reader", ["config", "checkpoint", "onnx"])
@pytest.mark.parametrize("name", sample(NAMES, 3))
def test_names(name, reader, folder, capsys):
    (folder / name).write_bytes(b"\x00nothing")
    got = answer(reader, name, capsys)
    assert_refused(got)
    assert not (folder / "executed").exists()


def test_what_is_appended_goes_through_no_link(folder):
    Path("victim").write_text("mine\n")
    Path("draws.jsonl").symlink_to("victim")
    os.mkfifo("fifo")
    for path in (Path("draws.jsonl"), Path("fifo"), Path()):
        with (
            pytest.raises(OSError, match=r"symbolic link|fifo|No such device|directory"),
            open_for_appending(path) as file,
        ):
            file.write("theirs\n")
    assert Path("victim").read_text() == "mine\n"
    with open_for_appending(Path("victim")) as file:  # the twin
        file.write("more\n")
    assert Path("victim").read_text() == "mine\nmore\n"


@pytest.mark.gate
def test_what_is_sound_is_read(folder):
    """The twins: what stands in the files is what is wrong with them."""
    (folder / "law.onnx").write_bytes(beside("short"))
    (folder / "short").write_bytes(np.ones(2).tobytes())
    assert read_onnx(Path("law.onnx")).digests.keys() == {"law.onnx", "short"}
    (folder / "law.onnx").write_bytes(beside("short", attribute=True))
    assert read_onnx(Path("law.onnx")).digests.keys() == {"law.onnx", "short"}
    (folder / "good.ckpt").write_bytes(changed(lambda c: c.update(x=[["x"] * 9] * 9)))
    assert main(["evaluate", "good.ckpt", "--samples", "2", "--no-optimum"]) == 0
    write_proofs(Path("good.proof"), {"above": {"of": [], "node": torch.zeros(3)}})
    assert read_proofs(Path("good.proof")).keys() == {"above"}

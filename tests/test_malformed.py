"""Malformed inputs of every kind, drawn from a seed: each is refused in one line, and leaves nothing behind."""

import copy
import dataclasses
import random
import re
import shutil
import signal
import sys
import time
from pathlib import Path
from typing import NamedTuple, get_args

import pytest
import torch
import yaml

from lyapnet.base import sizes
from lyapnet.cli import main
from lyapnet.experiment.config import Config
from tests.marks import at_the_gate

SECONDS = 20
BASE = {
    "experiment": "small", "loggers": ["csv"],
    "program": {"name": "lyapunov", "margin": 0.1}, "system": {"name": "double_integrator"},
    "cost": {"Q": [1, 1], "R": [1], "Q_T": [1, 1]}, "initial_states": {"lower": [-1, -1], "upper": [1, 1]},
    "horizon": {"steps": 4, "dt": 0.1}, "network": {"name": "anchored", "hidden": [4]},
    "training": {"iterations": 1, "batch_size": 2},
    "evaluation": {"validation_states": 2, "test_states": 2, "optimum": False},
}  # fmt: skip
FORM = re.compile(r"error: .*Expected .+, got.+[;:,] .+[.?]")


class Malformed(NamedTuple):
    """What is asked for, and the files that it needs, by name."""

    arguments: list[str]
    files: dict[str, str | bytes]
    what: str


class Answer(NamedTuple):
    """What came of it."""

    status: int
    lines: list[str]
    seconds: float
    left: list[str]  # files and folders that were not there


# Configs


def configs(draw):
    """Configs with a wrong value, key or kind of section, and texts that are none."""
    key, kind, bounds = draw.choice(list(fields()))
    wrong = ["no number", [[1]], {"a": 1}, "${oc.env:HOME}"]
    if "str" in kind:
        wrong = [[1], {"a": 1}, *(["nonsense", "", "no.such:Class"] if bounds == "choices" else [])]
    elif kind.startswith("dict"):
        wrong = [3, "text", [1], {"no_such": 1}]
    elif "Any" in kind:
        wrong = ["text", True, [[1, 2], [3]], [float("nan")], [True, False], ["1+2j", 1], {"a": 1}, [-1, 1], []]
    elif "list" in kind:
        wrong += [[None], [], ["a"], [float("inf")]]
    elif "int" in kind or "float" in kind:
        wrong += [
            float("nan"),
            float("-inf"),
            -1e300,
            [1, 2],
            *([1.5] if kind == "int" else []),
            *([10**30] if kind == "int" and "every" not in key else []),
        ]
    elif kind == "bool":
        wrong = ["maybe", [True], {"a": 1}]
    content = copy.deepcopy(BASE)
    form = draw.randrange(6)
    if form < 3:
        value = draw.choice(wrong)
        put(content, key, value)
        what = f"{key}={value!r}"
    elif form == 3:
        what = f"{key}{draw.choice('xyz_')}"
        put(content, what, 1)
    elif form == 4:
        what = draw.choice([name for name, value in BASE.items() if isinstance(value, dict)])
        content[what] = draw.choice([3, "text", [1, 2], None, True, 1.5])
    else:
        key, value = draw.choice(IMPOSSIBLE)
        put(content, key, value)
        what = f"{key}={value!r}"
    text = yaml.safe_dump(content)
    if draw.random() < 0.1:
        text, what = draw.choice([("a: [", "no YAML"), ("", "empty"), ("3", "a number"), ("\x00", "no text")])
    return Malformed(["train", "--config", "experiment.yaml"], {"experiment.yaml": text}, what)


IMPOSSIBLE = [
    ("network.hidden", [10**9]), ("network.hidden", [10**6, 10**6]), ("seeds", 10**13), ("training.threads", 10**12),
    ("training.batch_size", 10**12), ("horizon.steps", 10**12), ("evaluation.test_states", 10**12),
    ("evaluation.validation_states", 10**12), ("seed", 10**30), ("seed", -1), ("trainer", {"devices": 10**5}),
    ("trainer", {"gradient_clip_val": -1}), ("trainer", {"deterministic": "foo"}), ("trainer", {"max_epochs": 1}),
    ("trainer", {"accelerator": "abacus"}), ("trainer", {"devices": 0}), ("callbacks", ["no.such:Class"]),
    ("initial_states.lower", [-1, -1, -1]), ("initial_states.lower", [2, 2]), ("initial_states.upper", [1, 1, 1]),
    ("cost.R", [-1]), ("cost.Q", [-1, 1]), ("cost.R", [[1, 2], [3, 4]]), ("cost.R", "mass"), ("horizon.steps", 0),
    ("horizon.dt", 0), ("network.ignored_states", ["no_such"]), ("network.ignored_states", ["position", "velocity"]),
    ("network.state_scale", [1, 2, 3]), ("system.parameters", {"mass": "heavy"}), ("system.parameters", {"masss": 1}),
    ("network.epsilon", -1), ("rollout.compile", "perhaps"), ("program.name", "value"), ("controls.name", "ball"),
    ("pointwise", {"weight": 1, "points": 10**13}), ("pointwise", {"weight": 1, "counterexamples": "no.csv"}),
    ("pointwise", {"points": 10**13}),
    ("system.angles", ["velocity"]), ("system.title", "Sledge"),
    ("pointwise", {"weight": 1, "region": [1, 2, 3]}), ("training.optimizer", "sgd"), ("training.precision", "half"),
]  # fmt: skip


def fields(cls=Config, prefix=""):
    """Full name and type of every field, and whether it has choices."""
    for f in dataclasses.fields(cls):
        if dataclasses.is_dataclass(f.type):
            yield from fields(f.type, f"{prefix}{f.name}.")
        else:
            kind = str(f.type) if get_args(f.type) else getattr(f.type, "__name__", str(f.type))
            yield f"{prefix}{f.name}", kind, "choices" if f.metadata.get("choices") else ""


def put(content, key, value):
    *sections, last = key.split(".")
    for name in sections:
        content = content.setdefault(name, {})
        if not isinstance(content, dict):
            return
    content[last] = value


# Code of the user's own

SYSTEM = """
import sys
import torch
from lyapnet import ControlAffineSystem

{above}
class Own(ControlAffineSystem):
    state_names, state_units = ("position", "velocity"), ("m", "m/s")
    control_names, control_units = ("force",), ("N",)
    {facts}

    def __init__(self):
        {start}

    def f(self, x):
        {f}
        return torch.stack([x[..., 1], -x[..., 0]], -1)

    def g(self, x):
        {g}
        return torch.stack([torch.zeros_like(x[..., :1]), torch.ones_like(x[..., :1])], -2)
"""
NETWORK = """
import sys
import torch
from torch import nn
from lyapnet import ValueFunction

{above}
class Own(ValueFunction):
    def __init__(self, scaling, hidden=(4,)):
        super().__init__()
        self.weight = nn.Parameter(torch.ones(()))
        {start}

    def forward(self, t, x):
        {forward}
        return self.weight * (x**2).sum(-1) + 0 * t
"""
COST = """
import sys
import torch
from lyapnet import Cost

{above}
class Own(Cost):
    def __init__(self):
        {start}

    def state(self, x):
        {state}
        return (x**2).sum(-1)

    def R(self, x):
        {R}
        return torch.ones_like(x[..., :1, None])

    def terminal(self, x):
        {terminal}
        return (x**2).sum(-1)
"""
BODIES = [
    "return None", "return (x, x)", "return 3.0", "return x.numpy()", "return x.detach().float()", "return 'text'",
    "raise KeyError('mass')", "raise RuntimeError('a\\nb')", "sys.exit(0)", "sys.exit('bye')",
    "return x[..., :1, None, None]",
    "return undefined", "return torch.full_like(x, torch.nan)", "return x @ torch.ones(7, 7)",
    "return torch.rand_like(x)",
    "return x.mean(0)", "x += 1", "return x.detach().sum()", "return x.to(torch.complex128)", "return [x]",
]  # fmt: skip
ABOVE = [
    "import no_such_module", "from lyapnet import NoSuch", "1 / 0", "sys.exit(0)", "def (", "undefined",
    "raise SystemExit",
    "'unclosed", "  indented = 1", "raise Exception('[/bold] please file an issue at pytorch')",
]  # fmt: skip
START = [
    "sys.exit(0)",
    "raise ValueError('[/red]')",
    "self.undefined",
    "1 / 0",
    "raise KeyboardError",
    "torch.ones(2) @ torch.ones(3)",
]
FACTS = [
    "state_names = ()", "state_names = 'position'", "state_units = ('m',)", "control_names = ()",
    "state_names = (1, 2)",
    "state_names = ('a', 'a')", "angles = (5,)", "angles = ('position',)", "state_names = None", "control_units = ()",
]  # fmt: skip
PLACES = [
    (SYSTEM, "system", ("f", "g"), "super().__init__()"), (NETWORK, "network", ("forward",), "pass"),
    (COST, "cost", ("state", "R", "terminal"), "super().__init__()"),
]  # fmt: skip


def modules(draw):
    """Modules whose system, network or cost cannot be imported, built or called, or breaks its contract."""
    template, section, functions, start = draw.choice(PLACES)
    holes = {"above": "", "start": start, "facts": "", **dict.fromkeys(functions, "pass")}
    hole = draw.choice([*functions, *functions, "above", "start", *(["facts"] if section == "system" else [])])
    holes[hole] = draw.choice({"above": ABOVE, "start": START, "facts": FACTS}.get(hole, BODIES))
    name = f"own_{draw.getrandbits(60)}"
    content = {**copy.deepcopy(BASE), section: {"name": f"{name}:Own"}}
    what = f"{section}.{hole}: {holes[hole]}"
    if draw.random() < 0.1:
        content[section]["name"] = what = draw.choice(
            [f"{name}:None", f"{name}:sys", "os:path", ":", f"{name}:", "..:A"]
        )
    files = {"experiment.yaml": yaml.safe_dump(content), f"{name}.py": template.format(**holes)}
    return Malformed(["train", "--config", "experiment.yaml"], files, what)


# Options


def options(draw):
    """Options that no command takes, and values that they do not."""
    line = draw.choice([line for line in OPTIONS.strip().splitlines() if line])
    return Malformed(line.split(), {"experiment.yaml": yaml.safe_dump(BASE)}, line)


OPTIONS = """
train
train --config no.yaml
train --config .
train --config experiment.yaml --resume last
train --config experiment.yaml --resume no.ckpt
train --config experiment.yaml --finetune no.ckpt
train --config experiment.yaml --resume last --finetune CKPT
train --config experiment.yaml --bogus
train --config experiment.yaml horizon.steps
train --config experiment.yaml horizon.steps=
train --config experiment.yaml horizon.steps=[
train --config experiment.yaml =3
train --config experiment.yaml a=b=c
train --config experiment.yaml horizon=3
train --config experiment.yaml system.parameters.mass=-1
train --config experiment.yaml --resume
evaluate
evaluate no.ckpt
evaluate experiment.yaml
evaluate .
evaluate CKPT --samples 0
evaluate CKPT --samples -3
evaluate CKPT --samples many
evaluate CKPT --samples 10000000000000
evaluate CKPT --seed -1
evaluate CKPT --system no.such:Class
evaluate CKPT --system os:path
evaluate CKPT --network :
evaluate CKPT --cost quadratic:
evaluate CKPT --program nowhere
evaluate CKPT --table no/such/folder/table.csv
evaluate CKPT more
certify
certify no.ckpt
certify sampled CKPT --samples 0
certify sampled CKPT --samples 10000000000000
certify sampled CKPT --radius -1
certify sampled CKPT --radius nan
certify sampled CKPT --figure no/such/claim.png
certify sampled CKPT --figure claim.xyz
certify sampled CKPT --report experiment.yaml
certify statistical CKPT --samples 10000000000000
certify statistical CKPT --confidence 1
certify statistical CKPT --confidence nan
certify statistical CKPT --confidence high
certify statistical CKPT --share 0
certify statistical CKPT --share inf
certify statistical CKPT --seed -1
certify statistical CKPT --seed 1e3
certify sound CKPT --alpha 2
certify sound CKPT --alpha nan
certify sound CKPT --delta -1
certify sound CKPT --delta inf
certify sound CKPT --time sometimes
certify sound CKPT --time continuous --jitter 0.1
certify sound CKPT --interval 0
certify sound CKPT --jitter -1
certify sound CKPT --delay nan
certify sound CKPT --measured position
certify sound CKPT --measured place=0.1
certify sound CKPT --measured position=-1
certify region CKPT --quantised position=1
certify sound CKPT --set=1,2
certify sound CKPT --set=-inf:inf,-inf:inf
certify sound CKPT --set=nan:nan,-1:1
certify sound CKPT --set=
certify sound CKPT --set=-2:2
certify sound CKPT --set=2:-2,2:-2
certify sound CKPT --set=-0.1:0.1,-0.1:0.1
certify sound CKPT --seconds 0
certify sound CKPT --seconds nan
certify sound CKPT --seconds inf
certify sound CKPT --workers 0
certify sound CKPT --workers 1000000000000
certify sound CKPT --keep no/such/proof
certify sound CKPT --keep .
certify sound CKPT --refine -1
certify sound CKPT training.iterations=1
certify sound CKPT --refine 1 --keep proof
certify --kind certain CKPT
certify sound
sweep
sweep --config no.yaml
sweep --config experiment.yaml --vary horizon.steps
sweep --config experiment.yaml --vary no.such=1,2
sweep --config experiment.yaml --workers 0
sweep --config experiment.yaml --vary horizon.steps=
compare
compare --config no.yaml
compare --config experiment.yaml
compare --config compare.yaml --job none
bench --batch 0
bench --batch many
bench --task no_such
bench --routes no_such
bench --threads 0
bench --threads 1000000000000
bench --repeats 0
bench certify no.ckpt
bench certify --dimensions 0
bench certify --dimensions many
bench certify --seconds -1
systems more
nonsense
--nonsense
"""


# Files on disk


def files(draw):
    """Checkpoints and records of runs that are cut short, exchanged or emptied."""
    content, verb = (HERE / "best.ckpt").read_bytes(), draw.choice(VERBS)
    at = draw.randrange(1, len(content) - 1)
    broken, what = draw.choice([
        (content[:at], f"cut at {at}"), (b"", "empty"), (b"\x80\x04}.", "another pickle"),
        (b"PK\x03\x04", "no archive"),
        (draw.randbytes(500), "noise"), (content[: len(content) // 2] + draw.randbytes(2000), "half noise"),
        (rewritten(lambda c: c["lyapnet"].update(config="none")), "config a string"),
        (rewritten(lambda c: c["state_dict"].clear()), "no weights"),
        (rewritten(lambda c: c["lyapnet"]["config"]["network"].update(hidden=[10**9])), "hidden 1e9"),
        (rewritten(lambda c: c["lyapnet"]["config"]["horizon"].update(steps=10**13)), "steps 1e13"),
        (rewritten(lambda c: c["lyapnet"]["config"]["training"].update(threads=10**12)), "threads 1e12"),
        (rewritten(lambda c: c["lyapnet"]["config"].update(seeds=10**13)), "seeds 1e13"),
        (rewritten(lambda c: c["lyapnet"]["config"].update(experiment=3.5, horizon="x")), "horizon x"),
        (rewritten(lambda c: c["lyapnet"]["config"]["system"].update(name="os:system")), "a module"),
        (rewritten(lambda c: c["lyapnet"].update(config=[1])), "config a list"),
        (rewritten(lambda c: c.update(state_dict=[1])), "weights a list"),
    ])  # fmt: skip
    return Malformed(verb.split(), {"broken.ckpt": broken, "experiment.yaml": yaml.safe_dump(BASE)}, f"{what}: {verb}")


VERBS = ["evaluate broken.ckpt", "certify broken.ckpt", "certify sampled broken.ckpt",
         "certify sound broken.ckpt --seconds 1",
         "train --config experiment.yaml --resume broken.ckpt", "train --config experiment.yaml --finetune broken.ckpt",
         "bench certify broken.ckpt"]  # fmt: skip


def rewritten(change):
    """The bytes of the checkpoint with something else in it."""
    from lyapnet.experiment.checkpoint import read_checkpoint, write_checkpoint

    content = read_checkpoint(HERE / "best.ckpt")
    change(content)
    write_checkpoint(content, HERE / "changed.ckpt")
    return (HERE / "changed.ckpt").read_bytes()


HERE = Path()  # where best.ckpt is; the fixture's


# The test


KINDS = [configs, configs, modules, modules, options, files]


def malformed(count, seed=0):
    """So many inputs, of each kind in turn."""
    draw = random.Random(seed)
    return [KINDS[i % len(KINDS)](draw) for i in range(count)]


def answer(given, folder, capsys):
    """What the command line makes of an input, in a folder of its own."""
    folder.mkdir()
    for name, content in given.files.items():
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    before, started = set(folder.rglob("*")), time.monotonic()
    arguments = [str(HERE / "best.ckpt") if argument == "CKPT" else argument for argument in given.arguments]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(sys, "path", list(sys.path))
        signal.signal(signal.SIGALRM, signal.default_int_handler)
        signal.alarm(SECONDS)
        status = main(arguments)
        signal.alarm(0)
    printed = capsys.readouterr()
    left = [str(path.relative_to(folder)) for path in set(folder.rglob("*")) - before if "__pycache__" not in str(path)]
    shutil.rmtree(folder)
    return Answer(status, printed.err.splitlines(), time.monotonic() - started, left)


@pytest.fixture(scope="module", autouse=True)
def _checkpoint(tmp_path_factory):
    folder = tmp_path_factory.mktemp("trained")
    (folder / "experiment.yaml").write_text(yaml.safe_dump({**BASE, "logs": str(folder)}))
    assert main(["train", "--config", str(folder / "experiment.yaml")]) == 0
    shutil.copy(folder / "small/version_0/checkpoints/best.ckpt", folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys.modules[__name__], "HERE", folder)
        patch.setattr(sizes, "free_memory", lambda: 16 * 2**30)  # as if this were such a machine
        yield


@pytest.mark.parametrize("count", [20, at_the_gate(42)])
def test_what_is_malformed_is_refused_in_one_line_and_leaves_nothing(count, tmp_path, capsys):
    assert_refused(count, tmp_path, capsys)


@pytest.mark.nightly
def test_so_are_seven_hundred(tmp_path, capsys):
    assert_refused(700, tmp_path, capsys)


def assert_refused(count, tmp_path, capsys):
    threads = torch.get_num_threads()
    found = {name: [] for name in ("traceback", "slow", "accepted", "left", "form", "status")}
    for i, given in enumerate(malformed(count)):
        got = answer(given, tmp_path / str(i), capsys)
        errors = [line for line in got.lines if not line.startswith("note: ")]
        for name, wrong in (
            ("traceback", any("Traceback" in line or "please file" in line.lower() for line in got.lines)),
            ("slow", got.seconds > SECONDS - 1),
            ("accepted", got.status == 0),
            ("left", bool(got.left)),
            ("form", len(errors) != 1 or not FORM.fullmatch(errors[0])),
            ("status", got.status != 2 and "broken.ckpt" not in given.files),
        ):
            if wrong:
                found[name].append((given.what, got.status, [line[:300] for line in got.lines], got.left))
    torch.set_num_threads(threads)
    few = {name: len(wrong) <= (0.05 * count if name == "form" else 0) for name, wrong in found.items()}
    assert all(few.values()), "\n".join(map(str, found.items()))


@pytest.mark.gate
def test_what_is_not_malformed_is_accepted(tmp_path, capsys):
    """A twin: the inputs are refused for what is wrong with them."""
    for template, section, functions, start in PLACES:
        name = f"sound_{section}"
        holes = {"above": "", "start": start, "facts": "", **dict.fromkeys(functions, "pass")}
        content = {**copy.deepcopy(BASE), section: {"name": f"{name}:Own"}}
        given = {"experiment.yaml": yaml.safe_dump(content), f"{name}.py": template.format(**holes)}
        got = answer(Malformed(["train", "--config", "experiment.yaml"], given, ""), tmp_path / section, capsys)
        assert (got.status, got.lines) == (0, [])
        assert "logs/small/version_0/evaluation.json" in got.left


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("trian", "Expected a command of lyapnet, got 'trian'; did you mean 'train', 'trim'?"),
        ("qqq", "Expected a command of lyapnet, got 'qqq'; see lyapnet --help."),
        ("zoo -x", "Expected options of lyapnet zoo, got: No such option: -x; see lyapnet zoo --help."),
    ],
)
def test_a_command_line_that_is_misspelt_is_told_so(line, said, capsys):
    assert main(line.split()) == 2
    assert capsys.readouterr().err == f"error: {said}\n"

"""Trainings as a user starts them: the real command in a process of its own, and what it leaves behind.

The processes are forked from a server that has imported everything once: a start costs tenths of a second.
"""

import contextlib
import gc
import itertools
import json
import multiprocessing
import os
import pkgutil
import shutil
import signal
import sys
import time
from collections import defaultdict
from pathlib import Path

import torch
import yaml
from tensorboard.backend.event_processing.plugin_event_accumulator import EventAccumulator
from tensorboard.util import tensor_util

from lyapnet.cli import main, options
from lyapnet.experiment.checkpoint import read_checkpoint
from tests.pages import ROOT

SMALL = {
    "experiment": "small",
    "program": {"name": "lyapunov", "constraint": 1, "trajectory_cost": 1, "margin": 0.05},
    "system": {"name": "double_integrator"},
    "cost": {"Q": [10, 0.1], "R": "inverse_mass", "Q_T": [10, 0.1]},
    "initial_states": {"lower": [-1, -0.7], "upper": [1, 0.7]},
    "horizon": {"steps": 15, "dt": 0.1},
    "network": {"name": "anchored", "hidden": [8, 8]},
    "training": {"iterations": 17, "batch_size": 6, "learning_rate": 0.05, "validate_every": 5},
    "evaluation": {"validation_states": 6, "test_states": 6, "figures_every": 2, "animate": False},
    "trainer": {"gradient_clip_val": 3},
}
TINY = ["training.iterations=2", "horizon.steps=8", "evaluation.validation_states=4", "evaluation.test_states=4",
        "loggers=[csv]"]  # no figures  # fmt: skip
PATIENCE = 120  # seconds
MEASURED_TIME = {"rollout_steps_per_second", "training_seconds"}

_server = multiprocessing.get_context("forkserver")
_server.set_forkserver_preload(
    ["lyapnet.training.experiment", "lyapnet.cli", "lyapnet.evaluation.tables", "tensorboard.util.tensor_util",
     "torch.utils.tensorboard", "matplotlib.backends.backend_agg", "tests.frozen"]
)  # fmt: skip


def tiny_checkpoint(folder):
    """The best checkpoint of a double integrator that was trained for two iterations."""
    changes = [f"logs={folder}", "network.hidden=[8]", "rollout.gradient=backprop", *TINY]
    assert main(["train", "--config", "conf/from_scratch/double_integrator.yaml", *changes]) == 0
    return folder / "double_integrator_from_scratch/version_0/checkpoints/best.ckpt"


class Desk:
    """A working directory with one config, and the runs that are started in it."""

    def __init__(self, folder, **changes):
        self.folder = folder
        (folder / "experiment.yaml").write_text(yaml.safe_dump({**SMALL, **changes}))
        self.output, self.errors = folder / "output.txt", folder / "errors.txt"

    @property
    def run(self):
        """The folder of the first run."""
        return self.folder / "logs" / "small" / "version_0"

    @property
    def runs(self):
        return sorted(path.name for path in (self.folder / "logs" / "small").glob("*"))

    @property
    def last(self):
        return self.run / "checkpoints" / "last.ckpt"

    def best(self, member="."):
        """The best checkpoint, or that of a member."""
        return self.run / member / "checkpoints" / "best.ckpt"

    def start(self, *arguments, prepare=None):
        """A process that trains; `prepare` is called in it first."""
        process = _server.Process(target=_train, args=(self.folder, arguments, prepare))
        with contextlib.chdir(ROOT):  # the first one starts the server, which finds tests.frozen here
            process.start()
        return process

    def train(self, *arguments, prepare=None):
        """(exit status, standard output, standard error) of a training that is left alone."""
        return self.end(self.start(*arguments, prepare=prepare))

    def end(self, process):
        process.join(PATIENCE)
        process.kill()  # one that hangs has no exit status, which fails its test
        return process.exitcode, self.output.read_text(), self.errors.read_text()

    def wait_for(self, text, process):
        """Until the process has written this."""
        deadline = time.monotonic() + PATIENCE
        while text not in (self.output.read_text() if self.output.exists() else ""):
            assert process.is_alive(), self.errors.read_text()
            assert time.monotonic() < deadline
            time.sleep(0.005)

    def copy(self, folder):
        shutil.copytree(self.folder, folder, dirs_exist_ok=True)
        desk = object.__new__(Desk)
        desk.folder, desk.output, desk.errors = folder, folder / "output.txt", folder / "errors.txt"
        return desk


def _train(folder, arguments, prepare):
    assert gc.get_freeze_count(), "half of the time would go to the garbage of the server"
    os.chdir(folder)
    for name, descriptor in (("output.txt", 1), ("errors.txt", 2)):
        os.dup2(os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), descriptor)
    torch.set_num_threads(1)
    options.FIRST = float("inf")  # as in the tests themselves
    newest = max((path.stat().st_ctime for path in Path().rglob("events.out.tfevents.*")), default=0)
    while int(newest) == int(time.time()):  # event files are sorted by the second in which they were opened
        time.sleep(0.02)
    if prepare:
        prepare()
    sys.exit(main(["train", "--config", "experiment.yaml", *arguments]))


# What happens to a training


def both(*preparations):
    """All of them, one after the other."""
    for prepare in preparations:
        prepare()


def without_figures():
    """Drawing takes most of the time of a short run."""
    pkgutil.resolve_name("lyapnet.training.figure_logger").figures_of = lambda learner: {}


def dies_at(place, name, call=1):
    """SIGKILL itself when a function is called for the n-th time."""
    owner, calls = pkgutil.resolve_name(place), itertools.count(1)
    original = getattr(owner, name)

    def deadly(*args, **kwargs):
        if next(calls) == call:
            os.kill(os.getpid(), signal.SIGKILL)
        return original(*args, **kwargs)

    setattr(owner, name, deadly)


def dies_writing(name, call=1):
    """SIGKILL itself when half of what would have become a file of this name is written, for the n-th time."""
    original, calls = os.replace, itertools.count(1)

    def deadly(source, target, **options):
        if name in str(target) and next(calls) == call:
            os.truncate(source, Path(source).stat().st_size // 2)
            os.kill(os.getpid(), signal.SIGKILL)
        return original(source, target, **options)

    os.replace = deadly


def dies_appending(name, torn):
    """SIGKILL itself when only this much of what should be appended to a file of this name is written."""
    owner = pkgutil.resolve_name("lyapnet.training.metrics_file")
    original = owner.open_for_appending

    @contextlib.contextmanager
    def deadly(path):
        with original(path) as file:
            if path.name == name:
                file.write(torn)
                file.flush()
                os.kill(os.getpid(), signal.SIGKILL)
            yield file

    owner.open_for_appending = deadly


# What a run leaves behind


def events(folder):
    """tag ↦ what TensorBoard shows of a run under it, as events with a step and a tensor_proto."""
    everything = dict.fromkeys(("scalars", "images", "text", "custom_scalars", "hparams"), 0)
    accumulator = EventAccumulator(str(folder), tensor_size_guidance=everything).Reload()
    return {tag: accumulator.Tensors(tag) for tag in accumulator.Tags()["tensors"]}


def logged(folder):
    """tag ↦ [(step, content)]."""
    curves = defaultdict(list)
    for tag, shown in events(folder).items():
        curves[tag] = [(event.step, event.tensor_proto.SerializeToString()) for event in shown]
    return curves


def values(folder, tag):
    """step ↦ what was logged under a tag."""
    return {event.step: tensor_util.make_ndarray(event.tensor_proto).item() for event in events(folder)[tag]}


def differences(one, other, name=""):
    """Where two nested structures of tensors and plain data differ, bit for bit, measured time aside."""
    if name.endswith("Stopwatch.seconds"):
        return
    if isinstance(one, dict) and isinstance(other, dict):
        for key in one.keys() | other.keys():
            yield from differences(one.get(key), other.get(key), f"{name}.{key}")
    elif isinstance(one, list | tuple) and isinstance(other, list | tuple) and len(one) == len(other):
        for i, (a, b) in enumerate(zip(one, other, strict=True)):
            yield from differences(a, b, f"{name}[{i}]")
    elif isinstance(one, torch.Tensor) and isinstance(other, torch.Tensor):
        if one.dtype != other.dtype or not torch.equal(one, other):
            yield name
    elif one != other:
        yield name


def checkpoint(desk, name):
    """A checkpoint's content, with the path of the working directory taken out of it."""

    def without_path(value):
        if isinstance(value, dict):
            return {without_path(key): without_path(item) for key, item in value.items()}
        return value.replace(str(desk.folder.resolve()), "") if isinstance(value, str) else value

    return without_path(read_checkpoint(desk.run / "checkpoints" / f"{name}.ckpt"))


def origin(desk):
    """What made a run; without what it took, which is measured."""
    record = json.loads((desk.run / "run.json").read_text())
    assert record.pop("training_seconds") > 0
    assert record.pop("peak_bytes") > 1e7
    return record

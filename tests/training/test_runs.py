"""Training as a user meets it: killed, interrupted, resumed, fine-tuned, failed, and what it shows meanwhile."""

import contextlib
import csv
import ctypes
import errno
import fcntl
import functools
import io
import json
import math
import os
import random
import resource
import shlex
import shutil
import signal
import struct
import subprocess
import sys
import threading
import time
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch
import yaml
from lightning.pytorch.loggers import TensorBoardLogger
from tensorboard.plugins.custom_scalar.layout_pb2 import Layout

import lyapnet
from lyapnet.base.errors import LyapnetError, UsageError
from lyapnet.base.random_streams import VALIDATION, stream
from lyapnet.cli import main
from lyapnet.controller.controller import Controller
from lyapnet.controller.loading import load_value_function
from lyapnet.experiment.assembly import build_problem, build_value_function
from lyapnet.experiment.checkpoint import read_checkpoint, write_checkpoint
from lyapnet.experiment.config import config_from_plain, load_config
from lyapnet.task.systems import DoubleIntegrator
from lyapnet.training import loggers, metrics_file, plan
from lyapnet.training.plan import plan_run
from lyapnet.training.run_lock import RunLock
from lyapnet.training.runs import new_run
from lyapnet.value.networks import FCN
from tests.runs import (
    MEASURED_TIME,
    SMALL,
    TINY,
    Desk,
    both,
    checkpoint,
    dies_appending,
    dies_at,
    dies_writing,
    differences,
    logged,
    origin,
    tiny_checkpoint,
    values,
    without_figures,
)  # fmt: skip

pytestmark = pytest.mark.gate

ROOT = Path(__file__).parents[2]
STEPS = SMALL["training"]["iterations"]
VALIDATIONS = [0, 5, 10, 15, 17]
DRAWINGS = [0, 10, 17]
FIGURES = {"certified_region", "trajectories", "value_slices"}


def rows(folder):
    """The rows of metrics.csv, measured time aside."""
    with (folder / "metrics.csv").open(newline="") as file:
        return [
            {k: v for k, v in row.items() if k not in {*MEASURED_TIME, "wall_time"}} for row in csv.DictReader(file)
        ]


def unequal_ends(one, other):
    """What differs between two finished runs: checkpoints, evaluation, curves, pictures."""
    for name in ("last", "best"):
        yield from differences(checkpoint(one, name), checkpoint(other, name), name)
    for name in ("evaluation.json", "config.yaml"):
        if (one.run / name).read_text() != (other.run / name).read_text():
            yield name
    if origin(one) != origin(other):
        yield "run.json"
    if rows(one.run) != rows(other.run):
        yield "metrics.csv"
    curves, others = logged(one.run), logged(other.run)
    for tag in curves.keys() | others.keys():
        measured_time = tag in MEASURED_TIME or tag.startswith("_hparams_")
        shown = slice(1) if measured_time else slice(None)
        if [entry[shown] for entry in curves[tag]] != [entry[shown] for entry in others[tag]]:
            yield tag


def assert_same_end(one, other, pictures=True):
    assert set(unequal_ends(one, other)) == (set() if pictures else FIGURES)
    assert one.runs == ["version_0"]
    assert not [path.name for path in one.run.rglob("*.tmp")]


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """A run that nothing disturbed, by `python train.py`."""
    desk = Desk(tmp_path_factory.mktemp("reference"))
    command = [sys.executable, ROOT / "train.py", "--config", "experiment.yaml"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=desk.folder, env=environment, capture_output=True, text=True, check=True)
    desk.output.write_text(done.stdout)
    desk.errors.write_text(done.stderr)
    return desk


@pytest.fixture
def desk(tmp_path):
    return Desk(tmp_path)


@pytest.fixture
def finished(reference, tmp_path):
    """A copy of the finished run, to go on with."""
    return reference.copy(tmp_path)


# The undisturbed run


def test_run_tells_where_it_is_and_what_comes_next(reference):
    output = reference.output.read_text()
    assert all(line.startswith("train: ") for line in reference.errors.read_text().splitlines())
    for text in (f"step {STEPS}/{STEPS}", "cost / optimum", "logs/small/version_0", "tensorboard --logdir logs"):
        assert text in output
    assert "resuming" not in output
    for command in ("lyapnet evaluate", "--finetune", 'import lyapnet; controller = lyapnet.load("'):
        assert command in output


def test_the_commands_that_come_next_can_be_pasted(tmp_path, monkeypatch, capsys):
    folder = tmp_path / "it's mine"
    best = tiny_checkpoint(folder)
    shown = {line[:10].strip(): line[10:] for line in capsys.readouterr().out.splitlines()}
    assert shlex.split(shown["watch"]) == ["tensorboard", "--logdir", str(folder)]
    assert shlex.split(shown["measure"]) == ["lyapnet", "evaluate", str(best)]
    assert shlex.split(shown["certify"]) == ["lyapnet", "certify", "statistical", str(best)]
    assert shlex.split(shown["export"])[:3] == ["lyapnet", "export", str(best)]
    assert shlex.split(shown["fine-tune"])[-2:] == ["--finetune", str(best)]
    names: dict = {}
    exec(shown["use"], names)
    assert names["controller"].horizon.steps == 8


def test_the_claim_that_comes_next_is_that_which_v_was_trained_for(tmp_path, capsys):
    changes = {"pointwise": {"weight": 1, "points": 8, "region": [2.0, 2.0]}, "logs": str(tmp_path / "logs")}
    Desk(tmp_path, **changes)
    assert main(["train", "--config", str(tmp_path / "experiment.yaml"), *TINY]) == 0
    assert "certify   lyapnet certify sound " in capsys.readouterr().out


def test_folder_of_a_run(reference):
    assert {path.name for path in (reference.run / "checkpoints").iterdir()} == {"last.ckpt", "best.ckpt"}
    assert load_config(reference.run / "config.yaml") == load_config(reference.folder / "experiment.yaml")
    provenance = json.loads((reference.run / "run.json").read_text())
    assert provenance["seed"] == 0
    assert provenance["torch"] == torch.__version__
    assert {"lyapnet", "lightning", "python", "commit", "finetuned_from"} <= provenance.keys()
    assert json.loads((reference.run / "evaluation.json").read_text())["samples"] == 6


def test_curves_have_every_step_once(reference):
    curves = logged(reference.run)
    train = {tag for tag in curves if tag.endswith("/train")}
    assert train >= {"constraint_loss/train", "trajectory_cost/train"}
    for tag in train | {"gradient_norm", "learning_rate", "rollout_steps_per_second"}:
        assert [step for step, _ in curves[tag]] == list(range(1, STEPS + 1)), tag
    names = ("constraint_loss", "trajectory_cost", "optimality_gap", "value_error", "satisfied_fraction")
    assert [step for step, _ in curves["training_seconds"]] == VALIDATIONS
    for tag in [f"{name}/val" for name in names]:
        assert [step for step, _ in curves[tag]] == VALIDATIONS, tag


def test_figures_appear_during_training(reference):
    curves = logged(reference.run)
    for tag in FIGURES:
        assert [step for step, _ in curves[tag]] == DRAWINGS
        pictures = [content for _, content in curves[tag]]
        assert len(set(pictures)) == len(pictures), "V changes, and so must its picture"
        assert b"PNG" in pictures[0]


def test_config_hyperparameters_and_layout_are_in_tensorboard(reference):
    curves = logged(reference.run)
    text = values(reference.run, "config/text_summary")[0].decode()
    for line in ("experiment: small", f"iterations: {STEPS}", "optimizer: adam"):
        assert line in text
    assert "_hparams_/session_start_info" in curves
    final = {tag.removeprefix("hp/") for tag in curves if tag.startswith("hp/")}
    assert {"cost_mean", "cost_ratio", "value_error", "satisfied_fraction"} <= final
    layout = Layout.FromString(values(reference.run, "custom_scalars__config__")[0])
    charts = [list(chart.multiline.tag) for category in layout.category for chart in category.chart]
    assert charts[:2] == [["constraint_loss/train"], ["constraint_loss/val"]], "curves of one run share a colour"
    assert {tag for (tag,) in charts} <= curves.keys()


def test_hparams_file_has_the_config(reference, finished):
    def written(desk):
        return config_from_plain(yaml.safe_load((desk.run / "hparams.yaml").read_text()))

    assert written(reference) == load_config(reference.run / "config.yaml")
    assert finished.train("--resume", "last", "training.iterations=18", prepare=without_figures)[0] == 0
    assert written(finished).training.iterations == 18


def test_the_loss_falls(reference):
    for tag, share in (("trajectory_cost/val", 0.7), ("optimality_gap/val", 0.5), ("constraint_loss/val", 0.7)):
        curve = values(reference.run, tag)
        assert curve[STEPS] < share * curve[0], tag


def test_best_checkpoint_is_the_best_validation(reference):
    best, last = checkpoint(reference, "best"), checkpoint(reference, "last")
    assert last["global_step"] == STEPS
    assert best["global_step"] in VALIDATIONS
    losses = [checkpoint["callbacks"]["Checkpoints"]["best_loss"] for checkpoint in (best, last)]
    assert losses[0] == losses[1] < math.inf


# Killed

MODULE, EXPERIMENT, CURVES = (
    "lyapnet.training.modules:ValueModule",
    "lyapnet.training.experiment",
    "lyapnet.training.curves",
)
LOGGER = "lightning.pytorch.loggers:TensorBoardLogger"
MOMENTS = [  # in this order in one run
    (dies_at, EXPERIMENT, "build_trainer"),
    (dies_writing, "config.yaml"),
    (dies_at, CURVES, "log_scalars"),
    (dies_at, MODULE, "on_before_optimizer_step", 3),
    (dies_writing, "metrics.csv"),
    (dies_writing, "best.ckpt"),
    (dies_writing, "last.ckpt"),  # best.ckpt is in place
    (dies_at, "lyapnet.training.checkpoints:Checkpoints", "on_train_epoch_start", 6),  # step 5 is saved
    (dies_at, MODULE, "training_step", 3),  # step 8
    (dies_at, "tensorboard.summary.writer.record_writer:RecordWriter", "write", 30),
    (dies_at, CURVES, "log_scalars", 3),  # step 8 is made, not logged
    (dies_appending, "metrics.csv", "3,17"),  # as if that were a row of step 3
    (dies_at, MODULE, "validate_on", 2),  # step 10 is saved
    (dies_writing, "last.ckpt", 2),  # step 15 is saved
    (dies_at, "lyapnet.training.figure_logger", "log_figure"),
    (dies_at, EXPERIMENT, "evaluate"),
    (dies_at, EXPERIMENT, "log_result"),
    (dies_at, LOGGER, "finalize", 2),
    (dies_writing, "evaluation.json"),
]
DRAWN = {"on_train_epoch_start", "validate_on", "log_figure", "evaluate"}  # figures of the others would be taken back


def survives(desk, moments, arguments=()):
    """Start, then resume again and again, killed at each of the moments."""
    for moment in moments:
        preparations = (
            [functools.partial(*moment)] if DRAWN & {*moment} else [without_figures, functools.partial(*moment)]
        )
        status, _, errors = desk.train(*arguments, prepare=functools.partial(both, *preparations))
        assert status == -signal.SIGKILL, (moment, errors)
        arguments = ("--resume", "last")


def test_killed_at_chosen_moments_a_run_ends_the_same(desk, reference):
    survives(desk, MOMENTS)
    assert desk.train("--resume", "last")[0] == 0
    assert_same_end(desk, reference)


def test_killed_at_random_moments_a_run_ends_the_same(desk, reference):
    chance = random.Random(0)
    process = desk.start(prepare=without_figures)
    for step in (5, 10, 15):
        desk.wait_for(f"step {step}/", process)
        time.sleep(chance.uniform(0, 0.15))
        os.kill(process.pid, signal.SIGKILL)
        assert desk.end(process)[0] == -signal.SIGKILL
        desk.output.unlink()
        process = desk.start("--resume", "last", prepare=without_figures)
    assert desk.end(process)[0] == 0
    assert_same_end(desk, reference, pictures=False)


class Forgetful(TensorBoardLogger):
    """Opens an event file without the mark at which TensorBoard drops what came before."""

    def __init__(self, *arguments, purge_step, **options):
        super().__init__(*arguments, **options)


def forgets_to_take_back():
    without_figures()
    metrics_file.MetricsFile.drop_after = lambda *_: None
    loggers.TensorBoardLogger = Forgetful


def test_steps_that_are_logged_twice_are_found(desk, reference):
    """A twin: without taking back what was logged after the checkpoint, every curve has steps 6 to 10 twice."""
    survives(desk, [(dies_writing, "last.ckpt", 2)])
    assert desk.train("--resume", "last", prepare=forgets_to_take_back)[0] == 0
    unequal = set(unequal_ends(desk, reference))
    assert {"loss/train", "gradient_norm", "rollout_steps_per_second", "metrics.csv"} <= unequal
    assert not any(name.startswith(("last", "best", "evaluation")) for name in unequal)


def test_another_seed_ends_differently(desk, reference):
    """A twin: what the comparison can see."""
    assert desk.train("seed=1", prepare=without_figures)[0] == 0
    unequal = set(unequal_ends(desk, reference))
    assert {"evaluation.json", "trajectory_cost/val", "loss/train", "gradient_norm"} <= unequal
    assert any(name.startswith("last.state_dict") for name in unequal)
    assert any(name.startswith("last.optimizer_states") for name in unequal)
    assert any(name.startswith("last.callbacks") for name in unequal)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_a_run_saves_and_goes_on_to_the_same_end(number, desk, reference):
    process = desk.start(prepare=without_figures)
    desk.wait_for("step 5/", process)
    os.kill(process.pid, number)
    status, _, errors = desk.end(process)
    assert status == 0
    assert errors.count("\n") == 1
    for text in (number.name, "saved", "last.ckpt", "--resume last"):
        assert text in errors
    step = read_checkpoint(desk.last)["global_step"]
    assert f"step {step}" in errors
    assert 5 <= step < STEPS
    assert not (desk.run / "evaluation.json").exists()
    status, output, errors = desk.train("--resume", "last", prepare=without_figures)
    assert (status, errors) == (0, "")
    assert "logs/small/version_0" in output
    assert_same_end(desk, reference, pictures=False)
    seconds = list(values(desk.run, "training_seconds").values())
    assert seconds == sorted(seconds), "what the interrupted process took counts"
    assert seconds[-1] > seconds[0] == 0


@pytest.mark.parametrize("script", ["lyapnet", "train.py"])
def test_stopped_while_its_start_is_sought_a_run_says_how_to_go_on(script, tmp_path, monkeypatch, capsys):
    def stops(*_, **options):
        signal.raise_signal(signal.SIGINT)

    Desk(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [script])
    with monkeypatch.context() as patch:
        patch.setattr("lyapnet.training.experiment.load_or_choose_start", stops)
        assert main(["train", "--config", "experiment.yaml", *TINY]) == 130
    said, command, again = capsys.readouterr().err.splitlines()[-1].partition(" Continue with: ")
    assert said == "SIGINT: stopped at once."
    assert command
    typed = ["python", "train.py"] if script == "train.py" else ["lyapnet", "train"]
    assert shlex.split(again) == [*typed, "--config", "experiment.yaml", *TINY, "--resume", "last"]
    assert main(["train", *shlex.split(again)[2:]]) == 0
    assert "training starts anew from step 0" in capsys.readouterr().out
    assert [path.name for path in (tmp_path / "logs/small").iterdir()] == ["version_0"]


def test_stopped_before_it_has_a_folder_a_training_says_that_it_had_not_begun(tmp_path, monkeypatch, capsys):
    Desk(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("lyapnet.training.plan.plan_run", lambda *_: signal.raise_signal(signal.SIGINT))
    assert main(["train", "--config", "experiment.yaml"]) == 130
    assert capsys.readouterr().err.splitlines()[-1] == "SIGINT: stopped at once. The training had not begun."
    assert not (tmp_path / "logs").exists()


@pytest.mark.parametrize("moved", [False, True])
def test_best_checkpoint_is_kept_where_nothing_is_better(moved, desk, tmp_path):
    """Also in a folder that was moved: the paths that a checkpoint remembers do not matter."""
    assert desk.train("training.iterations=5", prepare=without_figures)[0] == 0
    if moved:
        origin, desk = desk, desk.copy(tmp_path / "elsewhere")
        shutil.rmtree(origin.folder / "logs")
    best, content = desk.run / "checkpoints" / "best.ckpt", read_checkpoint(desk.last)
    before = best.read_bytes()
    content["callbacks"]["Checkpoints"]["best_loss"] = -1e9  # that no later validation reaches
    write_checkpoint(content, desk.last)
    assert desk.train("--resume", "last", "training.iterations=10", prepare=without_figures)[0] == 0
    assert best.read_bytes() == before
    assert read_checkpoint(desk.last)["global_step"] == 10


def test_finetuning_killed_before_its_first_checkpoint_ends_the_same(reference, tmp_path):
    source = ("--finetune", str(reference.last), "training.iterations=3", "horizon.steps=5")
    ends = []
    for name, killed in (("one", False), ("other", True)):
        (tmp_path / name).mkdir()
        desk = Desk(tmp_path / name)
        if killed:
            survives(desk, [(dies_at, MODULE, "training_step", 2)], source)
        arguments = ("--resume", "last", *source[2:]) if killed else source
        assert desk.train(*arguments, prepare=without_figures)[0] == 0
        ends.append(desk)
    last, other_last = (checkpoint(desk, "last")["state_dict"] for desk in ends)
    assert not list(differences(last, other_last))
    assert origin(ends[0]) == origin(ends[1])


# Resumed


def command(desk, *arguments, capsys, monkeypatch):
    """(exit status, output, message) of a command that does not come to training."""
    monkeypatch.chdir(desk.folder)
    status = main(["train", "--config", "experiment.yaml", *arguments])
    return status, *capsys.readouterr()


@pytest.fixture
def ask(capsys, monkeypatch):
    return functools.partial(command, capsys=capsys, monkeypatch=monkeypatch)


@pytest.mark.parametrize(
    ("override", "key"),
    [
        ("program.margin=0.2", "program.margin"),
        ("horizon.steps=16", "horizon.steps"),
        ("seed=1", "seed"),
        ("system.parameters.mass=2", "system.parameters.mass"),
        ("training.learning_rate=0.1", "training.learning_rate"),
        ("network.hidden=[8, 9]", "network.hidden"),
        ("training.threads=2", "training.threads"),  # of torch, whose sums depend on their number
    ],
)
def test_resuming_another_config_is_refused(override, key, reference, ask):
    status, _, message = ask(reference, "--resume", "last", override)
    assert status == 2
    assert message.count("\n") == 1
    for text in ("Expected", key, "--finetune"):
        assert text in message


@pytest.mark.parametrize(
    ("then", "now", "same"), [(1, None, True), (None, 1, True), (None, None, True), (2, None, False)]
)
def test_a_run_of_one_thread_goes_on_with_programs_on_all_cores(then, now, same):
    task = str(ROOT / "conf" / "double_integrator.yaml")
    stored, given = (load_config(task, [f"training.threads={threads or 'null'}"]) for threads in (then, now))
    with contextlib.nullcontext() if same else pytest.raises(UsageError, match=r"got another training\.threads"):
        plan._require_same_experiment(given, stored, Path("last.ckpt"))


@pytest.mark.parametrize(("name", "same"), [("own:Price", True), ("quadratic", False)])
def test_a_run_goes_on_whatever_is_written_in_settings_that_are_not_read(name, same):
    """Such as cost.Q beside a cost that was passed as an object."""
    task = str(ROOT / "conf" / "double_integrator.yaml")
    given, stored = (load_config(task, [f"cost.name={name}", f"cost.Q={Q}"]) for Q in ("[1, 1]", "null"))
    with contextlib.nullcontext() if same else pytest.raises(UsageError, match=r"got another cost\.Q"):
        plan._require_same_experiment(given, stored, Path("last.ckpt"))


def test_resuming_another_config_is_refused_before_the_first_checkpoint_too(desk):
    survives(desk, [(dies_at, MODULE, "training_step", 2)])
    status, _, message = desk.train("--resume", "last", "program.margin=0.2", prepare=without_figures)
    assert status == 2
    assert message.count("\n") == 1
    assert "program.margin" in message
    assert not desk.last.exists()


def test_resuming_before_the_first_checkpoint_says_that_it_starts_anew(desk):
    said = "stopped before its first checkpoint: training starts anew from step 0\n"
    survives(desk, [(dies_at, MODULE, "training_step", 2)])
    _, output, _ = desk.train("--resume", "last", prepare=without_figures)
    assert said in output
    assert "resuming from" not in output
    _, output, _ = desk.train("--resume", "last", "training.iterations=18", prepare=without_figures)  # the twin
    assert said not in output
    assert f"resuming from step {STEPS} of 18" in output


def test_resuming_a_finished_run_says_so(reference, ask):
    files = [path for path in reference.run.rglob("*") if path.name != ".lock"]
    before = {path: path.stat().st_mtime_ns for path in files}
    status, output, message = ask(reference, "--resume", "last")
    assert (status, message) == (0, "")
    assert "finished" in output
    assert "training.iterations" in output
    assert {path: path.stat().st_mtime_ns for path in files} == before


def test_raising_the_iterations_goes_on(finished):
    earlier = logged(finished.run)
    status, output, _ = finished.train("--resume", "last", "training.iterations=21", prepare=without_figures)
    assert status == 0
    assert f"resuming from step {STEPS} of 21 (logs/small/version_0/checkpoints/last.ckpt)\n" in output
    assert finished.runs == ["version_0"]
    assert read_checkpoint(finished.last)["global_step"] == 21
    curves = logged(finished.run)
    assert [step for step, _ in curves["loss/train"]] == list(range(1, 22))
    assert curves["loss/train"][:STEPS] == earlier["loss/train"]
    assert [step for step, _ in curves["trajectory_cost/val"]] == [*VALIDATIONS, 20, 21]
    assert len(curves["hp/cost_mean"]) == 1
    assert load_config(finished.run / "config.yaml").training.iterations == 21


def test_resuming_a_path_goes_on_in_its_folder(finished):
    path = finished.run / "checkpoints" / "last.ckpt"
    assert finished.train("--resume", str(path), "training.iterations=18", prepare=without_figures)[0] == 0
    assert finished.runs == ["version_0"]
    assert read_checkpoint(path)["global_step"] == 18


@pytest.mark.parametrize(
    ("arguments", "status", "named"),
    [
        (("--resume", "nowhere.ckpt"), 2, "nowhere.ckpt"),
        (("--resume", "last", "--finetune", "x.ckpt"), 2, "both"),
        (("--finetune", "nowhere.ckpt"), 2, "nowhere.ckpt"),
        (("--finetune", "cut.ckpt"), 1, "cut.ckpt"),
        (("--resume", "cut.ckpt"), 1, "cut.ckpt"),
        (("--resume", "last", "experiment=unknown"), 2, "unknown"),
        (("--resume",), 2, "--resume"),
        (("--nonsense",), 2, "--nonsense"),
        (("--config", "nowhere.yaml"), 2, "nowhere.yaml"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else str(value),
)
def test_impossible_commands_are_refused_in_one_line(arguments, status, named, finished, ask):
    (finished.folder / "cut.ckpt").write_bytes(finished.last.read_bytes()[:1000])
    got, _, message = ask(finished, *arguments)
    assert got == status
    assert message.count("\n") == 1
    assert named in message
    assert finished.runs == ["version_0"], "a refused run leaves no folder"
    lyapnet.load(finished.last)


def test_truncated_last_checkpoint_is_refused_and_the_best_one_loads(finished, ask):
    finished.last.write_bytes(finished.last.read_bytes()[:-100])
    status, _, message = ask(finished, "--resume", "last", "training.iterations=40")
    assert status == 1
    assert message.count("\n") == 1
    assert "last.ckpt" in message
    lyapnet.load(finished.run / "checkpoints" / "best.ckpt")


# A last checkpoint that is lost


LOSSES = {
    "missing": lambda last: last.unlink(),
    "a loop": lambda last: (last.unlink(), last.symlink_to(last)),
    "a dangling link": lambda last: (last.unlink(), last.symlink_to("nowhere")),
    "empty": lambda last: last.write_bytes(b""),
    "a folder": lambda last: (last.unlink(), last.mkdir()),
    "flipped": lambda last: last.write_bytes(flipped(last.read_bytes())),
}


def flipped(whole):
    """With one bit of its largest tensor changed."""
    with zipfile.ZipFile(io.BytesIO(whole)) as archive:
        largest = max((e for e in archive.infolist() if "/data/" in e.filename), key=lambda e: e.file_size)
        place = whole.index(archive.read(largest))
    return whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :]


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.name != ".lock"}


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("kept", ["everything", "no evaluation", "no best", "only the event files"])
def test_without_its_last_checkpoint_a_run_is_not_begun_again(loss, kept, finished, ask):
    if kept in ("no evaluation", "only the event files"):
        (finished.run / "evaluation.json").unlink()
    if kept in ("no best", "only the event files"):
        finished.best().unlink()
    LOSSES[loss](finished.last)
    before = contents(finished.run)
    status, _, message = ask(finished, "--resume", "last", "training.iterations=40")
    assert status in (1, 2)
    assert message.count("\n") == 1
    assert "last.ckpt" in message
    assert (f"--resume {finished.best().relative_to(finished.folder)}" in message) is finished.best().exists()
    assert contents(finished.run) == before


def test_run_of_version_0_1_is_not_begun_again_where_a_best_checkpoint_is(finished, ask):
    """Its record does not say whether the last one was written."""
    record = finished.run / "run.json"
    record.write_text(json.dumps({k: v for k, v in json.loads(record.read_text()).items() if k != "saved"}))
    (finished.run / "evaluation.json").unlink()
    finished.last.unlink()
    status, _, message = ask(finished, "--resume", "last")
    assert status == 2
    assert "best.ckpt" in message


def test_from_its_best_checkpoint_a_run_goes_on_to_the_same_end(desk, reference):
    prepare = functools.partial(both, without_figures, functools.partial(dies_at, MODULE, "training_step", 13))
    assert desk.train(prepare=prepare)[0] == -signal.SIGKILL
    desk.last.unlink()
    assert desk.train("--resume", "last", prepare=without_figures)[0] == 2
    assert desk.train("--resume", str(desk.best()), prepare=without_figures)[0] == 0
    assert_same_end(desk, reference, pictures=False)


RECORDS = {
    "garbage": "{",
    "empty": "",
    "a list": "[]",
    "not text": "\udcff",
    "deep": "[" * 100_000,
    "no origin": '{"compiled": false}',
    "another origin": '{"finetuned_from": 3}',
    "another kind": '{"finetuned_from": null, "saved": "yes"}',
    "seconds": '{"finetuned_from": null, "training_seconds": "many"}',
}


@pytest.mark.parametrize("record", RECORDS)
def test_record_that_was_damaged_is_one_line(record, finished, ask):
    (finished.run / "run.json").write_bytes(RECORDS[record].encode(errors="surrogateescape"))
    before = contents(finished.run)
    status, _, message = ask(finished, "--resume", "last", "training.iterations=40")
    assert status == 1
    assert message.count("\n") == 1
    assert "run.json" in message
    assert "Traceback" not in message
    assert contents(finished.run) == before


def test_folders_that_are_numbered_otherwise_are_no_runs(finished, ask):
    for name in ("version_²", "version_x", "version_-1", "version_"):
        (finished.run.parent / name).mkdir()
    (finished.run.parent / "version_7").touch()
    assert ask(finished, "--resume", "last")[0] == 0


# At the same time


def test_run_in_progress_is_not_resumed_by_another_process(desk, ask):
    process = desk.start("training.iterations=100000", prepare=without_figures)
    desk.wait_for("step 5/", process)
    for resume in ("last", str(desk.last), str(desk.best())):
        status, _, message = ask(desk, "--resume", resume, "training.iterations=100001")
        assert status == 2
        assert message.count("\n") == 1
        assert f"process {process.pid} on" in message
    os.kill(process.pid, signal.SIGKILL)
    desk.end(process)
    content = read_checkpoint(desk.last)  # the lock went with the process
    assert f"process {process.pid} on" in (desk.run / ".lock").read_text()
    status, _, errors = desk.train("--resume", "last", f"training.iterations={content['global_step'] + 1}")
    assert (status, errors) == (0, "")


@pytest.mark.gate
def test_of_two_that_resume_at_the_same_time_one_is_refused(finished, tmp_path):
    (tmp_path / "other").mkdir()
    desks = [finished, Desk(tmp_path / "other")]
    (tmp_path / "other" / "logs").symlink_to(finished.folder / "logs")
    arguments = ("--resume", "last", "training.iterations=150")
    processes = [desk.start(*arguments, prepare=without_figures) for desk in desks]
    ends = [desk.end(process) for desk, process in zip(desks, processes, strict=True)]
    (_, _, quiet), (_, _, refusal) = sorted(ends)
    assert sorted(status for status, _, _ in ends) == [0, 2]
    assert quiet == ""
    assert refusal.count("\n") == 1
    assert "is training" in refusal
    assert [step for step, _ in logged(finished.run)["loss/train"]] == list(range(1, 151))


def test_runs_that_start_at_the_same_time_have_folders_of_their_own(tmp_path):
    config = config_from_plain({**SMALL, "logs": str(tmp_path)})
    together = threading.Barrier(8)

    def start(_):
        together.wait()
        run, lock = new_run(config, None)
        return run.folder.name, lock

    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(start, range(8)))
    assert sorted(name for name, _ in found) == [f"version_{k}" for k in range(8)]
    assert sorted(path.name for path in (tmp_path / "small").iterdir()) == [f"version_{k}" for k in range(8)]


def test_further_process_of_a_run_is_not_refused(desk, monkeypatch):
    config = config_from_plain({**SMALL, "logs": str(desk.folder)})
    first = plan_run(config)
    monkeypatch.setenv("LOCAL_RANK", "1")
    second = plan_run(config)
    assert second.run == first.run
    assert second.lock is None
    assert plan_run(config, "last").run == first.run
    monkeypatch.delenv("LOCAL_RANK")
    with pytest.raises(UsageError, match=f"process {os.getpid()} on"):  # the twin
        plan_run(config, "last")


def test_lock_is_no_way_to_another_file(desk):
    precious = desk.folder / "precious"
    precious.write_text("kept")
    (desk.folder / "run").mkdir()
    (desk.folder / "run" / ".lock").symlink_to(precious)
    with pytest.raises(LyapnetError, match="Expected a writable folder"):
        RunLock(desk.folder / "run")
    assert precious.read_text() == "kept"


def test_lock_ends_with_its_block_and_with_its_last_name(tmp_path):
    with RunLock(tmp_path), pytest.raises(UsageError, match=f"which process {os.getpid()} on"):
        RunLock(tmp_path)
    held = RunLock(tmp_path)
    with pytest.raises(UsageError):
        RunLock(tmp_path)
    del held
    with RunLock(tmp_path):
        pass


@pytest.mark.parametrize("code", [errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP])
def test_run_on_a_file_system_without_locks_goes_on(code, tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(fcntl, "flock", refuse)
    with RunLock(tmp_path):
        pass
    with RunLock(tmp_path):
        pass
    assert {path.name for path in tmp_path.iterdir()} <= {".lock"}


@pytest.mark.parametrize("removed", ["version_0", "small", "logs"])
def test_folder_that_is_removed_while_it_trains_is_one_line(removed, desk):
    process = desk.start("training.iterations=3000", "training.validate_every=50", prepare=without_figures)
    desk.wait_for("step 50/", process)
    folder = {"version_0": desk.run, "small": desk.run.parent, "logs": desk.run.parent.parent}[removed]
    folder.rename(desk.folder / "gone")  # at once: file by file, it would meet those that are written meanwhile
    status, _, errors = desk.end(process)
    assert status == 1
    assert errors.count("\n") == 1, errors
    assert "removed" in errors
    assert "logs/small/version_0" in errors


def reads_only(folder):
    """Make a folder and all in it read-only, for root too, who loses the right to pass over that."""
    without_figures()
    for path in (folder, *folder.rglob("*")):
        path.chmod(path.stat().st_mode & ~0o222)
    header, none = struct.pack("Ii", 0x20080522, 0), struct.pack("6I", *[0] * 6)
    assert ctypes.CDLL(None, use_errno=True).capset(header, none) == 0


def test_read_only_folders_are_one_line(finished):
    before = contents(finished.run)
    for arguments in (("--resume", "last", "training.iterations=40"), ()):
        status, _, errors = finished.train(*arguments, prepare=functools.partial(reads_only, finished.folder / "logs"))
        assert status == 1
        assert errors.count("\n") == 1, errors
        assert "Expected a writable folder" in errors
        assert "logs/small" in errors
    for path in (finished.folder / "logs", *(finished.folder / "logs").rglob("*")):
        path.chmod(0o755)
    assert contents(finished.run) == before
    assert finished.runs == ["version_0"]


# With classes of the user's own

OWN = """
import torch
from lyapnet import ControlAffineSystem
from lyapnet.value.networks import FCN

class Cart(ControlAffineSystem):
    state_names, state_units = ("position", "velocity"), ("m", "m/s")
    control_names, control_units = ("force",), ("N",)

    def f(self, x):
        return torch.stack([x[..., 1], -x[..., 1]], -1)

    def g(self, x):
        return torch.tensor([[0.0], [1.0]]).to(x).expand(*x.shape, 1)

class Sledge(Cart):
    def f(self, x):
        return 0.9 * super().f(x)

class Network(FCN):
    pass
"""


def test_classes_of_the_users_own_train_resume_and_load(tmp_path):
    desk = Desk(
        tmp_path,
        system={"name": "own:Cart"},
        cost={"Q": [1, 1], "R": [1], "Q_T": [1, 1]},
        network={"name": "own:Network", "hidden": [4]},
    )
    (tmp_path / "own.py").write_text(OWN)
    assert desk.train("training.iterations=2")[0] == 0
    assert desk.train("--resume", "last", "training.iterations=3", prepare=without_figures)[0] == 0
    with pytest.raises(UsageError, match="own:Cart"):
        lyapnet.load(desk.last)
    with pytest.raises(UsageError, match="own:Network"):
        lyapnet.load(desk.last, system=DoubleIntegrator())
    controller = lyapnet.load(desk.last, system=DoubleIntegrator(), network=FCN)
    assert controller.rollout([[1.0, 0.0]]).cost.shape == (1,)


# Fine-tuned


def first_validation(path, desk, *overrides):
    """The mean cost on the validation states of a checkpoint's weights under the desk's config."""
    config = load_config(desk.folder / "experiment.yaml", overrides)
    problem = build_problem(config)
    V = build_value_function(config, problem)
    load_value_function(V, read_checkpoint(path), path)
    states = problem.initial_states.sample(config.evaluation.validation_states, stream(config.seed, VALIDATION))
    return float(Controller(problem, V).rollout(states).cost.mean())


def finetunes(desk, source, *overrides):
    """A short run from the weights of a checkpoint, and its first validation the source's V."""
    overrides = (*overrides, "training.iterations=2", "experiment=tuned")
    status, _, errors = desk.train("--finetune", str(source), *overrides, prepare=without_figures)
    assert status == 0, errors
    run = desk.folder / "logs" / "tuned" / "version_0"
    expected = first_validation(source, desk, *overrides)
    assert values(run, "trajectory_cost/val")[0] == pytest.approx(expected, rel=1e-6)
    assert json.loads((run / "run.json").read_text())["finetuned_from"].endswith(source.name)
    assert read_checkpoint(run / "checkpoints" / "last.ckpt")["global_step"] == 2


@pytest.mark.parametrize("override", ["horizon.steps=20", "system.parameters.mass=2", "initial_states.upper=[2, 1]"])
def test_finetuning_another_task_starts_from_the_weights(override, finished):
    before = finished.last.read_bytes()
    finetunes(finished, finished.last, override)
    assert finished.last.read_bytes() == before


def test_finetuning_needs_a_system_and_a_network_of_the_users_where_the_checkpoint_has_them(tmp_path):
    """As --system and --network of the commands that load: what the file names is never imported."""
    system, network = {"name": "own:Cart"}, {"name": "own:Network", "hidden": [4]}
    desk = Desk(tmp_path, system=system, cost={"Q": [1, 1], "R": [1], "Q_T": [1, 1]}, network=network)
    (tmp_path / "own.py").write_text(OWN)
    assert desk.train("training.iterations=2", prepare=without_figures)[0] == 0
    for override in ("system.name=double_integrator", "network.name=fcn"):
        status, _, errors = desk.train("--finetune", str(desk.last), override)
        key, name = override.split("=")
        assert status == 2
        assert errors.splitlines()[-1].startswith(f"error: Expected {key} as module:Class for {str(desk.last)!r}, ")
        assert f", got {name}; " in errors
    tuned = ("--finetune", str(desk.last), "training.iterations=2", "experiment=tuned")
    assert desk.train(*tuned, "system.name=own:Sledge", prepare=without_figures)[0] == 0


def test_finetuning_from_the_value_to_the_lyapunov_program(tmp_path):
    desk = Desk(
        tmp_path,
        program={"name": "value", "trajectory_cost": 1},
        network={"name": "fcn", "hidden": [8, 8], "terminal": "exact"},
    )
    assert desk.train("training.iterations=6", prepare=without_figures)[0] == 0
    finetunes(desk, desk.last, "program.name=lyapunov", "program.margin=0.1")


@pytest.mark.parametrize(
    ("override", "named"),
    [("network.hidden=[8, 9]", "through.1.weight has shape (8, 2)"), ("network.name=fcn", "hidden.0.weight is only")],
)
def test_finetuning_another_network_names_the_tensors_that_differ(override, named, finished, ask):
    status, _, message = ask(finished, "--finetune", str(finished.last), override)
    assert status == 1
    assert message.count("\n") == 1
    assert named in message
    assert str(finished.last) in message
    assert finished.runs == ["version_0"], "a refused run leaves no folder"


# Failed


@pytest.fixture
def unstable(tmp_path):
    """A cartpole whose learning rate is too large."""
    return Desk(
        tmp_path,
        system={"name": "cartpole"},
        cost={"Q": [0, 25, 0.5, 0.1], "R": "inverse_mass", "Q_T": [80, 600, 0.8, 4.5]},
        initial_states={"lower": [-0.6, -0.6, -0.2, -0.2], "upper": [0.6, 0.6, 0.2, 0.2]},
        horizon={"steps": 40, "dt": 0.05},
        program={"name": "value", "trajectory_cost": 1},
        network={"name": "fcn", "hidden": [8, 8], "terminal": "exact"},
        training={"iterations": 30, "batch_size": 6, "learning_rate": 30, "validate_every": 1},
        evaluation={"validation_states": 6, "test_states": 6, "optimum": False},
        trainer={},
    )


@pytest.mark.parametrize(("validate_every", "rate"), [(1, 30), (3, 0.3)])
def test_divergence_is_one_line_and_keeps_the_last_good_checkpoint(validate_every, rate, unstable):
    """Whether a validation meets it first or a training step."""
    changes = f"training.validate_every={validate_every}", f"training.learning_rate={rate}"
    status, _, errors = unstable.train(*changes, prepare=without_figures)
    assert status == 1
    assert errors.count("\n") == 1, errors
    for text in ("Expected a", "Iteration", "returns did not help", "last.ckpt"):
        assert text in errors
    weights = lyapnet.load(unstable.last).V.state_dict().values()
    assert all(tensor.isfinite().all() for tensor in weights)
    assert read_checkpoint(unstable.last)["global_step"] >= 1


def test_debug_shows_the_traceback(unstable):
    status, _, errors = unstable.train("--debug", prepare=without_figures)
    assert status == 1
    assert "Traceback" in errors
    assert "DivergenceError" in errors


def test_file_in_the_place_of_the_log_folder_is_one_line(desk, ask):
    (desk.folder / "taken").touch()
    status, _, message = ask(desk, "logs=taken")
    assert status == 1
    assert message.count("\n") == 1
    assert "'taken/small'" in message
    assert "logs=" in message


def limit_file_size(size):
    """As a full disk, without the need of one: no file may grow beyond this."""
    without_figures()
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))


def test_full_disk_is_one_line_and_keeps_the_previous_checkpoint(tmp_path):
    desk = Desk(tmp_path, network={"name": "anchored", "hidden": [48, 48]})
    assert desk.train("training.iterations=2", prepare=without_figures)[0] == 0
    before, size = desk.last.read_bytes(), desk.last.stat().st_size
    full = functools.partial(limit_file_size, size // 2)
    status, _, errors = desk.train("--resume", "last", "training.iterations=5", prepare=full)
    assert status == 1
    assert errors.count("\n") == 1, errors
    assert "ckpt" in errors
    assert desk.last.read_bytes() == before
    assert {path.name for path in desk.last.parent.iterdir()} == {"last.ckpt", "best.ckpt"}
    lyapnet.load(desk.last)
    assert desk.train("--resume", "last", "training.iterations=5", prepare=without_figures)[0] == 0
    assert [step for step, _ in logged(desk.run)["loss/train"]] == [1, 2, 3, 4, 5]


def test_full_disk_while_logging_is_one_line(finished):
    before = finished.last.read_bytes()
    full = functools.partial(limit_file_size, 20_000)
    status, _, errors = finished.train("--resume", "last", "training.iterations=40", prepare=full)
    assert status == 1
    assert errors.count("\n") == 1, errors
    assert finished.last.read_bytes() == before
    assert finished.train("--resume", "last", "training.iterations=40", prepare=without_figures)[0] == 0
    assert [step for step, _ in logged(finished.run)["loss/train"]] == list(range(1, 41))

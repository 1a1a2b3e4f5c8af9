"""What loggers keep of a run that is resumed: each step once, in metrics.csv and in both of TensorBoard's readers."""

import csv
import shutil
import threading
import time
from contextlib import nullcontext
from pathlib import Path

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.summary.writer.event_file_writer import EventFileWriter

import lyapnet
from lyapnet.base.files import write_atomically
from lyapnet.training import figure_logger
from lyapnet.training.loggers import without_writer_tracebacks
from lyapnet.training.metrics_file import MetricsFile, read_curves
from tests.runs import SMALL, logged

CONFIG = {**SMALL, "training": {"iterations": 4, "batch_size": 6, "validate_every": 2}}


def table(folder):
    """The header of metrics.csv, and its rows without what is empty or measured time."""
    with (folder / "metrics.csv").open(newline="") as file:
        reader = csv.DictReader(file)
        rows = [{k: float(v) for k, v in row.items() if v and k != "wall_time"} for row in reader]
        return reader.fieldnames, rows


# metrics.csv


@pytest.fixture
def metrics(tmp_path):
    """Three steps, saved after the second."""
    file = MetricsFile(tmp_path)
    for step in (1, 2, 3):
        file.log_metrics({"loss": step / 10}, step)
        if step == 2:
            file.log_metrics({"cost": 5.0}, step)
            file.save()
    file.save()
    return file


def test_a_row_for_each_step_and_a_column_for_each_metric(metrics, tmp_path):
    header, rows = table(tmp_path)
    assert header == ["step", "wall_time", "loss", "cost"]
    assert rows == [{"step": 1, "loss": 0.1}, {"step": 2, "loss": 0.2, "cost": 5.0}, {"step": 3, "loss": 0.3}]
    assert read_curves(tmp_path, "cost", "step", "loss") == [(5.0, 2.0, 0.2)]
    assert read_curves(tmp_path, "loss", "cost") == [(0.1, None), (0.2, 5.0), (0.3, None)]
    assert read_curves(tmp_path / "nowhere", "loss") == []


def test_only_a_new_metric_rewrites_the_file(metrics, tmp_path, monkeypatch):
    written = []
    monkeypatch.setattr(
        "lyapnet.training.metrics_file.write_atomically",
        lambda path, content: (written.append(path), write_atomically(path, content)),
    )
    metrics.log_metrics({"loss": 0.4}, 4)
    metrics.save()
    metrics.save()
    assert not written
    metrics.log_metrics({"error": 1.0}, 5)
    metrics.save()
    assert len(written) == 1
    header, rows = table(tmp_path)
    assert header[-1] == "error"
    assert [row["step"] for row in rows] == [1, 2, 3, 4, 5]
    assert rows[1]["cost"] == 5.0


@pytest.mark.parametrize("torn", ["4", "1,17", "3,1.5,0.3,"])
def test_what_a_killed_process_left_unfinished_is_dropped(torn, metrics, tmp_path):
    path = tmp_path / "metrics.csv"
    whole = path.read_text()
    path.write_text(whole + torn)
    MetricsFile(tmp_path).drop_after(3)
    assert path.read_text() == whole


def test_going_on_from_a_step_takes_back_the_later_ones(metrics, tmp_path):
    MetricsFile(tmp_path).drop_after(1)
    assert [row["step"] for row in table(tmp_path)[1]] == [1]
    MetricsFile(tmp_path / "nothing").drop_after(1)
    assert not (tmp_path / "nothing").exists()


# TensorBoard


@pytest.fixture(scope="module")
def resumed(tmp_path_factory):
    """A run to step 6, gone on with to step 8, then again from step 6 to step 10: two ends are taken back."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figure_logger, "figures_of", lambda learner: {})
        home = f"logs={tmp_path_factory.mktemp('resumed')}"
        run = lyapnet.train(CONFIG, [home, "training.iterations=6"])
        early = run.checkpoints / "early.ckpt"
        shutil.copy(run.last, early)
        time.sleep(1)  # TensorBoard reads files in the order of their names, which have the second they were begun in
        lyapnet.train(CONFIG, [home, "training.iterations=8"], resume="last")
        time.sleep(1)
        lyapnet.train(CONFIG, [home, "training.iterations=10"], resume=str(early))
    return run


STEPS, VALIDATIONS = list(range(1, 11)), [0, 2, 4, 6, 8, 10]


def test_metrics_file_has_each_step_once(resumed):
    _, rows = table(resumed.folder)
    assert [row["step"] for row in rows] == [0, *STEPS]
    assert [row["step"] for row in rows if "trajectory_cost/val" in row] == VALIDATIONS


def test_tensorboards_own_loader_shows_each_step_once(resumed):
    curves = logged(resumed.folder)
    assert [step for step, _ in curves["loss/train"]] == STEPS
    assert [step for step, _ in curves["trajectory_cost/val"]] == VALIDATIONS
    for tag in ("hp/cost_mean", "_hparams_/session_start_info"):
        assert len(curves[tag]) == 1, "the final metrics of the earlier ends are taken back"


def test_the_accumulator_that_scripts_use_shows_each_step_once(resumed):
    accumulator = EventAccumulator(str(resumed.folder), size_guidance={"scalars": 0}).Reload()
    assert [event.step for event in accumulator.Scalars("loss/train")] == STEPS
    assert [event.step for event in accumulator.Scalars("trajectory_cost/val")] == VALIDATIONS
    assert len(accumulator.Scalars("hp/cost_mean")) == 1


def test_both_show_what_metrics_file_has(resumed):
    """Event files hold 32 bits of it."""
    _, rows = table(resumed.folder)
    accumulator = EventAccumulator(str(resumed.folder), size_guidance={"scalars": 0}).Reload()
    for tag in ("loss/train", "gradient_norm", "constraint_loss/val"):
        expected = [row[tag] for row in rows if tag in row]
        assert [event.value for event in accumulator.Scalars(tag)] == pytest.approx(expected, rel=1e-6)


def test_finished_run_is_left_as_it_is(resumed):
    def times():
        return {path: path.stat().st_mtime_ns for path in resumed.folder.rglob("*") if path.name != ".lock"}

    before = times()
    again = lyapnet.train(CONFIG, [f"logs={resumed.folder.parents[1]}", "training.iterations=10"], resume="last")
    assert again.evaluation == resumed.evaluation
    assert times() == before


@pytest.mark.parametrize(("quiet", "told"), [(True, 0), (False, 1)])
def test_a_writer_whose_folder_is_gone_tells_the_training_alone(quiet, told, tmp_path, monkeypatch):
    seen, folder = [], tmp_path / "run"
    monkeypatch.setattr(threading, "excepthook", seen.append)
    with without_writer_tracebacks() if quiet else nullcontext():
        writer = EventFileWriter(str(folder))
        writer.flush()
        shutil.rmtree(folder)
        writer.add_event(Event(step=1))
        writer._async_writer._worker.join(timeout=10)
        with pytest.raises(OSError, match="run"):
            writer.add_event(Event(step=2))
    assert len(seen) == told


def test_other_threads_are_heard():
    raised = []
    before, threading.excepthook = threading.excepthook, raised.append
    try:
        with without_writer_tracebacks():
            thread = threading.Thread(target=Path("/nowhere/at/all").stat)
            thread.start()
            thread.join()
    finally:
        threading.excepthook = before
    assert len(raised) == 1


@pytest.mark.gate
def test_the_last_step_shows_closed_loops_in_motion(tmp_path):
    config = {**CONFIG, "evaluation": {**CONFIG["evaluation"], "animate": True}}
    run = lyapnet.train(config, [f"logs={tmp_path}"])
    accumulator = EventAccumulator(str(run.folder), size_guidance={"images": 0}).Reload()
    (shown,) = accumulator.Images("closed_loop")
    assert shown.step == 4
    assert shown.encoded_image_string.startswith(b"GIF89a")
    assert "closed_loop" not in logged(lyapnet.train(CONFIG, [f"logs={tmp_path}"]).folder)

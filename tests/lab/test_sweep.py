"""Sweeps: each run once, in a process of its own; what is missing is filled in; what is shown is what was run."""

import csv
import io
import json
import re
from pathlib import Path

import pytest
from rich.console import Console

from lyapnet.base.errors import UsageError
from lyapnet.cli import main
from lyapnet.lab.comparison import workers
from lyapnet.lab.sweep.figures import swept as swept_figure
from lyapnet.lab.sweep.points import points_of
from lyapnet.lab.sweep.runs import rows_of, sweep
from lyapnet.lab.sweep.tables import sweep_table

CONF = Path(__file__).parents[2] / "conf"
CHAIN = CONF / "integrator_chain.yaml"
SMALL = [
    "horizon.steps=5", "network.hidden=[4]", "training.iterations=2", "training.batch_size=3",
    "rollout.compile=off", "evaluation.validation_states=2", "evaluation.test_states=4", "seeds=2",
    "loggers=[csv]",
]  # fmt: skip


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    """A sweep over two lengths: its folder, and what it was asked."""
    folder = tmp_path_factory.mktemp("sweep")
    arguments = ["sweep", "--config", str(CHAIN), "--vary", "system.parameters.length=2,3", "--workers", "2"]
    arguments += ["--out", str(folder / "out"), f"logs={folder / 'logs'}", *SMALL]
    assert main(arguments) == 0
    return folder, arguments


@pytest.fixture
def commands(monkeypatch):
    """The trainings that are asked for, of which none takes place."""
    asked = []

    def run(job, started):
        asked.append(job.command)
        return 0.0, "error: the last words"

    monkeypatch.setattr(workers, "run_process", run)
    return asked


def points(folder, *overrides, vary="system.parameters.length=2,3"):
    return points_of([CHAIN], vary, [f"logs={folder / 'logs'}", *SMALL, *overrides])


@pytest.mark.gate
def test_each_seed_of_each_value_is_a_row(swept):
    folder, _ = swept
    with (folder / "out" / "sweep.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["value"], row["seed"]) for row in rows] == [("2", "0"), ("2", "1"), ("3", "0"), ("3", "1")]
    stored = folder / "logs" / "integrator_chain" / "system.parameters.length=3" / "version_0" / "evaluation.json"
    first, second = json.loads(stored.read_text())["seeds"]
    assert [float(row["cost_mean"]) for row in rows[2:]] == [first["cost_mean"], second["cost_mean"]]
    assert first["cost_mean"] != second["cost_mean"]
    assert all(float(row["training_seconds"]) > 0 and int(row["peak_bytes"]) > 1e8 for row in rows)
    assert all(Path(row["checkpoint"]).is_file() for row in rows)


@pytest.mark.gate
def test_finished_runs_are_not_run_again(swept, commands, capsys):
    _, arguments = swept
    assert main(arguments) == 0
    assert not commands
    shown = capsys.readouterr().out
    assert "integrator_chain: best checkpoints" in shown
    assert shown.count("worst") == 2
    assert "closest to the optimum: system.parameters.length=3" in shown
    assert main([*arguments, "training.iterations=3"]) == 1, "another config is another run"
    assert len(commands) == 2


@pytest.mark.gate
def test_a_stopped_run_goes_on(swept, commands):
    folder, _ = swept
    point = points(folder)[0]
    finished = point.run().folder / "evaluation.json"
    content = finished.read_text()
    finished.unlink()
    try:
        assert not point.finished
        assert not sweep([point], 1, print)
    finally:
        finished.write_text(content)
    assert commands[0][-2:] == ["--resume", str(point.run().last)]
    said = []
    assert not sweep(points(folder, vary="system.parameters.length=5"), 1, said.append)
    assert re.search(r"failed: .*length=5.*the last words", said[-1])
    assert "--resume" not in commands[1]


def test_without_a_key_the_configs_keep_their_own_folders(tmp_path):
    point, other = points_of([CHAIN, CONF / "from_scratch" / "double_integrator.yaml"], None, [f"logs={tmp_path}"])
    assert (point.config.experiment, other.config.experiment) == ("integrator_chain", "double_integrator_from_scratch")
    assert point.run() is None


@pytest.mark.parametrize(
    ("configs", "vary", "named"),
    [
        ([CHAIN], "horizon.steps", "key=value,value"),
        ([CHAIN], "=3", "key=value,value"),
        ([CHAIN], "horizon.stepz=3", "horizon.steps?"),
        ([CHAIN], "horizon.steps=3,0", "horizon.steps ≥ 1"),
        ([], None, "--config PATH"),
        ([CHAIN, CHAIN], None, "integrator_chain twice"),
        ([CHAIN], "horizon.steps=3,3", "twice"),
    ],
)
def test_what_cannot_be_swept_is_refused_before_anything_is_trained(configs, vary, named, commands):
    with pytest.raises(UsageError, match=named.replace("?", r"\?")):
        points_of(configs, vary, [])
    assert not commands


@pytest.mark.gate
def test_figure_shows_every_seed_and_every_measure(swept):
    folder, _ = swept
    rows = [row for point in points(folder) for row in rows_of(point, point.run())]
    figure = swept_figure(rows)
    panel = figure.axes[0]
    assert panel.get_xlabel() == "system.parameters.length"
    assert {axes.get_ylabel() for axes in figure.axes} >= {"mean cost J", "cost / optimum", "peak memory (MB)"}
    *points_drawn, line = panel.lines
    assert sorted(y for drawn in points_drawn for y in drawn.get_ydata()) == sorted(
        row.measures["cost_mean"] for row in rows
    )
    two = [row.measures["cost_mean"] for row in rows if row.value == "2"]
    assert line.get_ydata()[0] == pytest.approx(sum(two) / 2)


@pytest.mark.gate
def test_a_run_that_fails_is_named_and_the_others_are_shown(swept, commands, capsys):
    _, arguments = swept
    more = [a.replace("length=2,3", "length=2,3,4") for a in arguments]
    assert main(more) == 1
    shown = capsys.readouterr()
    assert "length=4 failed" not in shown.out
    assert "integrator_chain: best checkpoints" in shown.out
    assert "the last words" in shown.err
    assert "1 failed" in shown.err


@pytest.mark.gate
def test_a_finetuned_run_is_not_the_training_itself(swept):
    folder, _ = swept
    point = points(folder)[0]
    record = point.run().folder / "run.json"
    content = record.read_text()
    record.write_text(json.dumps({**json.loads(content), "finetuned_from": "elsewhere.ckpt"}))
    try:
        assert point.run() is None
    finally:
        record.write_text(content)
    assert point.run() is not None


@pytest.mark.gate
def test_seconds_to_the_optimum_are_read_from_the_metrics(swept):
    folder, _ = swept
    point = points(folder)[0]
    metrics = point.run().folder / "seed_0" / "metrics.csv"
    content = metrics.read_text()
    try:
        metrics.write_text("step,wall_time,optimality_gap/val\n0,100.0,3.0\n1,104.0,\n2,107.5,0.01\n")
        assert next(rows_of(point, point.run())).seconds_to_near == 7.5
        metrics.write_text("step,wall_time,optimality_gap/val\n0,100.0,3.0\n2,107.5,0.03\n")
        assert next(rows_of(point, point.run())).seconds_to_near is None
        metrics.unlink()  # as in a run of lyapnet 0.1
        rows = list(rows_of(point, point.run()))
        assert rows[0].seconds_to_near is None
        console = Console(width=200, file=io.StringIO())
        console.print(sweep_table("chain", rows))
        assert "–" in console.file.getvalue()
    finally:
        metrics.write_text(content)

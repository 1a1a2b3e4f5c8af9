"""lyapnet evaluate, and the optimum in a training: what is reported, and what is not where there is no optimum."""

import contextlib
import csv
import io
import json
import shutil
import sys
from pathlib import Path

import pytest
import torch

from lyapnet.cli import main
from lyapnet.controller.loading import load
from lyapnet.evaluation.measurement import evaluation
from lyapnet.evaluation.oracles import oracle_of
from lyapnet.evaluation.oracles.transcription import Transcription
from lyapnet.evaluation.robustness import disturbances
from lyapnet.experiment.checkpoint import read_checkpoint

CONF = Path(__file__).parents[2] / "conf"


@pytest.fixture(autouse=True)
def _empty_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("LYAPNET_CACHE", str(tmp_path / "cache"))


SMALL = ["horizon.steps=6", "network.hidden=[4]", "training.iterations=2", "training.validate_every=1",
         "evaluation.validation_states=4", "evaluation.test_states=4",
         "rollout.gradient=backprop", "loggers=[csv]"]  # neither traces nor figures  # fmt: skip


def train(folder, *arguments):
    return main(
        ["train", "--config", str(CONF / "from_scratch" / "reacher.yaml"), *SMALL, f"logs={folder}", *arguments]
    )


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """(folder, printed lines) of a short training on the reacher."""
    folder, printed = tmp_path_factory.mktemp("trained"), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        patch.setenv("LYAPNET_CACHE", str(folder / "cache"))
        assert train(folder / "logs") == 0
    return folder / "logs" / "reacher_from_scratch" / "version_0", printed.getvalue()


@pytest.fixture
def run(trained):
    """The folder of that training."""
    return trained[0]


@pytest.fixture
def without_casadi(monkeypatch):
    for name in ("lyapnet.evaluation.oracles.transcription", "lyapnet.graphs.casadi_functions"):
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "casadi", None)


def evaluated(run, capsys, *arguments):
    capsys.readouterr()
    assert main(["evaluate", str(run / "checkpoints" / "best.ckpt"), "--samples", "5", *arguments]) == 0
    return capsys.readouterr().out


@pytest.mark.gate
def test_what_follows_the_horizon_is_told_where_it_is_asked_for(run, capsys, tmp_path):
    options = ["--no-optimum", "--until", "2"]
    later = json.loads(evaluated(run, capsys, "--json", "--figures", str(tmp_path), *options))["afterwards"]
    horizon = load(run / "checkpoints" / "best.ckpt").horizon
    assert [law["beyond"] for law in later] == ["riccati", "receding", "hold"]
    assert later[0]["distances"][-1]["time"] == pytest.approx(2 * horizon.duration)
    assert (tmp_path / "afterwards.png").is_file()
    shown = " ".join(evaluated(run, capsys, *options).split())
    assert "what follows T: mean ‖x − x*‖ of 5 closed loops" in shown
    assert f"{later[0]['distances'][-1]['mean']:.3g}" in shown
    assert "afterwards" not in json.loads(evaluated(run, capsys, "--json", "--no-optimum"))


@pytest.mark.gate
def test_evaluation_reports_the_optimum_of_a_nonlinear_task(run, capsys, tmp_path):
    files = ["--table", str(tmp_path / "states.csv"), "--figures", str(tmp_path / "figures")]
    result = json.loads(evaluated(run, capsys, "--json", *files))
    controller = load(run / "checkpoints" / "best.ckpt")
    measured = evaluation(controller, 5)
    oracle = oracle_of(controller.problem)
    optimal, V = oracle(measured.table.x0), controller.value(0.0, measured.table.x0)
    assert result["optimal_cost_mean"] == pytest.approx(float(optimal.mean()))
    assert result["cost_ratio"] == pytest.approx(
        float(controller.rollout(measured.table.x0).cost.mean() / optimal.mean())
    )
    assert result["value_error"] == pytest.approx(float((V - optimal).abs().mean() / optimal.mean()))
    assert result["cost_ratio"] > 1
    assert result["optimum_failures"] == 0
    rows = list(csv.DictReader((tmp_path / "states.csv").read_text(encoding="utf-8").splitlines()))
    assert [float(row["optimal_cost"]) for row in rows] == pytest.approx(optimal.tolist())
    assert [float(row["elbow angle (rad)"]) for row in rows] == pytest.approx(measured.table.x0[:, 1].tolist())
    for name in ("optimality", "trajectories", "value_slices"):
        assert (tmp_path / "figures" / f"{name}.png").stat().st_size > 10_000


@pytest.mark.gate
def test_failed_optima_are_left_out_and_counted(run, capsys, monkeypatch, tmp_path):
    controller = load(run / "checkpoints" / "best.ckpt")
    whole = evaluation(controller, 5)
    minimise, lost = Transcription.minimise, set(map(tuple, whole.table.x0[1:3].tolist()))

    def failing(self, x0, start, briefly):
        return "IPOPT: lost" if tuple(x0.tolist()) in lost else minimise(self, x0, start, briefly)

    monkeypatch.setenv("LYAPNET_CACHE", str(tmp_path / "another"))
    monkeypatch.setattr(Transcription, "minimise", failing)
    result = json.loads(evaluated(run, capsys, "--json"))
    assert result["optimum_failures"] == 2
    kept = [0, 3, 4]
    assert result["optimal_cost_mean"] == pytest.approx(float(whole.table.optimal_cost[kept].mean()))
    ratio = whole.table.cost[kept].mean() / whole.table.optimal_cost[kept].mean()
    assert result["cost_ratio"] == pytest.approx(float(ratio))
    assert result["cost_mean"] == pytest.approx(float(whole.table.cost.mean()))
    assert "2 of 5 states have no optimum" in " ".join(evaluated(run, capsys).split())


@pytest.mark.gate
@pytest.mark.usefixtures("without_casadi")
def test_without_casadi_the_rest_is_reported(run, capsys, tmp_path):
    result = evaluated(run, capsys, "--json", "--figures", str(tmp_path))
    assert json.loads(result)["optimal_cost_mean"] is None
    assert {path.stem for path in tmp_path.glob("*.png")} == {"trajectories", "value_slices"}
    printed = " ".join(evaluated(run, capsys).split())
    assert "pip install 'lyapnet[oracle]'" in printed
    assert "cost J, mean" in printed


@pytest.mark.usefixtures("without_casadi")
def test_without_casadi_a_training_goes_on(tmp_path, capsys):
    assert train(tmp_path / "logs") == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "no optimum to compare with: Expected CasADi" in printed
    assert printed.count("pip install 'lyapnet[oracle]'") == 2  # at the start, and below the table
    assert (
        json.loads((tmp_path / "logs/reacher_from_scratch/version_0/evaluation.json").read_text())["cost_ratio"] is None
    )


@pytest.mark.gate
def test_a_training_is_compared_with_the_same_optimum_to_its_end(run, trained, capsys, tmp_path):
    def kept(folder):
        (cost,) = read_checkpoint(folder / "checkpoints" / "last.ckpt")["callbacks"]["ValidationOptimum"]["cost"]
        return cost

    assert "optimum of 4 validation states, in" in trained[1]
    assert "cost/optimum" in trained[1]
    copy = tmp_path / "logs" / "reacher_from_scratch" / "version_0"
    shutil.copytree(run, copy)
    assert train(tmp_path / "logs", "training.iterations=3", "--resume", "last") == 0
    assert torch.equal(kept(copy), kept(run))
    assert "optimum of" not in capsys.readouterr().out


def test_the_optimum_is_not_sought_where_it_is_not_wanted(tmp_path, capsys):
    assert train(tmp_path / "logs", "evaluation.optimum=false") == 0
    assert "optimum of" not in capsys.readouterr().out
    assert not (tmp_path / "cache" / "optima").exists()


@pytest.mark.gate
def test_disturbances_are_reported(tmp_path, capsys):
    arguments = [
        *SMALL,
        "training.iterations=1",
        "training.batch_size=2",
        "rollout.gradient=backprop",
        f"logs={tmp_path}",
    ]
    assert main(["train", "--config", str(CONF / "from_scratch" / "double_integrator.yaml"), *arguments]) == 0
    path = str(tmp_path / "double_integrator_from_scratch" / "version_0" / "checkpoints" / "best.ckpt")
    capsys.readouterr()
    assert main(["evaluate", path, "--samples", "3", "--robustness", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert [row["disturbance"] for row in result["robustness"]] == [one.name for one in disturbances(load(path), 3, 0)]
    assert result["terminal_errors"].keys() == {"position (m)", "velocity (m/s)"}
    assert main(["evaluate", path, "--samples", "3", "--robustness"]) == 0
    shown = capsys.readouterr().out
    assert "mass +20%" in shown
    assert "terminal error, mean |position (m)|" in shown

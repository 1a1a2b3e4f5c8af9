"""The controllers that come with lyapnet: each as good as its record says, named everywhere as zoo:NAME."""

import functools
import json
import shutil
import tomllib
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

import lyapnet
from lyapnet.base.errors import UsageError
from lyapnet.cli import main
from lyapnet.experiment.checkpoint import (
    KEY,
    ZOO,
    locate_checkpoint,
    note_in_checkpoint,
    read_checkpoint,
    write_checkpoint,
    zoo_names,
)
from lyapnet.experiment.config import load_config
from lyapnet.lab import zoo_making as making
from lyapnet.zoo import entry
from tests.marks import sample

ROOT = Path(__file__).parents[2]
NAMES = zoo_names()
ONE = "cartpole_balancing"


@functools.cache
def config_of(name):
    """That of the loaded controller, for what only reads it."""
    return lyapnet.load(f"zoo:{name}").config


def test_every_checkpoint_has_its_record_and_its_command():
    assert set(NAMES) == making.TASKS.keys()
    assert {path.stem for path in ZOO.glob("*.json")} == set(NAMES)
    assert all((ROOT / arguments[0]).is_file() for arguments in making.TASKS.values())


@pytest.mark.parametrize("name", sample(NAMES, 6))
def test_a_controller_is_as_good_as_its_record_says(name):
    one = entry(name)
    trajectory, ratio, error = one.measured(one.load())
    found = one.record["evaluation"]
    # the recorded states are the first of those that were evaluated
    assert ratio == pytest.approx(found["cost_ratio"], abs=0.02)
    assert ratio > 1 - 1e-6
    assert error < 3 * found["value_error"] + 1e-3
    assert float((trajectory.cost / torch.tensor(one.record["optima"])).max()) <= one.record["worst_ratio"] * (1 + 1e-6)


@pytest.mark.parametrize("name", sample(NAMES, 4))
def test_a_controller_is_of_its_command_and_names_no_folder(name):
    content = read_checkpoint(f"zoo:{name}")
    path, *overrides = making.TASKS[name]
    config, own = load_config(ROOT / path, overrides), content[KEY]["config"]
    assert own["experiment"] == name
    assert own["logs"] == "logs"
    for part in ("system", "cost", "controls", "initial_states", "horizon", "program"):
        assert vars(config_of(name))[part] == getattr(config, part)
    assert set(content) == {"state_dict", "global_step", KEY}
    assert locate_checkpoint(f"zoo:{name}").stat().st_size < 400_000


def test_a_worse_controller_is_told_from_its_record(tmp_path):
    # the twin of the test above: weights that are a little off
    content = read_checkpoint(f"zoo:{ONE}")
    weights = {key: w + 0.1 * torch.ones_like(w) * w.abs().mean() for key, w in content["state_dict"].items()}
    write_checkpoint({**content, "state_dict": weights}, tmp_path / "worse.ckpt")
    _, ratio, error = entry(ONE).measured(lyapnet.load(tmp_path / "worse.ckpt"))
    found = entry(ONE).record["evaluation"]
    assert ratio > found["cost_ratio"] + 0.02 or error > 3 * found["value_error"] + 1e-3


def test_names():
    assert locate_checkpoint(f"zoo:{ONE}") == ZOO / f"{ONE}.ckpt"
    assert locate_checkpoint("logs/best.ckpt") == Path("logs/best.ckpt")
    with pytest.raises(UsageError, match=f"one of .*{ONE}"):
        locate_checkpoint("zoo:nothing")
    with pytest.raises(UsageError, match="zoo:NAME"):
        locate_checkpoint("zoo:../zoo/" + ONE)


def test_a_file_of_that_name_comes_first(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path(f"zoo:{ONE}").touch()
    assert locate_checkpoint(f"zoo:{ONE}") == Path(f"zoo:{ONE}")


def test_the_wheel_holds_them():
    data = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]["lyapnet"]
    assert {"zoo/*.ckpt", "zoo/*.json"} <= set(data)


@pytest.mark.gate
def test_demo_and_zoo(tmp_path, capsys):
    assert main(["demo", ONE, "--out", str(tmp_path / "shown")]) == 0
    printed = capsys.readouterr().out
    assert "cost / optimum" in printed
    assert {path.name for path in (tmp_path / "shown").iterdir()} == {"trajectories.png", "closed_loops.gif"}


def test_the_zoo_is_listed(capsys):
    assert main(["zoo"]) == 0
    printed = capsys.readouterr().out
    assert all(name in printed for name in NAMES)
    assert main(["zoo", "--exports"]) == 0
    printed = capsys.readouterr().out
    assert printed.count("float64") == printed.count("float32") == len(NAMES)


def test_what_follows_the_end_is_as_the_record_and_the_page_have_it(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "200")
    assert main(["zoo", "--after"]) == 0
    printed = capsys.readouterr().out.splitlines()
    for name in NAMES:
        (shown,) = [row for row in printed if f" {name} " in row]
        record, noted = entry(name).record["afterwards"], read_checkpoint(f"zoo:{name}")[KEY]["after_horizon"]
        law, held, *distances = [cell.strip() for cell in shown.split("│")[2:-1]]
        assert (law, held) == (record["beyond"], f"{record['held']} of {record['loops']}")
        for cell, distance in zip(distances, record["distance"].values(), strict=True):
            assert distance < 1e-12 if cell == "< 1e-12" else float(cell) == pytest.approx(distance, rel=0.06)
        assert record["beyond"] == noted["beyond"] == ("hold" if name == "bryson_denham" else "riccati")
        assert record["held"] == noted["held"] == (0 if name == "bryson_denham" else 64)
    page = " ".join((ROOT / "docs" / "beyond.md").read_text(encoding="utf-8").split())
    assert f"all {len(NAMES) - 1} with a goal that can be held" in page


@pytest.mark.gate
def test_what_follows_the_end_is_found_again(tmp_path, monkeypatch):
    """Not taken from the checkpoint; and what is recorded is of other closed loops than those of the choice."""
    path = tmp_path / "one.ckpt"
    shutil.copy(locate_checkpoint(f"zoo:{ONE}"), path)
    note_in_checkpoint(path, after_horizon={"beyond": "receding", "held": 3, "loops": 64, "reason": ""})
    monkeypatch.setattr(making, "is_held", lambda problem, x: torch.arange(x.shape[1]) < 5)
    recorded, noted = making.choose_law_after(path), read_checkpoint(path)[KEY]["after_horizon"]
    assert (recorded["beyond"], recorded["held"]) == ("riccati", 5)
    assert (noted["beyond"], noted["held"]) == ("riccati", 64)
    assert recorded["distance"] == pytest.approx(entry(ONE).record["afterwards"]["distance"])


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(("precision", "bound"), [("float64", 1e-10), ("float32", 1e-4)])
def test_every_export_is_its_controller(name, precision, bound):
    agreements = entry(name).record["export"][precision]
    assert set(agreements) == set(making.EXPORTS)
    assert all(one["states"] == 10_000 for one in agreements.values())
    if config_of(name).rollout.policy == "lookahead":  # where rounding decides between equal costs
        bound *= 1e4
    assert all(max(one["control"], one["value"]) < bound for one in agreements.values())


@pytest.mark.gate
def test_a_command_takes_one(capsys):
    assert main(["evaluate", f"zoo:{ONE}", "--samples", "2", "--no-optimum", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["samples"] == 2
    assert main(["evaluate", "zoo:nothing"]) == 2
    assert "zoo:NAME" in capsys.readouterr().err


@pytest.mark.gate
def test_making_strips_and_measures(tmp_path, monkeypatch):
    pytest.importorskip("casadi")
    pytest.importorskip("onnxscript")
    monkeypatch.setattr(making, "SAMPLES", 2)
    monkeypatch.setattr(making, "PRECISIONS", ("float64",))
    monkeypatch.setattr(making, "MULTIPLES", (1, 5))  # of T: longer closed loops are those of the test above
    certificate = SimpleNamespace(result={"probability_lower_bound": 0.5})
    monkeypatch.setattr(making, "certify", lambda *_: certificate)
    trained = tmp_path / "run" / "checkpoints" / "best.ckpt"
    trained.parent.mkdir(parents=True)
    shutil.copy(locate_checkpoint(f"zoo:{ONE}"), trained)
    known = dict.fromkeys(making.PACKAGES, "1") | {"commit": "abc", "seed": 0}
    (tmp_path / "run" / "run.json").write_text(json.dumps(known))
    record = making.make(ONE, trained, tmp_path / "zoo")
    assert (record["commit"], record["versions"]["torch"]) == ("abc", "1")
    assert record["evaluation"]["samples"] == 2
    assert (record["afterwards"]["beyond"], [*record["afterwards"]["distance"]]) == ("riccati", ["1", "5"])
    assert record["command"] == "lyapnet train --config conf/cartpole_balancing.yaml"
    assert all(set(agreements) == set(making.EXPORTS) for agreements in record["export"].values())
    assert record["export"]["float64"]["c"]["control"] < 1e-10
    assert {path.name for path in (tmp_path / "zoo").iterdir()} == {f"{ONE}.ckpt", f"{ONE}.json"}

"""Searches: what may be varied, what is compared, what is kept, and what is written as best."""

import importlib.util
from pathlib import Path

import pytest

pytest.importorskip("optuna")
from optuna.trial import TrialState

from lyapnet.base.errors import UsageError
from lyapnet.cli import main
from lyapnet.experiment.config import differing_keys, load_config
from lyapnet.lab.comparison import workers
from lyapnet.lab.tuning import search as searching
from lyapnet.lab.tuning.search import open_study, search, task_of, write_best
from lyapnet.lab.tuning.space import Choice, Range, given_values, space_of
from lyapnet.lab.tuning.tables import search_rows
from lyapnet.lab.tuning.trials import Trial, start_settings
from lyapnet.training.run_lock import RunLock
from tests.configs import PLAIN

RATE = "training.learning_rate=1e-3..0.1:log"


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "small.yaml"
    path.write_text(PLAIN)
    return path


def task(path, *vary, seed=0):
    return task_of(path, [f"logs={path.parent}"], list(vary) or [RATE], None, seed, print)


@pytest.fixture
def pretended(monkeypatch):
    """Trials whose measure is their learning rate, and of which those above 0.05 fail."""

    def run(job, started):
        rate = float(job.own[0].partition("=")[2])
        return 0.0, "error: diverged" if rate > 0.05 else ""

    monkeypatch.setattr(workers, "run_process", run)
    monkeypatch.setattr(Trial, "_value", lambda self: float(self.own[0].partition("=")[2]))


def test_ranges_and_choices_are_read(path):
    config = load_config(path)
    space = space_of(config, [RATE, "training.batch_size=2..8", "network.hidden=[4],[8,8]"])
    assert space == [
        Range("training.learning_rate", 1e-3, 0.1, True),
        Range("training.batch_size", 2, 8),
        Choice("network.hidden", ("[4]", "[8,8]")),
    ]
    assert given_values(config, space) == {
        "training.learning_rate": 0.01, "training.batch_size": 2, "network.hidden": "[4]"
    }  # fmt: skip
    assert given_values(config, space_of(config, ["training.batch_size=4,8"])) is None


@pytest.mark.parametrize(
    ("vary", "named"),
    [
        ("training.learning_rat=1,2", "training.learning_rate?"),
        ("training.learning_rate", "key=low..high"),
        ("training.learning_rate=0.1..0.01", "lower end"),
        ("training.learning_rate=0..1:log", "above 0"),
        ("training.batch_size=0..4", "batch_size ≥ 1"),
        ("program.relative=true,false", "program.relative"),
        ("horizon.steps=4,8", "another task"),
    ],
)
def test_what_cannot_be_varied_is_refused_before_anything_is_made(path, vary, named):
    with pytest.raises(UsageError, match=named.replace("?", r"\?")):
        task(path, vary)
    assert [*path.parent.iterdir()] == [path]


def test_the_standard_space_holds_what_is_given(path):
    for rate in ("0.01", "0.5"):
        config = load_config(path, [f"training.learning_rate={rate}"])
        assert given_values(config, space_of(config, [])) is not None


def test_only_the_network_changes_the_start():
    assert start_settings(["training.learning_rate=1", "network.hidden=[4]"]) == ("network.hidden=[4]",)


def test_a_search_goes_on_and_tells_what_fails(path, pretended):
    chosen = task(path)
    study = open_study(chosen, print)
    search(chosen, study, 3, 1, print)
    study = open_study(chosen, print)
    search(chosen, study, 6, 1, print)
    rows = search_rows(chosen, study)
    assert len(rows) == 6
    assert rows[0]["training.learning_rate"] == "0.01", "the given one comes first"
    for row in rows:
        diverged = float(row["training.learning_rate"]) > 0.05
        assert (row["state"], row["failure"]) == (("failed", "error: diverged") if diverged else ("complete", ""))
    assert {row["state"] for row in rows} == {"failed", "complete"}


@pytest.mark.gate
def test_a_search_that_was_killed_proposes_what_it_would_have(path, pretended, tmp_path):
    whole = task(path)
    study = open_study(whole, print)
    search(whole, study, 4, 1, print)
    broken = task_of(path, [f"logs={path.parent}"], [RATE], tmp_path / "broken", 0, print)
    first = open_study(broken, print)
    search(broken, first, 2, 1, print)
    trial = Trial(broken, first, {})
    trial.ask()  # and killed
    assert first.trials[-1].state == TrialState.RUNNING
    again = open_study(broken, print)
    search(broken, again, 4, 1, print)
    assert [one.params for one in again.trials] == [one.params for one in study.trials]
    other = task_of(path, [f"logs={path.parent}"], [RATE], tmp_path / "other", 1, print)
    search(other, open_study(other, print), 2, 1, print)
    assert open_study(other, print).trials[1].params != study.trials[1].params


def test_another_search_in_the_folder_is_refused(path, pretended, capsys):
    chosen = task(path)
    open_study(chosen, print)
    with pytest.raises(UsageError, match="another seed"):
        open_study(task(path, seed=1), print)
    with RunLock(chosen.folder):
        assert main(["tune", str(path), f"logs={path.parent}", "--vary", RATE]) == 2
    assert "process" in capsys.readouterr().err


@pytest.mark.parametrize("overrides", [[], ["network.name=fcn", "network.hidden=[8]"]])
def test_the_best_config_is_that_of_its_trial(path, pretended, overrides):
    chosen = task_of(path, [f"logs={path.parent}", *overrides], [RATE], None, 0, print)
    study = open_study(chosen, print)
    assert write_best(chosen, study) is None
    search(chosen, study, 4, 1, print)
    best = searching.best_of(study)
    written = write_best(chosen, study)
    assert Path(written).read_text().splitlines()[0] == f"# lyapnet train --config {written}"
    settings = chosen.settings(best.params)
    assert differing_keys(load_config(written), chosen.config(settings)) == ["experiment"]
    assert best.value == min(one.value for one in study.trials if one.value is not None)


def test_the_extra_is_named(path, monkeypatch, capsys):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert main(["tune", str(path)]) == 2
    assert 'pip install "lyapnet[tune]"' in capsys.readouterr().err

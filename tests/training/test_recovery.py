"""A training that diverges goes back and on more slowly; it gives up after a while, with the cause."""

import math

import pytest
import torch
from rich.console import Console

from lyapnet.base.errors import DivergenceError
from lyapnet.base.files import read_json
from lyapnet.experiment.checkpoint import read_checkpoint
from lyapnet.task.systems import ControlAffineSystem
from lyapnet.training.best_weights import RATE_DIVISOR
from lyapnet.training.experiment import train
from lyapnet.training.learner import Learner
from lyapnet.training.recovery import MAX_RETURNS
from tests.training.small_runs import small_run


@pytest.fixture
def traced():
    return False


@pytest.fixture
def config(tmp_path):
    return small_run(tmp_path, "recovery")


def run_of(config, capsys, **options):
    run = train(config, console=Console(), **options)
    return run, capsys.readouterr().out


class Breaks:
    """Has the n-th losses of training, counted from 1, raise as a divergence does."""

    def __init__(self, monkeypatch, calls):
        self.count, self.calls, self.original = 0, set(calls), Learner.train_on
        monkeypatch.setattr(Learner, "train_on", lambda learner, *rest: self.loss(learner, *rest))

    def loss(self, learner, *rest):
        self.count += 1
        if self.count in self.calls:
            raise DivergenceError("Expected a finite loss, got nan.")
        return self.original(learner, *rest)


def rates(run):
    return [group["lr"] for group in read_checkpoint(run.last)["optimizer_states"][0]["param_groups"]]


def test_without_divergence_nothing_goes_back(config, capsys):
    run, out = run_of(config, capsys)
    assert "Going back" not in out
    assert run.record()["returns"] == []
    assert read_checkpoint(run.last)["lyapnet"]["rate_share"] == 1


@pytest.mark.gate
def test_it_goes_on_from_the_last_checkpoint_with_a_smaller_rate(config, capsys, monkeypatch):
    untroubled, _ = run_of(config, capsys)
    Breaks(monkeypatch, [7])  # the step after 6, with last.ckpt at 4
    run, out = run_of(config, capsys)
    assert "Going back to step 4" in out.replace("\n", " ")
    assert len(out.split("Going back")) == 2
    assert read_checkpoint(run.last)["global_step"] == 12
    (entry,) = run.record()["returns"]
    assert entry["to"] == 4
    assert math.isclose(entry["rate_share"], 1 / RATE_DIVISOR)
    assert [r / u for r, u in zip(rates(run), rates(untroubled), strict=True)] == pytest.approx([1 / RATE_DIVISOR])
    steps = [line.split(",")[0] for line in (run.folder / "metrics.csv").read_text().splitlines()[1:]]
    assert len(steps) == len(set(steps))


@pytest.mark.gate
def test_before_the_first_checkpoint_it_goes_back_to_its_start(config, capsys, monkeypatch):
    Breaks(monkeypatch, [3])
    run, out = run_of(config, capsys)
    assert "Going back to step 0" in out.replace("\n", " ")
    assert read_checkpoint(run.last)["global_step"] == 12
    slower = {**config, "training": {**config["training"], "learning_rate": 0.01 / RATE_DIVISOR}}
    slower["training"]["final_learning_rate"] = 1e-4 / RATE_DIVISOR
    expected, _ = run_of(slower, capsys)
    weights, others = (read_checkpoint(r.last)["state_dict"] for r in (run, expected))
    for name in weights:
        torch.testing.assert_close(weights[name], others[name])


def test_it_gives_up(config, capsys, monkeypatch):
    Breaks(monkeypatch, range(2, 100))
    with pytest.raises(DivergenceError, match=f"{MAX_RETURNS} returns did not help"):
        run_of(config, capsys)
    assert len(capsys.readouterr().out.split("Going back")) == MAX_RETURNS + 1


def test_a_stiff_law_is_named(config, capsys, monkeypatch):
    Breaks(monkeypatch, range(2, 100))
    config["cost"] = {"Q": [1, 1], "R": [1e-5], "Q_T": [1, 1]}
    config["rollout"] = {**config["rollout"], "policy": "sampled"}
    with pytest.raises(DivergenceError) as error:
        run_of(config, capsys)
    assert "too long for the law" not in str(error.value)
    config["rollout"]["policy"] = "hjb"
    with pytest.raises(DivergenceError, match=r"too long for the law.*rollout\.policy=sampled"):
        run_of(config, capsys)


@pytest.mark.gate
def test_a_resumed_run_stays_slower(config, capsys, monkeypatch):
    Breaks(monkeypatch, [7])
    run, _ = run_of(config, capsys)
    longer = {**config, "training": {**config["training"], "iterations": 16}}
    again, _ = run_of(longer, capsys, resume="last")
    assert again.folder == run.folder
    assert math.isclose(read_checkpoint(run.last)["lyapnet"]["rate_share"], 1 / RATE_DIVISOR)
    assert len(read_json(run.folder / "run.json", "")["returns"]) == 1


def test_before_the_first_step_no_rate_is_to_blame(config, capsys, monkeypatch):
    Breaks(monkeypatch, range(1, 100))
    with pytest.raises(DivergenceError, match=r"got nan.*the learning rate is not the cause\. Check f") as error:
        run_of(config, capsys)
    assert "Going back" not in capsys.readouterr().out
    assert "lower training.learning_rate" not in str(error.value)


class Rough(ControlAffineSystem):
    """ẋ = √max(x, 0) − 1 + u, whose guard leaves a slope that is not a number below 0, where closed loops lead."""

    state_names, state_units = ("speed",), ("m/s",)
    control_names, control_units = ("force",), ("N",)

    def f(self, x):
        return torch.where(x > 0, torch.sqrt(x), 0.0) - 1

    def g(self, x):
        return torch.ones_like(x)[..., None]


def test_a_slope_that_is_not_finite_is_named(config, capsys):
    config["system"] = {"name": f"{__name__}:Rough"}
    config["cost"] = {"Q": [1], "R": [1], "Q_T": [1]}
    config["initial_states"] = {"lower": [0.1], "upper": [0.3]}
    config["rollout"] = {**config["rollout"], "gradient": "backprop"}
    with pytest.raises(DivergenceError, match=r"slope of Rough\.f\(x\) by speed is nan at x = .*lyapnet\.norm"):
        run_of(config, capsys)
    assert "Going back" not in capsys.readouterr().out

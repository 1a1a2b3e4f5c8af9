"""A start that was found is kept: the same task begins there at once, another one does not."""

import math

import pytest
import torch

from lyapnet import train
from lyapnet.config import config_from_plain
from lyapnet.loading import load
from lyapnet.training import start_cache
from lyapnet.training.build import build_module
from lyapnet.training.checkpoints import Checkpoints
from lyapnet.training.facts import facts_of
from lyapnet.training.start_cache import StartCache, kept_or_chosen
from tests.fits import shorten_fits

TASK = {
    "experiment": "mine",
    "system": {"name": "pendulum"},
    "cost": {"Q": [1, 0.1], "R": [0.1], "Q_T": [5, 1]},
    "controls": {"lower": -3, "upper": 3},
    "initial_states": {"lower": [-1, -0.5], "upper": [1, 0.5]},
    "horizon": {"steps": 20, "dt": 0.05},
}


@pytest.fixture(autouse=True)
def _few_optima(monkeypatch, tmp_path):
    monkeypatch.setenv("LYAPNET_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("lyapnet.training.start.OPTIMA", 6)
    shorten_fits(monkeypatch, 20, 10)
    monkeypatch.setattr("lyapnet.training.pretraining.BRIEF", 10)


@pytest.fixture
def sought(monkeypatch):
    """How often a start was sought."""
    times, seek = [], start_cache.choose_start
    monkeypatch.setattr(start_cache, "choose_start", lambda *told: times.append(1) or seek(*told))
    return times


def begun(*overrides):
    members = list(build_module(config_from_plain(TASK, overrides)).members)
    start = kept_or_chosen(members)
    assert start is not None
    return members, start


def test_the_same_task_begins_at_once_where_it_began(sought):
    (first, start), (again, kept) = begun(), begun()
    assert len(sought) == 1
    assert str(kept) == f"{start}; found by an earlier search"
    assert kept.as_json() == start.as_json()
    for one, other in zip(first[0].V.state_dict().values(), again[0].V.state_dict().values(), strict=True):
        assert torch.equal(one, other)


def test_facts_say_that_their_seconds_are_those_of_an_earlier_search():
    def found():
        (learner,) = build_module(config_from_plain(TASK)).members
        return [fact.found for fact in facts_of(learner) if "known after" in fact.found]

    first, again = found(), found()
    assert sorted(again) == sorted(f"{line} of an earlier search" for line in first)
    assert all("mean cost from 64 states of X₀ " in line for line in first)


@pytest.mark.parametrize(
    "change",
    ["seed=1", "cost.R=[0.2]", "horizon.steps=21", "controls.upper=2", "initial_states.upper=[1,0.6]",
     "system.parameters={length: 0.9}", "rollout.policy=lookahead", "network.hidden=[8]"],
)  # fmt: skip
def test_another_one_does_not(change, sought):
    begun()
    begun(change)
    assert len(sought) == 2


@pytest.mark.parametrize("damage", [b"", b"no archive", None])
def test_a_file_that_is_no_start_is_sought_again(damage, sought):
    _, start = begun()
    file = StartCache(list(build_module(config_from_plain(TASK)).members)).file
    assert file is not None
    file.write_bytes(file.read_bytes()[:-40] if damage is None else damage)
    _, again = begun()
    assert len(sought) == 2
    assert again.chosen.cost == pytest.approx(start.chosen.cost)


def test_what_training_starts_from_is_saved_before_anything_else(tmp_path, monkeypatch):
    """A run that is broken off before its first step leaves the controller that it would have begun with."""

    def broken_off(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(Checkpoints, "on_train_start", broken_off)
    with pytest.raises((KeyboardInterrupt, SystemExit)):
        train({**TASK, "logs": str(tmp_path)}, ["rollout.compile=off", "evaluation.optimum=false"])
    (best,) = tmp_path.glob("**/best.ckpt")
    cost = load(best).rollout(torch.tensor([[0.5, 0.0]])).cost
    assert math.isfinite(float(cost.detach()))
    assert not list(tmp_path.glob("**/last.ckpt"))

"""A start that was found is kept: the same task begins there at once, another one does not."""

import math
import shutil

import pytest
import torch

from lyapnet import train
from lyapnet.controller.loading import load
from lyapnet.experiment.config import config_from_plain
from lyapnet.training import start_cache
from lyapnet.training.build import build_module
from lyapnet.training.checkpoints import Checkpoints
from lyapnet.training.start_cache import StartCache, load_or_choose_start
from lyapnet.training.task_facts import facts_of
from tests.fits import few_optima
from tests.marks import sample

TASK = {
    "experiment": "mine",
    "system": {"name": "pendulum"},
    "cost": {"Q": [1, 0.1], "R": [0.1], "Q_T": [5, 1]},
    "controls": {"lower": -3, "upper": 3},
    "initial_states": {"lower": [-1, -0.5], "upper": [1, 0.5]},
    "horizon": {"steps": 20, "dt": 0.05},
}


@pytest.fixture(scope="module", autouse=True)
def _few_optima():
    with few_optima(6, 20, 10):
        yield


@pytest.fixture(autouse=True)
def cache(monkeypatch, tmp_path):
    monkeypatch.setenv("LYAPNET_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """The task's learners and their start, sought once, and the cache in which it is kept."""
    folder = tmp_path_factory.mktemp("found")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LYAPNET_CACHE", str(folder))
        return *begun(), folder


@pytest.fixture
def kept(found, cache):
    """The same, with the start in the cache of a test."""
    *begun_with, folder = found
    shutil.copytree(folder, cache)
    return begun_with


@pytest.fixture
def sought(monkeypatch):
    """The weights of the learners at each search for a start, which none of them finds."""
    weights = []
    monkeypatch.setattr(start_cache, "choose_start", lambda learners, *_: weights.append(weights_of(learners)))
    return weights


def weights_of(learners):
    return [tensor.clone() for learner in learners for tensor in learner.V.state_dict().values()]


def drawn(*overrides):
    return list(build_module(config_from_plain(TASK, overrides)).members)


def begun(*overrides):
    members = drawn(*overrides)
    return members, load_or_choose_start(members)


@pytest.mark.gate
def test_the_same_task_begins_at_once_where_it_began(kept, sought):
    (first, start), (again, at_once) = kept, begun()
    assert start is not None
    assert not sought
    assert str(at_once) == f"{start}; found by an earlier search"
    assert at_once.as_json() == start.as_json()
    assert all(map(torch.equal, weights_of(first), weights_of(again)))
    assert not all(map(torch.equal, weights_of(drawn()), weights_of(again)))


@pytest.mark.gate
def test_facts_say_that_their_seconds_are_those_of_an_earlier_search():
    def found():
        (learner,) = build_module(config_from_plain(TASK)).members
        return [fact.found for fact in facts_of(learner) if "known after" in fact.found]

    first, again = found(), found()
    assert sorted(again) == sorted(f"{line} of an earlier search" for line in first)
    assert all("mean cost from 64 states of X₀ " in line for line in first)


@pytest.mark.parametrize(
    "change",
    sample(["seed=1", "cost.R=[0.2]", "horizon.steps=21", "controls.upper=2", "initial_states.upper=[1,0.6]",
            "system.parameters={length: 0.9}", "rollout.policy=lookahead", "network.hidden=[8]",
            "noise={velocity: 0.1}"], 4),
)  # fmt: skip
@pytest.mark.usefixtures("kept")
def test_another_one_does_not(change, sought):
    begun()
    assert not sought
    begun(change)
    assert len(sought) == 1


@pytest.mark.parametrize("damage", [b"", b"no archive", None])
@pytest.mark.usefixtures("kept")
def test_a_file_that_is_no_start_is_sought_again(damage, sought):
    """From the weights as they were drawn."""
    file = StartCache(drawn()).file
    assert file is not None
    file.write_bytes(file.read_bytes()[:-40] if damage is None else damage)
    begun()
    (weights,) = sought
    assert all(map(torch.equal, weights, weights_of(drawn())))


@pytest.mark.gate
@pytest.mark.usefixtures("kept")
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

"""A training that has become worse returns to its best weights and ends with them."""

import math
from dataclasses import replace

import pytest
import torch
from rich.console import Console

from lyapnet.experiment.checkpoint import read_checkpoint
from lyapnet.task.problem import Problem
from lyapnet.training import best_weights, lost_states
from lyapnet.training.best_weights import COMPARED_SHARE, DIVERGENCE_COST_RATIO, RATE_DIVISOR, WORSE_BY
from lyapnet.training.experiment import train
from lyapnet.training.learner import Learner
from tests.training.small_runs import small_run

STATES = 64
MEASURE_ON = Learner.measure_on


@pytest.fixture
def config(tmp_path):
    content = small_run(tmp_path, "best")
    content["training"] |= {"validate_every": 2, "least_gain": 1e-9}
    content["evaluation"] |= {"validation_states": STATES}
    return content


class Validations:
    """Replaces what validations measure by costs of a list, the first at step 0, and keeps V at each of them."""

    def __init__(self, monkeypatch, costs, loss=math.log, values=torch.ones, excesses=(0,) * 7):
        self.costs, self.loss, self.values, self.excesses = costs, loss, values, excesses
        self.weights: dict[int, dict[str, torch.Tensor]] = {}
        self.original = MEASURE_ON
        monkeypatch.setattr(best_weights, "WORSE_FOR", 4)
        monkeypatch.setattr(Learner, "measure_on", lambda learner, trajectory: self.measure(learner, trajectory))

    def measure(self, learner, trajectory):
        self.original(learner, trajectory)
        step = learner.measured_at
        own = self.costs[step // 2]
        costs = own if isinstance(own, torch.Tensor) else torch.full((STATES,), float(own))
        learner.validation = replace(learner.validation, cost=costs, value=self.values(STATES))
        learner.validation_loss = self.loss(float(costs.mean()))
        if self.excesses is not None:
            learner.lost_excess = float(self.excesses[step // 2])
        self.weights[step] = {name: value.clone() for name, value in learner.V.state_dict().items()}
        return torch.tensor(learner.validation_loss)


def run_of(config, capsys, **options):
    run = train(config, console=Console(width=200), **options)
    return run, " ".join(capsys.readouterr().out.split())


def weights_of(run, which="last"):
    content = read_checkpoint(getattr(run, which))["state_dict"]
    return {name.removeprefix("V."): value for name, value in content.items()}


def rate(run):
    return read_checkpoint(run.last)["optimizer_states"][0]["param_groups"][0]["lr"]


def same(one, other):
    return all(torch.equal(one[name], other[name]) for name in other)


@pytest.mark.gate
def test_after_a_while_it_returns_to_its_best_weights(config, capsys, monkeypatch):
    seen = Validations(monkeypatch, [3, 2, 2.1, 2.1, 2.1, 1.9, 1.9])  # worse at 4, 6 and 8: for 4 steps
    run, out = run_of(config, capsys)
    assert "worse: the validation states cost 2.1 at step 8, 2 at step 2; training continues from there" in out
    (entry,) = run.record()["returns"]
    assert entry == {"to": 2, "rate_share": 1 / RATE_DIVISOR, "because": "cost 2.1 at step 8, 2 at step 2"}
    calm = Validations(monkeypatch, [3, 2, 2.1, 2, 2.1, 1.9, 1.9])  # never worse for so long
    untroubled, out = run_of(config, capsys)
    assert "worse" not in out
    assert untroubled.record()["returns"] == []
    assert rate(run) == pytest.approx(rate(untroubled) / RATE_DIVISOR)
    near = sum(float((seen.weights[10][name] - seen.weights[2][name]).abs().sum()) for name in seen.weights[2])
    far = sum(float((calm.weights[10][name] - calm.weights[2][name]).abs().sum()) for name in calm.weights[2])
    assert 0 < near < far / 2


@pytest.mark.gate
def test_it_ends_with_its_best_weights(config, capsys, monkeypatch):
    seen = Validations(monkeypatch, [3, 3, 3, 3, 2, 2, 2 * (1 + 1.01 * WORSE_BY)])
    run, out = run_of(config, capsys)
    assert "training ends with the weights of that step" in out
    assert same(weights_of(run), seen.weights[8])
    assert same(weights_of(run, "best"), seen.weights[8])
    seen = Validations(monkeypatch, [3, 3, 3, 3, 2, 2, 2 * (1 + 0.99 * WORSE_BY)])
    run, out = run_of(config, capsys)
    assert "worse" not in out
    assert same(weights_of(run), seen.weights[12])
    assert not same(weights_of(run), seen.weights[8])


@pytest.mark.parametrize(("excess", "best"), [(0, 2), (0.05 * STATES, 2), (0.2 * STATES, 4)])
def test_a_lost_state_counts_as_one_more_validation_state(excess, best, config, monkeypatch):
    seen = Validations(monkeypatch, [3, 2, 2.2, 3, 3, 3, 3], excesses=[0, excess, 0, 0, 0, 0, 0])
    run = train(config, console=Console(quiet=True))
    assert same(weights_of(run, "best"), seen.weights[best])


@pytest.mark.parametrize(("excess", "best"), [(0.4, 2), (50.0, 4)])
def test_the_search_at_a_validation_counts_for_its_weights(excess, best, config, monkeypatch):
    def found(learner, x0, step):
        return x0.new_zeros(len(x0)), excess if step == 2 else 0.0

    config["training"]["lost_share"] = 0.5
    monkeypatch.setattr(lost_states, "GRAVE_EXCESS", 0.5)
    monkeypatch.setattr(lost_states, "_search", found)
    seen = Validations(monkeypatch, [3, 2, 2.0001, 3, 3, 3, 3], excesses=None)
    run = train(config, console=Console(quiet=True))
    assert same(weights_of(run, "best"), seen.weights[best])
    assert read_checkpoint(run.last)["callbacks"]["LostStates"] == {"": 0.0}


@pytest.mark.parametrize("program", [{"normalise": False}, {"trajectory_cost": 0, "constraint": 1}])
def test_a_loss_without_relative_costs_knows_no_lost_states(program, config, monkeypatch):
    config["program"] |= program
    seen = Validations(monkeypatch, [3, 2, 2.2, 3, 3, 3, 3], excesses=[0, 1000, 0, 0, 0, 0, 0])
    run = train(config, console=Console(quiet=True))
    assert same(weights_of(run, "best"), seen.weights[2])


def test_a_loss_that_rises_alone_sends_nothing_back(config, capsys, monkeypatch):
    Validations(monkeypatch, [3, 2, 1.9, 1.9, 1.9, 1.9, 1.9], loss=lambda cost: 3 - cost)
    _, out = run_of(config, capsys)
    assert "worse" not in out


def test_where_training_does_not_settle_only_a_divergence_sends_it_back(config, capsys, monkeypatch):
    config["training"]["least_gain"] = 0
    Validations(monkeypatch, [3, 2, 2.1, 2.1, 2.1, 2.1, 2])
    _, out = run_of(config, capsys)
    assert "worse" not in out


def with_dear_ones(cost, share):
    """Costs of which a share is a million."""
    dear = int(share * STATES)
    return torch.cat([torch.full((STATES - dear,), float(cost)), torch.full((dear,), 1e6)])[torch.randperm(STATES)]


@pytest.mark.parametrize("least_gain", [1e-9, 0.0])
def test_a_divergence_sends_it_back_at_once(least_gain, config, capsys, monkeypatch):
    config["training"]["least_gain"] = least_gain
    few = 1 - COMPARED_SHARE
    below, above = (2 * (1 + share * (DIVERGENCE_COST_RATIO - 1)) for share in (0.98, 1.02))
    at_start = with_dear_ones(2, few)
    costs = [at_start, with_dear_ones(below, few), at_start, with_dear_ones(above, few), *[at_start] * 3]
    Validations(monkeypatch, costs)
    run, _ = run_of(config, capsys)
    (entry,) = run.record()["returns"]
    assert "at step 6" in entry["because"]
    assert entry["to"] in (0, 4)


@pytest.mark.gate
@pytest.mark.parametrize("noise", [{}, {"velocity": 0.5}], ids=["without noise", "under noise"])
def test_without_a_goal_a_rise_within_the_spread_is_none(noise, config, capsys, monkeypatch):
    """From one initial state, where V(0, x₀) has no spread."""
    config["noise"], config["training"]["least_gain"] = noise, 0
    monkeypatch.setattr(Problem, "has_goal", False)
    costs = [torch.linspace(mean - 1, mean + 1, STATES) for mean in (2.0, 2.1, 2.0, 2.0, 2.0, 2.0, 2.0)]
    Validations(monkeypatch, costs, values=lambda k: torch.linspace(1.999, 2.001, k))
    run, _ = run_of(config, capsys)
    assert len(run.record()["returns"]) == (0 if noise else 1)
    costs[1] = costs[1] + 2
    Validations(monkeypatch, costs, values=lambda k: torch.linspace(1.999, 2.001, k))
    run, _ = run_of(config, capsys)
    assert len(run.record()["returns"]) == 1


@pytest.mark.gate
def test_a_run_resumed_between_best_and_return_is_the_same(config, capsys, monkeypatch):
    costs = [3, 2, 2.1, 2.1, 2.1, 2.1, 1.9]
    Validations(monkeypatch, costs)
    whole, _ = run_of(config, capsys)
    calls, original = [0], Learner.train_on

    def stop(learner, *rest):
        calls[0] += 1
        if calls[0] == 7:
            raise KeyboardInterrupt
        return original(learner, *rest)

    monkeypatch.setattr(Learner, "train_on", stop)
    with pytest.raises((KeyboardInterrupt, SystemExit)):
        run_of({**config, "experiment": "stopped"}, capsys)
    monkeypatch.setattr(Learner, "train_on", original)
    resumed, out = run_of({**config, "experiment": "stopped"}, capsys, resume="last")
    assert "resuming from step 6" in out
    assert len(resumed.record()["returns"]) == 1
    assert same(weights_of(resumed), weights_of(whole))


@pytest.mark.gate
def test_each_seed_returns_as_it_would_alone(config, capsys, monkeypatch):
    config["seeds"] = 2
    worse = Validations(monkeypatch, [3, 2, 2.1, 2.1, 2.1, 2, 2])
    calm = Validations(monkeypatch, [3, 2, 2, 2, 2, 2, 2])
    monkeypatch.setattr(
        Learner, "measure_on", lambda learner, x: (worse if learner.label == "seed_0" else calm).measure(learner, x)
    )
    run, out = run_of(config, capsys)
    assert "of seed 0" in out
    groups = read_checkpoint(run.last)["optimizer_states"][0]["param_groups"]
    assert groups[0]["lr"] == pytest.approx(groups[1]["lr"] / RATE_DIVISOR)

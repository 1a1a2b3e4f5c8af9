"""A training ends where further steps bring nothing, each seed as it would alone, and resumes to the same end."""

import itertools
import math
from dataclasses import replace
from functools import partial

import pytest
import torch
from rich.console import Console

from lyapnet.evaluation.states import StateTable
from lyapnet.experiment.checkpoint import read_checkpoint
from lyapnet.experiment.config import config_from_plain
from lyapnet.loop.programs import LyapunovProgram, ValueProgram
from lyapnet.training.build import build_module
from lyapnet.training.learner import Learner
from lyapnet.training.optimizer import OptimizerOptions
from lyapnet.training.runs import TrainingRun
from lyapnet.training.settling import COOLING, WINDOW, Settling, end_of
from lyapnet.training.stage_messages import StageMessages
from tests.runs import SMALL, Desk, both, checkpoint, dies_at, differences, without_figures

EVERY = 20
LONG = {
    "training": {**SMALL["training"], "iterations": 400, "validate_every": EVERY, "least_gain": 1e6},
    "rollout": {"gradient": "discrete", "compile": "off"},
    "evaluation": {**SMALL["evaluation"], "optimum": False},
}
SETTLED_AT = WINDOW  # with a gain that no loss has and no warmup, after the start
END = SETTLED_AT + COOLING


def desk(folder, **changes):
    folder.mkdir(exist_ok=True)
    return Desk(folder, **{**LONG, **changes})


def trained(folder, *arguments, **changes):
    one = desk(folder, **changes)
    status, out, errors = one.train(*arguments, prepare=without_figures)
    assert (status, errors) == (0, "")
    return one, out


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return trained(tmp_path_factory.mktemp("settled"))


@pytest.mark.parametrize(
    ("losses", "stopped"),
    [
        ([3.0, 2.0, 1.0], False),  # no WINDOW has passed
        ([3.0, 2.0, 1.0, 0.5, 0.2], False),
        ([1.0, 1.0, 1.0, 1.0], True),
        ([1.0, 1.001, 1.001, 0.9999], True),  # less than before by less than the least gain
        ([1.0, 5.0, 4.0, 0.9999], False),  # which goes up and down
        ([1.0, 1.1, 1.0, 1.05], False),
        ([1.0, 5.0, 4.0, 0.9], False),
        ([1.0, 5.0, 3.0, 5.0, 3.0, 5.0], False),
        ([1.0, 5.0, 3.0, 5.0, 3.0, 5.0, 3.0], True),  # for PATIENCE steps
        ([1.0, 5.0, 3.0, 0.9, 3.0, 5.0, 3.0], False),
    ],
)
def test_when_a_loss_has_stopped_falling(losses, stopped):
    assert has_stopped(losses, warmup=0) is stopped


def has_stopped(losses, warmup):
    """Whether it has after losses every EVERY steps, from the start on."""
    settling = Settling(1e-3, warmup, StageMessages(Console(), ""))
    settling.losses[""] = [(EVERY * k, loss) for k, loss in enumerate(losses)]
    return settling._has_stopped("", EVERY * (len(losses) - 1))


@pytest.mark.parametrize(
    ("losses", "stopped"),
    [
        ([1.0, 1.0, 1.0], False),  # in the warmup little happens, and it counts for patience alone
        ([1.0, 3.0, 5.0, 4.0, 5.0, 4.0, 5.0], True),  # never below the start
        ([6.0, 3.0, 5.0, 4.0, 5.0, 4.0, 5.0], False),
        ([1.0, 5.0, 4.0, 3.5, 3.0, 2.5, 2.0], False),  # on its way back to it
    ],
)
def test_the_loss_of_the_start_counts_once_patience_is_out(losses, stopped):
    assert has_stopped(losses, warmup=2 * EVERY) is stopped


OPTIMA, UNKNOWN = [1.0, 2.0, math.nan], [math.nan] * 3
NEAR = [1.0005, 2.0005, 9.0]
ONE_VIOLATES = torch.tensor([[-1.0], [1.0], [-1.0]])


@pytest.mark.parametrize(
    ("cost", "optima", "states", "changes", "optimal"),
    [
        (NEAR, OPTIMA, {}, {}, True),
        ([1.0005, 2.0005, math.nan], OPTIMA, {}, {}, True),  # not finite where nothing is known
        ([1.002, 2.002, 3.0], OPTIMA, {}, {}, False),
        ([1.1, 1.9, 3.0], OPTIMA, {}, {}, False),  # one state is lost, though the mean is right
        ([1.04, 1.96, 3.0], OPTIMA, {}, {}, False),  # below J* at one state, which is no reason for the other
        ([0.97, 1.94, 3.0], OPTIMA, {}, {}, False),  # below J*, which is no optimum then
        ([1.0005, math.nan, 3.0], OPTIMA, {}, {}, False),
        (NEAR, OPTIMA, {"value": torch.tensor([1.1, 2.1, 9.0])}, {}, False),
        (NEAR, OPTIMA, {"worst": ONE_VIOLATES}, {}, False),
        (NEAR, OPTIMA, {"has_goal": False}, {}, False),
        (NEAR, OPTIMA, {}, {"lost_excess": 3.0}, False),
        (NEAR, OPTIMA, {}, {"pointwise": torch.nn.Identity()}, False),
        (NEAR, OPTIMA, {}, {"program": ValueProgram(trajectory_cost=1, normalise=False)}, False),
        (NEAR, OPTIMA, {}, {"program": ValueProgram(trajectory_cost=10)}, False),  # ten times the fall of the loss
        (NEAR, OPTIMA, {}, {"program": LyapunovProgram()}, False),  # which trains its condition too
        ([1.0, 2.0, 3.0], UNKNOWN, {}, {}, False),
        ([1.0, 2.0, 3.0], None, {}, {}, False),
    ],
)
def test_a_law_at_the_optimum_has_settled(cost, optima, states, changes, optimal):
    (member,) = build_module(config_from_plain({**SMALL, "program": {"name": "value", "trajectory_cost": 1}})).members
    x, costs = torch.ones(3, 2), torch.tensor(cost)
    known = None if optima is None else torch.tensor(optima)
    table = StateTable(x, costs, costs, known, costs, costs, costs > 0, costs > 0, costs, x, costs)
    member.validation = replace(table, **states)
    for name, value in changes.items():
        setattr(member, name, value)
    assert Settling(1e-3, 0, StageMessages(Console(), ""))._is_optimal(member, torch.device("cpu")) is optimal


@pytest.mark.gate
def test_a_training_that_starts_at_the_optimum_is_short(tmp_path):
    changes = {
        "program": {"name": "value", "constraint": 0, "cost_to_go": 10, "trajectory_cost": 1},
        "network": {"name": "expansion", "hidden": [8]},  # starts from the Riccati solution
        "rollout": {**LONG["rollout"], "policy": "sampled"},
        "training": {**LONG["training"], "least_gain": 1e-3, "warmup": 40},
        "evaluation": {**LONG["evaluation"], "optimum": True},
    }
    one, out = trained(tmp_path / "optimal", **changes)
    assert f"settled: the law costs less than 0.1 % more than the optimum; its training ends at step {COOLING}" in out
    assert checkpoint(one, "last")["global_step"] == COOLING


@pytest.mark.gate
def test_the_start_is_among_the_losses(run):
    losses = checkpoint(run[0], "last")["callbacks"]["Settling"]["losses"]
    (kept,) = losses.values()
    assert kept[0][0] == 0
    assert math.isfinite(kept[0][1])


def test_the_rate_falls_from_where_it_settled():
    options = OptimizerOptions(learning_rate=1e-2, final_learning_rate=1e-4)
    whole = [options.rate(step, 400) for step in range(400)]
    settled = [options.rate(step, 400, cooling=(100, 140)) for step in range(400)]
    assert settled[:101] == whole[:101]
    falling = settled[100:140]
    assert all(later < earlier for earlier, later in itertools.pairwise(falling))
    assert falling[-1] == pytest.approx(1e-2, rel=0.2)
    assert not any(settled[140:])


def test_it_ends_with_the_last_seed():
    assert end_of({"seed_0": (60, 220), "seed_1": (100, 140)}, 2) == 220
    assert end_of({"seed_0": (60, 100)}, 2) == math.inf


@pytest.mark.gate
def test_training_ends_early_and_says_so(run):
    one, out = run
    ends = f"the validation loss fell by less than 1e+06; its training ends at step {END}"
    assert f"settled: in {WINDOW} steps {ends}" in out
    assert f"step {END}/{END}" in out
    assert checkpoint(one, "last")["global_step"] == END
    assert TrainingRun(one.run).finished


@pytest.mark.gate
def test_without_a_least_gain_it_takes_all_steps(tmp_path):
    one, out = trained(tmp_path / "whole", training={**LONG["training"], "iterations": END + 5, "least_gain": 0})
    assert "settled" not in out
    assert checkpoint(one, "last")["global_step"] == END + 5


@pytest.mark.gate
@pytest.mark.parametrize("step", [SETTLED_AT + 5, END])
def test_a_settled_training_resumes_to_the_same_end(run, step, tmp_path):
    other = desk(tmp_path / "other")
    dies = partial(dies_at, "lyapnet.training.modules:TrainingModule", "training_step", step)
    assert other.train(prepare=partial(both, without_figures, dies))[0] != 0
    status, out, errors = other.train("--resume", "last", prepare=without_figures)
    assert (status, errors) == (0, "")
    assert "settled" not in out  # it was said
    assert [*differences(checkpoint(run[0], "last"), checkpoint(other, "last"))] == []


@pytest.mark.gate
def test_a_settled_run_is_finished_until_all_steps_are_asked_for(run, tmp_path):
    one = run[0].copy(tmp_path / "copy")
    status, out, _ = one.train("--resume", "last", prepare=without_figures)
    assert status == 0
    assert "nothing to resume. Set training.least_gain=0 to train longer." in out
    further = "training.least_gain=0", f"training.iterations={END + 5}"
    assert one.train(*further, "--resume", "last", prepare=without_figures)[0] == 0
    assert checkpoint(one, "last")["global_step"] == END + 5


def settles_at(step):
    """Have the first seed settle at the first validation after the start, and others at a step."""
    Settling._has_stopped = lambda self, label, now: now > 0 and (label in ("", "seed_0") or now >= step)


def count_rollouts(path):
    """Write each training batch of a member to a file: its label and the step."""
    train_on = Learner.train_on

    def counted(self, trajectory, draw):
        with path.open("a", encoding="utf-8") as file:
            file.write(f"{self.label} {draw[-1]}\n")
        return train_on(self, trajectory, draw)

    Learner.train_on = counted


@pytest.mark.gate
def test_a_seed_that_has_settled_costs_no_more_rollouts(tmp_path):
    two, counts = desk(tmp_path, seeds=2), tmp_path / "counts"
    first = partial(both, partial(both, without_figures, partial(settles_at, 40)), partial(count_rollouts, counts))
    assert two.train(prepare=first)[0] == 0
    steps = [line.split() for line in counts.read_text(encoding="utf-8").splitlines()]
    last = {label: max(int(step) for name, step in steps if name == label) for label in ("seed_0", "seed_1")}
    assert last == {"seed_0": EVERY + COOLING, "seed_1": 40 + COOLING - 1}


@pytest.mark.gate
def test_a_run_of_which_one_seed_has_settled_resumes(tmp_path):
    two = desk(tmp_path, seeds=2)
    first = partial(both, without_figures, partial(settles_at, 40))
    step = EVERY + COOLING + 3  # seed 0 has settled and seed 1 has not
    dies = partial(dies_at, "lyapnet.training.modules:TrainingModule", "training_step", step)
    assert two.train(prepare=partial(both, first, dies))[0] != 0
    status, out, errors = two.train("--resume", "last", prepare=first)
    assert (status, errors) == (0, "")
    assert f"step {40 + COOLING}/{40 + COOLING}" in out


def test_other_weights_are_measured_again():
    """As after a divergence, which goes back to a checkpoint."""
    module = build_module(config_from_plain(SMALL))
    (member,) = module.members
    member.measured_at = 70
    module.load_state_dict(module.state_dict())
    assert member.measured_at == -1


@pytest.mark.gate
def test_a_seed_that_has_settled_waits_for_the_others(tmp_path):
    first = partial(both, without_figures, partial(settles_at, 40))
    alone = desk(tmp_path / "alone")
    assert alone.train(prepare=first)[0] == 0
    two = desk(tmp_path / "two", seeds=2)
    status, out, errors = two.train(prepare=first)
    assert (status, errors) == (0, "")
    assert f"the validation loss of seed 0 fell by less than 1e+06; its training ends at step {EVERY + COOLING}" in out
    assert f"step {40 + COOLING}/{40 + COOLING}" in out
    weights, others = (read_checkpoint(path)["state_dict"] for path in (alone.best(), two.best("seed_0")))
    for key in weights:
        assert float((weights[key] - others[key]).abs().max()) < 1e-7

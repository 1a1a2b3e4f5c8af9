"""States whose closed loops cost more than V says come again, however the training goes on, and no others do."""

from functools import partial

import pytest
import torch

import lyapnet
from lyapnet.base.errors import DivergenceError
from lyapnet.base.random_streams import LOST, stream
from lyapnet.evaluation.worst_states import MIN_EXCESS, SPREAD, excess, search_near_worst
from lyapnet.experiment.checkpoint import read_checkpoint
from lyapnet.task.sets import Box
from lyapnet.task.systems import Linear
from lyapnet.training import lost_states
from lyapnet.training.data import EnsembleDataModule, InitialStateDataModule
from lyapnet.training.lost_states import MAX_LOST_STATES, SEARCHED_STATES
from lyapnet.training.validation_optimum import COMPARED_STATES
from tests.marks import sample
from tests.problems import problem_of
from tests.runs import SMALL, Desk, both, checkpoint, dies_at, differences, values, without_figures

LOSING = {
    "training": {**SMALL["training"], "lost_share": 0.5},
    "rollout": {"gradient": "discrete", "compile": "off"},
    "evaluation": {**SMALL["evaluation"], "optimum": False},
}
PROBLEM = problem_of(Linear(torch.eye(2), torch.eye(2)), initial_states=Box([-1.0, -0.7], [1.0, 0.7]))
VALIDATIONS = [0, 5, 10, 15, 17]


def data_with(lost, share=0.5, seed=0):
    data = InitialStateDataModule(PROBLEM, batch_size=16, seed=seed, lost_share=share)
    data.lost = lost
    return data


def trained(folder, *arguments, **changes):
    folder.mkdir(exist_ok=True)
    desk = Desk(folder, **{**LOSING, **changes})
    status, _, errors = desk.train(*arguments, prepare=without_figures)
    assert (status, errors) == (0, "")
    return desk


def lost_of(path, seed=0):
    """The states that a checkpoint of several seeds keeps for one of them."""
    (data,) = (value for key, value in read_checkpoint(path).items() if key.endswith("DataModule"))
    return data["lost"][seed]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return trained(tmp_path_factory.mktemp("lost"))


@pytest.mark.parametrize(("count", "share", "drawn"), [(3, 0.5, 3), (100, 0.5, 8), (100, 0.25, 4), (0, 0.5, 0)])
def test_a_batch_has_its_share_of_them_at_most(count, share, drawn):
    lost = 100 + torch.arange(2.0 * count).reshape(count, 2)
    plain, data = data_with(lost, share=0.0), data_with(lost, share)
    assert not (plain.batch(3) > 50).any()
    for step in range(3):
        batch = data.batch(step)
        assert int((batch > 50).all(-1).sum()) == drawn
        assert torch.equal(batch[: 16 - drawn], plain.batch(step)[drawn:])
        assert len({tuple(row) for row in batch.tolist()}) == 16, "none of them twice"


def test_which_of_them_depends_on_seed_process_and_step_alone():
    lost = 100 + torch.arange(200.0).reshape(100, 2)
    draws = [data_with(lost, seed=seed).batch(step, process)[8:] for seed, step, process in
             [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]]  # fmt: skip
    assert len({tuple(draw.flatten().tolist()) for draw in draws}) == 4
    assert torch.equal(data_with(lost).batch(0, 1)[8:], draws[3])


def test_excess_is_relative_to_what_v_says_or_to_the_typical_cost():
    cost, value = torch.tensor([2.0, 1.0, 1.0, 1.2]), torch.tensor([1.0, 1.0, 2.0, 0.0])
    assert excess(cost, value).tolist() == pytest.approx([1.0, 0.0, -0.5, 1.2 / 0.05])


def excess_beside_a_cliff(x0):
    """10 % within 0.1 of the line x₁ = 0.3, and a hundred times V within a thousandth of it."""
    distance = (x0[:, 0] - 0.3).abs()
    return 0.1 * (distance < 0.1) + 99.0 * (distance < 1e-3)


def found_beside_a_cliff(seed):
    """Whether a search finds the cliff, whether its random states meet it, and the states that were tested."""
    x0 = PROBLEM.initial_states.sample(SEARCHED_STATES, torch.Generator().manual_seed(seed))
    excesses = excess_beside_a_cliff(x0)
    generator = torch.Generator().manual_seed(seed)
    tested, found = search_near_worst(PROBLEM.initial_states, x0, excesses, excess_beside_a_cliff, generator)
    assert torch.equal(found, excess_beside_a_cliff(tested))
    assert torch.equal(tested[:SEARCHED_STATES], x0)
    return float(found.max()) > 50, float(excesses.max()) > 50, tested


def test_a_search_near_the_worst_states_finds_what_is_rare():
    by_search, by_chance, tested = zip(*map(found_beside_a_cliff, range(8)), strict=True)
    assert sum(by_search) == 8 > 5 > sum(by_chance)
    further = torch.cat([x0[SEARCHED_STATES:] for x0 in tested])
    assert (further.abs() <= torch.tensor([1.0, 0.7])).all(), "all are states of X₀"
    assert ((further[:, 0] - 0.3).abs() < 0.1 + 10 * SPREAD).all(), "and near the worst"


def test_excesses_near_the_worst_are_relative_to_random_costs():
    cost, value = torch.linspace(0.0, 2.0, 101), torch.zeros(101)
    near = torch.tensor([2.0, 2.001])
    assert excess(near, near - 0.1, False, cost).tolist() == pytest.approx([0.1 / float(cost.std(correction=0))] * 2)
    assert excess(near, near - 0.1, False).min() > 1, "the counterpart: relative to each other"
    floored = excess(near, torch.zeros(2), True, cost)
    assert floored.tolist() == pytest.approx([2.0 / 0.05, 2.001 / 0.05])
    assert excess(cost, value)[-1] == floored[0]


def test_a_loop_that_is_not_finite_has_an_infinite_excess_and_the_others_their_own():
    cost = torch.tensor([torch.inf, 1.0, 1.0, 1.2])
    for has_goal, size in ((True, 1.0), (False, float(cost[1:].std(correction=0)))):
        expected = [torch.inf, 0.0, 0.0, 0.2 / size]
        assert excess(cost, torch.ones(4), has_goal).tolist() == pytest.approx(expected)
    assert excess(cost[:1], torch.ones(1)).tolist() == [torch.inf]


def test_without_lost_states_nothing_more_is_tested():
    x0 = PROBLEM.initial_states.sample(8, torch.Generator().manual_seed(0))
    mild = torch.full((8,), 0.99 * MIN_EXCESS)
    same = search_near_worst(PROBLEM.initial_states, x0, mild, lambda _: pytest.fail("tested"), torch.Generator())
    assert all(map(torch.equal, same, (x0, mild)))


@pytest.mark.gate
def test_what_is_kept_is_lost_under_the_weights_that_found_it(run):
    shares = values(run.run, "lost_fraction/val")
    assert [*shares] == VALIDATIONS
    x0 = PROBLEM.initial_states.sample(SEARCHED_STATES, stream(0, LOST, 17))
    controller = lyapnet.load(run.last)
    trajectory = controller.rollout(x0.double())
    lost = excess(trajectory.cost, trajectory.require_value()[0]) > MIN_EXCESS
    found = int(lost.sum())
    assert 0 < found < SEARCHED_STATES
    assert shares[17] == pytest.approx(found / SEARCHED_STATES)
    kept = lost_of(run.last)
    torch.testing.assert_close(kept[: min(found, MAX_LOST_STATES)], x0[lost][:MAX_LOST_STATES].double())
    assert len(kept) == min(MAX_LOST_STATES, sum(round(share * SEARCHED_STATES) for share in shares.values()))


@pytest.mark.gate
def test_training_on_them_is_another_training(run, tmp_path):
    without = trained(tmp_path / "without", training=SMALL["training"])
    mine, its = (checkpoint(desk, "last")["state_dict"] for desk in (run, without))
    assert any(not torch.equal(mine[key], its[key]) for key in its)
    with pytest.raises(KeyError):
        values(without.run, "lost_fraction/val")


@pytest.mark.gate
@pytest.mark.parametrize("place", [("lyapnet.training.modules:ValueModule", "training_step", 8)], ids=["step 8"])
def test_a_killed_run_goes_on_with_the_same_states(place, run, tmp_path):
    desk = Desk(tmp_path, **LOSING)
    assert desk.train(prepare=partial(both, without_figures, partial(dies_at, *place)))[0] < 0
    assert len(lost_of(desk.last))
    assert desk.train("--resume", "last", prepare=without_figures)[0] == 0
    assert not [*differences(checkpoint(desk, "last"), checkpoint(run, "last"))]
    assert values(desk.run, "lost_fraction/val") == values(run.run, "lost_fraction/val")


@pytest.mark.gate
def test_each_member_of_an_ensemble_has_its_own(run, tmp_path):
    desk = trained(tmp_path / "ensemble", seeds=2)
    assert values(desk.run / "seed_0", "lost_fraction/val") == pytest.approx(values(run.run, "lost_fraction/val"))
    assert not torch.equal(lost_of(desk.last, 0)[:20], lost_of(desk.last, 1)[:20])


def test_an_ensemble_draws_for_each_seed_what_its_run_alone_would():
    both_seeds = EnsembleDataModule(PROBLEM, 16, 4, 3, seeds=2, lost_share=0.5)
    lost = [100 + torch.arange(40.0).reshape(20, 2), 500 + torch.arange(40.0).reshape(20, 2)]
    both_seeds.load_state_dict({"seed": 3, "step": 0, "lost": lost})
    for k, own in enumerate(lost):
        alone = data_with(own, seed=3 + k)
        assert torch.equal(both_seeds.batch(2)[k], alone.batch(2))
        assert torch.equal(both_seeds.further(5, 2)[k], alone.further(5, 2))


@pytest.mark.gate
def test_a_search_that_diverges_changes_nothing(tmp_path):
    desk = Desk(tmp_path, **LOSING)
    status, _, errors = desk.train(prepare=partial(both, without_figures, _diverges))
    assert (status, errors) == (0, "")
    assert len(lost_of(desk.last)) == 0


def _diverges():
    def diverging(learner, trajectory):
        raise DivergenceError("Expected a finite closed loop, got none.")

    lost_states._cost_and_value = diverging


@pytest.mark.parametrize("seeds", sample([1, 2], 2))
def test_of_many_validation_states_the_first_are_compared_with_their_optimum(seeds, tmp_path):
    evaluation = {**SMALL["evaluation"], "validation_states": COMPARED_STATES + 6}
    desk = trained(tmp_path, seeds=seeds, evaluation=evaluation, training={**SMALL["training"], "iterations": 1})
    cost = read_checkpoint(desk.last)["callbacks"]["ValidationOptimum"]["cost"]
    assert cost.shape == (seeds, COMPARED_STATES + 6)
    assert cost[:, :COMPARED_STATES].isfinite().all()
    assert cost[:, COMPARED_STATES:].isnan().all()
    folder = desk.run if seeds == 1 else desk.run / "seed_0"
    assert all(value > 0 for value in values(folder, "optimality_gap/val").values()), "over those that are known"

"""Optimal trajectories from many states: what each learns from its neighbours and the oracle."""

import itertools
import math
from types import SimpleNamespace

import pytest
import torch
from torch.testing import assert_close

from lyapnet.evaluation.oracles import Optima
from lyapnet.task.sets import ControlBox
from lyapnet.task.systems import IntegratorChain, Linear
from lyapnet.training import optima
from lyapnet.training.optima import count_optima, optima_for
from lyapnet.value.expansions import at_rest, optimal_trajectories, path_under, riccati
from tests.problems import problem_of
from tests.value.expansions.test_expansions import hanging


def test_as_many_trajectories_as_fit_into_memory(monkeypatch):
    problem = problem_of(Linear([[0.0, 1.0], [1.0, 0.0]], [[0.0], [1.0]]), steps=20, dt=0.1)
    monkeypatch.setattr(optima, "MAX_DERIVATIVE_ENTRIES", 2 * problem.horizon.steps * 3**2)
    assert optima_for(problem, [riccati(problem)], problem.initial_states.sample(9)).path.cost.shape == (2,)


@pytest.fixture
def without_oracle(monkeypatch):
    monkeypatch.setattr(optima, "optimal_cost", lambda _: None)


def test_few_are_sought_and_the_others_follow(monkeypatch, without_oracle):
    problem = hanging(steps=40)
    x0, expansions, batches = problem.initial_states.sample(9), [riccati(problem)], []
    expected = optima_for(problem, expansions, x0)

    def counted(problem, x0, u, **progress):
        batches.append(len(x0))
        return optimal_trajectories(problem, x0, u)

    monkeypatch.setattr(optima, "optimal_trajectories", counted)
    monkeypatch.setattr(optima, "FROM_SCRATCH", 4)
    optimum = optima_for(problem, expansions, x0)
    assert batches[0] == 4
    assert 5 in batches
    assert_close(optimum.path.x[0], x0)
    assert_close(optimum.path.cost, expected.path.cost, rtol=1e-6, atol=0)
    assert_close(optimum.expansion.hessian, expected.expansion.hessian, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(
    ("share", "many", "taken"), [(0.5, 0.25, [5, 3, 2]), (0.5, 2.0, [5, 3]), (2.0, 0.25, [5]), (math.inf, 0.25, [5])]
)
def test_what_an_oracle_knows_better_is_taken(share, many, taken, monkeypatch, without_oracle):
    """And where that is so for many of the first, of the others too."""
    problem = hanging(steps=40)
    x0, expansions, batches = problem.initial_states.sample(5), [riccati(problem)], []
    for name, value in (
        ("NEIGHBOUR_ROUNDS", 0), ("OTHER_WAY", math.inf), ("BY_ORACLE", 3), ("MIN_IMPROVED_SHARE", many),
    ):  # fmt: skip
        monkeypatch.setattr(optima, name, value)
    good, idle = optima_for(problem, expansions, x0).path, path_under(problem, at_rest(problem), x0)

    def solve(states, **progress):
        rows = slice(0, 3) if len(states) == 3 else slice(3, 5)
        return Optima(share * idle.cost[rows], [""] * len(states), good.u[:, rows])

    def spoiled(problem, x0, u, **progress):
        batches.append(len(x0))
        return optimal_trajectories(problem, x0, u) if batches[1:] else optimal_trajectories(problem, x0, 0 * u, 0)

    monkeypatch.setattr(optima, "optimal_cost", lambda _: SimpleNamespace(solve=solve))
    monkeypatch.setattr(optima, "optimal_trajectories", spoiled)
    cost = optima_for(problem, expansions, x0).path.cost
    assert batches == taken
    assert_close(cost[3:], (good if 2 in taken else idle).cost[3:], rtol=1e-6, atol=0)
    assert_close(cost[:3], (good if 3 in taken else idle).cost[:3], rtol=1e-6, atol=0)


def test_an_optimum_of_the_oracle_without_controls_replaces_none():
    """Whose path no controls lead along; its twin with controls does."""
    problem = hanging(steps=40)
    x0 = problem.initial_states.sample(3)
    idle = optimal_trajectories(problem, x0, torch.zeros(40, 3, 1), iterations=0)
    good = optimal_trajectories(problem, x0, torch.zeros(40, 3, 1)).path
    assert bool((good.cost < 0.9 * idle.path.cost).all())
    u = good.u.clone()
    u[:, 1] = torch.nan
    found = Optima(good.cost, [""] * 3, u)
    improved, count = optima._replace_improved(problem, idle, torch.arange(3), found, seconds=100.0)
    assert count == 2
    assert_close(improved.path.cost[1], idle.path.cost[1])
    assert_close(improved.path.cost[::2], good.cost[::2], rtol=1e-6, atol=0)


def test_controls_of_the_oracle_are_where_the_search_from_other_states_begins(monkeypatch, without_oracle):
    """But for the last one, which has none and begins with a neighbour's law."""
    problem, begun = hanging(steps=40), []
    x0, expansions = problem.initial_states.sample(6), [riccati(problem)]
    monkeypatch.setattr(optima, "NEIGHBOUR_ROUNDS", 0)
    for name in ("FROM_SCRATCH", "BY_ORACLE"):
        monkeypatch.setattr(optima, name, 3)
    good = optima_for(problem, expansions, x0).path
    u = good.u.index_fill(1, torch.tensor([5]), torch.nan)

    def solve(states, **progress):
        rows = slice(0, 3) if len(states) == 3 and torch.equal(states, x0[:3].double()) else slice(3, 6)
        return Optima(good.cost[rows], [""] * 3, u[:, rows])

    def spoiled(problem, x0, u, **progress):
        begun.append(u)
        return optimal_trajectories(problem, x0, u if len(begun) > 1 else 0 * u, 80 if len(begun) > 1 else 0)

    monkeypatch.setattr(optima, "optimal_cost", lambda _: SimpleNamespace(solve=solve))
    monkeypatch.setattr(optima, "optimal_trajectories", spoiled)
    found = optima_for(problem, expansions, x0).path
    assert_close(begun[-1][:, :2], good.u[:, 3:5], rtol=1e-3, atol=1e-3)
    assert begun[-1].isfinite().all()
    assert_close(found.cost[:5], good.cost[:5], rtol=1e-6, atol=0)


def test_a_search_ends_in_its_seconds(without_oracle):
    problem = hanging(steps=40)
    x0 = problem.initial_states.sample(3)
    u = torch.zeros(40, 3, 1)
    idle, found = (optimal_trajectories(problem, x0, u, seconds=seconds) for seconds in (0, 100))
    assert torch.equal(idle.path.u, u)
    assert (found.path.cost < idle.path.cost / 2).all()


def test_a_task_of_one_state_has_fewer_optima():
    counts = [count_optima(problem_of(IntegratorChain(n))) for n in (1, 2, 3)]
    assert counts == [48, 512, 512]


def test_a_bad_minimum_is_left_by_way_of_its_neighbours(monkeypatch, without_oracle):
    problem = hanging(steps=40)
    x0, expansions = problem.initial_states.sample(8), [riccati(problem)]
    expected = optima_for(problem, expansions, x0).path.cost
    begun = []

    def spoiled(problem, x0, u, **progress):
        found = optimal_trajectories(problem, x0, u)
        if begun:
            return found
        begun.append(x0)
        bad = optimal_trajectories(problem, x0[:1], 0 * u[:, :1], iterations=0)
        return optima._replace_rows(found, torch.tensor([0]), bad)

    monkeypatch.setattr(optima, "optimal_trajectories", spoiled)
    assert_close(optima_for(problem, expansions, x0).path.cost, expected, rtol=1e-6, atol=0)
    begun.clear()
    monkeypatch.setattr(optima, "NEIGHBOUR_ROUNDS", 0)
    monkeypatch.setattr(optima, "OTHER_WAY", math.inf)
    assert optima_for(problem, expansions, x0).path.cost[0] > 2 * expected[0]


@pytest.mark.parametrize("improve", [optima._improve_from_neighbours, optima._improve_by_other_ways])
def test_later_searches_end_in_their_seconds(improve, monkeypatch, without_oracle):
    """Each reading of the clock is a second later."""
    problem, clock, allowed = hanging(steps=20), itertools.count(), []
    x0 = problem.initial_states.sample(20)
    optimum = optimal_trajectories(problem, x0, torch.zeros(20, 20, 1), iterations=1)

    def recorded(problem, x0, *arguments, seconds, **options):
        allowed.append(seconds)
        return optimal_trajectories(problem, x0, *arguments, **options)

    for name, value in (("OTHER_WAY", -1.0), ("optimal_trajectories", recorded), ("seconds_of_work", clock.__next__)):
        monkeypatch.setattr(optima, name, value)
    monkeypatch.setattr(optima, "_path_distance", lambda _, x, other: torch.ones(x.shape[1]))
    for name in ("NEIGHBOUR_IMPROVEMENT", "OTHER_WAY_IMPROVEMENT"):  # whatever is found counts as cheaper
        monkeypatch.setattr(optima, name, 3.0)
    monkeypatch.setattr(optima, "SEARCH_SECONDS", 2.5)
    improve(problem, optimum, optima.silent)
    assert all(0 <= seconds < 2.5 for seconds in allowed)
    few = len(allowed)
    monkeypatch.setattr(optima, "SEARCH_SECONDS", 20.5)
    improve(problem, optimum, optima.silent)
    assert 0 < few < len(allowed) - few, "the twin: with enough seconds they go on"


def test_where_no_way_is_cheaper_few_are_tried(monkeypatch, without_oracle):
    """Of 80 paths that count as different ways, every fifth is searched from."""
    problem, batches = hanging(steps=20), []

    def counted(problem, x0, *arguments, **options):
        batches.append(len(x0))
        return optimal_trajectories(problem, x0, *arguments, **options)

    x0 = problem.initial_states.sample(20)
    optimum = optimal_trajectories(problem, x0, torch.zeros(20, 20, 1))
    for name, value in (("OTHER_WAY", -1.0), ("FIRST_WAYS", 16), ("optimal_trajectories", counted)):
        monkeypatch.setattr(optima, name, value)
    monkeypatch.setattr(optima, "_path_distance", lambda _, x, other: torch.ones(x.shape[1]))
    monkeypatch.setattr(optima, "WAYS", 4)
    assert optima._improve_by_other_ways(problem, optimum, optima.silent) is optimum
    assert batches == [16]


@pytest.mark.gate
def test_a_cheaper_way_is_found_where_the_law_of_the_neighbour_on_it_costs_more(monkeypatch, without_oracle):
    """Within tight limits a neighbour's law just misses the last swing, until a search begins with it."""
    problem = hanging(60, 0.06).replaced(controls=ControlBox([-3.0], [3.0]))
    x0 = torch.stack([torch.linspace(2.5, 3.5, 24), torch.full((24,), 0.3)], 1)
    cost = optima_for(problem, [riccati(problem)], x0).path.cost
    monkeypatch.setattr(optima, "OTHER_WAY", math.inf)
    without = optima_for(problem, [riccati(problem)], x0).path.cost
    assert (cost <= (1 + 1e-9) * without).all()
    assert float((cost / without).min()) < 0.9


def test_one_state_and_states_that_share_a_coordinate(without_oracle):
    problem = hanging(steps=20)
    x0 = problem.initial_states.sample(3)
    x0[:, 1] = 0.25
    whole = optima_for(problem, [riccati(problem)], x0)
    assert whole.path.cost.isfinite().all()
    assert_close(optima_for(problem, [riccati(problem)], x0[:1]).path.x[0], x0[:1])

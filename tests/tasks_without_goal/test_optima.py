"""Two formulations of each task without a goal, by us in torch and by us in CasADi, are the same task."""

import functools

import numpy as np
import pytest
import torch
import yaml

from lyapnet.task.cost import reason_for_no_goal
from tests.marks import sample
from tests.pages import ROOT, blocks
from tests.tasks_without_goal.optima import AGREES, TASKS, Transcription
from tests.tasks_without_goal.tasks import HERE, KEPT, WORKING, optima_of, problem_of, replay

ALL = (*WORKING, *KEPT)
problem = functools.cache(problem_of)  # checking where its functions are defined takes most of the time of these tests


def misses(name, controls=None):
    """By how much of the largest J* the replayed cost of what is kept differs from it."""
    kept = optima_of(name)
    controls = kept["controls"] if controls is None else controls
    optima = torch.tensor(kept["optima"])
    J = replay(problem(name), kept["states"][: len(controls)], controls).J
    return (J - optima[: len(controls)]) / optima.abs().max()


@pytest.mark.parametrize("name", ALL)
def test_optimal_controls_cost_the_same_by_our_steps(name):
    assert misses(name).abs().max() < AGREES


@pytest.mark.parametrize("name", ALL)
def test_other_controls_cost_more(name):
    """The twin that must fail: half the way to the middle of what is allowed."""
    low, high = map(torch.tensor, TASKS[name].controls)
    other = 0.5 * torch.tensor(optima_of(name)["controls"]) + 0.25 * (low + high)
    assert misses(name, other.tolist()).min() > AGREES or breaks_a_limit(name, other)


def breaks_a_limit(name, controls):
    return bool((replay(problem(name), optima_of(name)["states"][: len(controls)], controls).h > 1e-6).any())


@pytest.mark.parametrize("name", ALL)
def test_the_search_stays_where_it_ended(name):
    """What is kept is an optimum of the script as it is."""
    kept, own = optima_of(name), Transcription(TASKS[name])
    found = own.solve(np.array(kept["states"][0]), np.array(kept["controls"][0]))
    assert found is not None
    assert found[0] == pytest.approx(kept["optima"][0], rel=AGREES)


@pytest.mark.parametrize("name", ALL)
def test_optimal_controls_keep_every_limit(name):
    kept = optima_of(name)
    low, high = map(torch.tensor, TASKS[name].controls)
    controls = torch.tensor(kept["controls"])
    assert bool(((controls >= low) & (controls <= high)).all())
    assert not breaks_a_limit(name, controls)


@pytest.mark.parametrize("name", ALL)
def test_the_states_are_of_X0(name):
    states, box = torch.tensor(optima_of(name)["states"]), problem(name).initial_states
    assert states.shape == (64, len(box.lower))
    assert bool(((states >= box.lower - 1e-6) & (states <= box.upper + 1e-6)).all())


# −amount · volume and its slope vanish at the origin, and on all of X₀, where nothing is secreted yet.
@pytest.mark.parametrize("name", sample(ALL, 4))
def test_no_task_has_a_goal(name):
    problem(name).check()
    assert problem(name).no_goal


def test_the_readme_and_the_page_name_every_task():
    rows = [line for line in (HERE / "README.md").read_text(encoding="utf-8").splitlines() if line.startswith("| `")]
    assert [row.split("`")[1] for row in rows] == list(ALL)
    assert [row.rstrip("| ").endswith("kept") for row in rows] == [name in KEPT for name in ALL]


@pytest.mark.parametrize("name", ALL)
def test_the_file_has_four_sections_and_limits(name):
    content = yaml.safe_load((HERE / name / "task.yaml").read_text(encoding="utf-8"))
    assert {"experiment", "system", "cost", "controls", "initial_states", "horizon"} <= content.keys()
    assert content.keys() <= {"experiment", "system", "cost", "controls", "initial_states", "horizon", "constraints"}
    assert content["horizon"]["steps"] <= 200


def test_the_cost_on_the_page_has_no_goal():
    (source,) = [block for block in blocks("python", ROOT / "docs" / "systems.md") if "lyapnet.Cost" in block]
    space = {}
    exec(source, space)
    cost = space["Loss"]()
    x = torch.rand(8, 1)
    cost.check(x)
    assert reason_for_no_goal(cost, torch.zeros(1), x)

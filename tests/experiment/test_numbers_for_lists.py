"""A single number stands for a list that has one for each state or control, wherever such a list is taken."""

import pytest
import torch
from torch.testing import assert_close

from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import config_from_plain

TASK = {
    "experiment": "x", "system": {"name": "planar_quadrotor"}, "cost": {"Q": 1, "R": 1, "Q_T": 10},
    "initial_states": {"lower": -1, "upper": 1}, "horizon": {"steps": 4, "dt": 0.1},
}  # fmt: skip
BATTERY = {
    "experiment": "x", "system": {"name": "linear", "parameters": {"A": [[0]], "B": [[1]]}},
    "cost": {"Q": 0, "R": 0.1, "Q_T": 10}, "controls": {"lower": 0, "upper": 1}, "target": 0.9,
    "initial_states": {"lower": 0.1, "upper": 0.8}, "horizon": {"steps": 4, "dt": 0.1},
}  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "overrides", "same"),
    [
        ({}, ["initial_states.lower=-0.5"], {"initial_states": {"lower": [-0.5] * 6, "upper": [1] * 6}}),
        ({"initial_states": {"lower": [-1] * 6, "upper": 1}}, [], {}),
        ({"target": 0}, [], {"target": [0] * 6}),
        ({}, ["target=0"], {"target": [0] * 6}),
        ({"target": 0, "target_control": 0.5}, [], {"target": [0] * 6, "target_control": [0.5, 0.5]}),
        ({"controls": {"lower": -8, "upper": 9}}, [], {"controls": {"lower": [-8] * 2, "upper": [9] * 2}}),
        ({"controls": {"lower": [-8, -8], "upper": 8}}, ["controls.lower=-3"], {"controls": {"lower": -3, "upper": 8}}),
        ({}, ["cost.Q=2", "cost.R=[3]"], {"cost": {"Q": [2] * 6, "R": [3, 3], "Q_T": [10] * 6}}),
    ],
)
def test_a_number_counts_for_all(changes, overrides, same):
    one = build_problem(config_from_plain({**TASK, **changes}, overrides))
    other = build_problem(config_from_plain({**TASK, **same}))
    assert not one.differences(other.record())
    assert_close(one.goal, other.goal)


def test_one_state_needs_no_list():
    problem = build_problem(config_from_plain(BATTERY))
    assert_close(problem.initial_states.lower, torch.tensor([0.1]))
    assert_close(problem.goal, torch.tensor([0.9]))


@pytest.mark.parametrize("entry", [[1], ["a", "b"], "x", True, {"a": 1}])
@pytest.mark.parametrize("key", ["pointwise.region", "initial_states.lower", "target_control", "network.state_scale"])
def test_an_entry_that_is_no_number_is_refused(key, entry):
    section, _, name = key.rpartition(".")
    given = {section: {**TASK.get(section, {}), name: [entry]}} if section else {name: [entry]}
    with pytest.raises(UsageError, match=rf"Expected {key}.0 as a number, got"):
        config_from_plain({**TASK, **given})


def test_an_entry_may_be_a_number_in_quotes_or_another_value():
    config = config_from_plain({**TASK, "seed": 3, "pointwise": {"region": ["2.5", "${seed}"]}})
    assert config.pointwise.region == [2.5, 3.0]


@pytest.mark.parametrize("side", ["lower", "upper"])
@pytest.mark.parametrize(
    ("limits", "reason"),
    [
        (1.5, "as {name: number}, got 1.5"),
        ([1.5] * 6, r"got \[1.5"),
        ({"x": [1.5]}, r"\.x as a number, got \[1.5\]"),
        ({"x": None}, r"\.x as a number, got None"),
        ({"x": "high"}, r"\.x as a number, got 'high'"),
        ({"x": True}, r"\.x as a number, got True"),
        ({"x": {"a": 1}}, r"\.x as a number, got {'a': 1}"),
    ],
)
def test_limits_of_states_are_numbers_by_name(side, limits, reason):
    with pytest.raises(UsageError, match=f"Expected constraints.{side}.*{reason}"):
        config_from_plain({**TASK, "constraints": {side: limits}})

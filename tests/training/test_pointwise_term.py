"""The condition off the closed loops as a term of a training, and what a config says of it."""

import csv

import pytest
import torch
from torch.testing import assert_close

from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly import build_problem, build_program, build_rollout, build_value_function
from lyapnet.experiment.config import config_from_plain
from lyapnet.loop.programs import LyapunovProgram, ValueProgram
from lyapnet.training.build import build_data, build_module
from lyapnet.training.build_learner import build_pointwise

SMALL = {
    "experiment": "small",
    "program": {"name": "lyapunov", "margin": 0.1},
    "system": {"name": "double_integrator"},
    "cost": {"Q": [1, 1], "R": [1], "Q_T": [1, 1]},
    "initial_states": {"lower": [-1, -1], "upper": [1, 1]},
    "horizon": {"steps": 4, "dt": 0.1},
    "network": {"name": "anchored", "hidden": [4]},
    "training": {"iterations": 1, "batch_size": 2},
    "evaluation": {"validation_states": 2, "test_states": 2},
}


def config_of(*overrides):
    return config_from_plain(SMALL, ["pointwise.weight=2", "pointwise.points=8", *overrides])


def built(*overrides):
    config = config_of(*overrides)
    problem = build_problem(config)
    rollout = build_rollout(config, problem, build_value_function(config, problem))
    return build_pointwise(config, rollout, build_program(config))


def one_step(*overrides):
    """(the terms of the first member, its gradients) of a step."""
    config = config_of(*overrides)
    module = build_module(config)
    x0 = build_data(config, module.members[0].problem).batch(0)
    loss = module.training_step(x0, 0)["loss"]
    gradients = torch.autograd.grad(loss, list(module.members[-1].V.parameters()))
    return module.members[-1].output, gradients


def test_the_loss_has_the_term_with_its_weight():
    output, gradients = one_step()
    without, others = one_step("pointwise.weight=0")
    assert "pointwise" not in without.terms
    assert_close(output.loss - without.loss, 2 * output.terms["pointwise"])
    assert output.terms["pointwise"] > 0
    assert any(not torch.allclose(a, b, rtol=1e-3) for a, b in zip(gradients, others, strict=True))


@pytest.mark.gate
def test_a_member_of_an_ensemble_has_the_points_of_its_seed():
    discrete = ["rollout.gradient=discrete", "rollout.compile=off"]
    member, gradients = one_step("seed=3", "seeds=2", *discrete)
    alone, expected = one_step("seed=4", *discrete)
    assert_close(member.terms["pointwise"], alone.terms["pointwise"], rtol=1e-9, atol=0)
    for a, b in zip(gradients, expected, strict=True):
        assert_close(a, b, rtol=1e-9, atol=1e-12)
    assert not torch.allclose(one_step("seed=3", *discrete)[0].terms["pointwise"], alone.terms["pointwise"], rtol=1e-3)


# What is built


def write(path, rows):
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    return f"pointwise.counterexamples={path}"


def test_what_a_config_says():
    condition = built()
    assert condition.region.upper.tolist() == [1.5, 1.5], "one and a half times X₀"
    assert (condition.points, condition.weight, condition.further) == (8, 2, None)
    assert condition.program == LyapunovProgram(margin=0.1)
    assert condition.duration == pytest.approx(0.4)
    assert built("pointwise.region=[2, 3]").region.lower.tolist() == [-2, -3]
    assert built("pointwise.region=[2]").region.upper.tolist() == [2, 2]
    assert built("pointwise.weight=0") is None
    assert built("program={name: value, margin: null}").program == ValueProgram()


def test_counterexamples_are_read_to_the_last_digit(tmp_path):
    points = [[0.1, 1 / 3, -0.7], [0.2, 1e-17, 2.0]]
    torch.set_default_dtype(torch.float32)  # as a user has it
    condition = built(write(tmp_path / "points.csv", [["t", "position", "velocity"], *points]))
    assert condition.further.tolist() == points
    assert len(built(write(tmp_path / "none.csv", [["t", "position", "velocity"]])).further) == 0


@pytest.mark.parametrize(
    "rows",
    [
        [["t", "x"], [0.1, 0.2]],
        [["t", "x", "v"], [0.1, 0.2, "far"]],
        [["t", "x", "v"], [0.1, 0.2, "nan"]],
        [["t", "x", "v"], [0.1, 0.2, 0.3], [0.1]],
        [[0.1, 0.2, 0.3], [0.1, 0.2, 0.3]],
        [],
    ],
    ids=["two columns", "words", "nan", "ragged", "no heading", "empty"],
)
def test_a_broken_file_of_counterexamples_is_refused(rows, tmp_path):
    path = tmp_path / "points.csv"
    with pytest.raises(UsageError, match=r"Expected pointwise.counterexamples as a CSV of rows t, x_1, …, x_2, got"):
        built(write(path, rows))
    with pytest.raises(UsageError, match=r"nowhere\.csv"):
        built("pointwise.counterexamples=nowhere.csv")
    path.write_bytes(bytes(range(128, 256)))
    with pytest.raises(UsageError, match=r"points\.csv"):
        built(f"pointwise.counterexamples={path}")


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["pointwise.region=[1, 2, 3]"], "pointwise.region"),
        (["pointwise.region=[0, 1]"], "pointwise.region"),
        (["initial_states={lower: [-1, 0], upper: [1, 0]}"], "Expected pointwise.region, got none, and X₀ is thin"),
        (["pointwise.points=1"], "pointwise.points"),
        (["pointwise.weight=-1"], "pointwise.weight"),
    ],
)
def test_a_region_that_does_not_fit_is_refused(overrides, message):
    with pytest.raises(UsageError, match=message):
        built(*overrides)
    built("initial_states={lower: [-1, 0], upper: [1, 0]}", "pointwise.region=[1, 2]")

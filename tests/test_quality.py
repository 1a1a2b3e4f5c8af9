"""Shipped trainings at full length, held to what the README promises. Minutes each: pytest -m slow."""

import json

import pytest

from lyapnet.cli import main

pytestmark = pytest.mark.slow


def trained(name, folder, capsys, *overrides):
    """`lyapnet evaluate --json` of the best checkpoint of a shipped config."""
    assert main(["train", "--config", f"conf/{name}.yaml", f"logs={folder}", *overrides]) == 0
    capsys.readouterr()
    assert main(["evaluate", f"{folder}/{name}/version_0/checkpoints/best.ckpt", "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_lyapunov_program_on_the_double_integrator(tmp_path, capsys):
    result = trained("double_integrator", tmp_path, capsys)
    assert 1 <= result["cost_ratio"] <= 1.02
    assert result["satisfied_fraction"] >= 0.99
    assert result["decreasing_fraction"] == 1
    assert result["bounded_fraction"] >= 0.99
    assert result["value_to_cost"] <= 1.1


def test_the_bound_is_what_makes_V_tight(tmp_path, capsys):
    """The twin: the same training without it proves as much, by a V that is farther above the cost."""
    result = trained("double_integrator", tmp_path, capsys, "program.bound=0")
    assert result["satisfied_fraction"] >= 0.99
    assert result["value_to_cost"] > 1.1


def test_lyapunov_program_on_balancing(tmp_path, capsys):
    result = trained("cartpole_balancing", tmp_path, capsys)
    assert result["cost_mean"] <= 1.05 * 16.16  # of direct transcription, on the same states
    assert result["satisfied_fraction"] >= 0.95  # of 100 states
    assert result["value_to_cost"] <= 1.25


def test_value_program_on_the_double_integrator(tmp_path, capsys):
    result = trained("double_integrator_value", tmp_path, capsys)
    assert 1 <= result["cost_ratio"] <= 1.02
    assert result["value_error"] <= 0.03


@pytest.mark.parametrize(("name", "optimum"), [("cartpole_swingup", 185.95), ("reacher", 9.894)])
def test_value_program_where_the_initial_states_are_thin(name, optimum, tmp_path, capsys):
    """The optima are those of a direct transcription on the same states; V is the cost of its own policy."""
    result = trained(name, tmp_path, capsys)
    assert result["cost_mean"] <= 1.01 * optimum
    assert result["value_to_cost"] == pytest.approx(1, abs=0.02)


def test_a_short_training_meets_neither_bar_where_the_initial_states_are_thin(tmp_path, capsys):
    """The twin."""
    result = trained("cartpole_swingup", tmp_path, capsys, "training.iterations=20")
    assert result["cost_mean"] > 1.01 * 185.95
    assert abs(result["value_to_cost"] - 1) > 0.02


def test_a_hundredth_of_the_training_is_not_enough(tmp_path, capsys):
    """The twin: the bars above are not met by an untrained V."""
    result = trained("double_integrator", tmp_path, capsys, "training.iterations=1")
    assert result["cost_ratio"] > 1.05
    assert result["satisfied_fraction"] < 0.95

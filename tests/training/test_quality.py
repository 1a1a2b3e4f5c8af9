"""Shipped trainings at full length, held to what the README promises. Minutes each: pytest -m nightly."""

import json

import numpy as np
import pytest

import lyapnet
from lyapnet.base.random_streams import TEST, stream
from lyapnet.cli import main
from lyapnet.evaluation.measurement import PAPER_STATES
from tests.grid_solver import solve_on_grid

pytestmark = pytest.mark.nightly


def trained(name, folder, capsys, *overrides):
    """`lyapnet evaluate --json` of the best checkpoint of a shipped config."""
    run = name.removeprefix("from_scratch/")
    assert main(["train", "--config", f"conf/{name}.yaml", f"logs={folder}", f"experiment={run}", *overrides]) == 0
    capsys.readouterr()
    assert main(["evaluate", f"{folder}/{run}/version_0/checkpoints/best.ckpt", "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_lyapunov_program_on_the_double_integrator(tmp_path, capsys):
    result = trained("double_integrator", tmp_path, capsys)
    assert 1 <= result["cost_ratio"] <= 1.02
    assert result["satisfied_fraction"] >= 0.99
    assert result["decreasing_fraction"] == 1
    assert result["bounded_fraction"] >= 0.99
    assert result["value_to_cost"] <= 1.1


def test_the_bound_is_what_makes_V_tight(tmp_path, capsys):
    """The twin: a training from random weights without it proves as much, by a V that is farther above the cost."""
    result = trained("from_scratch/double_integrator", tmp_path, capsys, "program.bound=0")
    assert result["satisfied_fraction"] >= 0.99
    assert result["value_to_cost"] > 1.1


def test_lyapunov_program_on_balancing(tmp_path, capsys):
    result = trained("cartpole_balancing", tmp_path, capsys)
    assert result["cost_mean"] <= 1.05 * 16.16  # of direct transcription, on the same states
    assert result["satisfied_fraction"] >= 0.95  # of 100 states
    assert result["value_to_cost"] <= 1.25


def certificate(folder, name, capsys, *options):
    """`lyapnet certify sound --json` of a run."""
    path = f"{folder}/{name}/version_0/checkpoints/best.ckpt"
    assert main(["certify", "sound", path, "--json", *options]) == 0
    return json.loads(capsys.readouterr().out)


def test_a_funnel_that_holds_all_initial_states_of_the_double_integrator(tmp_path, capsys):
    name = "double_integrator_certified"
    assert trained(name, tmp_path, capsys)["cost_ratio"] <= 1.02
    result = certificate(tmp_path, name, capsys, "--alpha", "0.97", "--delta", "0.015", "--seconds", "200")
    assert result["verdict"] == "certified"
    assert result["volume_share"] == 1
    assert 1 <= result["guaranteed_cost_ratio"] <= 1.1


def test_without_points_off_the_closed_loops_it_is_falsified(tmp_path, capsys):
    """The twin."""
    name = "double_integrator_certified"
    trained(name, tmp_path, capsys, "pointwise.weight=0")
    assert certificate(tmp_path, name, capsys, "--alpha", "0.97", "--delta", "0.015")["verdict"] == "falsified"


def test_a_funnel_that_holds_half_of_balancing(tmp_path, capsys):
    name = "cartpole_balancing_certified"
    assert trained(name, tmp_path, capsys)["cost_mean"] <= 1.05 * 16.16
    result = certificate(tmp_path, name, capsys, "--alpha", "0.8", "--seconds", "1800", "--workers", "2")
    assert result["volume_share"] >= 0.5
    assert result["states_left_out"] == ["cart position"]


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
    """The twin, from random weights: the standard recipe's start meets both bars before the first step."""
    result = trained("from_scratch/cartpole_swingup", tmp_path, capsys, "training.iterations=20")
    assert result["cost_mean"] > 1.01 * 185.95
    assert abs(result["value_to_cost"] - 1) > 0.02


def test_a_hundredth_of_the_training_is_not_enough(tmp_path, capsys):
    """The twin: the bars above are not met by an untrained V."""
    result = trained("from_scratch/double_integrator", tmp_path, capsys, "training.iterations=1")
    assert result["cost_ratio"] > 1.05
    assert result["satisfied_fraction"] < 0.95


def test_a_swing_up_under_noise_costs_what_a_grid_finds(tmp_path, capsys):
    """The optimum by dynamic programming on a grid, an independent route; the law without training costs more."""
    result = trained("pendulum_noise", tmp_path, capsys)
    controller = lyapnet.load(f"{tmp_path}/pendulum_noise/version_0/checkpoints/best.ckpt")
    optimum = solve_on_grid(controller.problem, [-1.5, -8], [4.5, 4], 101, np.linspace(-16, 10, 40))
    x0 = controller.initial_states.sample(result["samples"] + PAPER_STATES, stream(result["seed"], TEST))
    least = float(optimum(x0[: result["samples"]]).mean())
    assert 0.998 <= result["cost_mean"] / least <= 1.01
    assert abs(result["value_mean"] / least - 1) <= 0.005
    assert result["lqr_cost_mean"] > 1.5 * least

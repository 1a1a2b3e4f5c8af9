"""What evaluations say of an estimator, against LQG in closed form; consistent where its noise is right, not else."""

import json
import math
from typing import Any

import numpy as np
import pytest
import torch
import yaml

import lyapnet
from lyapnet.base.files import plain
from lyapnet.cli import main
from lyapnet.evaluation.estimator_figure import states_and_estimates
from lyapnet.evaluation.tables import evaluation_table
from lyapnet.evaluation.with_estimator import loops_with_estimator, measure_with_estimator
from lyapnet.experiment.assembly import Parts, build_problem
from lyapnet.experiment.config import config_from_plain
from lyapnet.task.noise import StateNoise
from lyapnet.task.systems import DoubleIntegrator
from lyapnet.value.expansions import riccati
from tests.controller.test_output_feedback import TASK, controller_of
from tests.evaluation.dead_time import TASKS, known_cost, mean_cost
from tests.pages import ROOT, blocks
from tests.problems import OfExpansion, problem_of

STEPS, DT, SIGMA, STRENGTHS = 15, 0.1, 0.2, (0.1, 0.4)


def regulated(strengths=STRENGTHS):
    """A mass under its optimal law, with noise on both states."""
    problem = problem_of(DoubleIntegrator(), None, STEPS, DT).replaced(noise=StateNoise(strengths))
    return lyapnet.Controller(problem, OfExpansion(problem, riccati(problem)))


def measured(controller, states=2000, kind="ekf", **assumed):
    estimator = controller.with_estimator(kind, measure=["position"], noise=SIGMA, **assumed)
    x0 = controller.initial_states.sample(states, torch.Generator().manual_seed(3))
    return measure_with_estimator(loops_with_estimator(controller, estimator, x0), estimator)


def cost_of_lqg():
    """(E J with the state known, E J with the filter): Riccati forwards and backwards, with NumPy."""
    A, B, H = np.array([[1, DT], [0, 1]]), np.array([[0], [DT]]), np.array([[1.0, 0]])
    Q, R, W = DT * np.eye(2), np.array([[DT]]), DT * np.diag(np.square(STRENGTHS))
    S, gains = np.eye(2), list[tuple[np.ndarray, np.ndarray]]()
    noise = 0.0
    for _ in range(STEPS):
        noise += np.trace(S @ W)
        weight = R + B.T @ S @ B
        K = np.linalg.solve(weight, B.T @ S @ A)
        S = Q + A.T @ S @ A - K.T @ weight @ K
        gains.append((K, weight))
    P, more = np.eye(2) / 3, 0.0
    known = np.trace(S @ P) + noise
    for K, weight in gains[::-1]:
        P = P - P @ H.T @ np.linalg.solve(H @ P @ H.T + SIGMA**2, H @ P)
        more += np.trace(K.T @ weight @ K @ P)
        P = A @ P @ A.T + W
    return known, known + more


@pytest.mark.parametrize("kind", ["ekf", "ukf"])
def test_costs_of_a_linear_system_are_those_of_lqg(kind):
    """Both means within four standard deviations; the loss by estimation is no part of the noise of the sample."""
    found, (known, cost) = measured(regulated(), 4000, kind), cost_of_lqg()
    assert cost > 1.1 * known
    assert found.cost_ratio is not None
    assert found.half_width is not None
    assert abs(found.cost_ratio - cost / known) < 2 * found.half_width < 0.1
    assert found.known_cost_mean == pytest.approx(known, rel=0.05)
    assert found.lost_fraction < 0.5


@pytest.mark.parametrize("kind", ["ekf", "ukf"])
def test_the_error_of_a_linear_system_is_what_the_filter_says(kind):
    found = measured(regulated(), kind=kind)
    assert found.consistent
    assert found.nees_inside > 0.7
    low, high = found.nees_band
    assert low < 1 < high < 1.05
    for error, deviation in found.errors.values():
        assert error == pytest.approx(deviation, rel=0.06)


@pytest.mark.parametrize(("assumed", "side"), [({"velocity": 2.0}, -1), ({}, 1)])
def test_a_wrong_noise_is_found(assumed, side):
    """A random walk that is not there makes P too large; a noise that the estimator is not told, too small."""
    controller = regulated() if assumed else regulated((0.05, 0.2))
    estimator = controller.with_estimator(measure=["position"], noise=SIGMA, process_noise=assumed)
    if not assumed:
        estimator.problem.noise = regulated((0.05, 0.8)).problem.noise  # of the plant alone
        estimator.filter.problem = controller.problem
    x0 = controller.initial_states.sample(2000, torch.Generator().manual_seed(3))
    found = measure_with_estimator(loops_with_estimator(controller, estimator, x0), estimator)
    assert not found.consistent
    assert side * (found.nees - 1) > 0.1
    assert found.nees_inside < 0.5


def test_a_first_estimate_around_the_state_costs_less():
    near, center = measured(regulated(), initial_deviation=0.01), measured(regulated())
    assert near.consistent
    assert near.cost_ratio is not None
    assert center.cost_ratio is not None
    assert near.cost_ratio < center.cost_ratio


def test_loops_that_are_lost_are_told():
    controller = controller_of(controls={})
    estimator = controller.with_estimator(noise=0.01)
    loops = loops_with_estimator(controller, estimator, controller.initial_states.sample(8))
    assert measure_with_estimator(loops, estimator).lost_fraction == 0
    lost = loops._replace(cost=torch.where(torch.arange(8) < 2, torch.inf, loops.known_cost))
    found = measure_with_estimator(lost, estimator)
    assert found.lost_fraction == 0.25
    assert found.cost_ratio is None
    diverged = measure_with_estimator(loops._replace(x_hat=loops.x_hat * torch.nan, cost=lost.cost), estimator)
    result = {**lyapnet.evaluate(controller, 4, optimum=False), "outputs": plain(diverged._asdict())}
    assert "not finite" in [*evaluation_table("x", result).columns[1].cells]


@pytest.mark.gate
def test_an_evaluation_has_the_rows_where_outputs_are_measured():
    result = lyapnet.evaluate(controller_of(), 16, optimum=False)
    assert result["outputs"]["estimator"] == "ekf"
    assert result["outputs"]["readings"] == {"angle": 0.01}
    assert json.dumps(result)
    rows = [*evaluation_table("x", result).columns[0].cells]
    assert "with ekf from angle ± 0.01" in rows
    assert "outputs" not in lyapnet.evaluate(controller_of(outputs={}), 16, optimum=False)


@pytest.mark.gate
def test_random_plants_are_estimated_in_an_evaluation():
    controller = controller_of(randomise={"length": [0.8, 1.2]})
    result = lyapnet.evaluate(controller, 16, optimum=False)["outputs"]
    assert [*result["errors"]] == ["angle (rad)", "velocity (rad/s)", "length"]


def test_the_figure_has_a_panel_for_each_state_with_its_unit():
    controller = controller_of()
    estimator = controller.with_estimator()
    loops = loops_with_estimator(controller, estimator, controller.initial_states.sample(1))
    figure = states_and_estimates(loops, estimator)
    assert [panel.get_ylabel() for panel in figure.axes] == ["angle\n(rad)", "velocity\n(rad/s)"]
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["estimate ± 2σ", "reading", "state", "estimate"]
    assert len(figure.axes[0].lines) == len(figure.axes[1].lines) + 1  # the velocity has no readings


@pytest.mark.gate
def test_the_command_measures_outputs_of_any_checkpoint(tmp_path, capsys):
    config = {key: value for key, value in TASK.items() if key not in ("experiment", "outputs")}
    (tmp_path / "task.yaml").write_text(yaml.safe_dump({**config, "training": {"iterations": 1}}))
    options = ["evaluation.optimum=false", f"logs={tmp_path}"]
    assert main(["train", "--config", str(tmp_path / "task.yaml"), "network.name=fcn", *options]) == 0
    best = str(tmp_path / "task" / "version_0" / "checkpoints" / "best.ckpt")
    capsys.readouterr()
    command = ["evaluate", best, "--samples", "4", "--json", "--no-optimum"]
    asked = ["--outputs", "angle=0.1", "--estimator", "ukf", "--initial-deviation", "0.01"]
    assert main([*command, *asked, "--figures", str(tmp_path / "f")]) == 0
    found = json.loads(capsys.readouterr().out)["outputs"]
    assert (found["estimator"], found["readings"], found["runs"]) == ("ukf", {"angle": 0.1}, 4)
    assert (tmp_path / "f" / "estimates.png").exists()
    for given, message in (
        (["--outputs", "angle=x"], "Expected --outputs STATE=SIGMA with a number"),
        (["--outputs", "angle=1", "--outputs", "2"], "Expected --outputs STATE=SIGMA for each"),
        (["--outputs", "0.1"], "Expected outputs.measure, or a method output(x) of Pendulum"),
        (["--outputs", "angle=0.1", "--estimator", "kf"], "Expected an estimator as one of ekf, ukf"),
    ):
        assert main([*command, *given]) != 0
        assert message in capsys.readouterr().err
    assert math.isfinite(found["cost_mean"])


def test_the_tanks_of_the_page_are_a_task_whose_levels_one_reading_tells():
    page = ROOT / "docs" / "outputs.md"
    (source,) = [block for block in blocks("python", page) if "class Tanks" in block]
    (written,) = [block for block in blocks("yaml", page) if "tanks:Tanks" in block]
    names: dict[str, Any] = {}
    exec(source, names)
    config = config_from_plain({"experiment": "tanks", **yaml.safe_load(written)})
    parts = Parts(system=names["Tanks"]())
    problem = build_problem(config, parts)
    controller = lyapnet.Controller(problem, OfExpansion(problem, riccati(problem)), config=config, parts=parts)
    estimator = controller.with_estimator("ukf")
    loops = loops_with_estimator(controller, estimator, controller.initial_states.sample(64))
    found = measure_with_estimator(loops, estimator)
    assert found.cost_ratio is not None
    assert found.cost_ratio < 1.1
    assert found.errors["upper level (m)"][0] < 1e-3


def test_the_loop_of_the_page_runs(capsys):
    loop, offset, late = [block for block in blocks("python", ROOT / "docs" / "outputs.md") if "loop.step" in block]
    names: dict = {}
    exec(loop, names)
    assert capsys.readouterr().out.startswith("0.02")  # two steps of 0.01 s after the first readings
    exec(offset.replace("pump", "torque"), {"controller": controller_of(), "y": [0.1]})
    assert capsys.readouterr().out.startswith("[")
    exec(late, names)
    assert capsys.readouterr().out == "[0.]\n"


@pytest.mark.gate
def test_a_command_measures_dead_time(capsys):
    """Without any, and with what acts known, the cost is that of the evaluation's own loops."""
    readings = ["--outputs", "cart position=0.012", "--outputs", "pole angle=0.012"]
    command = ["evaluate", "zoo:cartpole_balancing", "--samples", "32", "--no-optimum", "--json", *readings]
    ratios = []
    for steps in (0, 5):
        assert main([*command, "--delay", str(steps)]) == 0
        found = json.loads(capsys.readouterr().out)["outputs"]
        assert found["delay"] == steps
        ratios.append(found["cost_ratio"])
        assert ratios[-1] == pytest.approx(ratio_of("cartpole_balancing", steps), rel=0.02)
    assert ratios[0] < 1.01 < 1.2 < ratios[1] < 1.3


def ratio_of(name, delay):
    """That of the page's table."""
    torch.set_default_dtype(torch.float64)
    controller = lyapnet.load(f"zoo:{name}")
    return mean_cost(controller, TASKS[name], delay, told=True, states=32) / known_cost(controller, states=32)


def test_a_run_that_diverges_makes_no_estimator_consistent():
    """Its error is the mean of all, and half of the interval: 1 is within, and one in 64 is too many."""
    controller = controller_of()
    estimator = controller.with_estimator()
    loops = loops_with_estimator(controller, estimator, controller.initial_states.sample(64))
    assert measure_with_estimator(loops, estimator).outlier_fraction <= 0.05
    x_hat = loops.x_hat.clone()
    x_hat[:, 0] += 100
    found = measure_with_estimator(loops._replace(x_hat=x_hat), estimator)
    assert abs(found.nees - 1) <= found.nees_half_width
    assert found.outlier_fraction >= 1 / 64
    assert not found.consistent

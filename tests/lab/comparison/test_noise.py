"""Environments and comparisons under noise: its draws, its mean costs, and what is still refused."""

import csv
import warnings
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env as gymnasium_check
from rich.console import Console
from stable_baselines3.common.env_checker import check_env as sb3_check

from lyapnet.base.errors import UsageError
from lyapnet.base.random_streams import TEST
from lyapnet.controller.controller import Controller
from lyapnet.evaluation.intervals import half_width_of_mean
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import load_config
from lyapnet.lab.comparison.baselines.vector_environment import VectorEnvironment
from lyapnet.lab.comparison.controller_policy import ControllerPolicy
from lyapnet.lab.comparison.environments import Environment, Episodes
from lyapnet.lab.comparison.execution import require_same, run_job
from lyapnet.lab.comparison.plan import job_named, jobs_of, load_comparison
from lyapnet.lab.comparison.planners import PlannerPolicy, planner_of
from lyapnet.lab.comparison.reference_problems import bounded_problem
from lyapnet.lab.comparison.report import mean_costs, write_report
from lyapnet.lab.comparison.report.rows import missing
from lyapnet.lab.comparison.results import Result, with_common_optima
from lyapnet.lab.comparison.scoring import costs_of, increments_of, optima_of
from lyapnet.lab.comparison.statistics import compared
from lyapnet.task.cost import QuadraticCost, TargetCost
from lyapnet.task.horizon import Horizon
from lyapnet.task.noise import StateNoise
from lyapnet.task.sets import ControlBox, Unbounded
from lyapnet.task.systems import DoubleIntegrator
from lyapnet.value.policy import HJBPolicy
from tests.problems import CONF, Quadratic, problem_of
from tests.tasks_without_goal.tasks import inside

SIGMA = [0.1, 0.5]


def lqg(sigma=SIGMA, steps=30):
    """A double integrator in noise, with a box that no control reaches."""
    problem = problem_of(DoubleIntegrator(), steps=steps, dt=0.1)
    return bounded_problem(problem.replaced(noise=StateNoise(sigma)), [100.0])


class Wind(DoubleIntegrator):
    """Noise that grows with the speed."""

    def noise(self, x):
        still = torch.zeros_like(x[..., 0])
        return torch.stack([still, 0.3 * x[..., 1]], -1)[..., None]


def path_of(environment, seed, steps=6):
    """The states of an episode under given actions."""
    environment.reset(seed=seed, options={"state": np.array([0.5, -0.2])})
    return np.stack([environment.step(np.array([0.1 * n]))[0] for n in range(steps)])


# Environments


def test_the_seed_of_reset_tells_the_whole_path():
    noisy, quiet = Environment(lqg().problem, 100.0), Environment(lqg().problem.without_noise(), 100.0)
    np.testing.assert_array_equal(path_of(noisy, 3), path_of(noisy, 3))
    np.testing.assert_array_equal(path_of(noisy, 3), path_of(Environment(lqg().problem, 100.0), 3))
    assert not np.isclose(path_of(noisy, 3), path_of(noisy, 4)).any()
    assert not np.isclose(path_of(noisy, 3), path_of(quiet, 3)).any()
    np.testing.assert_array_equal(path_of(quiet, 3), path_of(quiet, 4))


def test_what_is_drawn_is_the_noise_of_the_task():
    """Increments are the next state less the step without noise: mean 0, covariance Δt σσᵀ, independent in time."""
    problem = lqg(steps=5000).problem
    environment = Environment(problem, 100.0)
    environment.reset(seed=0, options={"state": np.zeros(2)})
    x, drawn = torch.zeros(2), []
    for _ in range(5000):
        expected = problem.step(x, torch.zeros(1))[0]
        x = torch.from_numpy(environment.step(np.zeros(1))[0])
        drawn.append(x - expected)
    noise = torch.stack(drawn)
    spread, sigma = 0.1**0.5, torch.tensor(SIGMA)
    assert (noise.mean(0).abs() < 4 * spread * sigma / 5000**0.5).all()
    torch.testing.assert_close(noise.std(0), spread * sigma, rtol=0.04, atol=0)
    assert abs(float(torch.corrcoef(noise.mT)[0, 1])) < 0.06
    assert abs(float(torch.corrcoef(torch.stack([noise[1:, 1], noise[:-1, 1]]))[0, 1])) < 0.06
    wrong = torch.tensor([0.1, 0.55])
    assert not torch.allclose(noise.std(0), spread * wrong, rtol=0.04, atol=0)


def test_noise_is_that_of_the_state_before_the_step():
    """Itô's: at rest this system has none, whatever the control."""
    environment = Environment(problem_of(Wind(), steps=4), 10.0)
    environment.reset(seed=0, options={"state": np.zeros(2)})
    np.testing.assert_allclose(environment.step(np.ones(1))[0], [0.0, 1.0])
    assert environment.step(np.zeros(1))[0][1] != 1.0


def test_the_return_is_minus_the_cost_of_the_path_and_nothing_is_said_of_an_optimum():
    problem = lqg(steps=20).problem
    environment = Environment(problem, 100.0)
    environment.reset(seed=1, options={"state": np.array([0.5, -0.2])})
    x, total, paid = environment.state, 0.0, 0.0
    for n in range(20):
        u = torch.tensor([0.3 * (-1) ** n])
        paid += float(problem.step(torch.from_numpy(x), u)[1])
        _, reward, _, _, info = environment.step(u.numpy() / 100)
        x, total = environment.state, total + reward
        assert set(info) == {"control", "clipped"}
    assert total == pytest.approx(-paid - float(problem.cost.terminal(torch.from_numpy(x))), rel=1e-6)


def test_checkers_pass_under_noise():
    environment = gymnasium.make("lyapnet/Task-v0", task=lqg().problem, control_scale=10, observe_time=True).unwrapped
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*(minimum|maximum) value is.*infinity.*")  # a state has no bounds
        gymnasium_check(environment, skip_render_check=True)
    sb3_check(environment)


def test_trajectories_of_a_batch_have_noise_of_their_own_and_go_on_where_they_were():
    def begun(seed=5):
        batch = VectorEnvironment(lqg().problem, 3, [100.0], seed=seed)
        batch.reset()
        batch.start(torch.zeros(3, 2))
        return batch

    def stepped(batch):
        return batch.step(np.zeros((3, 1)))[0]

    one, same, other = begun(), begun(), begun(6)
    first = stepped(one)
    np.testing.assert_array_equal(first, stepped(same))
    assert not np.isclose(first, stepped(other)).any()
    assert len(np.unique(first[:, 1])) == 3
    position = one.position()
    following = stepped(one)
    other.resume(position)
    np.testing.assert_array_equal(stepped(other), following)


def test_noise_and_increments_belong_together():
    for bounded, increment in ((lqg(), None), (bounded_problem("double_integrator"), torch.zeros(2))):
        episodes = Episodes(bounded, False)
        episodes.start(torch.zeros(2))
        with pytest.raises(ValueError, match="Expected increments with a task that has noise"):
            episodes.advance(np.zeros(1), increment)


# Costs


def scored(bounded, method="lqr", states=16, paths=200, drawn_for=None):
    """(costs of a method, its states) on paths of the noise of a task, or of another one."""
    x0 = bounded.problem.initial_states.sample(states, torch.Generator().manual_seed(3))
    increments = increments_of(drawn_for or bounded, x0, paths, 0, TEST)
    policy = PlannerPolicy(planner_of(method, bounded.problem), bounded)
    return costs_of(policy, bounded, True, x0, increments), x0


def test_mean_cost_of_lqr_is_the_value_of_the_riccati_recursion():
    """Within its interval; the optimum of a noise 10 % stronger is far outside."""
    bounded = lqg()
    costs, x0 = scored(bounded)
    assert costs.paths is not None
    assert costs.paths.shape == (200, 16)
    torch.testing.assert_close(costs.paths.mean(0), costs.cost)
    optima, others = optima_of(bounded, x0), optima_of(lqg([0.11, 0.55]), x0)
    half_width = half_width_of_mean(costs.paths)
    assert optima is not None
    assert others is not None
    error, wrong = (abs(float((costs.cost - one).mean())) for one in (optima, others))
    assert error < half_width < 0.03 * float(optima.mean())
    assert wrong > 2 * half_width


def test_methods_are_measured_on_the_same_paths_those_of_evaluate():
    """LQR and MPC are the same law here, path by path; a controller's rollouts on these paths cost what is scored."""
    bounded = lqg(steps=12)
    lqr, x0 = scored(bounded, states=3, paths=4)
    mpc, _ = scored(bounded, "mpc_25", states=3, paths=4)
    rest, _ = scored(bounded, "rest", states=3, paths=4)
    assert lqr.paths is not None
    torch.testing.assert_close(mpc.paths, lqr.paths, rtol=1e-6, atol=1e-9)
    assert float(rest.cost.mean()) > 1.5 * float(lqr.cost.mean())
    increments = increments_of(bounded, x0, 4, 0, TEST)
    assert increments is not None
    controller = Controller(bounded.problem, Quadratic(torch.eye(2)), policy=HJBPolicy)
    costs = costs_of(ControllerPolicy(controller, bounded.control_scale), bounded, True, x0, increments)
    assert costs.paths is not None
    rolled = [controller.rollout(x0, noise=increments[:, path]).cost for path in range(4)]
    torch.testing.assert_close(costs.paths, torch.stack(rolled))
    assert not torch.allclose(costs.paths[0], rolled[1])


def test_certainty_equivalent_control_does_not_know_the_noise():
    """The same plan with any σ, and on the task without."""
    weak, strong = (build_problem(load_config(CONF / "pendulum_noise.yaml", [f"noise.velocity={s}"])) for s in (0.1, 2))
    x, asked = np.array([2.9, 0.1]), []
    for problem in (weak, strong, weak.without_noise()):
        short = problem.replaced(horizon=Horizon(20, 0.1))
        asked.append(float(planner_of("mpc_100", short).law()(0, x)[0]))
    assert asked[0] == asked[1] == asked[2] != 0


def test_no_control_is_that_which_costs_nothing():
    cost = TargetCost(QuadraticCost(torch.eye(2), torch.eye(1), torch.eye(2)), [0.0, 0.0], [0.7])
    for controls, u in ((Unbounded(), 0.7), (ControlBox([-0.5], [0.5]), 0.5)):
        law = planner_of("rest", problem_of(DoubleIntegrator(), cost, controls=controls)).law()
        assert law(0, np.ones(2)) == law(7, np.zeros(2)) == pytest.approx(u)


# Reports


def result(method, path_costs, **changes):
    costs = np.mean(path_costs, 0).tolist()
    own = Result("wind", method, 0, 0, 0.1, 0.0, costs, costs, None, None, 0.0, 30, "", [], path_costs=path_costs)
    return replace(own, **changes)


LQR = result("lqr", [[1.0, 3.0], [2.0, 5.0], [3.0, 4.0]])
MPC = result("mpc_25", [[0.5, 2.5], [1.6, 4.6], [2.4, 3.4]])  # 0.5 less on each path, give or take 0.1


def test_differences_are_those_of_the_same_paths(tmp_path):
    comparison = compared([LQR, MPC])
    table = mean_costs(comparison)
    assert table is not None
    rows = {row["method"]: row for row in table.rows}
    assert (rows["lqr"]["paths"], rows["lqr"]["mean"], rows["mpc_25"]["excess"]) == (3, 3.0, None)
    assert rows["lqr"]["excess"] == pytest.approx(0.5)
    assert rows["lqr"]["excess_half_width"] < 0.2 * rows["lqr"]["half_width"], "luck is common to both"
    assert rows["lqr"]["half_width"] == pytest.approx(half_width_of_mean(torch.tensor(LQR.path_costs)))
    shuffled = result("mpc_25", [MPC.path_costs[i] for i in (2, 0, 1)])
    other = mean_costs(compared([LQR, shuffled]))
    assert other is not None
    assert other.rows[0]["excess_half_width"] > 5 * rows["lqr"]["excess_half_width"]
    write_report([LQR, MPC], tmp_path)
    with (tmp_path / "results.csv").open() as file:
        assert {row["paths"] for row in csv.DictReader(file)} == {"3"}
    text = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert "Mean cost under noise" in text
    assert "J*, which no job knew" not in text


def test_without_noise_there_is_no_such_table(tmp_path):
    quiet = [replace(one, path_costs=None) for one in (LQR, MPC)]
    assert mean_costs(compared(quiet)) is None
    write_report(quiet, tmp_path)
    assert not (tmp_path / "mean_costs.csv").exists()
    assert any("J*, which no job knew" in line for line in missing(compared(quiet)))


def test_what_diverges_on_a_path_has_no_mean():
    broken = result("rest", [[1.0, np.inf], [2.0, 3.0], [1.0, 1.0]])
    table = mean_costs(compared([LQR, broken]))
    assert table is not None
    row = next(cells for cells in table.cells() if cells[1] == "no control")
    assert row[3:] == ["diverged", "diverged"]


def test_lucky_paths_are_no_optimum():
    """Means over paths may be below J*, which they do not lower, as costs without noise do."""
    lucky = replace(MPC, optima=[2.0, 3.9])
    assert with_common_optima([LQR, lucky])[1].optima == [2.0, 3.9]
    quiet = [replace(one, path_costs=None) for one in (LQR, lucky)]
    assert with_common_optima(quiet)[1].optima == [1.5, 3.5]


def test_other_numbers_of_paths_are_not_compared():
    with pytest.raises(UsageError, match="equal evaluation states"):
        compared([LQR, result("mpc_25", MPC.path_costs[:2])])


def test_a_result_keeps_its_paths(tmp_path):
    LQR.write(tmp_path / "result.json")
    assert Result.read(tmp_path / "result.json") == LQR


@pytest.mark.parametrize(
    ("folder", "file", "tasks"),
    [
        (".", "conf/compare_noise.yaml", {"pendulum"}),
        (".", "tests/noise_tasks/compare.yaml", {"van_der_pol", "planar_quadrotor"}),
        ("tests/noise_tasks/walker", "compare.yaml", {"gap"}),
    ],
)
def test_comparisons_of_noisy_tasks_can_be_run(folder, file, tasks):
    """Where their first line says."""
    with inside(CONF.parent / folder):
        jobs = jobs_of(load_comparison(file))
        assert {job.task for job in jobs} == tasks
        assert all(job.bounded.problem.noise is not None for job in jobs)
        assert f"lyapnet compare --config {file}" in Path(file).read_text(encoding="utf-8").splitlines()[0]


# What is refused


def test_a_result_of_another_noise_or_number_of_paths_is_refused(tmp_path):
    path = tmp_path / "compare.yaml"
    path.write_text(
        f"logs: {tmp_path}\nmethods: [lqr]\nevaluation_states: 3\nevaluation_paths: 2\n"
        f"tasks: {{wind: {{config: {CONF / 'pendulum_noise.yaml'}, control_scale: [20]}}}}\n"
    )

    def job(*overrides):
        return job_named(load_comparison(path, overrides), "wind/lqr/seed_0")

    found = run_job(job(), Console(quiet=True))
    assert found.path_costs is not None
    assert np.mean(found.path_costs, 0) == pytest.approx(np.array(found.costs))
    assert (np.shape(found.path_costs), found.optima) == ((2, 3), None)
    require_same(job())
    for change in ("tasks.wind.overrides=['noise.velocity=0.6']", "evaluation_paths=16"):
        with pytest.raises(UsageError, match="as it was begun, got"):
            require_same(job(change))


def test_a_plan_without_feedback_and_a_risk_are_refused():
    noisy = build_problem(load_config(CONF / "pendulum_noise.yaml"))
    with pytest.raises(UsageError, match="Expected a task without noise for ilqr"):
        planner_of("ilqr", noisy)
    assert planner_of("ilqr", noisy.without_noise())
    with pytest.raises(UsageError, match="Expected a task without risk for an environment, got 1"):
        bounded_problem(noisy.replaced(risk=1.0), 20.0)
    assert bounded_problem(noisy, 20.0).problem.noise is noisy.noise

"""What evaluations report of tasks with noise, against closed forms and a grid; and what must fail."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from torch.testing import assert_close

import lyapnet
from lyapnet.base.errors import DivergenceError, OracleError, UsageError
from lyapnet.claims.sampling_certificates import StatisticalCertificate
from lyapnet.claims.statistical import count_successes
from lyapnet.cli import main
from lyapnet.controller.controller import Controller
from lyapnet.evaluation.intervals import half_width_of_mean
from lyapnet.evaluation.noise_figure import PATHS, bands, states_to_draw
from lyapnet.evaluation.oracles import oracle_of
from lyapnet.evaluation.tables import evaluation_table
from lyapnet.evaluation.under_noise import _mean_of_dearest, measure_under_noise
from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import config_from_plain
from lyapnet.loop.rollout import Rollout
from lyapnet.task.cost import QuadraticCost
from lyapnet.task.horizon import Horizon
from lyapnet.task.noise import StateNoise
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box, Unbounded
from lyapnet.task.systems import Linear, Pendulum
from lyapnet.training.task_facts import _noise_fact
from lyapnet.value.expansions import Expansion, optimal_trajectories, riccati
from tests.grid_solver import solve_on_grid
from tests.problems import OfExpansion

TASK = {
    "experiment": "noisy",
    "system": {"name": "double_integrator"},
    "cost": {"Q": [1, 0.1], "R": 0.1, "Q_T": [2, 1]},
    "initial_states": {"lower": -1, "upper": 1},
    "horizon": {"steps": 30, "dt": 0.1},
    "noise": {"velocity": 0.4},
}
DISCRETE = {"rollout": {"gradient": "discrete"}}


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def task(**changes) -> Problem:
    return build_problem(config_from_plain({**TASK, **changes}))


def controller_of(problem: Problem, expansion: Expansion | None = None) -> Controller:
    """The controller of an expansion, by default the Riccati solution with its noise."""
    return Controller(problem, OfExpansion(problem, riccati(problem) if expansion is None else expansion))


def ornstein_uhlenbeck(steps: int, method: str = "rk4") -> Problem:
    """A state of the quadratic easy task of SOC-matching, whose V(0, x) is known."""
    cost = QuadraticCost([[0.2]], [[0.5]], [[0.1]])
    horizon = Horizon(steps, 1 / steps, method)
    return Problem(Linear([[0.2]], [[1.0]]), cost, Unbounded(), Box([-1.0], [1.0]), horizon, noise=StateNoise([1.0]))


def test_the_expansion_converges_to_the_closed_form():
    """V(0, x) = 0.292554 x² + 4.055382 / 20 in continuous time; the error of N steps falls as 1/N."""
    errors = []
    for steps in (50, 100):
        _, c, p, H = (part[0] for part in riccati(ornstein_uhlenbeck(steps)))
        assert abs(float(p)) < 1e-12
        errors.append([float(H) / 2 - 0.292554, float(c) - 4.055382 / 20])
    for coarse, fine, exact in zip(*errors, (0.292554, 0.2027691), strict=True):
        assert abs(fine) < 0.01 * exact
        assert abs(fine) < 0.6 * abs(coarse) or abs(fine) < 1e-6


def test_noise_that_grows_with_the_state_is_in_the_riccati_equation():
    """dx = u dt + s x dW: the recursion of x² with F = 1, G = Δt, by hand."""

    class Multiplicative(Linear):
        def noise(self, x):
            return 0.6 * x[..., None]

    cost = QuadraticCost([[1.0]], [[0.5]], [[2.0]])
    problem = Problem(
        Multiplicative([[0.0]], [[1.0]]), cost, Unbounded(), Box([-1.0], [1.0]), Horizon(20, 0.1, "euler")
    )
    P = 2.0
    for _ in range(20):
        K = P / (0.5 + 0.1 * P)
        P = 0.1 * (1 + 0.5 * K**2) + P * (1 - 0.1 * K) ** 2 + 0.1 * 0.36 * P
    assert_close(float(riccati(problem).hessian[0]) / 2, P)
    assert float(riccati(problem.without_noise()).hessian[0]) / 2 < P - 0.1
    assert_close(oracle_of(problem)(torch.tensor([[0.7]])), torch.tensor([P * 0.49]))


def test_an_expansion_along_a_path_has_the_cost_of_the_noise_and_the_path_has_none():
    problem = task()
    x0 = problem.initial_states.sample(3, torch.Generator().manual_seed(0))
    guess = torch.zeros(30, 3, 1)
    optimum, quiet = (optimal_trajectories(each, x0, guess) for each in (problem, problem.without_noise()))
    assert_close(optimum.path.cost, quiet.path.cost)
    assert_close(quiet.expansion.value[0], quiet.path.cost)
    assert_close(optimum.expansion.value[0] - quiet.expansion.value[0], riccati(problem).value[0].expand(3))


@pytest.mark.gate
def test_expected_costs_are_those_of_the_oracle_within_their_interval():
    problem = task()
    x0 = problem.initial_states.sample(64, torch.Generator().manual_seed(0))
    table, noise, lqr = measure_under_noise(controller_of(problem), x0, 40, 64)
    optimum = oracle_of(problem)(x0)
    error = float((table.cost - optimum).mean())
    assert abs(error) < 2 * noise.half_width < 0.01 * float(optimum.mean())
    assert noise.half_width < noise.plain_half_width
    assert lqr is not None
    assert_close(lqr, table.cost)  # the certainty-equivalent law is the optimal one here
    assert noise.lost_fraction < 0.01
    assert [*noise.quantiles.values()] == sorted(noise.quantiles.values())


@pytest.mark.gate
def test_a_worse_law_costs_more_and_a_wrong_V_keeps_the_mean():
    problem = task()
    x0 = problem.initial_states.sample(64, torch.Generator().manual_seed(0))
    own = riccati(problem)
    worse = controller_of(problem, own._replace(hessian=0.3 * own.hessian, value=own.value + 5))
    table, noise, _ = measure_under_noise(worse, x0, 40, 64)
    optimum = oracle_of(problem)(x0)
    assert float((table.cost - optimum).mean()) > 3 * noise.half_width
    assert abs(float(table.cost.mean()) - noise.plain_mean) < 2 * (noise.half_width + noise.plain_half_width)


@pytest.mark.gate
def test_with_risk_costs_are_certainty_equivalents_those_of_the_oracle():
    problem = task(risk=1.0)
    x0 = problem.initial_states.sample(64, torch.Generator().manual_seed(0))
    table, noise, lqr = measure_under_noise(controller_of(problem), x0, 200, 64)
    optimum, assumed = oracle_of(problem)(x0), noise.with_risk
    assert assumed is not None
    assert noise.with_risk_half_width is not None
    assert abs(float((table.cost - optimum).mean())) < 2 * noise.with_risk_half_width < 0.02 * float(optimum.mean())
    assert_close(float(table.cost.mean()), assumed)
    assert assumed > noise.mean + 2 * noise.half_width
    assert noise.dearest_mean > noise.plain_mean
    assert lqr is not None
    assert float(lqr.mean()) > float(table.cost.mean())  # which knows no risk
    # the law without risk costs less on the mean, and more with the risk
    bold = task()
    V = OfExpansion(bold, riccati(bold))
    other = Controller(problem, V, Rollout(problem, lyapnet.SampledPolicy(bold, V), gradient="discrete"))
    _, worse, _ = measure_under_noise(other, x0, 200, 64)
    assert worse.with_risk is not None
    assert worse.with_risk > assumed
    assert worse.mean < noise.mean
    assert worse.dearest_mean > noise.dearest_mean


@pytest.mark.gate
@pytest.mark.parametrize("shift", [0.0, -0.3])
def test_a_risk_that_no_path_shows_is_not_measured(shift):
    """Where θ times the spread of J is large, paths tell nothing but V itself, which may be wrong."""
    problem = task(risk=12.0)
    own = riccati(problem)
    controller = controller_of(problem, own._replace(value=own.value + shift))
    x0 = problem.initial_states.sample(64, torch.Generator().manual_seed(0))
    table, noise, _ = measure_under_noise(controller, x0, 16, 64)
    assert noise.with_risk is None
    assert noise.with_risk_half_width is None
    assert_close(float(table.cost.mean()), noise.mean)
    result = lyapnet.evaluate(controller, samples=32, paths=8)
    assert result["cost_ratio"] is None
    assert "too few of these paths count" in result["no_optimum"]
    assert "not measured" in [str(cell) for cell in evaluation_table("title", result).columns[1]._cells]


@pytest.mark.gate
@pytest.mark.parametrize("shift", [-0.3, 0.3])
def test_a_wrong_V_keeps_the_certainty_equivalent(shift):
    problem = task(risk=1.0)
    own = riccati(problem)
    x0 = problem.initial_states.sample(64, torch.Generator().manual_seed(0))
    table, noise, _ = measure_under_noise(controller_of(problem, own._replace(value=own.value + shift)), x0, 200, 64)
    assert noise.with_risk_half_width is not None
    assert abs(float((table.cost - oracle_of(problem)(x0)).mean())) < 3 * noise.with_risk_half_width < 0.1


def test_the_dearest_paths_count_in_part():
    """Of 30 paths 1.5 are the dearest 5 %."""
    J = torch.arange(30.0)[:, None] * torch.tensor([1.0, 2.0])
    assert_close(_mean_of_dearest(J.flip(0)), torch.tensor([1.0, 2.0]) * (29 + 0.5 * 28) / 1.5)


@pytest.mark.gate
def test_the_summary_names_the_risk():
    result = lyapnet.evaluate(controller_of(task(risk=0.5)), samples=32, paths=16)
    printed = evaluation_table("title", result)
    labels = [str(cell) for cell in printed.columns[0]._cells]
    assert any("θ = 0.5" in label for label in labels)
    assert any("dearest 5 %" in label for label in labels)
    assert "log E exp(θJ)/θ" in str(printed.caption)
    assert result["cost_mean"] == result["noise"]["with_risk"]


@pytest.mark.gate
def test_the_certainty_equivalent_is_that_of_a_grid():
    problem = task(risk=1.0)
    found = solve_on_grid(problem, [-4, -5], [4, 5], 61, np.linspace(-12, 12, 49).tolist())
    x0 = problem.initial_states.sample(64, torch.Generator().manual_seed(0)).double()
    ratio = (found(x0) / oracle_of(problem)(x0)).mean()
    assert abs(float(ratio) - 1) < 2e-3
    assert abs(float((found(x0) / oracle_of(problem.replaced(risk=0.0))(x0)).mean()) - 1) > 0.01


@pytest.mark.gate
def test_the_summary_names_what_noise_does():
    result = lyapnet.evaluate(controller_of(task()), samples=32, paths=8)
    assert result["noise"]["paths"] == 8
    assert abs(result["cost_ratio"] - 1) < 0.05
    assert "held_cost_mean" not in result
    printed = evaluation_table("title", result)
    labels = [str(cell) for cell in printed.columns[0]._cells]
    assert any("95 % interval" in label for label in labels)
    quiet = lyapnet.evaluate(controller_of(task(noise={})), samples=32)
    assert "noise" not in quiet
    assert result["cost_mean"] > quiet["cost_mean"]


def test_one_path_has_no_interval_and_is_refused():
    with pytest.raises(ValueError, match="Expected paths ≥ 2"):
        lyapnet.evaluate(controller_of(task()), samples=4, paths=1)


def test_a_nonlinear_or_limited_task_has_no_oracle_under_noise():
    pendulum = {"system": {"name": "pendulum"}}
    for changes in (pendulum, {"controls": {"lower": -1, "upper": 1}}):
        with pytest.raises(OracleError, match="for an optimum under noise"):
            oracle_of(task(**changes))


@pytest.mark.gate
def test_the_riccati_solution_is_that_of_a_grid():
    problem = task()
    x0 = problem.initial_states.sample(16, torch.Generator().manual_seed(0))
    optimum = solve_on_grid(problem, [-3, -4], [3, 4], 49, np.linspace(-8, 8, 33))
    assert_close(optimum(x0), oracle_of(problem)(x0), rtol=1e-3, atol=0)
    assert float(optimum(x0).mean()) > 1.05 * float(oracle_of(task(noise={}))(x0).mean())


def test_a_rollout_takes_a_seed_or_increments():
    problem = task()
    controller, x0 = controller_of(problem), torch.tensor([[0.5, 0.1]])
    first, again, other = (controller.rollout(x0, noise=seed) for seed in (0, 0, 1))
    assert torch.equal(first.x, again.x)
    assert not torch.equal(first.x, other.x)
    quiet = controller.rollout(x0)
    assert torch.equal(controller.rollout(x0, noise=torch.zeros(30, 1, 1)).x, quiet.x)
    arrays = controller.rollout(x0.numpy(), noise=0)
    assert isinstance(arrays.x, np.ndarray)
    assert_close(torch.tensor(arrays.x), first.x)
    with pytest.raises(ValueError, match="Expected no noise for a task without"):
        controller_of(task(noise={})).rollout(x0, noise=0)
    with pytest.raises(ValueError, match="steps of the horizon with noise"):
        controller.rollout(x0, steps=3, noise=0)


@pytest.mark.parametrize("noise", [-1, 1.5, True, torch.tensor(0), torch.zeros(30, 2, 1), np.zeros((29, 1, 1)), "0"])
@pytest.mark.usefixtures("as_users_call")
def test_noise_of_another_kind_or_shape_is_one_line(noise):
    with pytest.raises(ValueError, match=r"Expected noise as a seed ≥ 0, or as ΔW of shape \(30, 1, 1\)"):
        controller_of(task()).rollout(torch.zeros(1, 2), noise=noise)


def test_arrays_of_increments_are_taken():
    controller, increments = controller_of(task()), 0.1 * np.ones((30, 1, 1))
    x = controller.rollout(np.zeros((1, 2)), noise=increments).x
    assert_close(torch.tensor(x), controller.rollout(torch.zeros(1, 2), noise=torch.tensor(increments)).x)


def test_a_trajectory_with_another_field_keeps_its_martingale():
    path = controller_of(task()).closed_loops(
        torch.zeros(2, 2), task().noise.draw(30, 0.1, torch.zeros(2, 2), seeded(0))
    )
    other = path._replace(terminal_cost=path.terminal_cost + 1)
    assert_close(other.expected_cost, path.expected_cost + 1)


@pytest.mark.parametrize(("states", "paths"), [(1, 2), (1, 4), (8, 2), (64, 2)])
def test_an_interval_covers_the_mean_in_95_percent_of_draws_also_for_few_paths(states, paths):
    draws = torch.randn(4000, paths, states, dtype=torch.float64, generator=seeded(0))
    draws = draws * torch.linspace(0.5, 2, states)
    covered = [abs(float(draw.mean())) <= half_width_of_mean(draw) for draw in draws]
    assert 0.94 < sum(covered) / 4000 < 0.975
    normal = [abs(float(draw.mean())) <= 1.96 * float(draw.var(0).sum().div(paths).sqrt()) / states for draw in draws]
    assert states * (paths - 1) > 20 or sum(normal) < sum(covered) - 80


def test_an_interval_of_an_infinite_cost_is_infinite_and_of_equal_costs_zero():
    assert half_width_of_mean(torch.tensor([[1.0], [torch.inf]])) == torch.inf
    assert half_width_of_mean(torch.ones(3, 2)) == 0


def of_root() -> Problem:
    """x' = u with a cost that is √x: the domain ends at 0, which noise crosses."""
    content = {
        "system": {"name": "integrator_chain", "parameters": {"length": 1}},
        "cost": {"Q": [1.0], "R": 1.0, "Q_T": [1.0]},
        "initial_states": {"lower": 0.5, "upper": 1.0},
        "target": [0.8],
        "domain": {"lower": {"x1": 0.0}},
        "horizon": {"steps": 20, "dt": 0.05},
        "noise": {"x1": 1.0},
        "network": {"name": "fcn"},
        "program": {"name": "value"},
        "rollout": {"gradient": "discrete"},
    }
    return build_problem(config_from_plain({"experiment": "root", **content}))


@pytest.mark.gate
def test_paths_that_leave_the_domain_cost_infinitely_and_fail_claims():
    problem = of_root()
    controller = Controller(problem, OfExpansion(problem, riccati(problem.without_noise())))
    result = lyapnet.evaluate(controller, samples=16, paths=4)
    assert result["left_domain_fraction"] > 0.5
    assert result["cost_mean"] is result["noise"]["mean"] is result["noise"]["half_width"] is None
    assert any("domain left" in str(cell) for cell in evaluation_table("title", result).columns[0]._cells)
    found = lyapnet.certify(controller, lyapnet.Statistical(samples=200, share=0.01, confidence=0.9, radius=100.0))
    assert isinstance(found, StatisticalCertificate)
    x0 = problem.initial_states.sample(2000, seeded(3))
    inside = (controller.rollout(x0, noise=4).x[..., 0] >= -0.01).all(0).double().mean()
    assert found.claim.successes["terminal"] / 200 < float(inside) + 0.15 < 0.9


def test_the_two_states_of_a_figure_are_far_apart_in_units_of_their_extents():
    """A and B are 1.02 extents apart, C and D 1; in their own units D is farther from C, by far."""
    A, B, C, D = [0.0, 600.0], [1.0, 400.0], [0.5, 0.0], [0.5, 1000.0]
    drawn = states_to_draw(torch.tensor([C, A, D, B]))
    assert sorted(drawn[0].tolist()) == [A, B]
    assert torch.equal(drawn, drawn[:1].expand(PATHS, 2, 2))


def test_bands_show_both_states_and_the_cost():
    problem = task()
    x0 = states_to_draw(problem.initial_states.sample(12, torch.Generator().manual_seed(0)))
    assert x0.shape == (PATHS, 2, 2)
    assert not torch.equal(x0[0, 0], x0[0, 1])
    figure = bands(controller_of(problem).rollout(x0, noise=0), problem)
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert [label.split("\n")[0] for label in labels[:4]] == ["position", "velocity", "force", "cost"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"noise": {"speed": 1}}, "Expected noise among position, velocity"),
        ({"noise": {"velocity": -1}}, "noise"),
        ({"noise": {"velocity": 0.1}, "rollout": {"gradient": "adjoint"}}, "rollout.gradient=discrete with noise"),
        ({"network": {"name": "icnn"}, "program": {"name": "value"}, **DISCRETE}, "network.name=expansion or fcn"),
        ({"cost": {"Q": 1, "R": 1}, "horizon": {"steps": 30, "dt": 0.1, "stationary": True}}, "stationary: false"),
    ],
)
def test_what_knows_no_noise_is_refused_by_name(changes, message):
    with pytest.raises(UsageError, match=message):
        task(**changes)


@pytest.mark.parametrize(("fold", "affine"), [(1.0, False), (-3.0, False), (None, True)])
def test_noise_that_is_affine_on_X0_alone_has_no_oracle(fold, affine):
    class Folded(Linear):
        def noise(self, x):
            return (0.5 * (1 - x) if fold is None else (fold - x).relu() if fold > 0 else (x - fold).relu())[..., None]

    cost = QuadraticCost([[1.0]], [[0.5]], [[2.0]])
    box = Box([1.2], [2.0]) if fold == 1.0 else Box([-1.0], [1.0])
    problem = Problem(Folded([[0.0]], [[1.0]]), cost, Unbounded(), box, Horizon(20, 0.1, "euler"))
    if affine:
        assert oracle_of(problem)(box.center[None]).isfinite().all()
    else:
        with pytest.raises(OracleError, match="σ affine in x"):
            oracle_of(problem)


@pytest.mark.parametrize(("power", "affine"), [(1, True), (2, False)])
def test_noise_has_to_be_affine_in_a_state_that_x0_fixes_too(power, affine):
    """σ = 0.1 x₂ᵖ, and x₂ is zero in all of X₀."""

    class Beside(Linear):
        def noise(self, x):
            return 0.1 * torch.stack([x[..., 1] ** power, torch.zeros_like(x[..., 1])], -1)[..., None]

    cost = QuadraticCost(torch.eye(2), [[0.5]], torch.eye(2))
    system, box = Beside([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]]), Box([-1.0, 0.0], [1.0, 0.0])
    problem = Problem(system, cost, Unbounded(), box, Horizon(20, 0.1, "euler"))
    if affine:
        assert oracle_of(problem)(box.center[None]).isfinite().all()
    else:
        with pytest.raises(OracleError, match="σ affine in x"):
            oracle_of(problem)


def test_noise_without_a_slope_at_the_goal_counts_as_constant_there():
    class Root(Linear):
        def noise(self, x):
            return 0.3 * x.abs().sqrt()[..., None]

    cost = QuadraticCost([[1.0]], [[0.5]], [[2.0]])
    problem = Problem(Root([[0.0]], [[1.0]]), cost, Unbounded(), Box([-1.0], [1.0]), Horizon(20, 0.1, "euler"))
    assert_close(riccati(problem).hessian, riccati(problem.without_noise()).hessian)


def test_noise_that_is_no_method_is_refused():
    for attribute in (lambda x: x[..., None], torch.nn.Linear(2, 2), 0.3):
        system = Pendulum()
        system.noise = attribute
        cost, box = QuadraticCost(torch.eye(2), torch.eye(1), torch.eye(2)), Box([-1.0, -1.0], [1.0, 1.0])
        with pytest.raises(UsageError, match=r"Expected Pendulum.noise as a method"):
            Problem(system, cost, Unbounded(), box, Horizon(10, 0.1, "euler"))


def test_noise_is_part_of_the_record_of_a_problem():
    problem, quiet = task(), task(noise={})
    assert problem.differences(problem.record()) == []
    assert problem.differences(quiet.record()) == ["σσᵀ"]
    assert quiet.differences(problem.record()) == ["σσᵀ"]
    assert quiet.differences(quiet.record()) == []


def test_noise_outside_of_X0_is_part_of_the_record():
    class Far(Linear):
        def noise(self, x):
            return (x.abs() - 1).relu()[..., None]

    cost, box = QuadraticCost([[1.0]], [[0.5]], [[2.0]]), Box([-1.0], [1.0])
    far, quiet = (
        Problem(cls([[0.0]], [[1.0]]), cost, Unbounded(), box, Horizon(20, 0.1, "euler")) for cls in (Far, Linear)
    )
    assert far.differences(quiet.record()) == ["σσᵀ"]
    assert quiet.differences(far.record()) == ["σσᵀ"]


class Gusty(Pendulum):
    """A pendulum with noise of its own."""

    def noise(self, x):
        rate = 0.3 + 0.1 * x[..., 1] ** 2
        return torch.stack([torch.zeros_like(rate), rate], -1)[..., None]


def test_a_system_s_own_noise_is_taken_and_follows_the_system():
    pendulum, box = Gusty(), Box([-1.0, -1.0], [1.0, 1.0])
    cost = QuadraticCost(torch.eye(2), torch.eye(1), torch.eye(2))
    problem = Problem(pendulum, cost, Unbounded(), box, Horizon(10, 0.1, "euler"))
    assert problem.noise is not None
    assert problem.noise.sources == 1
    assert problem.replaced(system=Pendulum()).noise is None
    assert problem.without_noise().noise is None
    problem.check()


def test_a_noise_of_the_wrong_shape_is_refused():
    class Wrong(Linear):
        def noise(self, x):
            return x  # no column

    cost = QuadraticCost([[1.0]], [[1.0]], [[1.0]])
    with pytest.raises(UsageError, match=r"noise\(x\)"):
        Problem(Wrong([[0.0]], [[1.0]]), cost, Unbounded(), Box([-1.0], [1.0]), Horizon(5, 0.1, "euler")).check()


def test_a_statistical_bound_draws_the_noise_and_proofs_refuse_it():
    noisy, quiet = (controller_of(task(noise=noise)) for noise in (TASK["noise"], {}))
    radius = 0.02
    claim = lyapnet.Statistical(samples=400, radius=radius, confidence=0.99)
    found, still = (lyapnet.certify(each, claim) for each in (noisy, quiet))
    assert isinstance(found, StatisticalCertificate)
    assert isinstance(still, StatisticalCertificate)
    ends = noisy.rollout(noisy.initial_states.sample(4000, torch.Generator().manual_seed(5)), noise=7).x[-1]
    expected = float((ends.norm(dim=-1) <= radius).double().mean())
    assert found.claim.lower_bounds["terminal"] < expected < found.claim.successes["terminal"] / 400 + 0.1
    assert still.claim.successes["terminal"] > found.claim.successes["terminal"]
    for claim in (lyapnet.Funnel(), lyapnet.Tube(), lyapnet.LowerBound()):
        with pytest.raises(UsageError, match="Expected a task without noise"):
            lyapnet.certify(noisy, claim, budget=5)


def test_a_path_that_diverges_is_not_drawn_again():
    """The states of a batch that is halved keep their noise, and those beside the divergent one count as failures."""
    problem = task()
    controller, calls = controller_of(problem), []

    def rollout(x0, increments):
        calls.append((x0, increments))
        if (x0[:, 0] > 0.98).any():
            raise DivergenceError("a state")
        return controller.closed_loops(x0, increments)

    count_successes(rollout, problem, controller.program.tolerances(1.0), 200, torch.Generator().manual_seed(0))
    whole = {tuple(x.tolist()): w for x, w in zip(calls[0][0], calls[0][1].unbind(1), strict=True)}
    assert len(calls) > 2
    for x0, increments in calls:
        for x, w in zip(x0, increments.unbind(1), strict=True):
            assert torch.equal(whole[tuple(x.tolist())], w)


def test_noise_without_a_column_or_that_fails_is_refused_by_name():
    class Empty(Linear):
        def noise(self, x):
            return x[..., None][..., :0]

    class Failing(Linear):
        def noise(self, x):
            raise KeyError("wind")

    cost = QuadraticCost([[1.0]], [[1.0]], [[1.0]])
    for cls, message in ((Empty, "k ≥ 1 sources"), (Failing, "Failing.noise")):
        with pytest.raises(UsageError, match=message):
            Problem(cls([[0.0]], [[1.0]]), cost, Unbounded(), Box([-1.0], [1.0]), Horizon(5, 0.1, "euler"))


@pytest.mark.gate
def test_a_run_without_noise_is_no_start_for_one_with_noise(tmp_path, capsys, monkeypatch):
    short = {"training": {"iterations": 1}, "evaluation": {"test_states": 2, "validation_states": 2, "animate": False}}
    module = (
        "import torch\nfrom lyapnet.task.systems import DoubleIntegrator\n\n\nclass Windy(DoubleIntegrator):\n"
        "    def noise(self, x):\n        return 0.4 * torch.ones_like(x)[..., None]\n"
    )
    (tmp_path / "windy.py").write_text(module)
    monkeypatch.syspath_prepend(tmp_path)
    for name, noise in (("quiet", {}), ("noisy", TASK["noise"]), ("windy", {})):
        content = {**TASK, **short, "experiment": name, "noise": noise, "loggers": ["csv"], "logs": str(tmp_path)}
        if name == "windy":
            content["system"] = {"name": "windy:Windy"}
        (tmp_path / f"{name}.yaml").write_text(yaml.safe_dump(content))
    checkpoint = f"{tmp_path}/quiet/version_0/checkpoints/best.ckpt"
    assert main(["train", "--config", f"{tmp_path}/quiet.yaml"]) == 0
    for name in ("noisy", "windy"):
        assert main(["train", "--config", f"{tmp_path}/{name}.yaml", "--finetune", checkpoint]) == 2
        assert "Expected a task without noise" in capsys.readouterr().err


def test_the_example_of_the_page_is_a_system_with_noise():
    page = Path(__file__).parents[2] / "docs" / "noise.md"
    (example,) = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    names: dict = {}
    exec(example, names)
    x = torch.tensor([[0.0, 2.0]])
    assert_close(names["Drone"]().noise(x), torch.tensor([[[0.0], [0.5]]]))


def test_a_task_without_a_goal_says_its_noise():
    problem = task(cost={"name": "tests.evaluation.test_under_noise:Profit"}, rollout={"gradient": "discrete"})
    assert not problem.has_goal
    assert "at the centre of X₀: velocity 0.4" in _noise_fact(problem, problem.noise).found
    assert "at the goal: velocity 0.4; from the goal it costs" in _noise_fact(task(), task().noise).found


class Profit(lyapnet.Cost):
    """−x₀ at the end."""

    def state(self, x):
        return torch.zeros_like(x[..., 0])

    def R(self, x):
        return torch.full_like(x[..., 0], 0.1)[..., None, None]

    def terminal(self, x):
        return -x[..., 0]

"""The optima of the tasks with noise, against their closed forms in continuous time; and what fails."""

import math

import numpy as np
import pytest
import torch

import lyapnet
from lyapnet.value.expansions import expansion_under_noise, greedy_law, path_under, riccati
from tests.noise_tasks.exact import about_a_point, linear_quadratic, on_a_line, one_dimension
from tests.noise_tasks.run import problem_in
from tests.noise_tasks.tasks import TASKS, quadratic, wells


def finer(name: str, factor: int) -> float:
    """V(0, centre of X₀) by a quadratic optimum, with steps that are shorter by a factor."""
    problem = problem_in(TASKS[name])
    steps, dt = factor * problem.horizon.steps, problem.horizon.dt / factor
    problem = problem_in(TASKS[name], f"horizon.steps={steps}", f"horizon.dt={dt}")
    return float(quadratic(problem).value(problem.initial_states.center[None]))


@pytest.mark.parametrize("name", ["ou_easy", "ou_hard"])
def test_shorter_steps_lead_to_the_closed_form(name):
    exact = TASKS[name].continuous
    assert exact is not None
    one, two = finer(name, 2), finer(name, 4)
    assert abs(2 * two - one - exact) < 1e-3 * exact  # extrapolated to steps of length 0
    assert abs(finer(name, 1) - exact) > 5e-4 * exact


def test_a_linear_end_has_a_law_that_does_not_depend_on_the_state():
    problem = problem_in(TASKS["ou_linear"])
    found, dt, N = linear_quadratic(problem), problem.horizon.dt, problem.horizon.steps
    A, sigma = (np.asarray(part) for part in (problem.system.A, problem.system.B))
    p = np.linalg.matrix_power(np.eye(10) + dt * A.T, N - 1) @ np.ones(10)
    assert np.allclose(found.k[0], -sigma.T @ p, atol=1e-12)
    assert np.abs(found.K[0]).max() < 1e-12
    assert not np.allclose(found.k[0], -p, atol=1e-3)  # without σ


def test_multiplicative_noise_is_in_the_riccati_equation():
    gusts, lqg = (linear_quadratic(problem_in(TASKS[name])) for name in ("lqg_multiplicative", "lqg_2"))
    assert np.linalg.eigvalsh(gusts.P[0] - lqg.P[0]).min() > 1e-3  # the same task, but for its noise


def path_integral(sigma: float, scale: float, start: float, weight: float) -> float:
    """−λ ln E exp(−φ(x + σW_1)/λ) of φ = scale · (x² − 1)², λ = 2 w σ²; for dx = v dt + σ dW at a cost w v²."""
    z, chances = np.polynomial.hermite_e.hermegauss(200)
    lam = 2 * weight * sigma**2
    costs = scale * ((start + sigma * z) ** 2 - 1) ** 2
    return -lam * math.log(float(chances @ np.exp(-costs / lam)) / math.sqrt(2 * math.pi))


@pytest.mark.parametrize(("sigma", "right"), [(1.0, True), (0.9, False)])
def test_dynamic_programming_on_a_line_is_the_path_integral(sigma, right):
    grid = np.linspace(-5, 5, 601)

    def with_steps(N: int) -> float:
        return float(
            one_dimension(
                lambda x: 0 * x, lambda x: (x**2 - 1) ** 2, [1 / N] * N, grid,
                lambda V, m, dt: on_a_line(V, m, math.sqrt(dt)), 0.5,
            ).value(0.3)
        )  # fmt: skip

    found = 2 * with_steps(64) - with_steps(32)  # extrapolated to steps of length 0
    assert (abs(found - path_integral(sigma, 1, 0.3, 0.5)) < 2e-3) == right


def test_the_distance_after_noise_has_its_mean_square():
    m = np.linspace(0, 5, 7)
    assert np.allclose(about_a_point(lambda r: r**2, m, 0.7, 100), m**2 + 0.49 * 100)
    assert not np.allclose(about_a_point(lambda r: r**2, m, 0.7, 99), m**2 + 0.49 * 100)


@pytest.mark.gate
def test_the_law_of_the_wells_is_the_best_of_its_neighbours():
    """V(0, x) is what its law costs on paths of noise, and a law of 0.8 times the control costs more."""
    problem = problem_in(TASKS["double_well"], "horizon.steps=50", "horizon.dt=0.02")
    exact, x0 = wells(problem), torch.zeros(1000, 10, dtype=torch.float64)
    assert problem.noise is not None
    noise = problem.noise.draw(50, 0.02, x0, torch.Generator().manual_seed(0))
    costs = [path_under(problem, lambda n, x, a=a: a * exact.control(n, x), x0, noise).cost for a in (1.0, 0.8)]
    error = 4 * float(costs[0].std()) / math.sqrt(len(x0))
    assert abs(float(costs[0].mean() - exact.value(x0[:1])[0])) < error
    difference = costs[1] - costs[0]
    assert float(difference.mean()) > 3 * float(difference.std()) / math.sqrt(len(x0))


def test_the_expansion_around_noisy_loops_of_a_linear_task_is_exact():
    problem = problem_in(TASKS["lqg_multiplicative"])
    found, exact = expansion_under_noise(problem, None, torch.Generator().manual_seed(0)), linear_quadratic(problem)
    assert found is not None
    assert np.allclose(found.hessian[0] / 2, exact.P[0], rtol=1e-8)
    x = problem.initial_states.sample(5, torch.Generator().manual_seed(1)).double()
    assert np.allclose(found.initially(x), exact.exact().value(x), rtol=1e-6)


class Logarithm(lyapnet.Cost):
    """½ ‖u‖² on the way, and ln(1 + 20 ‖x‖²) at the end."""

    def state(self, x):
        return torch.zeros_like(x[..., 0])

    def R(self, x):
        return torch.eye(20).to(x).expand(*x.shape, 20) / 2

    def terminal(self, x):
        return torch.log(1 + 20 * (x**2).sum(-1))


@pytest.mark.gate
def test_around_noisy_loops_the_tip_of_a_logarithm_is_no_guide():
    """The end has curvature 40 at its tip, and far less at states that noise reaches in 20 dimensions."""
    problem = problem_in(TASKS["ou_easy"], "horizon.steps=20", "horizon.dt=0.05").replaced(cost=Logarithm().double())
    found = expansion_under_noise(problem, None, torch.Generator().manual_seed(0))
    assert found is not None
    assert float(found.hessian[-1].diagonal().max()) < 0.1 * 40
    x0 = problem.initial_states.sample(200, torch.Generator().manual_seed(1)).double()
    assert problem.noise is not None
    noise = problem.noise.draw(20, 0.05, x0, torch.Generator().manual_seed(2))
    costs = [
        path_under(problem, greedy_law(problem, each), x0, noise).cost.mean() for each in (found, riccati(problem))
    ]
    assert abs(float(costs[0] - found.initially(x0).mean())) < 0.02 * float(costs[0])
    assert costs[1] > 1.5 * costs[0]  # the expansion at the tip

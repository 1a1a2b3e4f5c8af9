"""Steps with u held: against matrix exponentials and differences; what laws, rollouts and starts make of them."""

import math

import pytest
import torch
from torch.testing import assert_close

from lyapnet.experiment.assembly import build_problem
from lyapnet.experiment.config import load_config
from lyapnet.loop.rollout import Rollout
from lyapnet.task.cost import QuadraticCost, TargetCost
from lyapnet.task.horizon import TABLEAUX, Horizon
from lyapnet.task.sets import Box
from lyapnet.task.systems import DoubleIntegrator, Linear, Pendulum
from lyapnet.value.expansions import greedy_law, optimal_trajectories, path_under, riccati
from lyapnet.value.policy import HJBPolicy, LookaheadPolicy, SampledPolicy
from lyapnet.value.regulator import Regulator
from tests.marks import sample
from tests.problems import CONF, Formula, problem_of

ORDERS = {"euler": 1, "midpoint": 2, "rk4": 4}


def hanging(method, steps=40, dt=0.05):
    cost = QuadraticCost(torch.diag(torch.tensor([0.5, 0.05])), [[0.05]], torch.diag(torch.tensor([50.0, 5.0])))
    return problem_of(Pendulum(), cost, steps, dt, Box([2.6, -0.5], [3.6, 0.5]), method=method)


@pytest.mark.parametrize("method", TABLEAUX)
def test_a_step_is_of_the_order_of_its_method(method):
    """x' against exp of the linear system with u held, and ∫ℓ against its integral."""
    torch.manual_seed(1)
    system = Linear(torch.randn(3, 3).tolist(), torch.randn(3, 2).tolist())
    x, u = torch.randn(4, 3), torch.randn(4, 2)

    def off(dt):
        problem = problem_of(system, dt=dt, method=method)
        generator = torch.zeros(6, 6)  # of (x, u, 1)
        generator[:3, :3], generator[:3, 3:5] = system.A, system.B
        z, nodes = torch.cat([x, u, torch.ones(4, 1)], -1), torch.linspace(0, 1, 33)
        exact = torch.stack([z @ torch.matrix_exp(dt * s * generator).mT for s in nodes])[..., :3]
        rates = problem.cost.running(exact, u.expand(33, -1, -1))
        simpson = torch.tensor([1.0, *[4.0, 2.0] * 15, 4.0, 1.0]) / 96
        after, paid = problem.step(x, u)
        return (after - exact[-1]).abs().max(), (paid - dt * simpson @ rates).abs().max()

    for coarse, fine in zip(off(0.1), off(0.05), strict=True):  # of one step: an order more
        assert float(torch.log2(coarse / fine)) == pytest.approx(ORDERS[method] + 1, abs=0.25)


@pytest.mark.parametrize("target", [False, True])
@pytest.mark.parametrize("method", TABLEAUX)
def test_a_step_answers_to_its_control_as_differences_say(method, target):
    problem = hanging(method)
    if target:
        problem = problem.replaced(cost=TargetCost(problem.cost, torch.tensor([0.5, 0.0]), torch.tensor([-2.0])))
    x, given, h = torch.randn(6, 2), torch.randn(6, 1), 1e-6
    for u in (given, None):
        answer, at = problem.response(x, u), problem.rest.expand(6, -1) if u is None else u
        (above, dearer), (below, cheaper) = (problem.step(x, at + d) for d in (h, -h))
        assert_close(answer.x, problem.step(x, at)[0])
        assert_close(answer.by_control[..., 0], (above - below) / (2 * h * problem.horizon.dt), rtol=1e-6, atol=1e-7)
        assert_close(answer.slope[..., 0], (dearer - cheaper) / (2 * h * problem.horizon.dt), rtol=1e-6, atol=1e-6)
        dearest, middle, cheapest = (problem.step(x, at + d)[1] for d in (1e-3, 0, -1e-3))
        bent = (dearest - 2 * middle + cheapest) / (1e-6 * problem.horizon.dt)
        assert_close(answer.curvature[..., 0, 0], bent, rtol=1e-5, atol=1e-7)
    by_euler = torch.allclose(problem.response(x).by_control, problem.system.g(x))
    assert by_euler == (method == "euler")


@pytest.mark.gate
@pytest.mark.parametrize("law", [SampledPolicy, LookaheadPolicy])
@pytest.mark.parametrize("gradient", ["backprop", "discrete"])
def test_the_gradient_through_a_held_law_is_that_of_differences(law, gradient):
    """R is small: what q pays for u within a step counts."""
    cost = QuadraticCost(torch.eye(2), [[0.003]], torch.eye(2))
    problem, x0 = problem_of(DoubleIntegrator(), cost, steps=15, method="rk4"), torch.randn(4, 2)

    class Scaled(Formula):
        def __init__(self, k):
            super().__init__(lambda t, x: self.k * ((x**2).sum(-1) + x[..., 0] * x[..., 1]))
            self.k = torch.nn.Parameter(torch.tensor(k))

    def total(k):
        V = Scaled(k)
        return V, Rollout(problem, law(problem, V), "rk4", gradient)(x0).cost.sum()

    V, J = total(0.3)
    J.backward()
    with torch.no_grad():
        differences = (total(0.3 + 1e-5)[1] - total(0.3 - 1e-5)[1]) / 2e-5
    assert_close(V.k.grad, differences, rtol=1e-6, atol=0)


def test_what_is_held_has_no_costate_of_continuous_time():
    problem, V = hanging("rk4"), Formula(lambda t, x: (x**2).sum(-1))
    with pytest.raises(ValueError, match="Expected gradient discrete or backprop for a law that is held"):
        Rollout(problem, SampledPolicy(problem, V))
    Rollout(problem, HJBPolicy(problem, V))
    Rollout(problem.in_steps(method="euler"), SampledPolicy(problem, V))


def test_the_response_is_part_of_the_graph_where_one_is_recorded():
    problem, x = hanging("rk4"), torch.randn(3, 2, requires_grad=True)

    def total(x):
        answer = problem.response(x)
        return (answer.x * answer.by_control[..., 0]).sum() + answer.slope.sum()

    assert torch.autograd.gradcheck(total, x)
    with torch.no_grad():
        assert not any(part.requires_grad for part in problem.response(x) if part is not None)


@pytest.mark.parametrize("law", sample([SampledPolicy, LookaheadPolicy], 3))
@pytest.mark.parametrize("method", sample(TABLEAUX, 3))
def test_a_held_law_with_the_true_value_function_is_the_best_of_its_problem(method, law):
    """Of a linear problem by fourth-order steps too; and the law of Euler steps is not that of others."""
    system = DoubleIntegrator()
    cost = QuadraticCost(torch.eye(2), [[0.003]], torch.diag(torch.tensor([1.0, 0.0])))
    problem = problem_of(system, cost, steps=20, dt=0.2, method=method)
    expansion, x0 = riccati(problem), torch.randn(8, 2)
    best = optimal_trajectories(problem, x0, torch.zeros(20, 8, 1)).path.cost
    assert_close(expansion.initially(x0), best, rtol=1e-9, atol=0)

    def node(t):
        return round(float(t.detach().flatten()[0]) / 0.2)

    class Known(Formula):
        def curvature(self, t):
            return expansion.hessian[node(t)]

    def value(t, x):
        return ((x @ expansion.hessian[node(t)]) * x).sum(-1) / 2

    times = problem.horizon.times(x0)

    def cost(law):
        return path_under(problem, lambda n, x: law(times[n], x), x0).cost

    excess = cost(law(problem, Known(value))) / best - 1
    assert float(excess.abs().max()) < 1e-9
    of_euler = problem.replaced(horizon=Horizon(20, 0.2))
    assert (float((cost(law(of_euler, Known(value))) / best - 1).max()) > 1e-3) == (method != "euler")


@pytest.mark.gate
def test_a_rollout_holds_what_is_made_to_be_held():
    """Its path is that of one control a step, through every route; another law is read at every stage."""
    problem = hanging("rk4", steps=10)
    V = Formula(lambda t, x: (20 + t) * (1 - x[..., 0].cos()) + x[..., 1] ** 2)
    x0, times = problem.initial_states.sample(5), problem.horizon.times(torch.zeros(1))
    held = SampledPolicy(problem, V)
    expected = path_under(problem, lambda n, x: held(times[n], x), x0)
    for gradient in ("backprop", "discrete"):
        trajectory = Rollout(problem, held, "rk4", gradient)(x0)
        assert_close(trajectory.x, expected.x)
        assert_close(trajectory.cost, expected.cost)
    field = Rollout(problem, held, "rk4", "backprop").closed_loop
    assert_close(
        field.slope(x0, x0[:, :1])[:, :-1], problem.system.dynamics(x0, x0[:, :1]), msg="as a certificate reads"
    )
    stages = Rollout(problem, held, "rk4", "backprop", held=False)(x0)
    assert not torch.allclose(stages.x, expected.x, rtol=1e-4), "unless it is told otherwise"
    read = HJBPolicy(problem, V)
    other = path_under(problem, lambda n, x: read(times[n], x), x0)
    assert not torch.allclose(Rollout(problem, read, "rk4", "backprop")(x0).x, other.x, rtol=1e-4)


@pytest.mark.parametrize("method", TABLEAUX)
def test_the_regulator_is_that_of_many_steps(method):
    problem = problem_of(DoubleIntegrator(), steps=400, dt=0.1, method=method)
    regulator, expansion, x0 = Regulator(problem), riccati(problem), torch.randn(4, 2)
    assert_close(regulator.P, expansion.hessian[0] / 2, rtol=1e-9, atol=1e-9)
    assert_close(path_under(problem, lambda n, x: regulator(x), x0).cost, regulator.cost(x0), rtol=1e-6, atol=0)
    other = Regulator(problem.in_steps(method="euler" if method == "rk4" else "rk4"))
    assert not torch.allclose(regulator.P, other.P, rtol=1e-4)


@pytest.mark.gate
def test_a_start_knows_the_steps_of_its_rollouts():
    """What optima cost by fourth-order steps is what they cost in continuous time, up to O(Δt²) for holding u."""
    costs = {}
    for method in ("euler", "rk4"):
        problem = hanging(method)
        x0 = problem.initial_states.sample(4, torch.Generator().manual_seed(0))
        start = path_under(problem, greedy_law(problem, riccati(problem)), x0)
        optimum = optimal_trajectories(problem, x0, start.u)
        fine = problem.replaced(horizon=Horizon(400, 0.005, "rk4"))
        costs[method] = path_under(fine, lambda n, x, u=optimum.path.u: u[n // 10], x0).cost / optimum.path.cost - 1
    assert float(costs["rk4"].abs().max()) < 1e-3
    assert float(costs["euler"].abs().mean()) > 3e-2


@pytest.mark.parametrize(("method", "held"), [("euler", "euler"), ("rk4", "rk4"), ("dopri5", "rk4")])
def test_the_problem_of_a_config_has_the_steps_of_its_rollout(method, held):
    problem = build_problem(load_config(CONF / "planar_quadrotor.yaml", [f"rollout.method={method}"]))
    assert problem.horizon.method == held


def test_an_unknown_method_is_refused():
    with pytest.raises(ValueError, match="Expected method as one of euler, midpoint, rk4, got 'heun'"):
        Horizon(3, 0.1, "heun")
    assert math.isclose(Horizon(3, 0.1, "rk4").duration, 0.3)

"""Controls of systems that are not affine in them: against grids, finite differences and other routes."""

import math

import pytest
import torch
from torch.testing import assert_close

from lyapnet.base.errors import UsageError
from lyapnet.evaluation.oracles.transcription import Transcription
from lyapnet.loop.rollout import Rollout
from lyapnet.task.ball import ControlBall
from lyapnet.task.cost import QuadraticCost, TargetCost
from lyapnet.task.cost.control_costs import AbsoluteCost, ControlCosts
from lyapnet.task.sets import Box, ControlBox, Unbounded
from lyapnet.task.systems import ControlSystem, DoubleIntegrator, Glider, KinematicBicycle
from lyapnet.value.expansions import (
    derivatives_of,
    follow_expansions,
    greedy_law,
    held_control,
    in_float64,
    minimise_over_controls,
    optimal_trajectories,
    path_under,
    riccati,
    step_objective,
)
from lyapnet.value.networks import FCN, Scaling
from lyapnet.value.policy import HJBPolicy, LookaheadPolicy, SampledPolicy, SontagPolicy
from tests.marks import sample
from tests.problems import problem_of


class Sideways(ControlSystem):
    """ẋ = cos(3u) + u/4, which has several best controls; and ẋ = u in disguise, as `affine`."""

    state_names, state_units = ("place",), ("m",)
    control_names, control_units = ("angle",), ("rad",)

    def dynamics(self, x, u):
        return torch.cos(3 * u) + u / 4


class Disguised(ControlSystem):
    """The double integrator without f and g."""

    state_names, state_units = ("position", "velocity"), ("m", "m/s")
    control_names, control_units = ("force",), ("N",)

    def dynamics(self, x, u):
        return torch.stack([x[..., 1], u[..., 0]], -1)


def bicycle(controls=None, method="euler", cost=None):
    cost = cost or QuadraticCost(torch.eye(4), torch.diag(torch.tensor([0.1, 0.3])), torch.eye(4))
    box = ControlBox([-2.0, -0.61], [2.0, 0.61])
    return problem_of(KinematicBicycle(), cost, 20, 0.1, controls=controls or box, method=method)


def glider(controls=None, method="euler"):
    speed, angle, u = 12.0, -0.0627212459, 0.0888046284
    cost = TargetCost(QuadraticCost([[0.05, 0], [0, 5]], [[20.0]], [[0.1, 0], [0, 10]]), [speed, angle], [u])
    box = Box([8.0, -0.6], [18.0, 0.6])
    return problem_of(Glider(), cost, 40, 0.05, box, controls or ControlBox(-0.1, 0.25), method)


def sideways(controls=None, method="euler"):
    cost = QuadraticCost([[1.0]], [[0.05]], [[1.0]])
    return problem_of(Sideways(), cost, 10, 0.1, controls=controls or ControlBox(-3.0, 2.0), method=method)


def grid_of(problem):
    low, high = (side.expand(problem.system.m) for side in problem.controls.limits)
    m, count = problem.system.m, {1: 4001, 2: 151}[problem.system.m]
    axes = [torch.linspace(float(low[i]), float(high[i]), count) for i in range(m)]
    points = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, m)
    return points[problem.controls.contains(points)]


def quadratic_ahead(problem, b=64):
    """States, the step without control, and a V_x and H after it: strong enough that limits are met."""
    n, x = problem.system.n, problem.initial_states.sample(b, torch.Generator().manual_seed(0))
    x = x + 0.3 * torch.randn(x.shape, generator=torch.Generator().manual_seed(1))
    A = torch.randn(b, n, n, generator=torch.Generator().manual_seed(2))
    V_x = 4 * torch.randn(b, n, generator=torch.Generator().manual_seed(3))
    return x, V_x, A @ A.mT


TASKS = {
    "bicycle": bicycle,
    "glider": glider,
    "sideways": sideways,
}


@pytest.mark.parametrize("method", ["euler", "rk4"])
@pytest.mark.parametrize("task", TASKS)
def test_the_held_control_is_the_least_of_a_grid(task, method):
    problem = TASKS[task](method=method)
    x, V_x, H = quadratic_ahead(problem)
    free = problem.response(x)
    u, Q = held_control(problem, x, free, V_x, H), step_objective(problem, x, free, V_x, H)
    assert problem.controls.contains(u).all()
    grid = Q(grid_of(problem)[:, None].expand(-1, len(x), -1))
    assert (Q(u) <= grid.amin(0) + 1e-6).all()
    assert (Q(u) < grid.amax(0) - 1e-3).all()


def test_one_start_alone_misses_some_of_them():
    """The twin: from the nominal control the search ends in another local minimum."""
    problem = sideways()
    x, V_x, H = quadratic_ahead(problem)
    free = problem.response(x)
    Q, weight = step_objective(problem, x, free, V_x, H), 2 * problem.cost.R(x)
    alone = minimise_over_controls(problem, Q, free.u[None], weight)
    best = Q(grid_of(problem)[:, None].expand(-1, len(x), -1)).amin(0)
    missed = Q(alone) > best + 1e-2
    assert 0 < missed.double().mean() < 1


def test_a_control_near_a_given_one_is_a_local_minimum_there():
    problem = sideways()
    x, V_x, H = quadratic_ahead(problem)
    free = problem.response(x)
    Q, best = step_objective(problem, x, free, V_x, H), held_control(problem, x, free, V_x, H)
    assert_close(held_control(problem, x, free, V_x, H, near=best), best)
    near = held_control(problem, x, free, V_x, H, near=free.u)
    assert (Q(near) <= Q(free.u)).all()
    assert (Q(near) > Q(best) + 1e-2).any(), "another minimum, which the search from several controls leaves"


def test_an_optimum_is_followed_near_its_own_controls():
    """From its own start the law of its expansion is the optimum again; near other controls it is another law."""
    problem = in_float64(sideways())
    x0 = problem.initial_states.sample(8, torch.Generator().manual_seed(0)).double()
    found = optimal_trajectories(problem, x0, torch.zeros(problem.horizon.steps, 8, problem.system.m))
    u = found.path.u
    assert_close(follow_expansions(problem, found.expansion, u, x0).u, u, atol=1e-4, rtol=0)
    others = follow_expansions(problem, found.expansion, torch.full_like(u, 1.0), x0)
    assert not torch.allclose(others.u, u, atol=1e-2)


def test_without_limits_a_start_on_a_hill_is_left():
    """Around u = 0 the slope of ℓ + V_x cos 3u vanishes where it is greatest."""
    problem = sideways(Unbounded())
    x = torch.zeros(3, 1)
    free, V_x, H = problem.response(x), torch.tensor([[2.0], [3.0], [5.0]]), torch.zeros(3, 1, 1)
    u, Q = held_control(problem, x, free, V_x, H), step_objective(problem, x, free, V_x, H)
    slope, curvature = derivatives_of(Q, u)
    assert (curvature > 0).all()
    assert slope.abs().max() < 1e-6
    assert (Q(u) < Q(free.u) - 3).all()


@pytest.mark.parametrize("method", ["euler", "rk4"])
@pytest.mark.parametrize("task", TASKS)
def test_its_derivative_is_that_of_differences(task, method):
    """Where differences exist: the minimiser jumps from one minimum to another, and bends where it meets a limit."""
    problem, h = TASKS[task](method=method), 1e-6
    x, V_x, H = quadratic_ahead(problem)

    def law(x, V_x):
        return held_control(problem, x, problem.response(x), V_x, H)

    arguments = [x.clone().requires_grad_(), V_x.clone().requires_grad_()]
    u = law(*arguments)
    options = {"retain_graph": True, "materialize_grads": True}
    slopes = [torch.autograd.grad(each.sum(), arguments, allow_unused=True, **options) for each in u.unbind(-1)]
    for k, start in enumerate((x, V_x)) if task != "sideways" else [(1, V_x)]:  # whose rate is the same everywhere
        aside = torch.randn(start.shape, generator=torch.Generator().manual_seed(5))
        ends = [law(*(z + side * h * aside if i == k else z for i, z in enumerate((x, V_x)))) for side in (1, -1)]
        expected = (ends[0] - ends[1]) / (2 * h)
        found = torch.stack([(slope[k] * aside).sum(-1) for slope in slopes], -1)
        smooth = (ends[0] + ends[1] - 2 * u).abs().amax(-1) < 1e-8
        assert smooth.double().mean() > 0.8
        assert_close(found[smooth].detach(), expected[smooth].detach(), rtol=1e-4, atol=1e-4)
        assert not torch.allclose(1.01 * found[smooth], expected[smooth], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("controls", [Unbounded(), ControlBox(-0.5, 0.7)])
@pytest.mark.parametrize("method", ["euler", "rk4"])
def test_an_affine_system_in_disguise_has_the_same_law(controls, method):
    """Both by the search and by the formula, under Euler steps to rounding; of others the formula is a model."""
    cost = QuadraticCost(torch.eye(2), [[0.1]], torch.eye(2))
    hidden, known = (problem_of(s, cost, controls=controls, method=method) for s in (Disguised(), DoubleIntegrator()))
    x, V_x, H = quadratic_ahead(known)
    one, other = (held_control(problem, x, problem.response(x), V_x, H) for problem in (hidden, known))
    assert_close(one, other, rtol=1e-6, atol=1e-8)
    assert_close(hidden.system.affine_model(x, one)[1], known.system.g(x))


def test_costs_of_controls_beside():
    """|u| beside, whose kink holds u at 0 for some states."""
    problem = glider()
    problem.cost.nonquadratic = ControlCosts([AbsoluteCost(2.0)])
    x, V_x, H = quadratic_ahead(problem)
    free = problem.response(x)
    u, Q = held_control(problem, x, free, V_x, H), step_objective(problem, x, free, V_x, H)
    grid = torch.cat([grid_of(problem), torch.zeros(1, 1)])[:, None].expand(-1, len(x), -1)
    assert (Q(u) + 2 * u.abs()[..., 0] <= (Q(grid) + 2 * grid.abs()[..., 0]).amin(0) + 1e-6).all()
    assert 0 < (u == 0).double().mean() < 1


def test_sets_other_than_limits_are_refused():
    with pytest.raises(UsageError, match=r"Expected limits of each control, or none, .* got ControlBall; take .*"):
        bicycle(ControlBall(0.5))


# Laws of V


@pytest.mark.parametrize("task", ["bicycle", "glider"])
def test_the_lookahead_law_is_the_least_of_a_grid(task):
    problem = TASKS[task]()
    torch.manual_seed(0)
    V = FCN(Scaling([1.0] * problem.system.n, duration=1.0, value=3.0), hidden=(8, 8))
    x, t = quadratic_ahead(problem)[0], torch.tensor(0.2)
    with torch.no_grad():
        u, dt = LookaheadPolicy(problem, V)(t, x), problem.horizon.dt

        def Q(u):
            following, paid = problem.step(x.expand(*u.shape[:-1], -1), u)
            return (paid + V(t + dt, following)) / dt

        least = Q(grid_of(problem)[:, None].expand(-1, len(x), -1)).amin(0)
        assert (Q(u) <= least + 1e-5).double().mean() > 0.95  # the sampled law may start it at another minimum
        assert (Q(u) <= least + 0.05 * least.abs()).all()
        sampled = SampledPolicy(problem, V)(t, x)
    assert (Q(sampled) > Q(u) + 1e-7).any()


@pytest.mark.gate
@pytest.mark.parametrize("law", [SampledPolicy, LookaheadPolicy])
@pytest.mark.parametrize("task", ["bicycle", "glider"])
def test_the_gradient_through_closed_loops_is_that_of_differences(task, law):
    problem, h = TASKS[task]().in_steps(steps=5), 1e-5
    torch.manual_seed(1)
    scaling = Scaling(problem.initial_states.magnitude.tolist(), duration=problem.horizon.duration, value=1.0)
    V = FCN(scaling, hidden=(4,))
    policy = law(problem, V)
    x0 = problem.initial_states.sample(5, torch.Generator().manual_seed(0))

    def cost(route):
        return Rollout(problem, policy, gradient=route)(x0).cost.sum()

    theta = [p for p in V.parameters() if p.requires_grad]
    by_route = [torch.autograd.grad(cost(route), theta, materialize_grads=True) for route in ("discrete", "backprop")]
    flat = [torch.cat([s.flatten() for s in slopes]) for slopes in by_route]
    assert_close(flat[0], flat[1], rtol=1e-8, atol=1e-10)
    aside = [torch.randn(p.shape) for p in theta]
    ends = []
    with torch.no_grad():
        for side in (1, -2, 1):
            for p, move in zip(theta, aside, strict=True):
                p += side * h * move
            ends.append(float(cost("discrete")))
    expected = (ends[0] - ends[1]) / (2 * h)
    found = float(sum((s * move).sum() for s, move in zip(by_route[0], aside, strict=True)))
    assert found == pytest.approx(expected, rel=1e-4)
    assert found != pytest.approx(1.01 * expected, rel=1e-4)


@pytest.mark.parametrize("law", [HJBPolicy, SontagPolicy])
def test_laws_that_are_formulas_of_f_and_g_are_refused(law):
    V = FCN(Scaling([1.0] * 4, duration=1.0, value=3.0), hidden=(8, 8))
    with pytest.raises(UsageError, match=r"control-affine system for the law .*, got KinematicBicycle.*; take sampled"):
        law(bicycle(Unbounded()), V)


# Optima


@pytest.mark.parametrize("method", sample(["euler", "rk4"], 2))
def test_differential_dynamic_programming_agrees_with_ipopt(method, tmp_path, monkeypatch):
    monkeypatch.setenv("LYAPNET_CACHE", str(tmp_path))
    problem = glider(method=method)
    x0 = problem.goal + 0.3 * (problem.initial_states.sample(6, torch.Generator().manual_seed(0)) - problem.goal)
    start = path_under(problem, greedy_law(problem, riccati(problem)), x0).u
    found, expected = optimal_trajectories(problem, x0, start).path, Transcription(problem).solve(x0)
    assert_close(found.cost, expected.cost, rtol=1e-7, atol=0)
    assert_close(found.u, expected.u, rtol=0, atol=1e-3)
    # twin: without the drag that comes with lift the optimum is another
    light = problem.replaced(system=Glider(induced=1e-3))
    assert not torch.allclose(optimal_trajectories(light, x0, start).path.cost, expected.cost, rtol=1e-2)


def test_the_control_that_holds_a_state_is_found():
    problem = glider()
    u, left = problem.system.holding_control(problem.goal)
    assert_close(u, problem.rest, rtol=0, atol=1e-7)
    assert left.abs().max() < 1e-6
    assert math.isfinite(float(problem.system.holding_control(problem.goal + 1)[1].norm()))

"""Closed loops: against a loop by hand, reference integrators, and gradients by finite differences."""

import math
import re

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from torch import nn
from torch.nn.utils import parameters_to_vector, vector_to_parameters
from torch.testing import assert_close

from lyapnet.base.errors import DivergenceError
from lyapnet.loop.rollout import ADAPTIVE_METHODS, FIXED_STEP_METHODS, GRADIENTS, METHODS, Rollout
from lyapnet.task.horizon import Horizon
from lyapnet.task.systems import DoubleIntegrator
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.policy import POLICIES
from tests.marks import sample
from tests.problems import AFFINE, KINDS, problem_of

DURATION = 0.2
EXACT = [*((method, "backprop") for method in METHODS), *((method, "discrete") for method in FIXED_STEP_METHODS)]
routes = pytest.mark.parametrize(("method", "gradient"), [*((method, "adjoint") for method in METHODS), *EXACT])
double_integrator = pytest.mark.parametrize("system", ["double_integrator"], indirect=True)


def rollout_of(system, cost, policy, steps=16, **options):
    return Rollout(problem_of(system, cost, steps, DURATION / steps), policy, **options)


def by_hand(system, cost, policy, horizon, x0):
    """x_{n+1} = x_n + Δt (f + g u) and J_N = Δt Σ ℓ(x_n, u_n) + φ(x_N), one step after the other."""
    x, running, xs, us = x0, torch.zeros(x0.shape[:-1]), [x0], []
    for step in range(horizon.steps):
        u = policy(torch.tensor(step * horizon.dt), x)
        running = running + horizon.dt * cost.running(x, u)
        x = x + horizon.dt * (system.f(x) + torch.einsum("...nm,...m->...n", system.g(x), u))
        xs.append(x)
        us.append(u)
    return torch.stack(xs), torch.stack(us), running + cost.terminal(x)


@pytest.mark.parametrize("batch", [(), (2, 3)], ids=str)
@pytest.mark.parametrize("gradient", GRADIENTS)
def test_euler_is_the_loop_by_hand(system, cost, policy, batch, gradient):
    horizon, x0 = Horizon(12, 0.05), 0.5 * torch.randn(*batch, system.n)
    x, u, J = by_hand(system, cost, policy, horizon, x0)
    trajectory = Rollout(problem_of(system, cost, 12, 0.05), policy, gradient=gradient)(x0)
    assert_close(trajectory.t, torch.linspace(0, 0.6, 13))
    for value, expected in zip((trajectory.x, trajectory.u, trajectory.cost), (x, u, J), strict=True):
        assert_close(value, expected)
    assert_close(trajectory.step_cost, 0.05 * cost.running(x[:-1], u))
    assert_close(trajectory.terminal_cost, cost.terminal(x[-1]))
    values = torch.stack([policy.V(torch.tensor(step * 0.05), state) for step, state in enumerate(x)])
    assert_close(trajectory.value, values)
    assert not torch.allclose(trajectory.value, values.roll(1, 0))
    assert not torch.allclose(trajectory.cost, by_hand(system, cost, policy, Horizon(13, 0.05), x0)[2])


# Convergence


def reference(system, cost, policy, x0):
    """The end of the state and the running cost, by an eighth-order integrator of scipy at tight tolerance."""

    def slope(t, y):
        x = torch.from_numpy(y[:-1])
        with torch.no_grad():
            u = policy(torch.tensor(t), x)
            return np.append(system.dynamics(x, u).numpy(), cost.running(x, u).item())

    y0 = np.append(x0.numpy(), 0.0)
    return torch.from_numpy(solve_ivp(slope, (0.0, DURATION), y0, "DOP853", rtol=1e-13, atol=1e-14).y[:, -1])


def error_at_the_end(rollout, x0, exact):
    with torch.no_grad():
        trajectory = rollout(x0)
    return float((torch.cat([trajectory.x[-1], trajectory.running_cost[-1:]]) - exact).norm() / exact.norm())


def measured_order(system, cost, policy, method, x0, exact):
    """log₂ of the ratio of the errors at T when Δt is halved."""
    coarse, fine = (error_at_the_end(rollout_of(system, cost, policy, n, method=method), x0, exact) for n in (12, 24))
    return math.log2(coarse / fine)


ORDERS = {"euler": 1, "midpoint": 2, "rk4": 4}


def test_methods_converge_at_their_order_or_to_their_tolerance(system, cost, policy):
    x0 = 0.5 * torch.ones(system.n)
    exact = reference(system, cost, policy, x0)
    for method, order in ORDERS.items():
        assert measured_order(system, cost, policy, method, x0, exact) == pytest.approx(order, abs=0.3)
    for steps, tolerance in ((1, 1e-5), (7, 1e-9)):
        rollout = rollout_of(system, cost, policy, steps, method="dopri5", rtol=tolerance, atol=tolerance)
        assert error_at_the_end(rollout, x0, exact) < 20 * tolerance


class Law(nn.Module):
    """A control law given as a plain function."""

    def __init__(self, law):
        super().__init__()
        self.law = law

    def forward(self, t, x):
        return self.law(t, x)


@double_integrator
def test_a_jump_in_the_control_costs_the_order(system, cost):
    jump = Law(lambda t, x: torch.where(t < DURATION * 13 / 36, 10.0, -10.0) * torch.ones_like(x[..., :1]))
    exact = reference(system, cost, jump, torch.ones(2))
    for method in ("midpoint", "rk4"):
        assert measured_order(system, cost, jump, method, torch.ones(2), exact) < ORDERS[method] - 0.5


# Gradients: the directional derivatives of the mean cost J in the parameters of V and in x₀


def cost_of(rollout, x0):
    return rollout(x0).cost.mean()


def draw_directions(module, x0):
    """Two random directions in parameters and initial states together."""
    directions = torch.randn(2, parameters_to_vector(module.parameters()).numel() + x0.numel())
    return directions / directions.norm(dim=-1, keepdim=True)


@pytest.fixture
def directions(V, x0):
    return draw_directions(V, x0)


def by_differences(rollout, x0, directions, step=1e-5):
    """Central finite differences of J."""
    parameters = list(rollout.parameters())
    origin, slopes = parameters_to_vector(parameters).detach().clone(), []
    with torch.no_grad():
        for direction in directions:
            theta, x = direction.split([len(origin), x0.numel()])
            values = []
            for h in (step, -step):
                vector_to_parameters(origin + h * theta, parameters)
                values.append(cost_of(rollout, x0 + h * x.reshape(x0.shape)))
            slopes.append((values[0] - values[1]) / (2 * step))
        vector_to_parameters(origin, parameters)
    return torch.stack(slopes)


def by_gradient(rollout, x0, directions):
    leaf = x0.clone().requires_grad_()
    leaves = [*rollout.parameters(), leaf]
    gradients = torch.autograd.grad(cost_of(rollout, leaf), leaves, allow_unused=True, materialize_grads=True)
    return directions @ torch.cat([g.flatten() for g in gradients])


def relative_error(value, expected):
    return float((value - expected).norm() / expected.norm())


@pytest.mark.parametrize(
    ("system", "method", "gradient"),
    sample([(system, *route) for route in EXACT for system in (AFFINE if route[0] == "euler" else KINDS)], 3),
    indirect=["system"],
)
def test_exact_routes_give_the_gradient_of_the_discretisation(system, cost, policy, x0, directions, method, gradient):
    rollout = rollout_of(system, cost, policy, 4, method=method, gradient=gradient, rtol=1e-8, atol=1e-9)
    differences = by_differences(rollout, x0, directions)
    assert relative_error(by_gradient(rollout, x0, directions), differences) < 3e-7
    assert relative_error(by_gradient(rollout, x0 + 1e-3, directions), differences) > 1e-6


ADJOINTS = {  # options of the rollout: error of its gradient
    "midpoint": ({"method": "midpoint"}, 2e-2),
    "rk4": ({"method": "rk4", "steps": 20}, 2e-5),
    "dopri5": ({"method": "dopri5", "steps": 2, "rtol": 1e-7, "atol": 1e-8}, 1e-5),
}


@pytest.mark.gate
@pytest.mark.parametrize("system", KINDS, indirect=True)
def test_adjoint_is_the_gradient_of_the_continuous_problem(system, cost, policy, x0, directions):
    """With Euler up to O(Δt), measured; with the others to the tolerance they are used for."""
    continuous = by_differences(rollout_of(system, cost, policy, 32, method="rk4"), x0, directions, 1e-4)

    def error(**options):
        return relative_error(by_gradient(rollout_of(system, cost, policy, **options), x0, directions), continuous)

    coarse, fine = error(steps=16), error(steps=32)
    assert 1e-4 < coarse < 0.3
    assert coarse / fine == pytest.approx(2, abs=0.3)
    for options, tolerance in ADJOINTS.values():
        assert error(**options) < tolerance


def test_exact_gradient_of_euler_is_not_the_adjoint(system, cost, policy, x0, directions):
    gradients = {g: by_gradient(rollout_of(system, cost, policy, gradient=g), x0, directions) for g in GRADIENTS}
    for exact in ("backprop", "discrete"):
        assert relative_error(gradients["adjoint"], gradients[exact]) > 1e-4


# V by autograd: its derivatives join the graph, which odeint_adjoint's no_grad could have cut


@pytest.fixture(params=POLICIES)
def law_by_autograd(request, system, cost, quadratic):
    """Every law on a V without a formula for V_x."""
    V = quadratic(2 * torch.eye(system.n) + 0.5)
    assert type(V).value_and_state_gradient is ValueFunction.value_and_state_gradient
    return POLICIES[request.param](problem_of(system, cost), V)


@double_integrator
@pytest.mark.parametrize(
    ("gradient", "tolerance"), sample([("discrete", 1e-7), ("backprop", 1e-7), ("adjoint", 1e-5)], 5)
)
def test_every_route_differentiates_through_a_gradient(system, cost, law_by_autograd, x0, gradient, tolerance):
    laws = law_by_autograd, Cut(law_by_autograd)
    method = "dopri5" if gradient == "adjoint" else "rk4"  # held over steps, a law has no costate but the discrete one
    options = {"method": method, "gradient": gradient, "rtol": 1e-7, "atol": 1e-9}
    rollout, without = (rollout_of(system, cost, law, **options) for law in laws)
    directions = draw_directions(rollout, x0)
    expected = by_differences(rollout, x0, directions)
    assert relative_error(by_gradient(rollout, x0, directions), expected) < tolerance
    assert relative_error(by_gradient(without, x0, directions), expected) > 1e-3


class Cut(nn.Module):
    """A control law cut from the graph."""

    def __init__(self, policy):
        super().__init__()
        self.policy = policy

    def forward(self, t, x):
        return self.policy(t, x).detach()


@double_integrator
@routes
def test_every_node_carries_its_gradient(method, gradient, policy, system, cost, x0):
    """The gradient of a weighted sum over the nodes is the sum of the nodes' gradients."""
    rollout = rollout_of(system, cost, policy, 4, method=method, gradient=gradient)
    leaf, weights = x0.clone().requires_grad_(), torch.randn(5, *x0.shape)
    (path,) = torch.autograd.grad((weights * rollout(leaf).x).sum(), leaf)
    nodes = [torch.autograd.grad((w * rollout(leaf).x[n]).sum(), leaf)[0] for n, w in enumerate(weights)]
    assert_close(path, torch.stack(nodes).sum(0), rtol=1e-5, atol=1e-6)
    assert not torch.allclose(path, nodes[-1], rtol=1e-3)


@pytest.mark.parametrize("gradient", GRADIENTS)
def test_a_policy_without_parameters_still_has_a_gradient_in_x0(gradient, system, cost):
    off = Law(lambda t, x: x.new_zeros(*x.shape[:-1], system.m))
    x0 = torch.ones(2, system.n).requires_grad_()
    (slope,) = torch.autograd.grad(cost_of(rollout_of(system, cost, off, gradient=gradient), x0), x0)
    assert slope.abs().max() > 0


@double_integrator
@routes
def test_the_trajectory_is_the_same_without_a_graph(system, cost, law_by_autograd, x0, gradient, method):
    if law_by_autograd.held and gradient == "adjoint" and method in ("midpoint", "rk4"):
        with pytest.raises(ValueError, match="Expected gradient discrete or backprop for a law that is held"):
            rollout_of(system, cost, law_by_autograd, method=method, gradient=gradient)
        return
    rollout = rollout_of(system, cost, law_by_autograd, method=method, gradient=gradient)
    recorded = rollout(x0)
    assert recorded.cost.requires_grad
    with torch.no_grad():
        plain = rollout(x0)
    for value, expected in zip(plain, recorded, strict=True):
        assert not value.requires_grad
        assert_close(value, expected.detach())


def test_the_recorded_control_is_no_part_of_the_graph(system, cost, policy, x0):
    assert not rollout_of(system, cost, policy)(x0).u.requires_grad


# What is refused


@pytest.mark.parametrize("option", [{"method": "rk5"}, {"gradient": "symplectic"}, {"method": "RK4"}])
def test_unknown_methods_and_gradients_are_refused(option, system, cost, policy):
    ((name, value),) = option.items()
    with pytest.raises(ValueError, match=f"Expected {name} as one of .*got '{value}'"):
        Rollout(problem_of(system, cost), policy, **option)


@double_integrator
@pytest.mark.parametrize("method", ADAPTIVE_METHODS)
def test_the_discrete_costate_of_steps_that_depend_on_the_state_is_refused(system, cost, policy, method):
    message = rf"Expected method as one of {', '.join(FIXED_STEP_METHODS)} for gradient discrete, got '{method}'; "
    with pytest.raises(ValueError, match=message):
        rollout_of(system, cost, policy, method=method, gradient="discrete")


# Divergence


@pytest.fixture
def unstable():
    """The double integrator under u = 10⁶ q̇, pushed the way it goes."""

    def build(gradient="adjoint", steps=100):
        problem = problem_of(DoubleIntegrator(), steps=steps, dt=0.1)
        return Rollout(problem, Law(lambda t, x: 1e6 * x[..., 1:]), gradient=gradient)

    return build


def first_step_that_is_not_finite(rollout, x0):
    loop = rollout.closed_loop
    x, u, _ = by_hand(loop.system, loop.cost, loop.policy, rollout.horizon, x0)
    running = rollout.horizon.dt * loop.cost.running(x[:-1], u).cumsum(0)
    finite = torch.isfinite(x[1:]).all(-1) & torch.isfinite(running)
    return int((~finite).nonzero()[0, 0]) + 1


@pytest.mark.parametrize("gradient", GRADIENTS)
@pytest.mark.parametrize("batch", [(3,), (3, 1)], ids=str)
def test_divergence_names_the_step_and_the_initial_state(unstable, gradient, batch):
    """The goal itself does not diverge; of the others, the one that does so first is named."""
    x0 = torch.tensor([[0.0, 0.0], [1e-9, 1e-9], [0.0, 2.0]])
    later, step = (first_step_that_is_not_finite(unstable(), x) for x in x0[1:])
    assert step < later
    message = f"at step {step} (t = {step * 0.1:.4g} s) from x0 = [0.0, 2.0] (2 of 3 trajectories)"
    for recording in (True, False):
        with torch.set_grad_enabled(recording), pytest.raises(DivergenceError, match=re.escape(message)):
            unstable(gradient)(x0.reshape(*batch, 2))


def test_divergence_of_a_single_state(unstable):
    with pytest.raises(DivergenceError, match=re.escape("from x0 = [0.0, 2.0] (1 of 1 trajectories)")):
        unstable()(torch.tensor([0.0, 2.0]))


def test_nothing_diverges_before_that_step(unstable):
    x0 = torch.tensor([0.0, 2.0])
    step = first_step_that_is_not_finite(unstable(), x0)
    assert torch.isfinite(unstable(steps=step - 1)(x0).running_cost).all()
    with pytest.raises(DivergenceError):
        unstable(steps=step)(x0)
    assert torch.isfinite(unstable()(torch.zeros(4, 2)).cost).all()


@double_integrator
@pytest.mark.parametrize("gradient", ["adjoint", "backprop"])
def test_an_adaptive_method_that_cannot_go_on_says_so(system, cost, gradient):
    """q̈ = 100 q̇² leaves every bound before t = 0.01 s."""
    escape = Law(lambda t, x: 100 * x[..., 1:] ** 2)
    rollout = rollout_of(system, cost, escape, 2, method="dopri5", gradient=gradient, rtol=1e-3, atol=1e-3)
    with pytest.raises(DivergenceError, match=r"Expected dopri5 to reach t = 0.2 s.*; lower the learning rate"):
        rollout(torch.tensor([[0.0, 2.0]]))
    assert torch.isfinite(rollout(torch.zeros(1, 2)).cost).all()


@double_integrator
@routes
def test_weights_that_are_no_numbers_are_a_divergence(system, cost, V, policy, x0, method, gradient):
    with torch.no_grad():
        V.hidden[0].weight.fill_(math.nan)
    with pytest.raises(DivergenceError):
        rollout_of(system, cost, policy, method=method, gradient=gradient)(x0)


@pytest.mark.parametrize("gradient", GRADIENTS)
def test_single_precision_stays(system, cost, policy, x0, gradient):
    rollout = rollout_of(system, cost, policy.float(), 3, gradient=gradient)
    for module in (system, cost):
        module.float()
    for value in rollout(x0.float()):
        assert value.dtype == torch.float32

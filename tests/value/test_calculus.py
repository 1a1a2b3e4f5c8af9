"""Derivatives of V: by hand, by finite differences along the closed loop, and under no_grad."""

import torch
from torch.testing import assert_close

from lyapnet.task.systems import DoubleIntegrator
from lyapnet.value.calculus import drift_lie_derivative, gradients, input_lie_derivative, time_derivative
from tests.problems import Formula


def draw(n=2):
    return torch.rand(50), torch.randn(50, n)


def test_gradient_of_a_plain_function_and_of_a_constant():
    t, x = draw(3)
    V_t, V_x = gradients(lambda t, x: t**2 * x[..., 0] + x[..., 1] ** 3, t, x)
    assert_close(V_t, 2 * t * x[:, 0])
    assert_close(V_x, torch.stack([t**2, 3 * x[:, 1] ** 2, torch.zeros(50)], -1))
    assert not torch.stack([*gradients(lambda t, x: x[..., 0] ** 2, t, x)][:1]).any()


def test_a_value_function_differentiates_itself_unless_it_knows_better():
    t, x = draw()
    V = Formula(lambda t, x: t * x[..., 0] ** 2 + x[..., 1] ** 3)
    value, slope = V.value_and_state_gradient(t, x)
    assert_close(value, V(t, x))
    assert_close(slope, torch.stack([2 * t * x[:, 0], 3 * x[:, 1] ** 2], -1))


def test_lie_derivatives(system, V):
    """LfV and LgV are the parts of V̇ without control and by it."""
    t, x = draw(system.n)
    V_x = gradients(V, t, x)[1]
    assert_close(drift_lie_derivative(system, x, V_x), torch.einsum("bn,bn->b", V_x, system.f(x)))
    assert_close(input_lie_derivative(system, x, V_x), torch.einsum("bn,bnm->bm", V_x, system.g(x)))


def test_time_derivative_by_hand():
    """V = t x₁² + x₁x₂ along ẋ = (x₂, u): V̇ = x₁² + (2t x₁ + x₂)x₂ + x₁u."""
    (t, x), u = draw(), torch.randn(50, 1)
    V = Formula(lambda t, x: t * x[..., 0] ** 2 + x[..., 0] * x[..., 1])
    expected = x[:, 0] ** 2 + (2 * t * x[:, 0] + x[:, 1]) * x[:, 1] + x[:, 0] * u[:, 0]
    assert_close(time_derivative(V, DoubleIntegrator(), t, x, u), expected)


def test_time_derivative_against_differences_along_the_flow(system, V):
    (t, x), u, h = draw(system.n), torch.randn(50, system.m), 1e-5
    xdot = system.dynamics(x, u)
    differences = (V(t + h, x + h * xdot) - V(t - h, x - h * xdot)) / (2 * h)
    assert_close(time_derivative(V, system, t, x, u), differences, rtol=1e-6, atol=1e-6)
    assert not torch.allclose(time_derivative(V, system, t, x, 1.1 * u), differences, rtol=1e-6, atol=1e-6)


def test_time_derivative_under_no_grad_leaves_no_graph(system, V):
    (t, x), u = draw(system.n), torch.randn(50, system.m)
    recorded = time_derivative(V, system, t, x, u)
    assert recorded.requires_grad
    with torch.no_grad():
        plain = time_derivative(V, system, t, x, u)
    assert not plain.requires_grad
    assert_close(plain, recorded.detach())

"""½ tr(σσᵀV_xx) against Hessians of autograd and finite differences."""

import pytest
import torch

from lyapnet.value.calculus import ValueFunction, noise_derivative
from lyapnet.value.networks import FCN, ExpansionNetwork, Scaling
from tests.problems import Formula, with_expansion

NETWORKS = {
    "formula": lambda: Formula(lambda t, x: torch.sin(x[..., 0]) * x[..., 1] ** 3 + t * x[..., 2] ** 2),
    "fcn": lambda: FCN(Scaling([1.0, 2.0, 0.5], 2.0, 3.0), [8, 8]),
    "expansion": lambda: with_expansion(ExpansionNetwork(Scaling([1.0, 2.0, 0.5], 2.0, 3.0), [8, 8], smooth=True)),
}
SIGMA = torch.tensor([[0.5, 0.1], [0.0, -0.7], [0.3, 0.2]])


def sigma(x):
    """(*batch, 3, 2); it depends on x."""
    return SIGMA + 0.3 * torch.sin(x)[..., None] * torch.tensor([1.0, -0.5])


def by_hessian(V: ValueFunction, sigma, t, x):
    """½ tr(σσᵀV_xx), from the whole Hessian of each state."""
    values = []
    for one_t, one_x in zip(t, x, strict=True):
        H = torch.autograd.functional.hessian(lambda z, one_t=one_t: V(one_t, z), one_x)
        s = sigma(one_x)
        values.append((s.mT @ H @ s).diagonal().sum() / 2)
    return torch.stack(values)


def points():
    return 2 * torch.rand(7), torch.randn(7, 3)


@pytest.mark.parametrize("name", NETWORKS)
def test_it_is_the_trace_of_the_hessian(name):
    V, (t, x) = NETWORKS[name](), points()
    expected = by_hessian(V, sigma, t, x)
    with torch.no_grad():
        found = noise_derivative(V, sigma(x), t, x)
    torch.testing.assert_close(found, expected)
    torch.testing.assert_close(noise_derivative(V, sigma(x), t, x.requires_grad_()).detach(), expected)
    wrong = by_hessian(V, lambda x: sigma(x)[..., :1], t, x)  # without the second source
    assert (found - wrong).abs().max() > 1e-2


@pytest.mark.parametrize("name", NETWORKS)
def test_it_is_the_mean_of_differences(name):
    """E V(t, x + σΔW) − V(t, x) over Δt, by ± √Δt for each source."""
    V, (t, x), h = NETWORKS[name](), points(), 1e-4
    with torch.no_grad():
        steps = [sign * h * column for column in sigma(x).unbind(-1) for sign in (1, -1)]
        found = sum(V(t, x + step) - V(t, x) for step in steps) / (2 * h**2)
        torch.testing.assert_close(noise_derivative(V, sigma(x), t, x), found, rtol=1e-4, atol=1e-5)


def test_its_own_derivative_includes_that_of_the_noise():
    """The gradient in x of ½ tr(σσᵀV_xx), which ascent to counterexamples uses, by finite differences."""
    V, (t, x), h = NETWORKS["fcn"](), points(), 1e-5

    def rate(x):
        return noise_derivative(V, sigma(x), t, x)

    leaf = x.clone().requires_grad_()
    (found,) = torch.autograd.grad(rate(leaf).sum(), leaf)
    for i, direction in enumerate(torch.eye(3)):
        with torch.no_grad():
            difference = (rate(x + h * direction) - rate(x - h * direction)) / (2 * h)
        torch.testing.assert_close(found[:, i], difference, rtol=1e-5, atol=1e-6)


def test_a_value_that_is_linear_has_none():
    V = Formula(lambda t, x: 3 * x[..., 0] - t)
    assert not noise_derivative(V, sigma(torch.zeros(4, 3)), torch.zeros(4), torch.zeros(4, 3)).any()

"""Traced torch functions as CasADi functions: equal to torch; operators without a rule are named."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

import lyapnet
from lyapnet.base.errors import OracleError
from lyapnet.graphs.casadi_functions import casadi_function, require_equal, trace_for_casadi


def translated(function, arguments):
    result = casadi_function(trace_for_casadi(function, arguments), arguments)
    require_equal(result, function, arguments)
    return result


def test_every_registered_system_is_translated(system, cost):
    def task(x, u):
        return system.f(x), system.g(x), system.dynamics(x, u), cost.running(x, u), cost.terminal(x)

    arguments = torch.zeros(1, system.n), torch.zeros(1, system.m)
    result = translated(task, arguments)
    for _ in range(5):
        x, u = 3 * torch.randn(1, system.n), 3 * torch.randn(1, system.m)
        for ours, theirs in zip(result.call([x[0].numpy(), u[0].numpy()]), task(x, u), strict=True):
            assert_close(torch.tensor(np.array(ours)).flatten(), theirs.flatten(), rtol=1e-11, atol=1e-11)


MASS = torch.eye(4, dtype=torch.float64) + 0.1


def filled(x):
    result = torch.zeros_like(x)
    result[..., 0] = x[..., 1] ** 2
    result[..., 2:] = torch.sin(x[..., :2])
    return result


FUNCTIONS = {
    "powers": lambda x: x**2 + x**3 + (1 + x**2) ** 0.5 + 2.0**x + torch.sqrt(1 + x * x).pow(-1.5) + x.abs() ** x,
    "trigonometry": lambda x: torch.sin(x) + torch.cos(x) * torch.tan(x / 4) + torch.atan(x) + torch.atan2(x, 1 + x**2),
    "inverse": lambda x: torch.asin(torch.tanh(x)) + torch.acos(torch.sin(x)) + torch.asinh(x) + torch.acosh(2 + x * x),
    "exponentials": lambda x: torch.exp(-x) + torch.log(1 + x * x) + torch.log1p(x * x) + torch.expm1(x) + torch.erf(x),
    "hyperbolic": lambda x: torch.tanh(x) + torch.sinh(x) / torch.cosh(x) + torch.sigmoid(x),
    "activations": lambda x: torch.nn.functional.softplus(x) + torch.relu(x) + torch.nn.functional.silu(x)
    + torch.nn.functional.elu(x) + torch.nn.functional.gelu(x),
    "branches": lambda x: torch.where(x > 0, x, -2 * x) + torch.sign(x) + torch.clamp(x, -0.5, 0.5) + x.clamp(min=0),
    "contact": lambda x: lyapnet.normal_force(x, x.flip(-1), 9.0, 0.1, 0.5) + lyapnet.friction_force(x, x**2, 0.4, 0.3),
    "logic": lambda x: torch.where((x > 0) & ~(x >= 1) | (x < -1), x, 0.0) + (x == 0),
    "extremes": lambda x: torch.maximum(x, x.flip(-1)) + torch.minimum(x, 0 * x) + x.amax(-1, True) - x.amin(-1),
    "rounding": lambda x: torch.floor(x) + torch.ceil(3 * x) + torch.fmod(x, 0.7) + torch.remainder(x, 0.7),
    "sums": lambda x: x.sum(-1, keepdim=True) + x.mean() + x.prod(-1) + x.cumsum(-1) + torch.linalg.norm(x, dim=-1),
    "pieces": lambda x: torch.cat([x[..., 2:], x[..., :2]], -1) + x[..., [3, 1, 0, 2]] + x.roll(1, -1) + x.repeat(1, 1),
    "shapes": lambda x: x.view(1, 2, 2).mT.reshape(1, 4) + torch.stack(x.unbind(-1), -1) + x.T.expand(4, 4).sum(0),
    "in place": filled,
    "constants": lambda x: x + torch.arange(4.0) + torch.linspace(0, 1, 4) + torch.ones_like(x) + torch.full((4,), 2.0),
    "products": lambda x: x @ MASS + torch.einsum("ij,bj->bi", MASS, x) + torch.nn.functional.linear(x, MASS, MASS[0]),
    "outer": lambda x: (x[..., None] @ x[..., None, :]).flatten(1) + torch.diag_embed(x).flatten(1) + (x[0] @ x[0]),
    "matrices": lambda x: torch.linalg.solve(MASS + torch.diag_embed(x**2), x[..., None])[..., 0]
    + (torch.linalg.inv(MASS + x.mT @ x) @ x[0]) * torch.linalg.det(MASS + x.mT @ x),
    "row solve": lambda x: torch.linalg.solve(MASS + x.mT @ x, x, left=False) + torch.linalg.solve(MASS, x[0]),
    "cross": lambda x: torch.linalg.cross(x[..., :3], x[..., 1:]),
    "precision": lambda x: x.double().to(torch.float64) + x.detach().clone(),
}  # fmt: skip


@pytest.mark.parametrize("name", FUNCTIONS)
def test_operations_of_user_systems_are_translated(name):
    def function(x):
        return (FUNCTIONS[name](x),)

    x = torch.zeros(1, 4)
    result = translated(function, (x,))
    point = torch.tensor([[0.3, -0.8, 1.7, -2.2]])
    (value,) = result.call([point[0].numpy()])
    assert_close(torch.tensor(np.array(value)).flatten(), function(point)[0].flatten(), rtol=1e-10, atol=1e-10)


def test_a_wrong_rule_is_found():
    x = torch.zeros(1, 2)
    wrong = casadi_function(trace_for_casadi(lambda x: (torch.sin(x),), (x,)), (x,))
    with pytest.raises(OracleError, match="an error of"):
        require_equal(wrong, lambda x: (torch.sin(1.000001 * x),), (x,))


def test_an_operator_without_a_rule_is_named():
    x = torch.zeros(1, 2)
    with pytest.raises(OracleError, match=r"^Expected operations .*, got aten.special_bessel_j0.default; write it"):
        casadi_function(trace_for_casadi(lambda x: (torch.special.bessel_j0(x),), (x,)), (x,))

"""The condition that a proof bounds: V falls, by the derivative of V's own operations, whatever gradient V declares."""

import pytest
import torch

from lyapnet.base.errors import UsageError
from lyapnet.claims.funnel import prove_funnel
from lyapnet.prover.bounds import BoundedFunction
from lyapnet.prover.branch_and_bound import Budget
from lyapnet.prover.condition import DecreaseCondition, bounded_condition, require_own_gradient
from lyapnet.prover.proof import prove
from tests.claims.planted import domain, loop, problem, riccati
from tests.marks import sample
from tests.problems import Formula, hjb_loop, untrained

P = torch.as_tensor(riccati())


def quadratic(x):
    return ((x @ P) * x).sum(-1)


class TimesOne(torch.autograd.Function):
    """a, with a derivative of 1.5."""

    @staticmethod
    def forward(ctx, a):
        return a.clone()

    @staticmethod
    def backward(ctx, gradient):  # pyright: ignore[reportIncompatibleMethodOverride]
        return 1.5 * gradient


def hooked(x):
    x = 1 * x
    if x.requires_grad:
        x.register_hook(lambda gradient: 2 * gradient)
    return x


def unrecorded(x):
    with torch.no_grad():
        return 0.3 * x[..., 1]


class Overridden(Formula):
    def value_and_state_gradient(self, t, x):
        value, V_x = super().value_and_state_gradient(t, x)
        return value, V_x + torch.stack([torch.zeros_like(t + x[..., 0]), 0.1 * x[..., 0]], -1)


DISHONEST = {  # V, and the axis along which its gradient is wrong first
    "a wrong backward pass": (Formula(lambda t, x: TimesOne.apply(quadratic(x)) + 0 * t), r"∂V/∂x\[0\]"),
    "detach": (Formula(lambda t, x: quadratic(x) + 0 * t + 0.1 * (x[..., 1] ** 2).detach()), r"∂V/∂x\[1\]"),
    "data": (Formula(lambda t, x: quadratic(x) + 0 * t + 0.1 * x.data[..., 0] ** 2), r"∂V/∂x\[0\]"),
    "no_grad": (Formula(lambda t, x: quadratic(x) + 0 * t + unrecorded(x)), r"∂V/∂x\[1\]"),
    "detached time": (Formula(lambda t, x: quadratic(x) - 3 * t.detach()), "∂V/∂t"),
    "a hook": (Formula(lambda t, x: quadratic(hooked(x)) + 0 * t), r"∂V/∂x\[0\]"),
    "an override": (Overridden(lambda t, x: quadratic(x) + 0 * t), r"∂V/∂x\[1\]"),
}


def claim(V):
    return prove_funnel(
        hjb_loop(loop(P).system, loop(P).cost, V), problem(), 0.9, 0.5, budget=Budget(60, boxes=2000),
        generator=torch.Generator().manual_seed(0),
    )  # fmt: skip


@pytest.mark.parametrize("name", sample(DISHONEST, 3))
def test_a_gradient_that_is_not_the_derivative_is_refused(name):
    V, axis = DISHONEST[name]
    with pytest.raises(UsageError, match=rf"gradient is its derivative, got {axis} = .* give .*; mend its backward"):
        claim(V)


@pytest.mark.gate
def test_the_true_gradient_is_certified():
    """The twin, with kinks and an override that is right."""
    assert claim(Formula(lambda t, x: quadratic(x) + 0.01 * torch.relu(x[..., 0]) + 0 * t)).verdict == "certified"


@pytest.mark.gate
@pytest.mark.parametrize("name", ["double_integrator", "cartpole_balancing_certified", "reacher"])
def test_networks_of_the_package_know_their_gradients(name):
    controller = untrained(name)
    closed_loop, box = controller.closed_loop.double().requires_grad_(False), controller.initial_states
    lower, upper = torch.cat([torch.zeros(1), box.lower]), torch.cat([torch.ones(1), box.upper])
    require_own_gradient(DecreaseCondition(closed_loop, 0.9, 0.0).V, (lower.double(), upper.double()), points=50)


LOCAL = Formula(lambda t, x: quadratic(x) - 40 * t.detach() * torch.relu(0.01 - (x - 1).abs()).sum(-1).detach() + 0 * t)
"""The declared V_t misses a spike of V in a thin part of the domain, in which there may be no sample."""


@pytest.mark.parametrize("V", [LOCAL, Formula(lambda t, x: quadratic(x) + 3 * t.detach())], ids=["spike", "everywhere"])
def test_a_proof_does_not_rest_on_the_declared_gradient(V):
    """By the declared one, V falls everywhere; c is bounded by the derivative of V's operations."""
    closed_loop = hjb_loop(loop(P).system, loop(P).cost, V)
    condition, (lower, upper) = DecreaseCondition(closed_loop, 0.9, 0.05), domain()
    at = torch.tensor([[1.0, 1.0, 1.0]])
    bounded = bounded_condition(condition, (lower, upper))
    assert condition.V is closed_loop.V
    (low, high), *_ = bounded.bounds(at, at)
    declared = BoundedFunction(lambda t, x: (condition(t, x),), (lower, upper)).bounds(at, at)[0][1]
    missed = -0.8 if V is LOCAL else 3.0
    assert float(low) - 1e-9 <= float(declared) + missed <= float(high) + 1e-9


def test_a_rising_v_that_declares_no_time_derivative_is_not_certified():
    closed_loop = hjb_loop(loop(P).system, loop(P).cost, Formula(lambda t, x: quadratic(x) + 3 * t.detach()))
    condition = DecreaseCondition(closed_loop, 0.9, 0.05)
    proof = prove(condition, domain(), 2.0, Budget(20, boxes=500), generator=torch.Generator().manual_seed(0))
    assert proof.verdict != "certified"
    honest = DecreaseCondition(loop(P), 0.9, 0.05)
    assert prove(honest, domain(), 2.0, Budget(20, boxes=500)).verdict == "certified"

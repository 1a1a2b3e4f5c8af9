"""The one place that differentiates V: gradients, Lie derivatives, V̇.

Everything here works under torch.no_grad() too, which Lightning's validation and odeint_adjoint's forward pass switch
on: gradients are enabled inside, and the result is part of the outer graph only if the caller records one.
"""

import torch
from torch import Tensor

from lyapnet.cost import QuadraticCost
from lyapnet.linear_algebra import apply
from lyapnet.systems import ControlAffineSystem
from lyapnet.types import Control, PerState, Policy, State, Time, Value


def value_and_state_gradient(V: Value, t: Time, x: State) -> tuple[PerState, State]:
    """(V(t, x), V_x(t, x)), of shapes (*batch,) and (*batch, n).

    A network that knows its gradient as plain forward operations offers both, which share most of their work, as
    `V.value_and_state_gradient(t, x)`; any other V is differentiated by autograd.
    """
    formula = getattr(V, "value_and_state_gradient", None)
    return formula(t, x) if formula is not None else (V(t, x), gradients(V, t, x)[1])


def state_gradient(V: Value, t: Time, x: State) -> State:
    """V_x(t, x), (*batch, n); by the formula of a network that has one, else by autograd."""
    formula = getattr(V, "value_and_state_gradient", None)
    return formula(t, x)[1] if formula is not None else gradients(V, t, x)[1]


def gradients(V: Value, t: Time, x: State) -> tuple[PerState, State]:
    """(V_t, V_x) by automatic differentiation, of shapes (*batch,) and (*batch, n)."""
    recording = torch.is_grad_enabled()
    with torch.enable_grad():
        t = _differentiable(t.expand(x.shape[:-1]), recording)
        x = _differentiable(x, recording)
        # each V depends on its own (t, x) alone, so the gradient of the sum holds every state's gradient
        V_t, V_x = torch.autograd.grad(V(t, x).sum(), (t, x), create_graph=recording, materialize_grads=True)
    return V_t, V_x


def lie_derivatives(V: Value, system: ControlAffineSystem, t: Time, x: State) -> tuple[PerState, Control]:
    """(LfV, LgV) = (V_xᵀf, gᵀV_x), of shapes (*batch,) and (*batch, m)."""
    V_x = state_gradient(V, t, x)
    return drift_lie_derivative(system, x, V_x), input_lie_derivative(system, x, V_x)


def drift_lie_derivative(system: ControlAffineSystem, x: State, V_x: State) -> PerState:
    """LfV = V_xᵀf(x)."""
    return (V_x * system.f(x)).sum(-1)


def input_lie_derivative(system: ControlAffineSystem, x: State, V_x: State) -> Control:
    """LgV = g(x)ᵀV_x."""
    return apply(system.g(x).mT, V_x)


def time_derivative(V: Value, system: ControlAffineSystem, policy: Policy, t: Time, x: State) -> PerState:
    """V̇ = V_t + V_xᵀ(f + g u) along the closed loop u = policy(t, x)."""
    V_t, V_x = gradients(V, t, x)
    return V_t + (V_x * system.dynamics(x, policy(t, x))).sum(-1)


def hamiltonian(system: ControlAffineSystem, cost: QuadraticCost, x: State, u: Control, costate: State) -> PerState:
    """H(x, u, λ) = ℓ(x, u) + λᵀ(f + g u); the HJB equation is V_t + min_u H(x, u, V_x) = 0."""
    return cost.running(x, u) + (costate * system.dynamics(x, u)).sum(-1)


def _differentiable(leaf: Tensor, recording: bool) -> Tensor:
    """The tensor itself where the caller's graph runs through it, else a fresh leaf of its value."""
    return leaf if recording and leaf.requires_grad else leaf.detach().requires_grad_()

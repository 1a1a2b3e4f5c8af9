"""The base class of V(t, x), and its derivatives: gradients, Lie derivatives, V̇.

Everything here also works under torch.no_grad(), as in Lightning's validation and odeint_adjoint's forward pass:
gradients are enabled inside, and the result is part of the outer graph only if the caller records one.
"""

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from lyapnet.base.linear_algebra import apply
from lyapnet.base.types import Control, Noise, PerState, State, Time, Value
from lyapnet.task.systems import ControlSystem


class ValueFunction(nn.Module, ABC):
    """V(t, x): a value function, a Lyapunov function, or a candidate for one.

    A subclass implements `forward` with torch operations on tensors of any leading shape. Its gradient is computed by
    automatic differentiation. A subclass with a formula for V_x overrides `value_and_state_gradient`, which is faster,
    and can be compiled and exported everywhere.
    """

    made_for: type[nn.Module] | None = None
    """The control law for which V was trained, a ValuePolicy; training sets it. None: unknown."""

    @abstractmethod
    def forward(self, t: Time, x: State) -> PerState:
        """V(t, x), (*batch,), in units of cost, for t in s, a scalar or one time for each state, and x (*batch, n)."""

    def value_and_state_gradient(self, t: Time, x: State) -> tuple[PerState, State]:
        """(V, V_x) of shapes (*batch,) and (*batch, n); they share most of their work."""
        return self(t, x), gradients(self, t, x)[1]

    def curvature(self, t: Time) -> Tensor | None:
        """A positive semidefinite model of V_xx at t, (*batch, n, n), for control laws; None if V has none."""
        return None

    def curvature_at(self, t: Time, x: State) -> Tensor | None:
        """The same at a state; it depends on the state in a family with weights of the cost."""
        return self.curvature(t)


def gradients(V: Value, t: Time, x: State) -> tuple[PerState, State]:
    """(V_t, V_x) by automatic differentiation, of shapes (*batch,) and (*batch, n)."""
    recording = torch.is_grad_enabled()
    with torch.enable_grad():
        t = _differentiable(t.expand(x.shape[:-1]), recording)
        x = _differentiable(x, recording)
        # each V depends only on its own (t, x), so the gradient of the sum contains every state's gradient
        V_t, V_x = torch.autograd.grad(V(t, x).sum(), (t, x), create_graph=recording, materialize_grads=True)
    return V_t, V_x


def drift_lie_derivative(system: ControlSystem, x: State, V_x: State) -> PerState:
    """LfV = V_xᵀf(x)."""
    return (V_x * system.f(x)).sum(-1)


def input_lie_derivative(system: ControlSystem, x: State, V_x: State) -> Control:
    """LgV = g(x)ᵀV_x."""
    return apply(system.g(x).mT, V_x)


def time_derivative(V: ValueFunction, system: ControlSystem, t: Time, x: State, u: Control) -> PerState:
    """V̇ = V_t + V_xᵀ(f(x) + g(x)u), with the same V_x as in control laws, so that interval bounds see terms cancel."""
    V_t, V_x = gradients(V, t, x)[0], V.value_and_state_gradient(t, x)[1]
    return V_t + (V_x * system.dynamics(x, u)).sum(-1)


def noise_derivative(V: ValueFunction, sigma: Noise, t: Time, x: State) -> PerState:
    """½ tr(σσᵀV_xx) = ½ Σ_j σ_jᵀ V_xx σ_j, the part of the noise σ(x) dW in the mean rate of V, by Itô's formula.

    Only the second derivatives along the columns of σ are computed: σ_jᵀV_xx is the gradient of V_xᵀσ_j for fixed σ_j.
    """
    recording, columns = torch.is_grad_enabled(), sigma.unbind(-1)
    with torch.enable_grad():
        # a copy of x, on which σ does not depend: the gradient must not include that of σ(x)
        at = x.clone() if recording and x.requires_grad else x.detach().requires_grad_()
        V_x = V.value_and_state_gradient(t, at)[1]
        bends = [_gradient((V_x * column).sum(), at, recording) for column in columns]
    return sum(((bend * column).sum(-1) for bend, column in zip(bends, columns, strict=True)), 0 * x[..., 0]) / 2


def _gradient(y: Tensor, x: State, recording: bool) -> State:
    """∂y/∂x, and 0 if y does not depend on x; the graph of y is kept."""
    if not y.requires_grad:
        return torch.zeros_like(x)
    return torch.autograd.grad(y, x, create_graph=recording, retain_graph=True, materialize_grads=True)[0]


def _differentiable(leaf: Tensor, recording: bool) -> Tensor:
    """The tensor itself if it is part of the caller's graph, else a new leaf with its value."""
    return leaf if recording and leaf.requires_grad else leaf.detach().requires_grad_()

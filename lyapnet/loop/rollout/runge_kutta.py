"""Explicit Runge–Kutta steps of the closed loop, their linearisation, and their gradient by the parameters.

Let X_i and k_i be the stages and slopes of a step x' = x + Δt Σ b_i k_i, λ' the costate after the step, β the loss's
derivative by the step's running cost, λ̄ the loss's derivative by the node itself (also through V(t, x)), and
H_i = β b_i ℓ + μ_iᵀ(f + g u) the Hamiltonian of a stage. With d/dx the total derivative, also through u(t, x),

    μ_i = b_i λ' + Σ_{j>i} a_ji X̄_j,   X̄_i = Δt dH_i/dx,   λ = λ' + Σ_i X̄_i + λ̄,   θ̄ = Σ_i Δt u_θᵀ ∂H_i/∂u.

With Euler this is λ_n = λ_{n+1} + Δt dH/dx + λ̄_n, the costate equation of the paper (arXiv 2305.15244) on the grid of
the rollout. With noise a step adds σ(x)ΔW at its first stage, and λ adds (∂(σΔW)/∂x)ᵀλ'.

Source of the general form: Hager, "Runge-Kutta methods in optimal control and the transformed adjoint system",
Numerische Mathematik 2000.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lyapnet.base.linear_algebra import apply, multiply
from lyapnet.base.types import (
    Jacobians,
    Scalar,
    StageControls,
    StageInputMatrices,
    StageJacobians,
    StagePath,
    StageSlopes,
    StageValues,
    State,
    StatePath,
    Times,
    ValuePath,
)
from lyapnet.loop.rollout.closed_loop import ClosedLoop
from lyapnet.task.horizon import ButcherTableau, weighted_sum
from lyapnet.task.noise import Increments


class Step(nn.Module):
    """One step from a batch of states: (t, Δt, x), or (t, Δt, ΔW, x) with noise, ↦ (x', stages, ∫ℓ, u, V)."""

    loop: ClosedLoop
    tableau: ButcherTableau

    def __init__(self, loop: ClosedLoop, tableau: ButcherTableau):
        super().__init__()
        self.loop, self.tableau = loop, tableau

    def forward(self, t: Scalar, dt: Scalar, *arguments: Tensor) -> tuple[Tensor, ...]:
        *increment, x = arguments
        stages, slopes, outputs = [], [], []
        for row, c in zip(self.tableau.a, self.tableau.c, strict=True):
            X = x + dt * weighted_sum(row, [k[..., :-1] for k in slopes]) if any(row) else x
            output = self.loop.control(t + c * dt, X)
            outputs.append(output)
            stages.append(X)
            slopes.append(self.loop.slope(X, output.u))
        step = dt * weighted_sum(self.tableau.b, slopes)
        following = x + step[..., :-1]
        if increment:
            following = following + self.loop.displacement(x, *increment)
        return following, torch.stack(stages), step[..., -1], outputs[0].u, outputs[0].value


class PullBack(nn.Module):
    """One backward step by automatic differentiation: (t, Δt, x, x̄, c̄, V̄, λ') ↦ (λ, λ, *θ̄); with noise ΔW before λ'.

    Args:
        step: the step with parameters θ.
    """

    def __init__(self, step: Step):
        super().__init__()
        self.step = step

    def forward(
        self,
        t: Scalar,
        dt: Scalar,
        x: State,
        node_bar: State,
        cost_bar: Tensor,
        value_bar: Tensor,
        *increment_and_costate: Tensor,
    ) -> tuple[Tensor, ...]:
        *increment, costate = increment_and_costate
        with torch.enable_grad():
            x = x.detach().requires_grad_()
            theta = [p for p in self.step.parameters() if p.requires_grad]
            following, _, cost, _, value = self.step(t, dt, *increment, x)
            x_bar, *theta_bar = _vjp([following, cost, value], [x, *theta], [costate, cost_bar, value_bar])
        before = node_bar + x_bar
        return before, before.clone(), *theta_bar  # the carried state and the output of a scan


class Linearisation(NamedTuple):
    """The closed loop to first order at all stages of a block of steps."""

    transition: Jacobians  # Φᵀ with Φ = ∂x'/∂x
    source: StatePath  # λ̄ + β ∂(∫ℓ)/∂x, so that λ = Φᵀλ' + source
    f_x: StageJacobians  # d(f + gu)/dx, also through u
    cost_x: StagePath  # dℓ/dx, also through u
    f_u: StageInputMatrices
    cost_u: StageControls
    u: StageControls  # with its graph, like the next two
    value: StageValues
    slope: StageSlopes  # (f + gu, ℓ) at given (x, u), for parameters of the system and the cost


class Linearise(nn.Module):
    """Linearisation and parameter gradient of blocks; `forward` computes both for a known costate."""

    loop: ClosedLoop
    tableau: ButcherTableau

    def __init__(self, loop: ClosedLoop, tableau: ButcherTableau):
        super().__init__()
        self.loop, self.tableau = loop, tableau

    def forward(self, *arguments: Tensor) -> tuple[Tensor, ...]:
        linearisation = self.linearise(*arguments[:-1])
        return linearisation.transition, linearisation.source, *self.product(linearisation, *arguments)

    def linearise(
        self,
        t: Times,
        dt: Times,
        stages: StagePath,
        node_bar: StatePath,
        cost_bar: ValuePath,
        value_bar: ValuePath,
        *increment: Increments,
    ) -> Linearisation:
        """Linearise at the stages, given the loss's derivatives by x_n, by ∫ℓ over the step, and by V_n; and ΔW."""
        tableau, n = self.tableau, stages.shape[-1]
        with torch.enable_grad():
            x = stages.detach().requires_grad_()
            u, value, V_x = self.loop.control(self._times(t, dt), x)
            u_x = torch.stack([_vjp([u_j], [x], [torch.ones_like(u_j)])[0] for u_j in u.unbind(-1)], -2)
            # One copy of (x, u) for each component of (f + gu, ℓ): all rows of the Jacobian in one backward pass.
            copies = [y.detach().expand(n + 1, *y.shape).clone().requires_grad_() for y in (x, u)]
            slope = self.loop.slope(*copies)
            rows = torch.eye(n + 1, dtype=slope.dtype, device=slope.device).reshape(
                n + 1, *[1] * (slope.ndim - 2), n + 1
            )
            y_x, y_u = _vjp([slope], copies, [rows.expand_as(slope)])
            noise_x = [self._displacement_jacobian(stages[:, 0], increment[0])] if increment else []
            given = self.loop.slope(x.detach(), u.detach())
        y_x = y_x + apply(u_x.mT, y_u)
        f_x, cost_x, f_u, cost_u = y_x[:n].movedim(0, -2), y_x[n], y_u[:n].movedim(0, -2), y_u[n]

        h = dt[:, None, None, None]
        eye = torch.eye(n, dtype=stages.dtype, device=stages.device).expand(f_x.shape[0], *f_x.shape[2:])
        jacobians, cost_jacobians = [], []
        for i, row in enumerate(tableau.a):
            if any(row):
                X_x = eye + h * weighted_sum(row, jacobians)
                jacobians.append(multiply(f_x[:, i], X_x))
                cost_jacobians.append(apply(X_x.mT, cost_x[:, i]))
            else:
                jacobians.append(f_x[:, i])
                cost_jacobians.append(cost_x[:, i])
        transition = (sum(noise_x, eye) + h * weighted_sum(tableau.b, jacobians)).mT
        cost_x0 = dt[:, None, None] * weighted_sum(tableau.b, cost_jacobians)
        source = node_bar + value_bar[..., None] * V_x[:, 0].detach() + cost_bar[..., None] * cost_x0
        return Linearisation(transition, source, f_x, cost_x, f_u, cost_u, u, value, given)

    def product(
        self,
        linearisation: Linearisation,
        t: Times,
        dt: Times,
        stages: StagePath,
        node_bar: StatePath,
        cost_bar: ValuePath,
        value_bar: ValuePath,
        *increment_and_costate: Tensor,
    ) -> tuple[Tensor, ...]:
        """θ̄ of the block, given the costates λ' after each of its steps."""
        costate = increment_and_costate[-1]
        (a, b, _), (_, _, f_x, cost_x, f_u, cost_u, u, value, slope) = self.tableau, linearisation
        h, s = dt[:, None, None], len(self.tableau.b)
        stage_bars: dict[int, Tensor] = {}
        u_bars, slope_bars = [], []
        for i in reversed(range(s)):
            mu = b[i] * costate
            for j, X_bar in stage_bars.items():
                if a[j][i]:
                    mu = mu + a[j][i] * X_bar
            beta = b[i] * cost_bar[..., None]
            if i > 0:
                stage_bars[i] = h * (apply(f_x[:, i].mT, mu) + beta * cost_x[:, i])
            u_bars.append(h * (apply(f_u[:, i].mT, mu) + beta * cost_u[:, i]))  # Δt ∂H/∂u
            slope_bars.append(h * torch.cat([mu, beta], -1))
        at_node = torch.cat([value_bar[:, None], torch.zeros_like(value[:, 1:])], 1)
        theta = [p for p in self.loop.parameters() if p.requires_grad]
        bars = [torch.stack(u_bars[::-1], 1), at_node, torch.stack(slope_bars[::-1], 1)]
        return _vjp([u, value, slope], theta, bars)

    def _displacement_jacobian(self, x: StatePath, increment: Increments) -> Jacobians:
        """∂(σ(x)ΔW)/∂x at the first stage of each step."""
        n = x.shape[-1]
        copies = x.detach().expand(n, *x.shape).clone().requires_grad_()
        rows = torch.eye(n, dtype=x.dtype, device=x.device).reshape(n, *[1] * (x.ndim - 1), n).expand_as(copies)
        (jacobian,) = _vjp([self.loop.displacement(copies, increment.expand(n, *increment.shape))], [copies], [rows])
        return jacobian.movedim(0, -2)

    def _times(self, t: Times, dt: Times) -> Float[Tensor, "nodes stages 1"]:
        """The times of the stages."""
        return torch.stack([t + c * dt for c in self.tableau.c], -1)[..., None]


def _vjp(outputs: Sequence[Tensor], inputs: Sequence[Tensor], cotangents: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """Σ cotangentᵀ ∂output/∂input for each input; zero if no output depends on it."""
    pairs = [(y, bar) for y, bar in zip(outputs, cotangents, strict=True) if y.requires_grad]
    if not pairs or not inputs:
        return tuple(torch.zeros_like(x) for x in inputs)
    ys, bars = zip(*pairs, strict=True)
    return torch.autograd.grad(ys, inputs, bars, retain_graph=True, allow_unused=True, materialize_grads=True)

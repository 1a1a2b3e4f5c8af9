"""Second order expansions of V along a trajectory, and the greedy control of a step."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from lyapnet.base.linear_algebra import apply, multiply, solve
from lyapnet.base.types import Control, PerState, State, StatePath, ValuePath
from lyapnet.task.problem import Problem, Response
from lyapnet.task.sets import about_control
from lyapnet.value.expansions.control_search import Objective, minimise_over_controls, starts_of
from lyapnet.value.risk import equivalent_derivatives


class Expansion(NamedTuple):
    """V(t_n, x̄_n + δ) ≈ c_n + p_nᵀδ + ½ δᵀH_nδ at the nodes of the horizon, in float64; or a batch of these."""

    x: StatePath  # x̄
    value: ValuePath  # c
    gradient: StatePath  # p
    hessian: Tensor  # H (N + 1, *batch, n, n), symmetric

    def member(self, i: int | Tensor) -> "Expansion":
        """One expansion of a batch, or those with some indices."""
        return Expansion(*(part[:, i] for part in self))

    def restricted_to(self, kept: list[int]) -> "Expansion":
        """The expansion as a function of some of the states only."""
        return Expansion(
            self.x[..., kept], self.value, self.gradient[..., kept], self.hessian[..., kept, :][..., :, kept]
        )

    def initially(self, x0: State) -> PerState:
        """V(0, x₀) of a single expansion."""
        delta = x0 - self.x[0]
        return self.value[0] + ((self.gradient[0] + apply(self.hessian[0], delta) / 2) * delta).sum(-1)


def certainty_equivalents(problem: Problem, expansion: Expansion) -> Expansion:
    """The expansion of the function that a law minimises: V, or with risk its certainty equivalent over a step.

    Args:
        expansion: the expansion of V; its first node and its c are not changed, because no law needs them.
    """
    if problem.noise is None or not problem.risk:
        return expansion
    x, value, p, H = expansion
    later = equivalent_derivatives(p[1:], H[1:], problem.noise(x[:-1]), problem.horizon.dt, problem.risk)
    return Expansion(x, value, *(torch.cat([part[:1], new]) for part, new in zip((p, H), later, strict=True)))


def held_control(
    problem: Problem, x: State, free: Response, V_x: State, H: Tensor, near: Control | None = None
) -> Control:
    """The control held for Δt that minimises ∫ℓ + V(F(x, u)), for V with gradient V_x at F(x, 0) and curvature H.

    It is the minimiser of ½ uᵀ(ℓ_uu + Δt BᵀHB)u + (BᵀV_x + ℓ_u)ᵀu + s(u) over U, with B = F_u/Δt: without limits and
    s, −(ℓ_uu + Δt BᵀHB)⁻¹(BᵀV_x + ℓ_u). With Euler steps F(x, 0) = x + Δt f, B = g, ℓ_u = 0 and ℓ_uu = 2R; with
    others u also changes q within the step. With a target, u − u* replaces u in uᵀRu, and f + gu* replaces f.

    For a system that is not control-affine it is the minimiser of ∫ℓ + V(F(x, u)) for this quadratic V.

    Args:
        x: the state at which the step begins.
        free: the step with the control at rest, or for other systems with the nominal one.
        near: a control at which the search begins for a system that is not control-affine, which then finds the local
            minimum there; None: the best minimum of a search from several controls.
    """
    if not problem.system.affine:
        return _control_of_quadratic(problem, x, free, V_x, H, near)
    B = free.by_control
    weight = free.curvature + problem.horizon.dt * multiply(B.mT, multiply(H, B))
    b = apply(B.mT, V_x) + free.slope
    if not problem.has_linear_law:
        return problem.best_control(weight / 2, about_control(weight / 2, b, free.u))
    u = -solve(weight, b[..., None])[..., 0]
    return u if free.u is None else u + free.u


def _control_of_quadratic(
    problem: Problem, x: State, free: Response, V_x: State, H: Tensor, near: Control | None
) -> Control:
    """argmin over u ∈ U of `step_objective`."""
    assert free.u is not None
    Q, weight = step_objective(problem, x, free, V_x, H), 2 * problem.cost.R(x)
    if near is not None:
        return minimise_over_controls(problem, Q, near[None], weight)
    paid = problem.smooth_rates(x, free.u)[1]
    return minimise_over_controls(problem, Q, starts_of(problem, Q, free.u, paid, weight), weight)


def step_objective(problem: Problem, x: State, free: Response, V_x: State, H: Tensor) -> Objective:
    """(∫ℓ + V_xᵀδ + ½ δᵀHδ)/Δt without s(u), with δ = F(x, u) − F(x, ū) and ū the control of a response at x."""
    assert free.u is not None
    dt, rate = problem.horizon.dt, problem.smooth_rates(x, free.u)[0]

    def Q(u: Control) -> PerState:
        moved, cost = problem.smooth_rates(x.expand(*u.shape[:-1], -1), u)
        delta = moved - rate  # the difference of next states would have larger rounding errors
        return cost + (V_x * delta).sum(-1) + dt / 2 * (apply(H, delta) * delta).sum(-1)

    return Q


def greedy_law(problem: Problem, expansion: Expansion) -> Callable[[int, State], Control]:
    """The law (n, x_n) ↦ u_n: the held control for V from an expansion."""
    expansion = certainty_equivalents(problem, expansion)

    def law(n: int, x: State) -> Control:
        H, free = expansion.hessian[n + 1], problem.response(x)
        V_x = expansion.gradient[n + 1] + apply(H, free.x - expansion.x[n + 1])
        return held_control(problem, x, free, V_x, H)

    return law


def at_rest(problem: Problem) -> Callable[[int, State], Control]:
    """The law (n, x_n) ↦ the control at rest, which costs nothing, projected onto U."""
    return lambda _, x: problem.controls.project(problem.rest_at(x))

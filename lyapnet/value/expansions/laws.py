"""V to second order along a trajectory, and the control that it asks for in a step."""

from collections.abc import Callable
from typing import NamedTuple

from torch import Tensor

from lyapnet.base.linear_algebra import apply, multiply, solve
from lyapnet.base.types import Control, PerState, State, StatePath, ValuePath
from lyapnet.task.problem import Problem, Response


class Expansion(NamedTuple):
    """V(t_n, x̄_n + δ) ≈ c_n + p_nᵀδ + ½ δᵀH_nδ at the nodes of the horizon, in float64; *batch for several."""

    x: StatePath  # x̄
    value: ValuePath  # c
    gradient: StatePath  # p
    hessian: Tensor  # H (N + 1, *batch, n, n), symmetric

    def member(self, i: int | Tensor) -> "Expansion":
        """One of several, or those with some indices."""
        return Expansion(*(part[:, i] for part in self))

    def restricted_to(self, kept: list[int]) -> "Expansion":
        """As a function of some of the states alone."""
        return Expansion(
            self.x[..., kept], self.value, self.gradient[..., kept], self.hessian[..., kept, :][..., :, kept]
        )

    def initially(self, x0: State) -> PerState:
        """V(0, x₀) as a single expansion has it."""
        delta = x0 - self.x[0]
        return self.value[0] + ((self.gradient[0] + apply(self.hessian[0], delta) / 2) * delta).sum(-1)


def held_control(problem: Problem, free: Response, V_x: State, H: Tensor) -> Control:
    """u held for Δt: the minimiser of ∫ℓ + V(F(x, u)) for V of gradient V_x at F(x, 0) and curvature H.

    It is the minimiser of ½ uᵀ(ℓ_uu + Δt BᵀHB)u + (BᵀV_x + ℓ_u)ᵀu over U, with B = F_u/Δt: without limits,
    −(ℓ_uu + Δt BᵀHB)⁻¹(BᵀV_x + ℓ_u). With Euler steps F(x, 0) = x + Δt f, B = g, ℓ_u = 0 and ℓ_uu = 2R; with others q
    pays for u within the step too. About a target, u is counted from u*, and f is f + gu*.

    Args:
        free: the step with the control that costs nothing.
    """
    B = free.by_control
    weight = free.curvature + problem.horizon.dt * multiply(B.mT, multiply(H, B))
    b = apply(B.mT, V_x) + free.slope
    if problem.controls.limited:
        return problem.controls.minimise(weight / 2, problem.cost.about_rest(weight / 2, b))
    u = -solve(weight, b[..., None])[..., 0]
    return u if problem.cost.rest is None else u + problem.cost.rest


def greedy_law(problem: Problem, expansion: Expansion) -> Callable[[int, State], Control]:
    """(n, x_n) ↦ u_n: the held control for V as one expansion has it."""

    def law(n: int, x: State) -> Control:
        H, free = expansion.hessian[n + 1], problem.response(x)
        V_x = expansion.gradient[n + 1] + apply(H, free.x - expansion.x[n + 1])
        return held_control(problem, free, V_x, H)

    return law


def at_rest(problem: Problem) -> Callable[[int, State], Control]:
    """(n, x_n) ↦ the control that costs nothing, or the one of U that is closest to it."""
    u = problem.controls.project(problem.rest)
    return lambda _, x: u.to(x).expand(*x.shape[:-1], -1)

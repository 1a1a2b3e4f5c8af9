"""The gains of one node in the backward pass: the derivative of the best control by the state, and its cost."""

import torch
from torch import Tensor

from lyapnet.base.linear_algebra import is_positive_definite, solve
from lyapnet.base.types import Control, PerState
from lyapnet.task.cost.control_costs import local_shape
from lyapnet.task.problem import Problem

ROUNDING = 1e-12  # eigenvalue of Q_uu, relative to the largest, below which it may be only a rounding error


def gain_of_node(problem: Problem, u: Control, Q_uu: Tensor, Q_ua: Tensor) -> Tensor:
    """(k, K) from Q_ua = (Q_u, Q_ux): k = argmin of ½ kᵀQ_uu k + Q_uᵀk + Δt s(u + k) over u + k ∈ U, K its derivative.

    With P the projection onto the directions in which the minimiser moves, and S the curvature of s there,
    K = −P (P(Q_uu + Δt S)P + 1 − P)⁻¹ P Q_ux. Its rows are zero for controls at a limit, or at a kink of s.

    Source: Tassa, Mansard, Todorov, "Control-limited differential dynamic programming", ICRA 2014.
    """
    if problem.has_linear_law:
        return -solve(Q_uu, Q_ua)
    Q_uu, Q_ua = Q_uu / problem.horizon.dt, Q_ua / problem.horizon.dt  # per second, as s
    to = problem.best_control(Q_uu / 2, Q_ua[..., 0] - (Q_uu @ u[..., None])[..., 0])
    k = to - u
    slope = Q_ua[..., 0] + (Q_uu @ k[..., None])[..., 0]
    P, S = local_shape(problem.cost.nonquadratic, problem.controls, to, slope)
    A = P @ (Q_uu if S is None else Q_uu + S) @ P + torch.eye(u.shape[-1]).to(P) - P
    return torch.cat([k[..., None], -torch.linalg.solve(A, P @ Q_ua[..., 1:])], -1)


def cost_beside(problem: Problem, u: Control, gain: Tensor, left: Tensor) -> Tensor:
    """The parts of W = [[2c, pᵀ], [p, H]] of a node by s(u) and by a curved border of U.

    At the minimum k the slope of Δt s along K is −(Q_u + Q_uu k), and its curvature along K is −(Q_ux + Q_uu K).

    Args:
        gain: (k, K).
        left: (Q_u + Q_uu k, Q_ux + Q_uu K).
    """
    k, K = gain[..., 0], gain[..., 1:]
    H = -K.mT @ left[..., 1:]
    return as_matrix(problem.horizon.dt * problem.cost.beside(u + k), -(K.mT @ left[..., :1])[..., 0], (H + H.mT) / 2)


def as_matrix(c: PerState, p: Tensor, H: Tensor) -> Tensor:
    """[[2c, pᵀ], [p, H]]: c + pᵀz + ½ zᵀHz as one matrix."""
    first = torch.cat([2 * c[..., None], p], -1)
    return torch.cat([first[..., None, :], torch.cat([p[..., None], H], -1)], -2)


def regularise(Q_uu: Tensor, floor: Tensor, damping: Tensor | None) -> Tensor:
    """Q_uu with eigenvalues raised to at least a floor, plus damping; non-finite entries become zero."""
    Q_uu, one = Q_uu.where(Q_uu.isfinite(), 0), torch.eye(Q_uu.shape[-1]).to(Q_uu)
    least = floor.maximum(ROUNDING * Q_uu.diagonal(0, -2, -1).sum(-1))
    if Q_uu.shape[-1] == 1:
        regularised = Q_uu.maximum(floor[..., None, None])
    elif is_positive_definite(Q_uu - one * least[..., None, None]).all():
        regularised = Q_uu
    else:
        values, vectors = torch.linalg.eigh(Q_uu)
        values = values.clamp_min(0).maximum(floor[..., None])
        values = values.maximum(ROUNDING * values[..., -1:])
        regularised = (vectors * values[..., None, :]) @ vectors.mT
    return regularised if damping is None else regularised + one * damping[..., None, None]

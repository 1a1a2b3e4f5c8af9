"""Exact solution of linear-quadratic tasks by Riccati equations in discrete and continuous time.

The small matrices are computed in float64 on the CPU, so that this reference does not share the rounding of a float32
run.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lyapnet.base.types import Control, ControlPath, PerState, State
from lyapnet.evaluation.oracles.base import Optima, Oracle, Report, silent
from lyapnet.task.cost import QuadraticCost
from lyapnet.task.horizon import Horizon
from lyapnet.task.systems import Linear

SUBSTEPS = 10_000  # largest number of restarts in one step of Δt; with 100 steps this takes a minute


@dataclass(frozen=True)
class RiccatiSolution:
    """The optimal value xᵀP_n x and the optimal control −K_n x on the nodes t_n = nΔt.

    P is (N + 1, n, n), symmetric positive semidefinite, P_N = Q_T; entry ij in cost per (unit of x_i · unit of x_j).
    K is (N, m, n) in discrete time; in continuous time (N + 1, m, n), since the law is defined at T too. Entry ij in
    unit of u_i per unit of x_j.
    """

    P: Float[Tensor, "nodes n n"]
    K: Float[Tensor, "laws m n"]

    def value(self, step: int, x: State) -> PerState:
        """xᵀP_n x, the least cost from t_n on, n = step in 0 … N; in the dtype of x."""
        P, y = self.P[step].to(x.device), x.double()
        return ((y @ P) * y).sum(-1).to(x.dtype)

    def policy(self, step: int, x: State) -> Control:
        """−K_n x, the control at t_n, n = step; in the dtype of x."""
        return (-x.double() @ self.K[step].to(x.device).mT).to(x.dtype)


class RiccatiOracle(Oracle):
    """J*(x₀) = x₀ᵀP_0x₀."""

    def __init__(self, solution: RiccatiSolution):
        self.solution = solution

    def solve(
        self, x0: State, known: ControlPath | None = None, progress: Report = silent, seconds: float = math.inf
    ) -> Optima:
        return Optima(self.solution.value(0, x0), [""] * len(x0))


def discrete_riccati(system: Linear, cost: QuadraticCost, horizon: Horizon) -> RiccatiSolution:
    """The optimum of J_N = Δt Σ_{n<N} ℓ(x_n, u_n) + φ(x_N) along x_{n+1} = Fx_n + Gu_n, F = I + ΔtA, G = ΔtB:

        K_n = (ΔtR + GᵀP_{n+1}G)⁻¹GᵀP_{n+1}F,
        P_n = Δt(Q + K_nᵀRK_n) + (F − GK_n)ᵀP_{n+1}(F − GK_n),   P_N = Q_T,

    so that J_N*(x₀) = x₀ᵀP_0x₀. This is Joseph's form of P_n, which remains positive semidefinite under rounding.

    Raises:
        ValueError: R depends on the state, or a weight does not fit the system's dimensions.

    Source: Bertsekas, Dynamic Programming and Optimal Control, vol. 1, linear-quadratic problems.
    """
    A, B, Q, R, Q_T = _matrices(system, cost)
    F, G = torch.eye(len(A)).to(A) + horizon.dt * A, horizon.dt * B
    P, K = [Q_T], []
    for _ in range(horizon.steps):
        PG = P[-1] @ G
        K.append(torch.linalg.solve(horizon.dt * R + G.mT @ PG, PG.mT @ F))
        closed = F - G @ K[-1]
        P.append(_symmetrised(horizon.dt * (Q + K[-1].mT @ R @ K[-1]) + closed.mT @ P[-1] @ closed))
    return RiccatiSolution(torch.stack(P[::-1]), torch.stack(K[::-1]))


def continuous_riccati(system: Linear, cost: QuadraticCost, horizon: Horizon) -> RiccatiSolution:
    """The optimum of J = ∫₀ᵀ ℓ dt + φ(x(T)) along ẋ = Ax + Bu, exact at the nodes:

        −Ṗ = Q + AᵀP + PA − PBR⁻¹BᵀP,   P(T) = Q_T,   K = R⁻¹BᵀP.

    (x, Px) obeys a linear equation with the Hamiltonian matrix H = [[A, −BR⁻¹Bᵀ], [−Q, −Aᵀ]], hence
    P(t − h) = YX⁻¹ with (X, Y) = exp(−hH)(I, P(t)).

    Raises:
        ValueError: R depends on the state, or a weight does not fit the system's dimensions.
        OverflowError: the equation has a mode with more than SUBSTEPS time constants in Δt.

    Source: Kenney, Leipnik, "Numerical integration of the differential matrix Riccati equation", IEEE Transactions on
    Automatic Control 1985 (the modified Davison-Maki method).
    """
    A, B, Q, R, Q_T = _matrices(system, cost)
    RinvBT = torch.linalg.solve(R, B.mT)
    H = torch.cat([torch.cat([A, -B @ RinvBT], 1), torch.cat([-Q, -A.mT], 1)])
    # Over a long h the fastest mode of exp(−hH) dominates X, and rounding loses P: keep |λ|h ≤ 1 between restarts.
    fastest = horizon.dt * float(torch.linalg.eigvals(H).abs().max())
    if not fastest <= SUBSTEPS:
        raise OverflowError(f"a mode of {fastest:.1g} time constants in a step of Δt")
    substeps = max(1, math.ceil(fastest))
    flow = torch.linalg.matrix_exp(-horizon.dt / substeps * H)
    P = [Q_T]
    for _ in range(horizon.steps):
        P.append(_flow_back(flow, P[-1], substeps))
    nodes = torch.stack(P[::-1])
    return RiccatiSolution(nodes, RinvBT @ nodes)


def _flow_back(flow: Tensor, P: Tensor, substeps: int) -> Tensor:
    """P one node earlier: (X, Y) = exp(−hH)(I, P) and P ← YX⁻¹, `substeps` times."""
    for _ in range(substeps):
        X, Y = (flow @ torch.cat([torch.eye(len(P)).to(P), P])).split(len(P))
        P = _symmetrised(torch.linalg.solve(X, Y, left=False))
    return P


def _matrices(system: Linear, cost: QuadraticCost) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """(A, B, Q, R, Q_T) in float64 on the CPU; raises ValueError if there is no Riccati equation."""
    if cost.R_constant is None:
        raise ValueError(
            "Expected a constant R, got a function R(x); give R as a matrix, as the Riccati equation has it."
        )
    got = len(cost.Q), len(cost.R_constant)
    if got != (system.n, system.m):  # a 1 × 1 R would broadcast to any m
        raise ValueError(
            f"Expected a cost of {system.n} states and {system.m} controls, got {got[0]} and {got[1]}; "
            "give Q, Q_T and R one row for each."
        )
    matrices = (system.A, system.B, cost.Q, cost.R_constant, cost.Q_T)
    A, B, Q, R, Q_T = (matrix.detach().double().cpu() for matrix in matrices)
    return A, B, Q, R, Q_T


def _symmetrised(P: Tensor) -> Tensor:
    return (P + P.mT) / 2

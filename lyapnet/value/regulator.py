"""The linear-quadratic regulator of a problem's goal, for an infinite horizon; of a family, one for each member."""

import itertools
import operator
from functools import reduce
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from lyapnet.base.linear_algebra import apply
from lyapnet.base.types import Control, Matrix, PerState, State
from lyapnet.task.cost.base import quadratic_form
from lyapnet.task.problem import Problem
from lyapnet.value.expansions import in_float64

STILL = 1e-9  # by which a mode has to decay in each step
EQUILIBRIUM = 1e-6  # largest |ẋ| at the goal under the control that costs nothing
NODES = 5  # Chebyshev nodes along each parameter of a family
MOST_NODES = 200
INTERPOLATED = 1e-2  # largest error of an interpolated gain, relative to the largest of its entries


class Gains(NamedTuple):
    """δᵀPδ, what is left to pay from x* + δ, and the law u = u* − Kδ."""

    P: Float[np.ndarray, "n n"]
    K: Float[np.ndarray, "m n"]


class Regulator(nn.Module):
    """u = u* − K(x − x*), kept to U: optimal for the problem linearised at its goal, over an infinite horizon.

    P solves the discrete algebraic Riccati equation of one step with u held; δᵀPδ, δ = x − x*, is what is left to pay.
    States that neither the rates nor q depend on, such as a cart's position, have no part in it. Of a family, P and K
    are polynomials in its parameters, through those of the members at Chebyshev nodes.

    Args:
        purpose, instead: what asks for it, and what else can be done, for messages.
        spread: where q does not see every mode that has to be stabilised, pay φ's Hessian besides q, an Nth of it in
            each of the N steps of T, as a task that weighs its end alone asks to be held there.

    Raises:
        ValueError: the goal is no equilibrium, no linear law stabilises it, or a family has too many parameters, or
            members whose gains no such polynomial fits.
    """

    problem: Problem
    basis: "_ChebyshevBasis | None"  # of a family
    P: Matrix  # of a family (nodes, n + k, n + k), coefficients of Chebyshev polynomials
    K: Float[Tensor, "m n"]  # likewise

    def __init__(
        self, problem: Problem, purpose: str = "beyond=riccati", instead: str = "take hold", spread: bool = False
    ):
        super().__init__()
        self.problem, exact = problem, in_float64(problem)
        solve = _Solver(exact, purpose, instead, spread)
        basis = _ChebyshevBasis(exact) if exact.system.constants else None
        P, K = solve(exact.goal) if basis is None else _fit(basis, exact, solve)
        self.basis = None if basis is None else basis.to(problem.goal)
        self.register_buffer("P", torch.as_tensor(P).to(problem.goal), persistent=False)
        self.register_buffer("K", torch.as_tensor(K).to(problem.goal), persistent=False)

    def forward(self, x: State) -> Control:
        offset = self.problem.cost.from_goal(x)
        if self.basis is None:
            feedback = apply(self.K, offset)
        else:
            feedback = _sum([b[..., None] * apply(K, offset) for b, K in zip(self.basis(x), self.K, strict=True)])
        return self.problem.controls.project(self.problem.rest - feedback)

    def cost(self, x: State) -> PerState:
        """What is left to pay, without limits."""
        offset = self.problem.cost.from_goal(x)
        if self.basis is None:
            return quadratic_form(self.P, offset)
        return _sum([b * quadratic_form(P, offset) for b, P in zip(self.basis(x), self.P, strict=True)])


class _Solver:
    """The gains at a goal, (n,), or at that of one member of a family, (x*(p), p)."""

    def __init__(self, exact: Problem, purpose: str, instead: str, spread: bool):
        self.exact, self.purpose, self.instead, self.spread = exact, purpose, instead, spread

    def __call__(self, goal: State) -> Gains:
        exact, u = self.exact, self.exact.rest
        if float(exact.system.dynamics(goal, u).abs().max()) > EQUILIBRIUM:
            raise ValueError(f"Expected a goal that is an equilibrium for {self.purpose}, got another; {self.instead}.")
        jacobian, hessian = torch.autograd.functional.jacobian, torch.autograd.functional.hessian
        A, B = (np.asarray(part) for part in jacobian(lambda *z: exact.step(*z)[0], (goal, u)))
        (Q, S), (_, R) = (
            [np.asarray(part) / 2 for part in row] for row in hessian(lambda *z: exact.step(*z)[1], (goal, u))
        )
        of_end = np.asarray(hessian(exact.cost.terminal, goal)) / 2 / exact.horizon.steps
        moves = np.ones(len(A), dtype=bool)
        moves[list(exact.system.constants)] = False
        reason: Exception | None = None
        for weights in (Q, Q + of_end) if self.spread else (Q,):
            try:
                return _stabilising(A, B, weights, S, R, moves)
            except (ValueError, np.linalg.LinAlgError) as error:
                reason = error
        raise ValueError(
            f"Expected a goal that a linear law stabilises, and a cost q that sees every mode which does not "
            f"decay, for {self.purpose}, got others ({reason}); give Q more weights, or {self.instead}."
        ) from reason


def _stabilising(A: np.ndarray, B: np.ndarray, Q: np.ndarray, S: np.ndarray, R: np.ndarray, moves: np.ndarray) -> Gains:
    """P and K of a step x' = Ax + Bu that costs xᵀQx + 2xᵀSu + uᵀRu, in the states that move.

    Raises:
        ValueError, LinAlgError: there is none under which all states that count decay.
    """
    counts = moves & ((np.eye(len(A)) != A)[moves].any(0) | Q.any(0) | S.any(1))
    if not counts.any():
        raise ValueError("no state has a part in it")
    A, B, Q, S = A[counts][:, counts], B[counts], Q[counts][:, counts], S[counts]
    from scipy.linalg import solve_discrete_are  # loaded where it is asked for: it takes a tenth of a second

    P = solve_discrete_are(A, B, Q, R, s=S)
    K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A + S.T)
    slowest = float(np.abs(np.linalg.eigvals(A - B @ K)).max())
    if slowest >= 1 - STILL:
        raise ValueError(f"a regulator with a factor of {slowest:.9g} in each step")
    among_all = np.eye(len(counts))[counts]
    return Gains(among_all.T @ P @ among_all, K @ among_all)


class _ChebyshevBasis(nn.Module):
    """Products of Chebyshev polynomials of the parameters of a family, each scaled to its range, and kept within it."""

    center: Float[Tensor, " k"]
    half_widths: Float[Tensor, " k"]

    def __init__(self, exact: Problem):
        super().__init__()
        box, constants = exact.initial_states, list(exact.system.constants)
        half = box.widths[constants] / 2
        self.constants: list[int] = constants
        self.counts: list[int] = [NODES if float(h) > 0 else 1 for h in half]
        like = exact.goal
        self.register_buffer("center", box.center[constants].to(like), persistent=False)
        self.register_buffer("half_widths", torch.where(half > 0, half, 1.0).to(like), persistent=False)

    def forward(self, x: State) -> list[PerState]:
        """Each of the products at the parameters of states (*batch, n + k)."""
        axes = []
        for k, (i, count) in enumerate(zip(self.constants, self.counts, strict=True)):
            s = ((x[..., i] - self.center[k]) / self.half_widths[k]).clamp(-1.0, 1.0)
            terms = [torch.ones_like(s), s]
            while len(terms) < count:
                terms.append(2 * s * terms[-1] - terms[-2])
            axes.append(terms[:count])
        return [reduce(operator.mul, factors) for factors in itertools.product(*axes)]

    def nodes(self) -> Float[Tensor, "nodes k"]:
        """The parameters at which the products are fitted, as many as there are products."""
        angles = [(torch.arange(count, dtype=torch.float64) + 0.5) * torch.pi / count for count in self.counts]
        scaled = torch.cartesian_prod(*(a.cos() for a in angles)).reshape(-1, len(angles))
        return self.center + self.half_widths * scaled


def _fit(basis: _ChebyshevBasis, exact: Problem, solve: _Solver) -> Gains:
    """The coefficients of the gains of a family: exact at the nodes, and held against members between them.

    Raises:
        ValueError: too many parameters, or the gains of members between the nodes are others.
    """
    nodes = basis.nodes()
    if len(nodes) > MOST_NODES:
        raise ValueError(
            f"Expected a family of three parameters at most for {solve.purpose}, got {len(basis.constants)}; take "
            f"one member, or {solve.instead}."
        )
    between = exact.initial_states.sample(8, torch.Generator().manual_seed(0))[:, basis.constants]
    at_nodes, at_others = ([solve(_goal_of(exact, p)) for p in some] for some in (nodes, between))
    matrix, others = (
        np.asarray(torch.stack(basis(torch.stack([_goal_of(exact, p) for p in some])), -1)) for some in (nodes, between)
    )
    coefficients = []
    for known, expected in zip(zip(*at_nodes, strict=True), zip(*at_others, strict=True), strict=True):
        found = np.tensordot(np.linalg.inv(matrix), np.stack(known), 1)
        error = np.abs(np.tensordot(others, found, 1) - np.stack(expected)).max() / np.abs(expected).max()
        if error > INTERPOLATED:
            raise ValueError(
                f"Expected a family whose gains are smooth in its parameters for {solve.purpose}, got an error of "
                f"{error:.1%} between {len(nodes)} members; narrow the family, take one member, or {solve.instead}."
            )
        coefficients.append(found)
    return Gains(*coefficients)


def _goal_of(exact: Problem, p: Float[Tensor, " k"]) -> State:
    """(x*(p), p): where from_goal vanishes for the parameters p of a family."""
    constants = list(exact.system.constants)
    state = exact.goal.clone()
    state[constants] = p
    return state - exact.cost.from_goal(state)


def _sum(terms: list[Tensor]) -> Tensor:
    return reduce(operator.add, terms)

"""The infinite-horizon linear-quadratic regulator at a problem's goal; for a family, one for each member."""

import operator
from functools import reduce
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from lyapnet.base.interpolation import ChebyshevProducts, Interpolant, fewest_products
from lyapnet.base.linear_algebra import apply
from lyapnet.base.types import Control, Matrix, PerState, State
from lyapnet.task.cost.base import quadratic_form
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box
from lyapnet.value.expansions import in_float64

DECAY_MARGIN = 1e-9  # smallest relative decay of each mode in a step
EQUILIBRIUM_TOLERANCE = 1e-6  # largest |ẋ| at the goal under the control at rest
NODES = 5  # Chebyshev nodes along each parameter of a family
MOST_NODES = 200  # largest number of nodes for all parameters together
INTERPOLATION_TOLERANCE = 1e-2  # largest error of an interpolated gain, relative to its largest entry
ROOT_TOLERANCE = 1e-4  # largest error of an interpolated cost δᵀP(p)δ, relative to it in any direction δ
ROOT_NODES = 400  # largest number of members for the interpolation of the root
TESTED_MEMBERS = 32  # random members at which the interpolant is checked, besides those at the ends of the ranges
FLAT = 1e-9  # eigenvalues that are added to P(p), relative to the largest, so that its root is unique


class Gains(NamedTuple):
    """The cost to go δᵀPδ from x* + δ, and the law u = u* − Kδ."""

    P: Float[np.ndarray, "n n"]
    K: Float[np.ndarray, "m n"]


class Regulator(nn.Module):
    """u = u* − K(x − x*), projected onto U: optimal for the problem linearised at its goal, over an infinite horizon.

    P solves the discrete algebraic Riccati equation of one step with u held; δᵀPδ, δ = x − x*, is the cost to go.
    States on which neither the rates nor q depend, such as a cart's position, are left out. For a family, P and K are
    polynomials in its parameters that interpolate the members at Chebyshev nodes.

    Args:
        purpose, instead: the user of the regulator, and the alternative, for messages.
        spread: whether to add an Nth of φ's Hessian to q in each step if q does not detect every mode that has to be
            stabilised; for tasks that weigh only their terminal state.

    Raises:
        ValueError: the goal is no equilibrium, no linear law stabilises it, or a family has too many parameters, or
            gains that no such polynomial fits.
    """

    problem: Problem
    basis: ChebyshevProducts | None  # for a family
    P: Matrix  # for a family the coefficients of Chebyshev polynomials, (nodes, n + k, n + k)
    K: Float[Tensor, "m n"]  # likewise

    def __init__(
        self, problem: Problem, purpose: str = "beyond=riccati", instead: str = "take hold", spread: bool = False
    ):
        super().__init__()
        self.problem, exact = problem, in_float64(problem)
        solve = _Solver(exact, purpose, instead, spread)
        basis = _basis_of(exact) if exact.system.constants else None
        P, K = solve(exact.goal) if basis is None else _fit(basis, exact, solve)
        self.basis = None if basis is None else basis.to(problem.goal)
        self.register_buffer("P", torch.as_tensor(P).to(problem.goal), persistent=False)
        self.register_buffer("K", torch.as_tensor(K).to(problem.goal), persistent=False)

    def forward(self, x: State) -> Control:
        offset = self.problem.cost.from_goal(x)
        if self.basis is None:
            feedback = apply(self.K, offset)
        else:
            products = self.basis(self._parameters_of(x))
            feedback = _sum([b[..., None] * apply(K, offset) for b, K in zip(products.unbind(-1), self.K, strict=True)])
        # the law is relative to the control at the goal, which may differ from u* at x
        return self.problem.controls.project(self.problem.rest_at(x - offset) - feedback)

    def cost(self, x: State) -> PerState:
        """The cost to go without control limits."""
        offset = self.problem.cost.from_goal(x)
        if self.basis is None:
            return quadratic_form(self.P, offset)
        products = self.basis(self._parameters_of(x))
        return _sum([b * quadratic_form(P, offset) for b, P in zip(products.unbind(-1), self.P, strict=True)])

    def _parameters_of(self, x: State) -> Tensor:
        return x[..., list(self.problem.system.constants)]


class _Solver:
    """Computes the gains at a goal (n,), or at the goal (x*(p), p) of a member of a family."""

    def __init__(self, exact: Problem, purpose: str, instead: str, spread: bool):
        self.exact, self.purpose, self.instead, self.spread = exact, purpose, instead, spread

    def __call__(self, goal: State) -> Gains:
        exact, u = self.exact, self.exact.rest_at(goal)
        if exact.cost.nonquadratic is not None:
            raise ValueError(f"Expected controls that cost uᵀRu alone for {self.purpose}, got more; {self.instead}.")
        if float(exact.system.dynamics(goal, u).abs().max()) > EQUILIBRIUM_TOLERANCE:
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
                return _stabilising_gains(A, B, weights, S, R, moves)
            except (ValueError, np.linalg.LinAlgError) as error:
                reason = error
        raise ValueError(
            f"Expected a goal that a linear law stabilises, and a cost q that depends on every mode which does not "
            f"decay, for {self.purpose}, got others ({reason}); give Q more weights, or {self.instead}."
        ) from reason


def _stabilising_gains(
    A: np.ndarray, B: np.ndarray, Q: np.ndarray, S: np.ndarray, R: np.ndarray, moves: np.ndarray
) -> Gains:
    """P and K of a step x' = Ax + Bu with cost xᵀQx + 2xᵀSu + uᵀRu, in the states that move.

    Raises:
        ValueError, LinAlgError: no gains stabilise all relevant states.
    """
    relevant = moves & ((np.eye(len(A)) != A)[moves].any(0) | Q.any(0) | S.any(1))
    if not relevant.any():
        raise ValueError("no state is involved")
    A, B, Q, S = A[relevant][:, relevant], B[relevant], Q[relevant][:, relevant], S[relevant]
    from scipy.linalg import solve_discrete_are  # imported here because it takes 0.1 s

    P = solve_discrete_are(A, B, Q, R, s=S)
    K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A + S.T)
    slowest = float(np.abs(np.linalg.eigvals(A - B @ K)).max())
    if slowest >= 1 - DECAY_MARGIN:
        raise ValueError(f"a regulator with a factor of {slowest:.9g} in each step")
    embedding = np.eye(len(relevant))[relevant]
    return Gains(embedding.T @ P @ embedding, K @ embedding)


def _basis_of(exact: Problem) -> ChebyshevProducts:
    """Chebyshev polynomials of the parameters of a family."""
    box, constants = exact.initial_states, list(exact.system.constants)
    low, high = box.lower[constants], box.upper[constants]
    return ChebyshevProducts(low, high, [NODES if w > 0 else 1 for w in (high - low).tolist()])


def _fit(basis: ChebyshevProducts, exact: Problem, solve: _Solver) -> Gains:
    """Interpolate the gains of a family at the nodes, and check the result at random members between them.

    Raises:
        ValueError: too many parameters, or a large error between the nodes.
    """
    nodes = basis.nodes()
    if len(nodes) > MOST_NODES:
        raise ValueError(
            f"Expected a family of three parameters at most for {solve.purpose}, got {len(basis.counts)}; take "
            f"one member, or {solve.instead}."
        )
    between = exact.initial_states.sample(8, torch.Generator().manual_seed(0))[:, list(exact.system.constants)]
    at_nodes, at_others = ([solve(goal_of_member(exact, p)) for p in some] for some in (nodes, between))
    others = np.asarray(basis(between))
    coefficients = []
    for known, expected in zip(zip(*at_nodes, strict=True), zip(*at_others, strict=True), strict=True):
        found = basis.coefficients(torch.from_numpy(np.stack(known))).numpy()
        error = np.abs(np.tensordot(others, found, 1) - np.stack(expected)).max() / np.abs(expected).max()
        if error > INTERPOLATION_TOLERANCE:
            raise ValueError(
                f"Expected a family whose gains are smooth in its parameters for {solve.purpose}, got an error of "
                f"{error:.1%} between {len(nodes)} members; narrow the family, take one member, or {solve.instead}."
            )
        coefficients.append(found)
    return Gains(*coefficients)


def root_of_members(problem: Problem, purpose: str, instead: str) -> Interpolant:
    """p ↦ L(p) (n, n), lower triangular, with δᵀP(p)δ = ‖L(p)ᵀδ‖² the cost to go of each member's regulator.

    n is the number of states without the parameters. L interpolates the Cholesky factors of members by polynomials of
    the least degree with an error ε of at most ROOT_TOLERANCE: (1 − ε)P ≤ LLᵀ ≤ (1 + ε)P at members between the nodes.
    LLᵀ is positive semidefinite everywhere. States that cost nothing have rows of zeros.

    Raises:
        ValueError: a member has no regulator, or no such polynomials fit.
    """
    exact = in_float64(problem)
    solve, constants = _Solver(exact, purpose, instead, spread=False), list(exact.system.constants)
    n, box = exact.system.n - len(constants), exact.initial_states
    ranges = Box(box.lower[constants], box.upper[constants])
    solutions = dict[tuple[float, ...], Tensor]()

    def P_of(p: Tensor) -> Matrix:
        key = tuple(p.tolist())
        if key not in solutions:
            solutions[key] = torch.as_tensor(solve(goal_of_member(exact, p)).P)[:n, :n]
        return solutions[key]

    tested = torch.cat([ranges.corners(), ranges.sample(TESTED_MEMBERS, torch.Generator().manual_seed(0))])
    costs = torch.stack([P_of(p) for p in tested]).any(0).any(-1)

    def factor(p: Tensor) -> Matrix:
        P = P_of(p)[costs][:, costs]
        return torch.linalg.cholesky(P + FLAT * torch.linalg.eigvalsh(P)[-1] * torch.eye(len(P)).to(P))

    def through(basis: ChebyshevProducts) -> Interpolant:
        places = torch.eye(n, dtype=torch.float64)[costs]
        return Interpolant(basis, torch.stack([places.mT @ factor(p) @ places for p in basis.nodes()]))

    def is_accurate(basis: ChebyshevProducts, between: Tensor) -> bool:
        found = through(basis)(between)[:, costs][:, :, costs]
        share = torch.linalg.solve_triangular(torch.stack([factor(p) for p in between]), found, upper=False)
        error = torch.linalg.matrix_norm(share @ share.mT - torch.eye(share.shape[-1]).to(share), 2)
        return bool((error <= ROOT_TOLERANCE).all())

    basis = fewest_products(ranges.lower, ranges.upper, is_accurate, tested, ROOT_NODES)
    if basis is None:
        raise ValueError(
            f"Expected a family whose regulators are smooth in its parameters for {purpose}, got some that polynomials "
            f"through {ROOT_NODES} members miss by more than {ROOT_TOLERANCE:.0e}; narrow the family, take one member, "
            f"or {instead}."
        )
    return through(basis)


def goal_of_member(exact: Problem, p: Float[Tensor, " k"]) -> State:
    """(x*(p), p), the goal of a family's member with parameters p, where from_goal vanishes."""
    constants = list(exact.system.constants)
    state = exact.goal.clone()
    state[constants] = p
    return state - exact.cost.from_goal(state)


def _sum(terms: list[Tensor]) -> Tensor:
    return reduce(operator.add, terms)

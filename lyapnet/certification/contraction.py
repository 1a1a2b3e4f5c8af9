"""Where closed loops at one instant's law converge exponentially: a box on which the linearised law contracts."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np
import torch
from scipy.linalg import solve_continuous_lyapunov
from torch import Tensor

from lyapnet.calculus import gradients
from lyapnet.certification.branch_and_bound import Budget, minimum
from lyapnet.certification.preconditions import at_time, over_time
from lyapnet.graphs.bounds import BoundedFunction
from lyapnet.graphs.branches import decisions
from lyapnet.rollout.closed_loop import ClosedLoop
from lyapnet.sets import Box
from lyapnet.types import PerState, State, Time

BOXES, SAMPLES = 2000, 200  # that are bounded, and states that are tried, for one size of the box
GROWTH, SIZES = 1.6, 20  # sizes of the box that are tried, as long as they do, up to half of D
NEAR = 1e-6  # how far YZ may be from 1
LEAST = 0.2  # of the linearised law's own rate, that is enough


@dataclass(frozen=True)
class Contraction:
    """With F(x) = f(x) + g(x)u(0, x), continuous on a box B around x*, J its Jacobian and P = YᵀY:

        ½(P J(x) + J(x)ᵀP) ≤ −κP   almost everywhere on B.

    By the mean value theorem on the segment between them, ‖Y(x − x')‖ falls at the rate κ for any two closed loops in
    B. Those of a set that none leaves therefore converge to one equilibrium x_e in B, and ‖Y(x_e − x*)‖ ≤ ‖Y F(x*)‖/κ.

    Source: Lohmiller, Slotine, "On contraction analysis for non-linear systems", Automatica 1998.
    """

    box: Box
    rate: float  # κ in 1/s
    coordinates: Tensor  # Y, (k, k), of the states that the law depends on
    offset: float  # ‖x_e − x*‖, at most: rounding, where x* is an equilibrium
    fingerprint: str  # of F and its Jacobian as they were traced


class _Law:
    """F(0, x), as its own operations at one x, so that its derivative is theirs; as it is on batches."""

    def __init__(self, loop: ClosedLoop, states: Box):
        self.loop, self.domain = loop, over_time(states, 0.0)
        self.bounded = BoundedFunction(lambda t, x: (self._declared(t, x),), self.domain)
        decided = decisions(self.bounded.graph)
        self.decisions = None if decided is None else BoundedFunction(decided, self.domain)

    def is_continuous_on(self, box: Box) -> bool:
        """Whether every truth and every sign in F is decided in a box: all else is continuous."""
        if self.decisions is None:
            return True
        decided = self.decisions.bounds(*at_time(0.0, box.lower, box.upper))
        return all(bool((high - low < 0.5).all()) for low, high in decided)

    def _declared(self, t: Time, x: State) -> State:
        return self.loop.system.dynamics(x, self.loop.policy(t, x))

    def __call__(self, t: Time, x: State) -> State:
        return self.bounded.graph(t, x)[0] if x.ndim == 1 else self._declared(t, x)

    def jacobian(self, t: Time, x: State, seen: Sequence[int]) -> Tensor:
        """∂F_i/∂x_j for the states i, j that are seen, (*batch, k, k)."""
        rows = [gradients(lambda t, x, i=i: self(t, x)[..., i], t, x)[1][..., list(seen)] for i in seen]
        return torch.stack(rows, -2)


def contraction_around(
    loop: ClosedLoop, goal: State, states: Box, seen: Sequence[int], seconds: float = 60.0
) -> tuple[Contraction | None, float]:
    """(contraction, slowest): on the largest box around the goal on which the law contracts, of sizes that grow in the
    shape of D; and the largest real part among the eigenvalues of the linearised law, in 1/s.

    Args:
        states: D; no box is larger than half of it.
        seen: the indices of the states that the law depends on.
        seconds: when to stop.

    Returns:
        None for the contraction where the linearised law is not stable, or contracts on no box that was tried.
    """
    law, reach = _Law(loop, states), torch.minimum(goal - states.lower, states.upper - goal)
    A = law.jacobian(goal.new_zeros(()), goal, seen).detach().numpy()
    slowest = float(np.linalg.eigvals(A).real.max()) if np.isfinite(A).all() else math.nan
    own = -slowest / 2
    found = _coordinates(A, reach[list(seen)].numpy(), own) if own > 0 else None
    if found is None:
        return None, slowest
    Y, inverse = (torch.from_numpy(each) for each in found)

    def contracted(t: Time, x: State) -> PerState:
        """A lower bound of the least eigenvalue of −½ZᵀPJZ and its transpose, by Gershgorin's discs; Z is near Y⁻¹."""
        M = inverse.mT @ (Y.mT @ (Y @ (law.jacobian(t, x, seen) @ inverse)))
        S = -(M + M.mT) / 2
        rows = range(len(seen))
        discs = [S[..., i, i] - sum((S[..., i, j].abs() for j in rows if j != i), 0 * S[..., i, i]) for i in rows]
        return reduce(torch.minimum, discs)

    counts, found = torch.isin(torch.arange(len(goal)), torch.tensor(list(seen))), None
    bounded = BoundedFunction(lambda t, x: (contracted(t, x),) * 2, law.domain)
    budget = Budget(seconds)
    for k in range(SIZES):
        radii = torch.where(counts, reach / 2 * GROWTH ** (k + 1 - SIZES), 0.0)
        box = Box(goal - radii, goal + radii)
        x = torch.cat([box.sample(SAMPLES, torch.Generator().manual_seed(0)), box.corners()])
        with torch.no_grad():
            hopeless = bool((contracted(x.new_zeros(()), x) < LEAST * own).any())
        if hopeless or not budget.left or not law.is_continuous_on(box):
            break
        tried = Budget(budget.left, boxes=BOXES)
        rate = minimum(contracted, *at_time(0.0, box.lower, box.upper), tried, enough=LEAST * own, bounded=bounded)
        if rate < LEAST * own * (1 - 1e-6):
            break
        rate /= 1 + NEAR  # ZᵀPZ is 1 but for as much
        offset = min(_offset(law, goal, seen, Y, rate), float(torch.linalg.vector_norm(radii)))  # it lies in B
        found = Contraction(box, rate, Y, offset, bounded.fingerprint)
    return found, slowest


def _coordinates(A: np.ndarray, reach: np.ndarray, own: float) -> tuple[np.ndarray, np.ndarray] | None:
    """(Y, Z ≈ Y⁻¹) with ½(M + Mᵀ) diagonal and at most −own for M = Y A Z, where A's eigenvalues have less than that.

    None where rounding leaves none of it.
    """
    scaled, eye = A * reach / reach[:, None], np.eye(len(A))
    try:
        P = solve_continuous_lyapunov((scaled + own * eye).T, -eye)
        L = np.linalg.cholesky((P + P.T) / 2)
        M = L.T @ scaled @ np.linalg.inv(L.T)
        _, turn = np.linalg.eigh((M + M.T) / 2)
        Y = turn.T @ L.T / reach
        Z = np.linalg.inv(Y)
    except np.linalg.LinAlgError:
        return None
    return (Y, Z) if np.linalg.norm(Y @ Z - eye) < NEAR / 10 else None


def _offset(law: _Law, goal: State, seen: Sequence[int], Y: Tensor, rate: float) -> float:
    """‖Y F(x*)‖ / (κ σ), with the bounds of F(x*) and the least singular value σ of Y."""
    ((low, high),) = law.bounded.bounds(*at_time(0.0, goal, goal))
    size = torch.maximum(low.abs(), high.abs())[0, list(seen)]
    return float(torch.linalg.vector_norm(Y.abs() @ size) / (rate * torch.linalg.matrix_norm(Y, -2)))

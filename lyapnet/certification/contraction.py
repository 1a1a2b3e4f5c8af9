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


class _Coordinates:
    """Coordinates Y in which a law is asked to contract at a rate, and bounds of the rate at which it does.

    Raises:
        LinAlgError: as _inverse.
    """

    def __init__(self, law: _Law, goal: State, seen: Sequence[int], Y: Tensor, least: float):
        self.law, self.goal, self.seen, self.Y, self.least = law, goal, seen, Y, least
        self.Z = _inverse(Y, len(seen))
        self.bounded = BoundedFunction(lambda t, x: (self.rate(t, x),) * 2, law.domain)

    def rate(self, t: Time, x: State) -> PerState:
        """A lower bound of the least eigenvalue of −½ZᵀPJZ and its transpose, by Gershgorin's discs; Z is near Y⁻¹."""
        M = self.Z.mT @ (self.Y.mT @ (self.Y @ (self.law.jacobian(t, x, self.seen) @ self.Z)))
        S, rows = -(M + M.mT) / 2, range(len(self.seen))
        discs = [S[..., i, i] - sum((S[..., i, j].abs() for j in rows if j != i), 0 * S[..., i, i]) for i in rows]
        return reduce(torch.minimum, discs)

    def on(self, box: Box, seconds: float) -> Contraction | None:
        """The contraction on a box around the goal; None where it is not seen within the time."""
        x = torch.cat([box.sample(SAMPLES, torch.Generator().manual_seed(0)), box.corners()])
        with torch.no_grad():
            hopeless = bool((self.rate(x.new_zeros(()), x) < self.least).any())
        if hopeless or not seconds or not self.law.is_continuous_on(box):
            return None
        ends, tried = at_time(0.0, box.lower, box.upper), Budget(seconds, boxes=BOXES)
        rate = minimum(self.rate, *ends, tried, enough=self.least, bounded=self.bounded)
        if not rate >= self.least * (1 - 1e-6):
            return None
        rate /= 1 + NEAR  # ZᵀPZ is 1 but for as much
        corner = torch.maximum(box.upper - self.goal, self.goal - box.lower)  # the equilibrium lies in B
        offset = min(_offset(self.law, self.goal, self.seen, self.Y, rate), float(torch.linalg.vector_norm(corner)))
        return Contraction(box, rate, self.Y, offset, self.bounded.fingerprint)


def contraction_around(
    loop: ClosedLoop,
    goal: State,
    states: Box,
    seen: Sequence[int],
    seconds: float = 60.0,
    proposed: tuple[Box, Tensor] | None = None,
) -> tuple[Contraction | None, float]:
    """(contraction, slowest): on the largest box around the goal on which the law contracts, of sizes that grow in the
    shape of D; and the largest real part among the eigenvalues of the linearised law, in 1/s.

    Args:
        states: D; no box is larger than half of it.
        seen: the indices of the states that the law depends on.
        seconds: when to stop.
        proposed: the (B, Y) that alone are tried; nothing of them is believed.

    Returns:
        None for the contraction where the linearised law is not stable, or contracts on no box that was tried.
    """
    law, reach, budget = _Law(loop, states), torch.minimum(goal - states.lower, states.upper - goal), Budget(seconds)
    A = law.jacobian(goal.new_zeros(()), goal, seen).detach().numpy()
    slowest = float(np.linalg.eigvals(A).real.max()) if np.isfinite(A).all() else math.nan
    own, found = -slowest / 2, None
    if not own > 0:
        return None, slowest
    try:
        Y = _coordinates(A, reach[list(seen)].numpy(), own) if proposed is None else proposed[1]
        coordinates = _Coordinates(law, goal, seen, Y, LEAST * own)
    except np.linalg.LinAlgError:
        return None, slowest
    radii = reach.where(torch.isin(torch.arange(len(goal)), torch.tensor(list(seen))), 0.0) / 2
    if proposed is not None:
        box = proposed[0]
        fits = _is_around(box, goal, states, radii * GROWTH**-SIZES)
        return coordinates.on(box, budget.left) if fits else None, slowest
    for k in range(SIZES):
        size = radii * GROWTH ** (k + 1 - SIZES)
        larger = coordinates.on(Box(goal - size, goal + size), budget.left)
        if larger is None:
            break
        found = larger
    return found, slowest


def _is_around(box: Box, goal: State, states: Box, least: State) -> bool:
    """Whether a box lies in D and reaches at least so far from the goal on each side, and nowhere where that is 0."""
    if box.lower.shape != goal.shape:
        return False
    within, room = (states.lower <= box.lower) & (box.upper <= states.upper), (goal - box.lower, box.upper - goal)
    return bool(torch.where(least > 0, within & (torch.minimum(*room) >= least), (room[0] == 0) & (room[1] == 0)).all())


def _coordinates(A: np.ndarray, reach: np.ndarray, own: float) -> Tensor:
    """Y with ½(M + Mᵀ) diagonal and at most −own for M = Y A Y⁻¹, where A's eigenvalues have less than that.

    Raises:
        LinAlgError: rounding leaves none of it.
    """
    scaled, eye = A * reach / reach[:, None], np.eye(len(A))
    P = solve_continuous_lyapunov((scaled + own * eye).T, -eye)
    L = np.linalg.cholesky((P + P.T) / 2)
    M = L.T @ scaled @ np.linalg.inv(L.T)
    _, turn = np.linalg.eigh((M + M.T) / 2)
    return torch.from_numpy(turn.T @ L.T / reach)


def _inverse(Y: Tensor, k: int) -> Tensor:
    """Z with ‖YZ − 1‖ < NEAR/10, whatever Y is: rounding of the product is counted.

    Raises:
        LinAlgError: there is none.
    """
    if Y.shape != (k, k) or not bool(Y.isfinite().all()):
        raise np.linalg.LinAlgError("Expected coordinates of the states, got others.")
    Z = torch.from_numpy(np.linalg.inv(Y.numpy()))
    rounding = (k + 2) * torch.finfo(Z.dtype).eps * Y.abs() @ Z.abs()
    if not float(torch.linalg.matrix_norm((Y @ Z - torch.eye(k, dtype=Z.dtype)).abs() + rounding)) < NEAR / 10:
        raise np.linalg.LinAlgError("Expected coordinates that can be inverted, got others.")
    return Z


def _offset(law: _Law, goal: State, seen: Sequence[int], Y: Tensor, rate: float) -> float:
    """‖Y F(x*)‖ / (κ σ), with the bounds of F(x*) and the least singular value σ of Y."""
    ((low, high),) = law.bounded.bounds(*at_time(0.0, goal, goal))
    size = torch.maximum(low.abs(), high.abs())[0, list(seen)]
    return float(torch.linalg.vector_norm(Y.abs() @ size) / (rate * torch.linalg.matrix_norm(Y, -2)))

"""Finds a box around the goal on which the closed loop of u(0, x) contracts, so that trajectories converge."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from operator import itemgetter

import numpy as np
import torch
from scipy.linalg import solve_continuous_lyapunov, solve_discrete_lyapunov
from torch import Tensor

from lyapnet.base.types import Control, PerState, State, Time
from lyapnet.claims.preconditions import append_constants, at_time, first_states, over_time
from lyapnet.loop.rollout.closed_loop import ClosedLoop
from lyapnet.prover.bounds import BoundedFunction
from lyapnet.prover.boxes import divide_box
from lyapnet.prover.branch_and_bound import Budget, minimum
from lyapnet.prover.branches import decisions
from lyapnet.prover.rounding import rounding
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box
from lyapnet.value.calculus import gradients

BOXES, SAMPLES = 2000, 200  # for each size of B: largest number of bounded boxes, and of states that are tested first
GROWTH, SIZES = 1.6, 20  # ratio of two neighbouring sizes of B, and their number; the largest is half of D
NEAR = 1e-6  # bound of ‖YZ − 1‖ for a computed inverse Z; it enters the bounds as a factor 1 + NEAR
LEAST_SHARE_OF_RATE = 0.2  # required rate / rate of the linearised law; half of the rate at the goal if that is less
CORNERS = 6  # largest number of axes of P at whose corners the law is linearised
MOST_BALLS, NEXT_BALL = 10, 0.9  # largest number of nested balls, and ratio of radii below which a next one is tried
PIECES = 256  # number of boxes, about, into which the box around a ball is cut
SMALLEST_BALL = 1e-12  # radius below which no further ball is tried


@dataclass(frozen=True)
class Contraction:
    """F(x) = f(x) + g(x)u(0, x) is continuous on a box B around x*, and with its Jacobian J and P = YᵀY

        ½(P J(x) + J(x)ᵀP) ≤ −κP   almost everywhere on B.

    By the mean value theorem on the segment between two closed loops x and x' in B, ‖Y(x − x')‖ falls at the rate κ.
    So all closed loops in a subset of B that none of them leaves converge to one equilibrium x_e in B, and
    ‖Y(x_e − x*)‖ ≤ ‖Y F(x*)‖/κ.

    For steps x⁺ = x + Δt F(x), F is the mean rate of a step, and

        ½(P J + JᵀP) + ½Δt JᵀPJ ≤ −κP,

    so that ‖Y(x − x')‖ falls by the factor 1 − κΔt in each step: with M = YJY⁻¹, ‖1 + ΔtM‖² ≤ 1 − 2κΔt ≤ (1 − κΔt)².

    For several plants ẋ = F(x; p), the inequality holds for every p with the same Y. Each plant has its own equilibrium
    x_e(p), and the bound of ‖x_e − x*‖ uses the largest ‖Y F(x*; p)‖.

    Source: Lohmiller, Slotine, "On contraction analysis for non-linear systems", Automatica 1998.
    """

    box: Box  # B, without the axes of p
    rate: float  # κ in 1/s
    coordinates: Tensor  # Y, (k, k), of the states that the law depends on
    offset: float  # an upper bound of ‖x_e − x*‖; of the size of rounding if x* is an equilibrium
    fingerprint: str  # of the traced F and its Jacobian


def rate_of(loop: ClosedLoop, steps: Problem | None, x: State, u: Control) -> State:
    """f + gu, or the mean of ẋ over one step with u held."""
    return loop.system.dynamics(x, u) if steps is None else steps.smooth_rates(x, u)[0]


class _Law:
    """F(x) in real arithmetic: for one x its traced operations, which can be differentiated; for a batch its code.

    Args:
        steps: a problem; F is then the mean rate over one of its steps. None: F = f + gu.
    """

    def __init__(self, loop: ClosedLoop, states: Box, steps: Problem | None):
        self.loop, self.domain, self.constants = loop, over_time(states, 0.0), loop.system.constants
        self.steps, self.dt = steps, 0.0 if steps is None else steps.horizon.dt
        self.bounded = BoundedFunction(lambda t, x: (self._slope(t, x),), self.domain, exact=True)
        branches = decisions(self.bounded.graph)
        self.decisions = None if branches is None else BoundedFunction(branches, self.domain)

    def is_continuous_on(self, box: Box) -> bool:
        """Whether F is continuous on a box: each comparison and sign in it is constant, the rest is continuous."""
        if self.decisions is None:
            return True
        bounds = self.decisions.bounds(*at_time(0.0, box.lower, box.upper))
        return all(bool((high - low < 0.5).all()) for low, high in bounds)

    def _slope(self, t: Time, x: State) -> State:
        return rate_of(self.loop, self.steps, x, self.loop.policy(t, x))

    def __call__(self, t: Time, x: State) -> State:
        return self.bounded.graph(t, x)[0] if x.ndim == 1 else self._slope(t, x)

    def jacobian(self, t: Time, x: State, seen: Sequence[int]) -> Tensor:
        """∂F_i/∂x_j for i, j in seen, (*batch, k, k)."""
        rows = [gradients(lambda t, x, i=i: self(t, x)[..., i], t, x)[1][..., list(seen)] for i in seen]
        return torch.stack(rows, -2)

    def linearised(self, goal: State, states: Box, seen: Sequence[int]) -> list[np.ndarray]:
        """The Jacobian at the goal; for several plants, in the middle of P and at its corners."""
        n = len(goal) - len(self.constants)
        corners = append_constants(Box(goal[:n], goal[:n]), states).corners(CORNERS)
        at = [goal] if not self.constants else [goal, *corners]
        return [self.jacobian(goal.new_zeros(()), z, seen).detach().numpy() for z in at]


class _Coordinates:
    """Coordinates Y, and bounds of the rate at which a law contracts in them; a rate of `least` is required.

    Raises:
        LinAlgError: as _inverse.
    """

    def __init__(self, law: _Law, goal: State, states: Box, seen: Sequence[int], Y: Tensor, least: float):
        self.law, self.goal, self.states, self.seen, self.Y, self.least = law, goal, states, seen, Y, least
        self.Z = _inverse(Y, len(seen))
        self.bounded = BoundedFunction(lambda t, x: (self.rate(t, x),) * 2, law.domain)

    def rate(self, t: Time, x: State) -> PerState:
        """A lower bound of the least eigenvalue of S = −½Zᵀ(PJ + JᵀP + ΔtJᵀPJ)Z, where Z ≈ Y⁻¹.

        It uses Gershgorin's discs. For several plants, as Y cannot make every S diagonal, it also uses Brauer's ovals,
        which are tighter.
        """
        N = self.Y @ (self.law.jacobian(t, x, self.seen) @ self.Z)
        M, rows = self.Z.mT @ (self.Y.mT @ N), range(len(self.seen))
        S = -(M + M.mT) / 2
        if self.law.dt:
            S = S - self.law.dt / 2 * N.mT @ N
        radii = [sum((S[..., i, j].abs() for j in rows if j != i), 0 * S[..., i, i]) for i in rows]
        discs = reduce(torch.minimum, [S[..., i, i] - radii[i] for i in rows])
        if len(rows) == 1 or not self.law.constants:
            return discs
        pairs = [(i, j, S[..., i, j] ** 2 if len(rows) == 2 else radii[i] * radii[j]) for i in rows for j in rows[:i]]
        ovals = [_oval(S[..., i, i], S[..., j, j], product) for i, j, product in pairs]
        return torch.maximum(discs, reduce(torch.minimum, ovals))

    def on(self, box: Box, seconds: float) -> Contraction | None:
        """The contraction on a box around the goal; None if it is not proved in time."""
        whole = append_constants(box, self.states)
        x = torch.cat([whole.sample(SAMPLES, torch.Generator().manual_seed(0)), whole.corners()])
        with torch.no_grad():
            hopeless = bool((self.rate(x.new_zeros(()), x) < self.least).any())
        if hopeless or not seconds or not self.law.is_continuous_on(whole):
            return None
        ends, budget = at_time(0.0, whole.lower, whole.upper), Budget(seconds, boxes=BOXES)
        rate = minimum(self.rate, *ends, budget, enough=self.least, bounded=self.bounded)
        if not rate >= self.least * (1 - 1e-6):
            return None
        rate /= 1 + NEAR  # since ZᵀPZ is 1 up to NEAR
        corner = box.reach_from(self.goal[: box.dimension])  # the equilibrium lies in B
        offset = min(self._offset(rate), float(torch.linalg.vector_norm(corner)))
        return Contraction(box, rate, self.Y, offset, self.bounded.fingerprint)

    def _offset(self, rate: float) -> float:
        """A bound of ‖Y F(x*)‖ / (κσ), where σ is the least singular value of Y."""
        n = self.states.dimension - len(self.law.constants)
        at_goal = over_time(append_constants(Box(self.goal[:n], self.goal[:n]), self.states), 0.0)
        plants = divide_box(*at_goal, [1 + i for i in self.law.constants])
        ((low, high),) = self.law.bounded.bounds(*plants)
        size = torch.maximum(low.abs(), high.abs())[:, list(self.seen)]
        largest = float(torch.linalg.vector_norm(size @ self.Y.abs().mT, dim=-1).max())
        return largest / (rate * float(torch.linalg.matrix_norm(self.Y, -2)))


def _oval(a: Tensor, b: Tensor, product: Tensor) -> Tensor:
    """A lower bound of the smaller root λ of (λ − a)(λ − b) = product ≥ 0; for λ > 0 it is at least λ/2.

    λ = 2 (ab − product)/(a + b + s) with s = √((a − b)² + 4 product), and s ≤ a + b where ab ≥ product and a + b > 0.
    """
    return torch.minimum((a * b - product) / (a + b), (a + b) / 2)


def contraction_around(
    loop: ClosedLoop,
    goal: State,
    states: Box,
    seen: Sequence[int],
    seconds: float = 60.0,
    proposed: tuple[Box, Tensor] | None = None,
    steps: Problem | None = None,
) -> tuple[Contraction | None, float]:
    """Find the largest box around the goal on which the law contracts, among scaled copies of D.

    Args:
        goal, states: x* and D; for several plants, with the middle of P and with P as further components.
        seen: the indices of the states that the law depends on, without constants.
        seconds: the time limit.
        proposed: the only (B, Y) to test, for example from a file; the test assumes nothing about them.
        steps: the problem whose steps are to contract, with u held; None: continuous time.

    Returns:
        (contraction, slowest): the contraction, or None if the linearised law is unstable or contracts on no tested
        box; and the largest Re μ + ½Δt|μ|² among the eigenvalues μ of the linearised law, in 1/s, with Δt = 0 in
        continuous time. It is negative if the law is stable: for steps, if |1 + Δtμ| < 1 for each μ.
    """
    law, reach, budget = (
        _Law(loop, states, steps),
        torch.minimum(goal - states.lower, states.upper - goal),
        Budget(seconds),
    )
    A, *others = law.linearised(goal, states, seen)
    slowest = float(np.max([_slowest_rate(each, law.dt) for each in (A, *others)]))  # nan if one of them is nan
    own_rate, found = -slowest / 2, None
    if not own_rate > 0:
        return None, slowest
    scale = reach[list(seen)].numpy()
    try:
        metrics = [] if proposed else _candidate_metrics(law, A, goal, seen, scale, own_rate)
        Ys = [proposed[1]] if proposed else [_coordinates_of(P, A, scale, law.dt) for P in metrics]
        at_goal, Y = max(((_rate_of_linear_laws(Y, (A, *others), law.dt), Y) for Y in Ys), key=itemgetter(0))
        coordinates = _Coordinates(law, goal, states, seen, Y, min(LEAST_SHARE_OF_RATE * own_rate, at_goal / 2))
    except np.linalg.LinAlgError:
        return None, slowest
    n = len(goal) - len(loop.system.constants)
    radii = reach.where(torch.isin(torch.arange(len(goal)), torch.tensor(list(seen))), 0.0)[:n] / 2
    goal, within = goal[:n], first_states(states, n)
    if proposed is not None:
        box = proposed[0]
        fits = _is_box_around(box, goal, within, radii * GROWTH**-SIZES)
        return coordinates.on(box, budget.left) if fits and at_goal > 0 else None, slowest
    low, high = -1, SIZES if at_goal > 0 else 0  # contraction is proved for size low, and not for size high
    while high - low > 1:
        k = (low + high) // 2
        size = radii * GROWTH ** (k + 1 - SIZES)
        one = coordinates.on(Box(goal - size, goal + size), budget.left / 2)  # the other half is for smaller boxes
        low, high, found = (k, high, one) if one is not None else (low, k, found)
    return found, slowest


def final_distance(
    loop: ClosedLoop,
    around: Contraction,
    goal: State,
    states: Box,
    seen: Sequence[int],
    steps: Problem | None = None,
) -> float:
    """An upper bound of the distance from the goal as t → ∞ if u is rounded, so that ẋ = F̂(x) instead of F(x).

    In B, d/dt ‖Y(x − x_e)‖ ≤ −κ‖Y(x − x_e)‖ + ‖Y(F̂ − F)‖; for steps, with a difference quotient on the left. As t → ∞
    the closed loop therefore comes into the ball ‖Y(x − x_e)‖ ≤ R = sup ‖Y(F̂ − F)‖/κ, where the supremum is over B. The
    supremum over a box around that ball gives a smaller ball, and so on. The bound is R/σ plus the distance of x_e from
    the goal, where σ is the least singular value of Y.

    Args:
        around: the contraction of F; B contains a set that no closed loop of F̂ leaves.
        goal, states, seen, steps: as in contraction_around.
    """

    def error(t: Time, x: State) -> tuple[State]:
        rounded = rate_of(loop, steps, x, loop.policy(t, x))
        with rounding(counted=False):
            return (rounded - rate_of(loop, steps, x, loop.policy(t, x)),)

    bounded, n, Y = BoundedFunction(error, over_time(states, 0.0)), around.box.dimension, around.coordinates
    chosen, box, radius = list(seen), around.box, math.inf
    of_ball = torch.linalg.vector_norm(_inverse(Y, len(seen)), dim=-1)
    axes = [1 + i for i in (*seen, *loop.system.constants)]
    for _ in range(MOST_BALLS):
        whole = append_constants(box, states)
        ((low, high),) = bounded.bounds(*divide_box(*over_time(whole, 0.0), axes, PIECES))
        size = torch.maximum(low.abs(), high.abs())[:, chosen] @ Y.abs().mT
        found = float(torch.linalg.vector_norm(size, dim=-1).max()) / around.rate * (1 + NEAR)
        if not found < NEXT_BALL * radius:
            break
        radius = found
        if radius < SMALLEST_BALL:
            break
        reach = torch.zeros(n, dtype=goal.dtype)
        reach[chosen] = (of_ball * radius + around.offset) * (1 + NEAR)
        low, high = goal[:n] - reach, goal[:n] + reach
        box = Box(torch.maximum(low, around.box.lower), torch.minimum(high, around.box.upper))
    left = around.offset + radius / float(torch.linalg.matrix_norm(Y, -2)) * (1 + NEAR)
    return min(left, float(torch.linalg.vector_norm(around.box.reach_from(goal[:n]))))


def _slowest_rate(A: np.ndarray, dt: float) -> float:
    """The largest Re μ + ½Δt|μ|² among the eigenvalues μ; nan if A is not finite."""
    if not np.isfinite(A).all():
        return math.nan
    mu = np.linalg.eigvals(A)
    return float((mu.real + dt / 2 * np.abs(mu) ** 2).max())


def _is_box_around(box: Box, goal: State, states: Box, least: State) -> bool:
    """Whether a box lies in D and extends at least by `least` from the goal; along axes with least = 0, not at all."""
    if box.lower.shape != goal.shape:
        return False
    within, room = (states.lower <= box.lower) & (box.upper <= states.upper), (goal - box.lower, box.upper - goal)
    return bool(torch.where(least > 0, within & (torch.minimum(*room) >= least), (room[0] == 0) & (room[1] == 0)).all())


def _candidate_metrics(
    law: _Law, A: np.ndarray, goal: State, seen: Sequence[int], scale: np.ndarray, own_rate: float
) -> list[np.ndarray]:
    """Candidates for P, in states divided by scale.

    In the first one the linear law A contracts at least at `own_rate`, if its eigenvalues have real parts below
    −own_rate. For several plants V_xx is another candidate, since a good V falls for all of them.

    Raises:
        LinAlgError: A is not finite in this scale.
    """
    scaled, eye = A * scale / scale[:, None], np.eye(len(A))
    if not np.isfinite(scaled).all():
        raise np.linalg.LinAlgError("Expected a finite linearised law in units of D, got infinite entries.")
    with warnings.catch_warnings():  # warnings about rounding do not matter: each P is tested before it is used
        warnings.simplefilter("ignore")
        if law.dt:
            step = (eye + law.dt * scaled) / math.sqrt(1 - 2 * own_rate * law.dt)
            found = [solve_discrete_lyapunov(step.T, law.dt * eye)]
        else:
            found = [solve_continuous_lyapunov((scaled + own_rate * eye).T, -eye)]
    if law.constants and law.loop.V is not None:
        t, V, chosen = goal.new_zeros(()), law.loop.V, list(seen)
        H = torch.autograd.functional.hessian(lambda x: V(t, x), goal)[chosen][:, chosen].numpy()  # pyright: ignore[reportArgumentType, reportCallIssue]
        if np.isfinite(H).all() and np.linalg.eigvalsh(H + H.T).min() > 0:
            found.append(H * scale * scale[:, None])
    return found


def _coordinates_of(P: np.ndarray, A: np.ndarray, scale: np.ndarray, dt: float) -> Tensor:
    """Y in unscaled states with YᵀY = P and M + Mᵀ + Δt MᵀM diagonal, where M = Y A Y⁻¹.

    Raises:
        LinAlgError: P is not positive definite.
    """
    L = np.linalg.cholesky((P + P.T) / 2)
    M = L.T @ (A * scale / scale[:, None]) @ np.linalg.inv(L.T)
    _, turn = np.linalg.eigh((M + M.T + dt * M.T @ M) / 2)
    return torch.from_numpy(turn.T @ L.T / scale)


def _rate_of_linear_laws(Y: Tensor, laws: Sequence[np.ndarray], dt: float) -> float:
    """The rate at which all of some linear laws contract in coordinates Y.

    Raises:
        LinAlgError: as _inverse.
    """
    Z = _inverse(Y, len(laws[0])).numpy()
    parts = [Y.numpy() @ A @ Z for A in laws]
    return -max(float(np.linalg.eigvalsh(M + M.T + dt * M.T @ M).max()) / 2 for M in parts)


def _inverse(Y: Tensor, k: int) -> Tensor:
    """Z with ‖YZ − 1‖ < NEAR/10; the test includes the rounding of the product.

    Raises:
        LinAlgError: Y has no such inverse, or another shape.
    """
    if Y.shape != (k, k) or not bool(Y.isfinite().all()):
        raise np.linalg.LinAlgError("Expected finite coordinates of k states, got others.")
    Z = torch.from_numpy(np.linalg.inv(Y.numpy()))
    rounding = (k + 2) * torch.finfo(Z.dtype).eps * Y.abs() @ Z.abs()
    if not float(torch.linalg.matrix_norm((Y @ Z - torch.eye(k, dtype=Z.dtype)).abs() + rounding)) < NEAR / 10:
        raise np.linalg.LinAlgError("Expected invertible coordinates, got others.")
    return Z

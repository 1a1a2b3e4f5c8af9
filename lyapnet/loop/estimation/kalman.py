"""Kalman filters for the steps of a problem: extended, and unscented.

No library is used. FilterPy filters one loop at a time, with NumPy; kalman-py compiles its loops with JAX; torch-kf is
for linear systems only. Each needs F in its own form. Here F and its Jacobian follow from the task's f, g and Δt in
torch, for thousands of loops at once, and what remains is the linear algebra below.
"""

import math
from abc import ABC, abstractmethod
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lyapnet.base.linear_algebra import apply
from lyapnet.base.types import Control, State
from lyapnet.task.domain import size_of
from lyapnet.task.outputs import Outputs, Readings
from lyapnet.task.problem import Problem
from lyapnet.value.derivatives import jacobian_of

Covariance = Float[Tensor, "*batch n n"]
Deviations = Float[Tensor, " n"]

# Random walk over the horizon, relative to the initial uncertainty, if no noise is known or given. Without it, P of a
# decaying mode falls below the error of the linearisation: for the balanced cart-pole errors at T were 100 times P.
AWAKE = 1e-4
KNOWN = 1e-2  # initial standard deviation of a state that X₀ fixes, relative to its size


class Belief(NamedTuple):
    """A normal distribution of the state: its mean x̂ and its covariance P."""

    x: State
    P: Covariance


class KalmanFilter(nn.Module, ABC):
    """x' = F(x, u) + w, y = h(x) + v, with the steps F of a problem, u held; w and v normal and independent.

    The covariance of w is Δt (σ(x̂)σ(x̂)ᵀ + diag(drift²)), with the noise σ of the problem. Readings that are NaN are
    missing and left out.

    Args:
        problem: F and σ.
        outputs: h and the covariance of v.
        drift: standard deviation of an additional random walk of each state, (n,), in its unit per √s.
    """

    problem: Problem
    outputs: Outputs
    drift: Deviations

    def __init__(self, problem: Problem, outputs: Outputs, drift: Deviations):
        super().__init__()
        self.problem, self.outputs = problem, outputs
        self.register_buffer("drift", drift, persistent=False)

    @abstractmethod
    def predict(self, belief: Belief, u: Control) -> Belief:
        """The belief after a step under u."""

    @abstractmethod
    def update(self, belief: Belief, y: Readings) -> Belief:
        """The belief after readings y."""

    def _next(self, x: Tensor, u: Control) -> Tensor:
        """F(x, u), for states that may have more batch axes than controls."""
        return self.problem.step(x, u.expand(*x.shape[:-1], -1))[0]

    def process_noise(self, x: State) -> Covariance:
        """The covariance of w at x̂."""
        dt, noise = self.problem.horizon.dt, self.problem.noise
        walk = torch.diag(dt * self.drift.square())
        if noise is None:
            return walk.expand(*x.shape[:-1], -1, -1)
        sigma = noise(x)
        return dt * sigma @ sigma.mT + walk

    @property
    def _reading_noise(self) -> Tensor:
        """R, the covariance of v."""
        return torch.diag(self.outputs.noise.square())


class ExtendedKalmanFilter(KalmanFilter):
    """F and h to first order around x̂, with exact Jacobians, and Joseph's form (I − KH)P(I − KH)ᵀ + KRKᵀ of the update.

    Source: Simon, Optimal State Estimation, 2006, ch. 13.
    """

    def predict(self, belief: Belief, u: Control) -> Belief:
        x, P = belief
        A = self.step_jacobian(x, u)
        return Belief(self._next(x, u), _symmetric(A @ P @ A.mT + self.process_noise(x)))

    def update(self, belief: Belief, y: Readings) -> Belief:
        x, P = belief
        surprise, known = _without_missing(self.outputs.surprise(y, self.outputs(x)))
        P, K = self.corrected(P, known[..., None] * self.output_jacobian(x))
        return Belief(x + apply(K, surprise), P)

    def step_jacobian(self, x: State, u: Control) -> Covariance:
        """A = ∂F/∂x."""
        return jacobian_of(lambda x: self._next(x, u), x, x.shape[-1])

    def output_jacobian(self, x: State) -> Float[Tensor, "*batch p n"]:
        """H = ∂h/∂x."""
        return jacobian_of(self.outputs, x, self.outputs.count)

    def corrected(
        self, P: Covariance, H: Float[Tensor, "*batch p n"]
    ) -> tuple[Covariance, Float[Tensor, "*batch n p"]]:
        """The covariance after a reading with the Jacobian H, and the gain K = PHᵀ(HPHᵀ + R)⁻¹."""
        R = self._reading_noise
        K = torch.linalg.solve(H @ P @ H.mT + R, H @ P).mT
        kept = torch.eye(P.shape[-1]).to(P) - K @ H
        return _symmetric(kept @ P @ kept.mT + K @ R @ K.mT), K


class UnscentedKalmanFilter(KalmanFilter):
    """Means and covariances of 2n states x̂ ± √n d_i, with the columns d_i of a square root of P.

    It is the unscented transform without a point in the centre (κ = 0), whose weights are all positive: covariances are
    semidefinite by their form. Means are exact to third order in the deviation from x̂.

    Source: Julier, Uhlmann, "Unscented filtering and nonlinear estimation", Proceedings of the IEEE 2004; Arasaratnam,
    Haykin, "Cubature Kalman filters", IEEE Transactions on Automatic Control 2009.
    """

    def predict(self, belief: Belief, u: Control) -> Belief:
        mean, E = _spread(self._next(self._points(belief)[0], u))
        return Belief(mean, _symmetric(E @ E.mT + self.process_noise(belief.x)))

    def update(self, belief: Belief, y: Readings) -> Belief:
        (points, D), R = self._points(belief), self._reading_noise
        mean, E = _spread(self.outputs(points))
        surprise, known = _without_missing(self.outputs.surprise(y, mean))
        E = known[..., None] * E
        K = torch.linalg.solve(E @ E.mT + R, E @ D.mT).mT
        rest = D - K @ E
        return Belief(belief.x + apply(K, surprise), _symmetric(rest @ rest.mT + K @ R @ K.mT))

    def _points(self, belief: Belief) -> tuple[Tensor, Tensor]:
        """The points (2n, *batch, n), and their deviations (*batch, n, 2n) divided by √(2n), D with P = DDᵀ."""
        root = _root(belief.P)
        D = torch.cat([root, -root], -1) / math.sqrt(2)
        return belief.x + math.sqrt(D.shape[-1]) * D.movedim(-1, 0), D


FILTERS = {"ekf": ExtendedKalmanFilter, "ukf": UnscentedKalmanFilter}


def initial_deviation(problem: Problem) -> Deviations:
    """The standard deviation of a uniform distribution on X₀; of a state that X₀ fixes, KNOWN times its size.

    Settings, such as the targets of a family, are known exactly.
    """
    box = problem.initial_states
    deviation = (box.widths / math.sqrt(12)).where(box.widths > 0, KNOWN * size_of(box))
    deviation[list(problem.system.settings)] = 0.0
    return deviation


def least_drift(problem: Problem) -> Deviations:
    """The drift of a random walk that amounts to AWAKE times the initial uncertainty over the horizon."""
    return AWAKE * initial_deviation(problem) / math.sqrt(problem.horizon.duration)


def _without_missing(surprise: Readings) -> tuple[Readings, Tensor]:
    """y − ŷ with 0 for readings that are NaN, and 1 for each that is known, 0 for the others."""
    missing = surprise.isnan()
    return surprise.masked_fill(missing, 0.0), (~missing).to(surprise)


def _symmetric(P: Covariance) -> Covariance:
    return (P + P.mT) / 2


def _spread(points: Tensor) -> tuple[Tensor, Tensor]:
    """The mean of points (2n, *batch, k), and their deviations from it (*batch, k, 2n) divided by √(2n)."""
    mean = points.mean(0)
    return mean, (points - mean).movedim(0, -1) / math.sqrt(len(points))


def _root(P: Covariance) -> Tensor:
    """D with DDᵀ = P, for positive semidefinite P."""
    values, vectors = torch.linalg.eigh(P)
    return vectors * values.clamp_min(0).sqrt()[..., None, :]

"""The covariance of estimated parameters, and the directions in which the readings do not determine them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from lyapnet.lab.identification.estimation import Solution

NOT_AT_ALL = 1e-7  # singular value, relative to the largest, below which a direction counts as undetermined
NO_EFFECT = 1e-3  # effect on all readings, in units of noise, of a change by 100 %, below which a parameter has none
ALIKE = 0.02  # singular value below which effects nearly cancel, so that a direction may be undetermined
PART = 0.03  # smallest part of a parameter in undetermined directions, in units of its effect, that makes it so too
NAMED = 0.01  # smallest part of a parameter in a direction, relative to the largest, that is reported

Array = np.ndarray


class Confidence(NamedTuple):
    """The uncertainty of p."""

    covariance: Float[Array, "k k"]  # in the determined directions
    told: Bool[Array, " k"]  # whether the readings determine each parameter
    directions: list[dict[str, float]]  # the undetermined directions, as relative changes by name


def confidence_of(found: Solution, before: Float[Array, " k"], names: Sequence[str], lags: int = 0) -> Confidence:
    """The covariance (MᵀM)⁻¹ of the parameters at a minimum, in the directions that the readings determine.

    If residuals are correlated, it is (MᵀM)⁻¹ S (MᵀM)⁻¹ with the covariance S of the gradient in p.

    In units of the effect of each parameter alone, ‖∂ŷ/∂p_i‖, a direction in which effects cancel has a small singular
    value s, and the standard deviation 1/s. It counts as undetermined if s is 0 up to rounding; or if s < ALIKE, and a
    standard deviation changes some parameter by 100 %.

    Args:
        before: the parameters at the start.
        lags: number of samples over which residuals are correlated; 0 if they are white.
    """
    p = found.point.p
    scale = np.where(p != 0, np.abs(p), np.abs(before))
    counts = np.where(scale > 0, found.size * scale > NO_EFFECT, found.size > 0)
    size, some = np.where(counts, found.size, 1.0), np.flatnonzero(counts)
    _, s, V_of_some = np.linalg.svd((found.root / size)[:, some], full_matrices=False)
    V = np.zeros((len(s), len(p)))
    V[:, some] = V_of_some
    relative = V / size / np.where(scale > 0, scale, 1 / size)
    far = np.abs(relative).max(1) > s
    known = (s > NOT_AT_ALL * s.max(initial=0.0)) & ~((s < ALIKE) & far)
    directions = [{name: 1.0} for name, does in zip(names, counts, strict=True) if not does]
    for change in relative[~known]:
        change = change / change[np.argmax(np.abs(change))]
        directions.append({name: float(c) for name, c in zip(names, change, strict=True) if abs(c) > NAMED})
    root = V[known] / size / s[known, None]
    covariance = root.T @ root
    if lags:
        covariance = covariance @ _covariance_of_gradient(found.scores, lags) @ covariance
    return Confidence(covariance, counts & ((V[~known] ** 2).sum(0) < PART**2), directions)


def _covariance_of_gradient(scores: Sequence[Float[Array, "_ k"]], lags: int) -> Float[Array, "k k"]:
    """Σ_l (1 − |l|/(L + 1)) Σ_t g_t g_{t+l}ᵀ over lags |l| ≤ L; its weights make it positive semidefinite.

    Source: Newey, West, "A simple, positive semi-definite, heteroskedasticity and autocorrelation consistent covariance
    matrix", Econometrica 1987.
    """
    total = np.sum([g.T @ g for g in scores], 0)
    for lag in range(1, lags + 1):
        product = np.sum([g[:-lag].T @ g[lag:] for g in scores], 0)
        total = total + (1 - lag / (lags + 1)) * (product + product.T)
    return total

"""How well readings tell parameters: their covariance, and the directions in which they are not told."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from lyapnet.lab.identification.estimation import Solution

NOT_AT_ALL = 1e-7  # singular value, relative to the greatest, from which effects of parameters count as the same
NO_EFFECT = 1e-3  # of a change by all of its value on all readings together, in their noise: a parameter does not count
ALIKE = 0.02  # share to which effects cancel in a direction that may be hardly told
PART = 0.03  # square of the smallest part of a parameter in a direction by which it is not told, in units of its effect
NAMED = 0.01  # smallest part of a parameter in a direction, relative to the greatest, that is named

Array = np.ndarray


class Confidence(NamedTuple):
    """What readings tell of p."""

    covariance: Float[Array, "k k"]  # along what is told
    told: Bool[Array, " k"]
    directions: list[dict[str, float]]  # relative changes by name that are not told


def confidence_of(found: Solution, before: Float[Array, " k"], names: Sequence[str], lags: int = 0) -> Confidence:
    """The covariance (MᵀM)⁻¹ of the parameters at a minimum, in the directions that readings tell.

    Where residuals are correlated it is (MᵀM)⁻¹ S (MᵀM)⁻¹, with the covariance S of the gradient in p by its samples.

    In units of what each parameter does by itself, ‖∂ŷ/∂p_i‖, a direction in which effects cancel has a small singular
    value s, and 1/s is its standard deviation. It is not told if s is 0 up to rounding, nor if effects cancel to ALIKE
    and a standard deviation changes some parameter by all of its value.

    Args:
        before: the parameters at the start.
        lags: samples over which residuals are correlated; 0: they are white.
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
    """Σ_l (1 − |l|/(L + 1)) Σ_t g_t g_{t+l}ᵀ over lags up to L, semidefinite by its weights.

    Source: Newey, West, "A simple, positive semi-definite, heteroskedasticity and autocorrelation consistent covariance
    matrix", Econometrica 1987.
    """
    total = np.sum([g.T @ g for g in scores], 0)
    for lag in range(1, lags + 1):
        product = np.sum([g[:-lag].T @ g[lag:] for g in scores], 0)
        total = total + (1 - lag / (lags + 1)) * (product + product.T)
    return total

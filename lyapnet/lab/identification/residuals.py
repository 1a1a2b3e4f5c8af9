"""Tests of what a fit leaves: whether it is white, free of the controls, and as large as the noise is said to be.

Of a right model the residuals are the noise of the readings. What remains of a wrong one is correlated in time, or with
controls that acted before.
Source: Ljung, Box, "On a measure of lack of fit in time series models", Biometrika 1978; Ljung, System Identification,
1999, ch. 16.6.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

LAGS = 25  # of tests, in samples
MOST_LAGS = 1000  # over which residuals are correlated, as far as that is counted
LEVEL = 1e-3  # below this probability a right model is given up

Array = np.ndarray


@dataclass(frozen=True)
class ResidualTest:
    """Residuals of one reading: how probable they are if the model is right, in three respects.

    Args:
        reading: its name.
        white: probability of such correlations in time.
        controls: of such correlations with controls that acted before; None where no control moves.
        size: of so large or so small residuals; None where the noise is not known.
        ratio: root mean square of the residuals, relative to the noise that is known; None likewise.
        correlated: samples after which the autocorrelation is within what chance gives; 0 if it is at once.
    """

    reading: str
    white: float
    controls: float | None
    size: float | None
    ratio: float | None
    correlated: int

    @property
    def explained(self) -> bool:
        """Whether nothing is left that a model could explain."""
        return self.white >= LEVEL and (self.controls is None or self.controls >= LEVEL)

    @property
    def passed(self) -> bool:
        """Whether none of the probabilities is below LEVEL."""
        return self.explained and (self.size is None or self.size >= LEVEL)


def examine(
    reading: str,
    residuals: Sequence[Float[Array, " N"]],
    controls: Sequence[Float[Array, "N m"]],
    noise: float | None,
    freedom: float,
) -> ResidualTest:
    """The tests of one reading.

    Args:
        residuals: of each recording.
        controls: of each recording.
        noise: standard deviation that the config says; None if it is not known.
        freedom: degrees of freedom of the residuals together.
    """
    from scipy.stats import chi2  # imported here because it takes 0.3 s

    longest = max(1, min(MOST_LAGS, min(map(len, residuals)) // 4))
    lags = min(LAGS, longest)
    total, square = sum(map(len, residuals)), sum(float(e @ e) for e in residuals)
    if square == 0:
        return ResidualTest(reading, 1.0, None, None, None, 0)
    rho = np.array([sum(float(e[k:] @ e[:-k]) for e in residuals) for k in range(1, longest + 1)]) / square
    portmanteau = total * (total + 2) * float((rho[:lags] ** 2 / (total - np.arange(1, lags + 1))).sum())
    within = np.abs(rho) < 3 / np.sqrt(total)
    size = ratio = None
    if noise is not None:
        statistic = square / noise**2
        size = float(2 * min(chi2.sf(statistic, freedom), chi2.cdf(statistic, freedom)))
        ratio = float(np.sqrt(statistic / freedom))
    return ResidualTest(
        reading,
        float(chi2.sf(portmanteau, lags)),
        _independence(residuals, controls, lags),
        size,
        ratio,
        int(np.argmax(within)) if within.any() else longest,
    )


def _independence(residuals: Sequence[Array], controls: Sequence[Array], lags: int) -> float | None:
    """The probability of so good a regression of residuals on the controls of the samples before; see examine."""
    from scipy.stats import chi2

    earlier, later = list[Array](), list[Array]()
    for e, u in zip(residuals, controls, strict=True):
        windows = np.lib.stride_tricks.sliding_window_view(u[:-1], lags, 0)
        earlier.append(windows.reshape(len(windows), -1))
        later.append(e[lags:])
    U, e = np.concatenate(earlier), np.concatenate(later)
    U, e = U - U.mean(0), e - e.mean()
    scale = U.std(0)
    if not scale.any() or not e.any():
        return None
    left, values, _ = np.linalg.svd(U[:, scale > 0] / scale[scale > 0], full_matrices=False)
    left = left[:, values > 1e-6 * values[0]]  # steps and slow controls repeat themselves
    explained = float(((left.T @ e) ** 2).sum() / (e @ e))
    return float(chi2.sf(len(e) * explained, left.shape[1]))

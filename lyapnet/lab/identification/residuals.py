"""Tests of residuals: whether they are white, independent of earlier controls, and as large as the known noise.

The residuals of a correct model are the noise of the readings. Those of a wrong model are correlated in time, or with
earlier controls.
Source: Ljung, Box, "On a measure of lack of fit in time series models", Biometrika 1978; Ljung, System Identification,
1999, ch. 16.6.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

LAGS = 25  # largest lag in tests, in samples
MOST_LAGS = 1000  # largest lag at which correlation is computed, in samples
LEVEL = 1e-3  # significance level: with a smaller probability, a test says that the model is wrong

Array = np.ndarray


@dataclass(frozen=True)
class ResidualTest:
    """Tests of the residuals of one reading: three p-values under the assumption that the model is correct.

    Args:
        reading: its name.
        white: p-value of their correlations in time.
        controls: p-value of their correlations with earlier controls; None if no control changes.
        size: p-value of their size; None if the noise is not known.
        ratio: root mean square of the residuals, relative to the known noise; None if it is not known.
        correlated: largest lag, in samples, up to which the autocorrelation exceeds chance; 0 for none.
    """

    reading: str
    white: float
    controls: float | None
    size: float | None
    ratio: float | None
    correlated: int

    @property
    def explained(self) -> bool:
        """Whether the residuals are white and independent of controls, so that the model lacks nothing."""
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
        residuals: those of each recording.
        controls: those of each recording.
        noise: standard deviation of the noise in the config; None if it is not known.
        freedom: degrees of freedom of all residuals together.
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
    """The p-value of a regression of residuals on the controls of earlier samples; None if no control changes."""
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
    left = left[:, values > 1e-6 * values[0]]  # columns of steps and slow controls are nearly dependent
    explained = float(((left.T @ e) ** 2).sum() / (e @ e))
    return float(chi2.sf(len(e) * explained, left.shape[1]))

"""The spread of a measure over seeds and states: mean, interquartile mean, and its bootstrap interval."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import trim_mean

CONFIDENCE, RESAMPLES, RESAMPLING_SEED = 0.95, 2000, 0


class Spread(NamedTuple):
    """A measure of n seeds × k states.

    mean and std are those of the seeds' means, std with n − 1. iqm is the mean of the middle half of all n·k values,
    [low, high] its percentile bootstrap interval: seeds are drawn with replacement, each with all its states, because
    the states of a seed share its network. One seed has neither std nor interval.

    Source: Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice", NeurIPS 2021.
    """

    mean: float  # inf if a seed diverges somewhere
    std: float | None
    iqm: float
    low: float | None
    high: float | None
    diverged: int  # seeds with a state of infinite cost
    seeds: int


def spread(values: ArrayLike) -> Spread:
    """The spread of values (n, k); NaN counts as diverged, as inf does."""
    table = np.asarray(values, dtype=float)
    table = np.where(np.isnan(table), np.inf, table)
    means = table.mean(-1)
    several, finite = len(means) > 1, bool(np.isfinite(means).all())
    std = float(means.std(ddof=1)) if several and finite else None
    low, high = bootstrap_interval(table) if several else (None, None)
    return Spread(
        float(means.mean()), std, interquartile_mean(table), low, high, int(np.isinf(means).sum()), len(means)
    )


def interquartile_mean(values: ArrayLike) -> float:
    """The mean without the lowest and the highest quarter, ⌊n/4⌋ values each."""
    return float(trim_mean(np.ravel(values), 0.25))


def bootstrap_interval(table: np.ndarray) -> tuple[float, float]:
    """The interval of the interquartile mean of (n, k) values, by resampling rows; the same for the same table.

    Quantiles are values of the sample (inverted distribution function): between inf and a number nothing interpolates.
    """
    n = len(table)
    chosen = np.random.default_rng(RESAMPLING_SEED).integers(n, size=(RESAMPLES, n))
    means = trim_mean(table[chosen].reshape(RESAMPLES, -1), 0.25, axis=1)
    tail = (1 - CONFIDENCE) / 2
    low, high = np.quantile(means, [tail, 1 - tail], method="inverted_cdf")
    return float(low), float(high)

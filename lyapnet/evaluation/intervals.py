"""Intervals of expectations that many paths of noise estimate."""

import math

from torch import Tensor

CONFIDENCE = 0.95  # confidence of the intervals


def half_width_of_mean(samples: Tensor) -> float:
    """The half-width of the 95 % interval of the mean over the states of expectations, from samples (paths, states).

    By Student's t, with the degrees of freedom of a sum of variances.

    Source: Welch, "The generalization of 'Student's' problem when several different population variances are involved",
    Biometrika 1947.
    """
    if len(samples) < 2 or not samples.isfinite().all():
        return math.inf
    variances = samples.double().var(0) / len(samples)  # of the mean of each state
    if not (total := float(variances.sum())):
        return 0.0
    from scipy.special import stdtrit  # imported here because it takes 0.2 s

    freedom = (len(samples) - 1) * total**2 / float((variances**2).sum())
    return float(stdtrit(freedom, (1 + CONFIDENCE) / 2)) * math.sqrt(total) / samples.shape[1]

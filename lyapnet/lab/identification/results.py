"""Results of an identification: estimates, fits, tests and curves."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from lyapnet.lab.identification.residuals import ResidualTest

CONFIDENCE = 0.95

Array = np.ndarray


class Estimate(NamedTuple):
    """The estimate of a parameter."""

    before: float  # its value in the config
    value: float  # the estimate
    low: float  # the ends of its 95 % interval, which is infinite if the data do not determine the parameter
    high: float
    at_bound: bool  # whether it is at the least or greatest value that the system takes

    @property
    def told(self) -> bool:
        """Whether the data determine the parameter."""
        return self.high - self.low < math.inf


class Curve(NamedTuple):
    """Readings y of a recording, and those ŷ of the fitted model, (N, q) each, at times t, (N,)."""

    name: str
    t: Array
    y: Array
    y_hat: Array
    held_out: bool
    starts: Array  # indices at which the model starts again from another state


def fit_of(curves: Sequence[Curve]) -> list[float]:
    """1 − ‖y − ŷ‖/‖y − ȳ‖ of each reading over some curves."""
    y, y_hat = (np.concatenate([getattr(curve, name) for curve in curves]) for name in ("y", "y_hat"))
    spread = np.linalg.norm(y - y.mean(0), axis=0)
    return (1 - np.linalg.norm(y - y_hat, axis=0) / np.where(spread > 0, spread, 1.0)).tolist()


@dataclass(frozen=True)
class Identification:
    """The result of `identify`.

    Args:
        parameters: the estimates by name.
        covariance: that of the estimates, (k, k), in the directions that the data determine.
        unknown_directions: relative changes of parameters by name, which together do not change the readings.
        noise: standard deviation of each reading, estimated or from the config.
        fit: 1 − ‖y − ŷ‖/‖y − ȳ‖ of each reading, on the fitted data.
        fit_held_out: the same on held-out data, with fitted initial states; empty if nothing was held out.
        tests: the tests of the residuals, one for each reading.
        curves: readings and model, for figures.
        units: the units of the readings.
        freedom: degrees of freedom, the number of readings minus that of unknowns.
        pieces: number of pieces, each with its own initial state.
        states, controls: some of those on the fitted trajectories, (segments, n) and (segments, m).
    """

    parameters: dict[str, Estimate]
    covariance: Float[Array, "k k"]
    unknown_directions: list[dict[str, float]]
    noise: dict[str, float]
    fit: dict[str, float]
    fit_held_out: dict[str, float]
    tests: list[ResidualTest]
    curves: list[Curve]
    units: dict[str, str]
    freedom: int
    pieces: int
    states: Float[Array, "segments n"]
    controls: Float[Array, "segments m"]

    @property
    def values(self) -> dict[str, float]:
        """The estimates by name."""
        return {name: estimate.value for name, estimate in self.parameters.items()}

    @property
    def model_is_right(self) -> bool:
        """Whether no test of the residuals says otherwise."""
        return all(test.passed for test in self.tests)

    def contains(self, parameters: Mapping[str, float], confidence: float = CONFIDENCE) -> bool:
        """Whether parameters are in the confidence region, (p − p̂)ᵀC⁺(p − p̂) ≤ r F_r; r is the rank of C."""
        from scipy.stats import f  # imported here because it takes 0.3 s

        away = np.array([parameters[name] - estimate.value for name, estimate in self.parameters.items()])
        scale = np.sqrt(np.diag(self.covariance).clip(1e-300))
        values, vectors = np.linalg.eigh(self.covariance / scale / scale[:, None])
        told = values > 1e-10 * values[-1]
        distance = float((((away / scale) @ vectors)[told] ** 2 / values[told]).sum())
        rank = int(told.sum())
        return bool(distance <= rank * f.ppf(confidence, rank, self.freedom))

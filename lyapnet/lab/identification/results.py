"""What measurements tell of the parameters of a system."""

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
    """A parameter."""

    before: float  # in the config
    value: float
    low: float  # of its 95 % interval, which is infinite if the data do not tell the parameter
    high: float
    at_bound: bool  # whether it is at the least or greatest value that the system takes

    @property
    def told(self) -> bool:
        """Whether the data tell it."""
        return self.high - self.low < math.inf


class Curve(NamedTuple):
    """Readings of a recording, and those of the fitted model: (N,) and (N, q)."""

    name: str
    t: Array
    y: Array
    y_hat: Array
    held_out: bool
    starts: Array  # indices at which the model begins anew from a state of its own


def fit_of(curves: Sequence[Curve]) -> list[float]:
    """1 − ‖y − ŷ‖/‖y − ȳ‖ of each reading over some curves."""
    y, y_hat = (np.concatenate([getattr(curve, name) for curve in curves]) for name in ("y", "y_hat"))
    spread = np.linalg.norm(y - y.mean(0), axis=0)
    return (1 - np.linalg.norm(y - y_hat, axis=0) / np.where(spread > 0, spread, 1.0)).tolist()


@dataclass(frozen=True)
class Identification:
    """What measurements tell of the parameters of a system.

    Args:
        parameters: by name.
        covariance: of the estimates, (k, k); of parameters that are not told, along what is told.
        unknown_directions: relative changes of parameters by name, which together leave the data as they are.
        noise: standard deviation of each reading, estimated or as the config says.
        fit: 1 − ‖y − ŷ‖/‖y − ȳ‖ of each reading, on what was fitted.
        fit_held_out: the same on what was not, from initial states of its own; empty if nothing was held out.
        tests: of the residuals, one for each reading.
        curves: for figures.
        units: of the readings.
        freedom: readings without unknowns.
        pieces: how many, each from a state of its own.
        states, controls: some of those along what was fitted, (segments, n) and (segments, m).
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

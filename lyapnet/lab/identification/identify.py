"""Estimates parameters of a system from measurements, with confidence intervals and tests of the model."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly.classes import default_dtype
from lyapnet.experiment.config import Config
from lyapnet.lab.identification.confidence import Confidence, confidence_of
from lyapnet.lab.identification.estimation import Fit, Solution
from lyapnet.lab.identification.measurements import Measurements, read_measurements
from lyapnet.lab.identification.residuals import examine
from lyapnet.lab.identification.results import CONFIDENCE, Curve, Estimate, Identification, fit_of
from lyapnet.lab.identification.search import Search
from lyapnet.lab.identification.shooting import SEGMENT
from lyapnet.lab.identification.unknown_system import UnknownSystem, system_of
from lyapnet.task.systems import ControlSystem
from lyapnet.training.stage_messages import StageReport, silent

HELD_OUT = 0.25  # share of each recording, its end, that is not fitted
LAGS_COUNTED = 4  # lags of residuals in intervals, in multiples of the lag after which they are uncorrelated
AT = 1e-6  # distance of a parameter from an end of its range, relative to its size, that counts as none

Array = np.ndarray


def identify(
    config: Config,
    data: Sequence[str | Path | Measurements],
    parameters: Sequence[str] = (),
    test: Sequence[str | Path | Measurements] = (),
    held_out: float | None = None,
    report: StageReport = silent,
) -> Identification:
    """Fit parameters of a config's system to measurements, by multiple shooting with exact derivatives.

    The model is y_k = h(x(t_k)) + v_k with ẋ = f(x, u; p), u held between samples, and independent normal v_k.

    Args:
        config: the system, X₀ for states that are not measured, and in `outputs` the noise if it is known.
        data: recordings, or CSV files of them.
        parameters: names of the parameters to estimate; empty: those in the config's system.parameters.
        test: recordings that are held out.
        held_out: share of each recording of `data`, at its end, that is held out; None: 0.25, or 0 with a `test`.
        report: called with the stages of the work.

    Raises:
        UsageError: a name, a file or a number does not fit.
        LyapnetError: no trajectory of the model follows the data.
    """
    with default_dtype(torch.float64):
        system, _ = system_of(config)
        fitted, tested = split_recordings(system, data, test, held_out)
        search = Search(UnknownSystem(config, parameters, fitted[0].outputs), fitted, report)
        return _conclude(search, *search.run(), tested)


def split_recordings(
    system: ControlSystem,
    data: Sequence[str | Path | Measurements],
    test: Sequence[str | Path | Measurements],
    held_out: float | None,
) -> tuple[list[Measurements], list[Measurements]]:
    """(the recordings to fit, those that are held out); arguments as in `identify`."""
    given, tested = ([_recording(each, system) for each in many] for many in (data, test))
    share = (0.0 if tested else HELD_OUT) if held_out is None else held_out
    if not given or not 0 <= share < 1:
        raise UsageError(
            f"Expected recordings, and a share in [0, 1) that is held out, got {len(given)} and {share}; give some."
        )
    _require_alike([*given, *tested])
    ends = [len(each) - int(share * len(each)) for each in given]
    fitted = [each.part(0, end) for each, end in zip(given, ends, strict=True)]
    return fitted, [
        *tested,
        *(each.part(end, len(each)) for each, end in zip(given, ends, strict=True) if end < len(each)),
    ]


def _recording(given: str | Path | Measurements, system: ControlSystem) -> Measurements:
    return given if isinstance(given, Measurements) else read_measurements(Path(given), system)


def _require_alike(recordings: Sequence[Measurements]) -> None:
    first = recordings[0]
    for other in recordings[1:]:
        if other.outputs != first.outputs:
            raise UsageError(
                f"Expected the same readings in all files, got {', '.join(first.outputs)} in {first.name!r} and "
                f"{', '.join(other.outputs)} in {other.name!r}; leave columns or files out."
            )


def _conclude(search: Search, fit: Fit, found: Solution, tested: Sequence[Measurements]) -> Identification:
    """The result of `identify` for a minimum."""
    sigma, names, recordings = search.noise(found), search.readings.names, search.recordings
    freedom = int(found.residuals.size - np.round(found.leverage.sum()))
    fitted, later = _curves(fit, found, held_out=False), held_out_curves(search, fit, found, tested)
    residuals = np.split(found.residuals, np.cumsum([len(each) for each in recordings])[:-1])
    tests = [
        examine(
            name,
            [each[:, j] for each in residuals],
            [each.u for each in recordings],
            None if np.isnan(search.known[j]) else float(sigma[j]),
            len(found.residuals) - float(found.leverage[j]),
        )
        for j, name in enumerate(names)
    ]
    lags = LAGS_COUNTED * max((test.correlated + 1 for test in tests if not test.explained), default=0)
    confidence = confidence_of(found, search.unknown.before, search.unknown.names, lags)
    return Identification(
        parameters=_estimates(search, found, confidence, freedom),
        covariance=confidence.covariance,
        unknown_directions=confidence.directions,
        noise=dict(zip(names, sigma.tolist(), strict=True)),
        fit=dict(zip(names, fit_of(fitted), strict=True)),
        fit_held_out=dict(zip(names, fit_of(later), strict=True)) if later else {},
        tests=tests,
        curves=[*fitted, *later],
        units=dict(zip(names, search.readings.units, strict=True)),
        freedom=freedom,
        pieces=len(fit.shooting.pieces),
        states=found.path.nodes,
        controls=np.concatenate([piece.u[::SEGMENT] for piece in fit.shooting.pieces]),
    )


def _estimates(search: Search, found: Solution, confidence: Confidence, freedom: int) -> dict[str, Estimate]:
    """The parameters by name, with intervals that are cut to the values that the system takes."""
    from scipy.stats import t  # imported here because it takes 0.3 s

    p, before, (lower, upper) = found.point.p, search.unknown.before, search.bounds
    half = t.ppf((1 + CONFIDENCE) / 2, freedom) * np.sqrt(np.diag(confidence.covariance))
    low, high, room = np.maximum(p - half, lower), np.minimum(p + half, upper), AT * np.maximum(abs(p), abs(before))
    at_bound = (p - lower <= room) | (upper - p <= room)
    return {
        name: Estimate(
            before=float(before[i]),
            value=float(p[i]),
            low=float(low[i]) if confidence.told[i] else -math.inf,
            high=float(high[i]) if confidence.told[i] else math.inf,
            at_bound=bool(at_bound[i]),
        )
        for i, name in enumerate(search.unknown.names)
    }


def held_out_curves(search: Search, fit: Fit, found: Solution, tested: Sequence[Measurements]) -> list[Curve]:
    """Curves of held-out recordings and of the model, with fitted initial states; empty if the model follows none."""
    pieces, longest = fit.shooting.pieces, max((len(each) for each in tested), default=0)
    cut = len(pieces) > len(search.recordings)  # the fit had to cut recordings into pieces: here too
    segments = -(-min(longest, *(len(piece) for piece in pieces) if cut else [longest]) // SEGMENT)
    while segments:
        parts = [piece for each in tested for piece in each.pieces(segments * SEGMENT)]
        shooting = search.shooting(parts, fit.shooting.substeps)
        later = Fit(shooting, fit.sigma, search.bounds, None)
        if (again := later.minimise(search.start(shooting, found.point.p))) is not None:
            return _curves(later, again, held_out=True)
        segments //= 2
    return []


def _curves(fit: Fit, found: Solution, held_out: bool) -> list[Curve]:
    """The curves of readings and model; the pieces of a recording form one curve."""
    y_hat = fit.shooting.y + found.residuals  # angles are in the same turn as their readings
    ends, curves = np.cumsum([len(piece) for piece in fit.shooting.pieces])[:-1], list[Curve]()
    for piece, own in zip(fit.shooting.pieces, np.split(y_hat, ends), strict=True):
        last = curves[-1] if curves else None
        if last is not None and last.name == piece.name and piece.t[0] > last.t[-1]:
            curves[-1] = Curve(
                piece.name, np.append(last.t, piece.t), np.concatenate([last.y, piece.y]),
                np.concatenate([last.y_hat, own]), held_out, np.append(last.starts, len(last.t)),
            )  # fmt: skip
        else:
            curves.append(Curve(piece.name, piece.t, piece.y, own, held_out, np.zeros(1, int)))
    return curves

"""Builds the system, cost and initial states of a task that follows a reference r(t)."""

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from lyapnet.base.errors import UsageError, did_you_mean
from lyapnet.base.interpolation import Basis, ChebyshevProducts, FourierSeries, combine
from lyapnet.base.linear_algebra import apply
from lyapnet.experiment.assembly.entries import repeated, require_length
from lyapnet.experiment.assembly.target import log_once
from lyapnet.experiment.config import Config, ReferenceConfig
from lyapnet.task.cost import Cost, CostWrapper, TargetCost, innermost
from lyapnet.task.family import FamilyCost, InterpolatedTargets
from lyapnet.task.problem import TEST_STATES
from lyapnet.task.reference import TimedSystem
from lyapnet.task.sets import Box, ControlSet
from lyapnet.task.systems import ControlSystem, states_that_are_rates
from lyapnet.value.derivatives import jacobian_of

COUNTS = (9, 17, 33, 65, 129)  # numbers of terms of r; the smallest that reaches MAX_DISTANCE is used
# Distances are relative to the extent of each state.
MAX_DISTANCE = 1e-4  # largest distance of r from the given points
MAX_GAP = 1e-3  # largest distance between the first and the last point of a periodic reference
MAX_DISTANCE_AT_LAST = 0.02  # largest distance of r from the given points with the last of COUNTS
LEAST_STEPS = 8  # least number of steps along a reference
TIMES_BETWEEN = 4  # number of times between two points at which rates are compared
MAX_RATE_LEFT = 1e-2  # largest rate that u_r leaves, relative to the largest rate of that state along r
ADVICE = "give columns for other states, or give the control along r, as in reference.control: [0]"


def reference_of(
    config: Config, system: ControlSystem, cost: Cost, controls: ControlSet, initial_states: Box
) -> tuple[TimedSystem, FamilyCost, Box]:
    """The system in z = (x, τ), the cost of x − r(τ) and u − u_r(τ), and the box X₀ × times.

    u_r is the control that follows r, f(r) + g(r)u_r = ṙ, or that of the config.

    Raises:
        UsageError: names, times or numbers do not fit, or no control follows r.
    """
    reference = config.reference
    if not system.affine:
        raise UsageError(
            f"Expected a control-affine system for a reference, got {system.title}; take a target for each goal."
        )
    if config.target is not None or config.target_control is not None or config.family or config.horizon.stationary:
        raise UsageError(
            "Expected a reference without target, target_control, family and horizon.stationary, got one of them; "
            "leave it out."
        )
    if isinstance(cost, CostWrapper) and innermost(cost).goal is not None:
        raise UsageError("Expected a cost about the origin for a reference, got one about a goal of its own.")
    times, values = _points_of(config, system)
    path, control, left = _fit(times, values, system, initial_states, reference.periodic)
    if reference.control is not None:
        given = repeated(reference.control, system.m)
        require_length("reference.control", len(given), system.control_names)
        control = _Curve(control.basis, torch.zeros_like(control.coefficients))
        control.coefficients[0] = control.coefficients.new_tensor(given)  # the first function is 1
    else:
        _require_followed(system, left)
        _log_exceeded_limits(system, controls, control.at(_between(times)))
    start = torch.zeros(1, dtype=torch.float64)
    x, u = path.at(start), control.at(start)
    points = torch.cat([path.at(path.basis.nodes()), control.at(path.basis.nodes())], -1)
    targets = InterpolatedTargets(path.basis, points, torch.cat([x, u]), system.n)
    duration, box = float(times[-1]), initial_states
    last = duration if reference.periodic else duration - config.horizon.steps * config.horizon.dt
    box = Box(torch.cat([box.lower, start]), torch.cat([box.upper, start + max(0.0, last)]))
    timed = TimedSystem(system, duration if reference.periodic else None)
    return timed, FamilyCost(TargetCost(cost, x, u), targets, start, system.n), box


def require_points(reference: ReferenceConfig) -> None:
    """Refuse a reference with settings but without points; points of a file are read with the YAML."""
    if reference.file:
        raise UsageError(
            f"Expected reference.points, got reference.file {reference.file!r}, which is read where a YAML file is "
            "loaded; give the points, or lyapnet.experiment.config.load_config(PATH)."
        )
    if not reference.points and reference != ReferenceConfig():
        raise UsageError("Expected reference.file or reference.points, got neither; give one, or leave the rest out.")


class _Curve:
    """y(τ) = Σ c_k b_k(τ), with the functions b_k of a basis."""

    def __init__(self, basis: Basis, coefficients: Tensor):
        self.basis, self.coefficients = basis, coefficients

    def at(self, tau: Tensor) -> Tensor:
        """y at times (*batch, 1)."""
        return combine(self.basis(tau), self.coefficients)

    def rate(self, tau: Tensor) -> Tensor:
        """ẏ."""
        return jacobian_of(self.at, tau, self.coefficients.shape[-1])[..., 0]


def _points_of(config: Config, system: ControlSystem) -> tuple[np.ndarray, dict[int, np.ndarray]]:
    """The times of the reference's points (K,), and index ↦ values (K,) of the states that are given.

    Raises:
        UsageError: they do not fit each other, the system or the horizon.
    """
    reference, duration = config.reference, config.horizon.steps * config.horizon.dt
    points = {name.replace("_", " "): np.array(column) for name, column in reference.points.items()}
    if len(points) < len(reference.points):
        raise UsageError(f"Expected each state once in reference, got {', '.join(reference.points)}; leave one out.")
    if infinite := [name for name, column in points.items() if not np.isfinite(column).all()]:
        raise UsageError(f"Expected finite numbers in reference, got others for {infinite[0]}; correct them.")
    times = points.pop("t", np.empty(0)) / reference.speed
    if len(times) < 3 or times[0] != 0 or not (np.diff(times) > 0).all():
        raise UsageError("Expected reference.points.t as three or more rising times from 0, got others; correct them.")
    names = {name.replace("_", " "): i for i, name in enumerate(system.state_names)}
    values = dict[int, np.ndarray]()
    for name, column in points.items():
        if name not in names:
            hint = did_you_mean(name, names, "name states of the system.")
            raise UsageError(
                f"Expected reference.points of t and {', '.join(system.state_names)}, got {name!r}; {hint}"
            )
        if len(column) != len(times):
            raise UsageError(f"Expected {len(times)} numbers for {name}, one for each t, got {len(column)}.")
        if reference.periodic and abs(column[0] - column[-1]) > MAX_GAP * np.ptp(column):
            raise UsageError(
                f"Expected a periodic reference to end where it begins, got {name} from {column[0]:g} to "
                f"{column[-1]:g}; give the first point again at t = the period."
            )
        values[names[name]] = column
    if not values:
        raise UsageError(f"Expected a state in reference.points, got none of {', '.join(system.state_names)}.")
    if not reference.periodic and times[-1] < duration * (1 - 1e-9):
        raise UsageError(
            f"Expected a reference as long as the horizon, {duration:g} s, got {times[-1]:g} s; give further points, "
            "fewer horizon.steps, or reference.periodic: true."
        )
    if times[-1] < LEAST_STEPS * config.horizon.dt:
        raise UsageError(
            f"Expected a reference of {LEAST_STEPS} steps of {config.horizon.dt:g} s or more, got {times[-1]:g} s; "
            "choose a smaller horizon.dt or reference.speed."
        )
    return times, values


def _fit(
    times: np.ndarray,
    values: Mapping[int, np.ndarray],
    system: ControlSystem,
    initial_states: Box,
    periodic: bool,
) -> tuple[_Curve, _Curve, Tensor]:
    """r and u_r as smooth functions near the given points, and the rates that u_r leaves.

    States that are not given are rates of others, or 0.

    Raises:
        UsageError: no such function is within the tolerance.
    """
    from scipy.interpolate import CubicSpline  # imported here because it takes 0.3 s

    columns = np.stack([*values.values()], -1)
    columns[-1] = columns[0] if periodic else columns[-1]
    spline = CubicSpline(times, columns, bc_type="periodic" if periodic else "not-a-knot")
    rates, duration = _rates_of(system, initial_states, values), float(times[-1])
    zeros, extent = [i for i in range(system.n) if i not in values and i not in rates], np.ptp(columns, 0)
    if zeros:
        log_once(f"reference: 0 for {', '.join(system.state_names[i] for i in zeros)}, which are not given.")
    best: tuple[_Curve, _Curve, Tensor] | None = None
    for count in COUNTS:
        ends = torch.zeros(1, dtype=torch.float64), torch.tensor([duration], dtype=torch.float64)
        basis = FourierSeries(duration, count) if periodic else ChebyshevProducts(*ends, [count])
        given = _Curve(basis, basis.coefficients(torch.from_numpy(spline(basis.nodes()[:, 0].numpy()))))
        away = np.abs(given.at(torch.from_numpy(times)[:, None]).numpy() - columns) / np.where(extent > 0, extent, 1.0)
        if away.max() > (MAX_DISTANCE if count < COUNTS[-1] else MAX_DISTANCE_AT_LAST):
            continue
        coefficients = torch.zeros(count, system.n, dtype=torch.float64)
        coefficients[:, [*values]] = given.coefficients
        slope = basis.coefficients(given.rate(basis.nodes()))
        for i, j in rates.items():
            coefficients[:, i] = slope[:, [*values].index(j)]
        path = _Curve(basis, coefficients)
        control = _Curve(basis, basis.coefficients(_following_control(system, path, basis.nodes())))
        left = _rates_left(system, path, control, _between(times))
        if best is None or bool(left.max() < best[2].max() / 2):
            best = path, control, left
        if bool(left.max() <= MAX_RATE_LEFT / 10):
            break
    if best is None:
        raise UsageError(
            f"Expected a smooth reference, got one with jumps or corners that sums of {COUNTS[-1]} functions miss; "
            "round them, or give more points."
        )
    return best


def _rates_of(system: ControlSystem, initial_states: Box, given: Mapping[int, np.ndarray]) -> dict[int, int]:
    """Index of a state that is not given ↦ that of the given one whose rate it is, such as velocity ↦ position."""
    x = initial_states.sample(TEST_STATES, torch.Generator().manual_seed(0)).double()
    return {i: j for i, j in states_that_are_rates(system, x) if i not in given and j in given}


def _following_control(system: ControlSystem, path: _Curve, tau: Tensor) -> Tensor:
    """u with f(r) + g(r)u = ṙ, as the least squares solution of least norm, (b, m)."""
    r = path.at(tau)
    return apply(torch.linalg.pinv(system.g(r)), path.rate(tau) - system.f(r))


def _between(times: np.ndarray) -> Tensor:
    """Times (k, 1) at the points of the reference and between them."""
    return torch.linspace(0, float(times[-1]), TIMES_BETWEEN * len(times) + 1, dtype=torch.float64)[:, None]


def _rates_left(system: ControlSystem, path: _Curve, control: _Curve, tau: Tensor) -> Tensor:
    """max |f(r) + g(r)u_r − ṙ| of each state, relative to the largest |ṙ|, |f(r)| and |g(r)u_r|, (n,)."""
    r, rate = path.at(tau), path.rate(tau)
    f, pushed = system.f(r).expand_as(r), apply(system.g(r), control.at(tau))
    scale = torch.stack([rate, f, pushed]).abs().amax((0, 1))
    return (f + pushed - rate).abs().amax(0) / torch.where(scale > 0, scale, 1.0)


def _require_followed(system: ControlSystem, left: Tensor) -> None:
    worst = int(left.argmax())
    if not float(left[worst]) <= MAX_RATE_LEFT:
        raise UsageError(
            f"Expected a reference that some control follows, f(r) + g(r)u = ṙ, got {float(left[worst]):.2g} of the "
            f"rate of {system.state_names[worst]} left by any; {ADVICE}."
        )


def _log_exceeded_limits(system: ControlSystem, controls: ControlSet, u: Tensor) -> None:
    """Log which of the controls u (k, m) along the reference exceed their limits."""
    beyond = (controls.project(u) - u).abs().amax(0) > 0
    if bool(beyond.any()):
        names = ", ".join(name for name, far in zip(system.control_names, beyond.tolist(), strict=True) if far)
        log_once(
            f"reference: it needs more than the limits of {names} allow; the closed loop follows as well as it can."
        )

"""Control laws that are evaluated at certain times, by readings, and held in between: assumptions and simulations."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import torch

from lyapnet.base.types import Control, PerState, State, Time
from lyapnet.loop.rollout.closed_loop import ClosedLoop

SIMULATION_STEPS = 2  # Runge-Kutta steps from a reading to the time of interest
SIMULATED_RUNS = 3  # simulations from each reading if there are errors: one without errors, the others with random ones


@dataclass(frozen=True)
class Computed:
    """A program that computes the law in floating-point numbers, with its errors (lyapnet.prover.float_errors).

    Args:
        sha256: hash of its file.
        precision: "float32" or "float64".
        errors: the largest |ũ_j − u_j| of each control, in its unit, (m,), for readings at t ≤ latest.
        latest: in s.
    """

    sha256: str
    precision: str
    errors: Sequence[float]
    latest: float


@dataclass(frozen=True)
class Readings:
    """How often a control law is read, the delay until its control is used, and the errors of states and controls.

    A reading at t̂ gives the control u = policy(t̂, x(t̂) + e) + r. It is used from t̂ + d on, 0 ≤ d ≤ delay, until the
    control of the next reading is used, which is at most interval + delay after t̂. Controls are used in the order of
    their readings; that of t̂ = 0 is used at once.

    Args:
        interval: the longest time between two readings, in s.
        delay: the longest time from a reading to the use of its control, in s.
        errors: the largest |e_i| of each measured state, in its unit, (n,).
        control_errors: the largest |r_j| of each control, in its unit, (m,).
        duration: T in s; None for a receding law u = policy(0, x), used without end.
        computed: the program that computes the law, whose errors control_errors contains; None for real numbers.
    """

    interval: float
    delay: float
    errors: Sequence[float]
    control_errors: Sequence[float]
    duration: float | None
    computed: Computed | None = None

    @property
    def receding(self) -> bool:
        """Whether the law is policy(0, x), without end."""
        return self.duration is None

    @property
    def facts(self) -> dict[str, Any]:
        """The numbers as plain data."""
        return asdict(self, dict_factory=_plain_fields)

    @property
    def longest(self) -> float:
        """The longest time from a reading to the end of the use of its control, in s, rounded upwards."""
        return self.interval + self.delay if not self.delay else math.nextafter(self.interval + self.delay, math.inf)

    def control(self, loop: ClosedLoop, t: Time, x: State, e: State, r: Control) -> Control:
        """The control of a reading at (t, x), with the errors e of the state and r of the control."""
        return loop.policy(torch.zeros_like(t) if self.receding else t, x + e) + r

    def span(self, t: Time) -> Time:
        """The longest time in s from a reading at t to the end of the use of its control, which is at most T."""
        span = torch.full_like(t, self.longest)
        return span if self.duration is None else torch.minimum(span, self.duration - t)


def _plain_fields(items: list[tuple[str, Any]]) -> dict[str, Any]:
    """Fields by name, with lists for tuples; `computed` is left out if it is None."""
    given = ((name, value) for name, value in items if not (name == "computed" and value is None))
    return {name: list(value) if isinstance(value, tuple) else value for name, value in given}


def readings_from(facts: Any, duration: float | None) -> Readings | None:
    """Readings from their `facts`, which files of proofs contain; None for None, a law that is read at every t.

    Args:
        duration: as in Readings.

    Raises:
        ValueError: invalid numbers.
    """
    if facts is None:
        return None
    of = facts.get("computed")
    computed = of and Computed(
        str(of["sha256"]), str(of["precision"]), tuple(map(float, of["errors"])), float(of["latest"])
    )  # fmt: skip
    found = Readings(
        float(facts["interval"]), float(facts["delay"]), tuple(map(float, facts["errors"])),
        tuple(map(float, facts["control_errors"])), duration, computed,
    )  # fmt: skip
    numbers = [found.interval, found.delay, *found.errors, *found.control_errors]
    if not found.interval > 0 or not all(0 <= number < math.inf for number in numbers):
        raise ValueError("invalid readings")
    return found


class Run(NamedTuple):
    """Closed loops some time after a reading; each field is (runs, *batch, …)."""

    t: Time
    x: State
    u: Control  # the control in use
    drift: State  # the mean of ẋ since the reading, minus ẋ at the reading
    e: State
    r: Control


def simulate_runs(loop: ClosedLoop, readings: Readings, t: Time, x: State, share: PerState) -> Run:
    """Closed loops at t + share · span(t) whose control was read at (t, x) and used at once.

    The first run has no errors; the others have errors of their largest size and random sign. The integration takes
    SIMULATION_STEPS steps of the classical Runge-Kutta method.
    """
    bounds = [x.new_tensor(each) for each in (readings.errors, readings.control_errors)]
    generator, age, runs = torch.Generator().manual_seed(0), share * readings.span(t), []
    for k in range(SIMULATED_RUNS if any(readings.errors) or any(readings.control_errors) else 1):
        signs = [2 * torch.randint(2, each.shape, generator=generator).to(x) - 1 for each in bounds]
        e, r = ((bound * sign * (k > 0)).expand(*x.shape[:-1], -1) for bound, sign in zip(bounds, signs, strict=True))
        u, now = readings.control(loop, t, x, e, r), x
        for _ in range(SIMULATION_STEPS):
            now = _runge_kutta(loop, now, u, age / SIMULATION_STEPS)
        drift = (now - x) / age.clamp_min(1e-9)[..., None] - loop.system.dynamics(x, u)
        runs.append((t + age, now, u, torch.where(age[..., None] > 1e-9, drift, 0.0), e, r))
    return Run(*(torch.stack(each) for each in zip(*runs, strict=True)))


def _runge_kutta(loop: ClosedLoop, x: State, u: Control, step: PerState) -> State:
    """x after one step of the classical Runge-Kutta method with u held."""
    h, rate = step[..., None], loop.system.dynamics
    k1 = rate(x, u)
    k2 = rate(x + h / 2 * k1, u)
    k3 = rate(x + h / 2 * k2, u)
    k4 = rate(x + h * k3, u)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)

"""Recordings of a plant: times, controls and readings, from CSV files with named columns."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from lyapnet.base.errors import UsageError, did_you_mean
from lyapnet.base.names import with_underscores
from lyapnet.base.types import State
from lyapnet.experiment.csv_columns import read_columns
from lyapnet.lab.identification.units import factor, name_and_unit
from lyapnet.task.outputs import Outputs, Readings
from lyapnet.task.systems import ControlSystem

MOST_ROWS = 200_000  # largest number of rows of a file
LARGEST_FILE = 40_000_000  # largest size of a file in bytes
LARGEST = 1e30  # largest number; squares do not overflow
TIMES = ("t", "time")  # names of the column of times


@dataclass(frozen=True)
class Measurements:
    """One recording of a plant.

    Args:
        name: the name of its file, for messages.
        t: increasing times in s, (N,).
        u: controls in the order of the system, (N, m); u[k] is held from t[k] to t[k + 1].
        y: readings at t, (N, q).
        outputs: names of the readings: states, or outputs that the system declares.
        unread: headings of columns that are neither.
    """

    name: str
    t: Float[np.ndarray, " N"]
    u: Float[np.ndarray, "N m"]
    y: Float[np.ndarray, "N q"]
    outputs: tuple[str, ...]
    unread: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.t)

    def part(self, first: int, last: int) -> "Measurements":
        """Samples first, …, last − 1."""
        return replace(self, t=self.t[first:last], u=self.u[first:last], y=self.y[first:last])

    def pieces(self, length: int) -> list["Measurements"]:
        """Parts of this many samples; the last one may have up to half as many more."""
        first = range(0, max(1, len(self) - length // 2), length)
        return [self.part(i, i + length if i + length in first else len(self)) for i in first]


class NamedReadings(Outputs):
    """Readings by their names: states, and entries of the system's output(x).

    Args:
        system: the system.
        names: the names of the readings.
    """

    def __init__(self, system: ControlSystem, names: Sequence[str]):
        super().__init__([1.0] * len(names))
        known = readable(system)
        self.system, self.indices = system, [[*known].index(name) for name in names]
        self.names, self.units = list(names), [known[name] for name in names]
        self.angles = [k for k, i in enumerate(self.indices) if i in system.angles]

    def forward(self, x: State) -> Readings:
        return self.of(self.system, x)

    def of(self, system: ControlSystem, x: State) -> Readings:
        """The readings of a system of the same class with other parameters."""
        declared: Any = system
        if max(self.indices) >= system.n:
            x = torch.cat([x, declared.output(x)], -1)
        return x[..., self.indices]


def readable(system: ControlSystem) -> dict[str, str]:
    """Name ↦ unit of everything that can be read: states, then the outputs that the system declares."""
    states = dict(zip(system.state_names, system.state_units, strict=True))
    if not system.has_output:
        return states
    declared: Any = system
    count = declared.output(torch.zeros(1, system.n, dtype=torch.float64)).shape[-1]
    names = getattr(system, "output_names", None) or [f"reading {k + 1}" for k in range(count)]
    units = getattr(system, "output_units", None) or [""] * count
    return {**states, **dict(zip(names, units, strict=True))}


def read_measurements(path: Path, system: ControlSystem) -> Measurements:
    """A recording from a CSV file: t, a column for each control, and one or more for states or outputs.

    In names, `_` and a space are the same. A column may have a unit, as in "angle [deg]"; else it is the system's.

    Raises:
        UsageError: the file is no such table, a column is missing or occurs twice, or times do not increase.
    """
    columns = read_columns(path, MOST_ROWS, LARGEST_FILE, "begin with t, controls and states")
    outputs = readable(system)
    controls = dict(zip(system.control_names, system.control_units, strict=True))
    wanted = {with_underscores(name): (name, unit) for name, unit in {**outputs, **controls}.items()}
    wanted |= {name: ("t", "s") for name in TIMES if name not in wanted}
    found, unread = dict[str, np.ndarray](), list[str]()
    for heading, column in columns.items():
        written, unit = name_and_unit(heading)
        if with_underscores(written) not in wanted:
            unread.append(heading)
            continue
        name, own = wanted[with_underscores(written)]
        if name in found:
            raise UsageError(f"Expected {name} once in {str(path)!r}, got two columns; leave one of them out.")
        found[name] = np.array(column) * factor(unit, own, f"{name} of {str(path)!r}")
    missing = [name for name in ("t", *controls) if name not in found]
    names = [name for name in outputs if name in found]
    if missing or not names:
        absent = missing[0] if missing else f"one of {', '.join(outputs)}"
        hint = did_you_mean(missing[0] if missing else next(iter(outputs)), unread, "name it in the first row.")
        raise UsageError(f"Expected a column for {absent} in {str(path)!r}, got {', '.join(columns)[:200]!r}; {hint}")
    if large := [name for name, column in found.items() if np.abs(column).max() > LARGEST]:
        raise UsageError(
            f"Expected numbers below {LARGEST:g} for {large[0]} in {str(path)!r}, got larger; correct them."
        )
    times = found["t"]
    if not (np.diff(times) > 0).all():
        row = int(np.argmin(np.diff(times) > 0)) + 1
        raise UsageError(
            f"Expected rising times in {str(path)!r}, got {times[row]:g} s after {times[row - 1]:g} s in row {row + 2}"
            "; sort the rows."
        )
    u = np.stack([found[name] for name in controls], -1) if controls else np.empty((len(times), 0))
    y = np.stack([found[name] for name in names], -1)
    return Measurements(str(path), times, u, y, tuple(names), tuple(unread))

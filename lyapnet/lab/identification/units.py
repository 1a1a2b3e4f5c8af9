"""Units of columns, and their conversion to those of a system."""

import math
import re

from lyapnet.base.errors import UsageError

# unit ↦ (the unit of the same kind that it is a multiple of, the factor)
UNITS: dict[str, tuple[str, float]] = {
    "rad": ("rad", 1.0), "deg": ("rad", math.pi / 180), "°": ("rad", math.pi / 180), "rev": ("rad", 2 * math.pi),
    "rad/s": ("rad/s", 1.0), "deg/s": ("rad/s", math.pi / 180), "°/s": ("rad/s", math.pi / 180),
    "rev/s": ("rad/s", 2 * math.pi), "rpm": ("rad/s", math.pi / 30),
    "rad/s²": ("rad/s²", 1.0), "deg/s²": ("rad/s²", math.pi / 180), "m/s²": ("m/s²", 1.0), "N·m·s": ("N·m·s", 1.0),
    "m": ("m", 1.0), "km": ("m", 1e3), "cm": ("m", 1e-2), "mm": ("m", 1e-3), "µm": ("m", 1e-6),
    "m/s": ("m/s", 1.0), "cm/s": ("m/s", 1e-2), "mm/s": ("m/s", 1e-3), "km/h": ("m/s", 1 / 3.6),
    "s": ("s", 1.0), "ms": ("s", 1e-3), "µs": ("s", 1e-6), "min": ("s", 60.0), "h": ("s", 3600.0),
    "N": ("N", 1.0), "mN": ("N", 1e-3), "kN": ("N", 1e3), "N·m": ("N·m", 1.0), "mN·m": ("N·m", 1e-3),
    "kg": ("kg", 1.0), "g": ("kg", 1e-3), "V": ("V", 1.0), "mV": ("V", 1e-3), "A": ("A", 1.0), "mA": ("A", 1e-3),
    "W": ("W", 1.0), "kW": ("W", 1e3), "Pa": ("Pa", 1.0), "kPa": ("Pa", 1e3), "bar": ("Pa", 1e5),
    "L": ("L", 1.0), "mL": ("L", 1e-3), "m³": ("L", 1e3),
    "L/s": ("L/s", 1.0), "mL/s": ("L/s", 1e-3), "L/min": ("L/s", 1 / 60), "m³/s": ("L/s", 1e3),
    "m³/h": ("L/s", 1 / 3.6), "K": ("K", 1.0),
}  # fmt: skip
SPELLINGS = {
    "Nm": "N·m", "N m": "N·m", "N*m": "N·m", "mNm": "mN·m", "mN*m": "mN·m", "degree": "deg", "degrees": "deg",
    "degrees/s": "deg/s", "l": "L", "l/s": "L/s", "ml/s": "mL/s", "l/min": "L/min", "m3": "m³", "m^3": "m³",
    "m3/s": "m³/s", "m^3/s": "m³/s", "m3/h": "m³/h", "m^3/h": "m³/h", "us": "µs", "um": "µm", "sec": "s",
    "m/s2": "m/s²", "m/s^2": "m/s²",
}  # fmt: skip
_WITH_UNIT = re.compile(r"(.*?)\s*[\[(]([^\[\]()]*)[\])]")


def name_and_unit(heading: str) -> tuple[str, str]:
    """("angle", "deg") for "angle [deg]" or "angle (deg)"; the unit is empty if there is none."""
    found = _WITH_UNIT.fullmatch(heading.strip())
    return (found[1], found[2].strip()) if found else (heading.strip(), "")


def factor(unit: str, wanted: str, column: str) -> float:
    """The factor that converts numbers from a unit to the wanted unit; 1 for a column without unit.

    Raises:
        UsageError: the unit is unknown or of another kind; the message names the column.
    """
    unit, goal = (SPELLINGS.get(each, each) for each in (unit, wanted))
    if not unit or unit == goal:
        return 1.0
    kind, size = UNITS.get(goal, (goal, 1.0))
    if unit not in UNITS or UNITS[unit][0] != kind:
        known = ", ".join(each for each, (other, _) in UNITS.items() if other == kind) or wanted or "no unit"
        raise UsageError(f"Expected {column} in a unit of its kind ({known}), got {unit!r}; convert the column.")
    return UNITS[unit][1] / size

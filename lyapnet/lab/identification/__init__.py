"""Parameters of a system from measurements, as `lyapnet identify` finds them."""

from lyapnet.lab.identification.identify import identify
from lyapnet.lab.identification.measurements import Measurements, read_measurements
from lyapnet.lab.identification.residuals import ResidualTest
from lyapnet.lab.identification.results import CONFIDENCE, Curve, Estimate, Identification
from lyapnet.lab.identification.unknown_system import system_of

__all__ = [
    "CONFIDENCE",
    "Curve",
    "Estimate",
    "Identification",
    "Measurements",
    "ResidualTest",
    "identify",
    "read_measurements",
    "system_of",
]

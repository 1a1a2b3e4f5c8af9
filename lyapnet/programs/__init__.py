"""The two programs of the paper, with the terms that make them stronger, and that of a region of attraction."""

from lyapnet.programs.base import Program, ProgramOutput
from lyapnet.programs.lyapunov import LyapunovProgram
from lyapnet.programs.pointwise import PointwiseCondition
from lyapnet.programs.region import RegionCondition, RegionProgram
from lyapnet.programs.tolerances import EVENTS, Tolerances
from lyapnet.programs.value import ValueProgram

PROGRAMS: dict[str, type[Program]] = {"value": ValueProgram, "lyapunov": LyapunovProgram, "region": RegionProgram}

__all__ = [
    "EVENTS",
    "PROGRAMS",
    "LyapunovProgram",
    "PointwiseCondition",
    "Program",
    "ProgramOutput",
    "RegionCondition",
    "RegionProgram",
    "Tolerances",
    "ValueProgram",
]

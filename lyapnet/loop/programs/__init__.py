"""The two programs of the paper with additional terms, and the program of a region of attraction."""

from lyapnet.loop.programs.base import Program, ProgramOutput
from lyapnet.loop.programs.lyapunov import LyapunovProgram
from lyapnet.loop.programs.pointwise import PointwiseCondition
from lyapnet.loop.programs.region import RegionCondition, RegionProgram
from lyapnet.loop.programs.tolerances import EVENTS, Tolerances
from lyapnet.loop.programs.value import ValueProgram

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

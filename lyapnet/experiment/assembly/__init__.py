"""Builds the objects of a config."""

from lyapnet.experiment.assembly.classes import (
    DTYPES,
    REGISTRIES,
    Parts,
    default_of,
    own_parts,
    resolve,
    without_unread_settings,
)
from lyapnet.experiment.assembly.entries import entry_per_state
from lyapnet.experiment.assembly.family import is_in_range, member, ranges_of
from lyapnet.experiment.assembly.learner import build_program, build_rollout, build_value_function
from lyapnet.experiment.assembly.named_parts import parts_named, parts_of
from lyapnet.experiment.assembly.plants import build_plants
from lyapnet.experiment.assembly.problem import build_problem, build_system, operating_point, with_parameters
from lyapnet.experiment.assembly.weights import named

__all__ = [
    "DTYPES",
    "REGISTRIES",
    "Parts",
    "build_plants",
    "build_problem",
    "build_program",
    "build_rollout",
    "build_system",
    "build_value_function",
    "default_of",
    "entry_per_state",
    "is_in_range",
    "member",
    "named",
    "operating_point",
    "own_parts",
    "parts_named",
    "parts_of",
    "ranges_of",
    "resolve",
    "with_parameters",
    "without_unread_settings",
]

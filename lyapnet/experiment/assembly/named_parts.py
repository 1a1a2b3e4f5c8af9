"""Builds the user's own parts that a config names."""

import copy
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from lyapnet.experiment.assembly.classes import (
    Parts,
    class_of,
    instance_of,
    own_parts,
    section_without_unread_settings,
)
from lyapnet.experiment.assembly.learner import build_program, program_options
from lyapnet.experiment.assembly.problem import build_cost, build_system, refuse_two_sets
from lyapnet.experiment.config import Config


def parts_of(config: Config) -> Parts:
    """Import the user's parts that a config names as module:Class; registered parts remain None.

    Raises:
        UsageError: no such module or class, or it does not accept its arguments.
    """
    refuse_two_sets(config.controls)
    return parts_named(config, own_parts(config))


def parts_named(config: Config, names: Mapping[str, str]) -> Parts:
    """Import parts by section and class name, with the other options of a config; see parts_of.

    What only the class that is replaced would read, such as cost.Q, is left out.
    """
    config = copy.deepcopy(config)
    for part, name in names.items():
        options = getattr(config, part)
        if options.name != name:
            setattr(config, part, section_without_unread_settings(replace(options, name=name), part))
    builders: dict[str, Callable[[], Any]] = {
        "system": lambda: build_system(config.system),
        "cost": lambda: build_cost(config.cost),
        "controls": lambda: instance_of(config.controls, "controls"),
        "constraints": lambda: instance_of(config.constraints, "constraints"),
        "network": lambda: class_of(config.network, "network"),
        "program": lambda: build_program(config),
    }
    return Parts(**{part: builders[part]() for part in names})


def python_expression(config: Config, part: str) -> str:
    """The Python expression that builds a user's part of a config, assuming that its module is imported."""
    options = getattr(config, part)
    name = options.name.replace(":", ".")
    if part == "network":  # lyapnet.load expects its class
        return name
    given = {**(program_options(config) if part == "program" else {}), **options.parameters}
    return f"{name}({', '.join(f'{key}={value!r}' for key, value in given.items())})"

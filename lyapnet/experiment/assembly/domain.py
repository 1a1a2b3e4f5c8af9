"""From a config to the domain of its problem: the borders that are declared, and those that are found."""

import math

from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly.classes import section
from lyapnet.experiment.assembly.entries import index_of
from lyapnet.experiment.config import DomainConfig
from lyapnet.task.domain import Border
from lyapnet.task.problem import Problem


def in_domain(config: DomainConfig, problem: Problem) -> Problem:
    """The problem within its domain; itself where it has none, or is in one already.

    Raises:
        UsageError: a border is of no state, no finite number, or X₀ reaches it.
    """
    if problem.domain is not None:  # made by hand
        return problem
    with section("domain"):
        declared = [border for side in ("lower", "upper") for border in _declared(side, config, problem)]
    return problem.within([*problem.borders(), *declared])


def _declared(side: str, config: DomainConfig, problem: Problem) -> list[Border]:
    """The borders of one side that a config has, each with X₀ strictly within."""
    box, borders = problem.initial_states, list[Border]()
    for name, value in getattr(config, side).items():
        i = index_of(name, f"domain.{side}", problem.system)
        if not math.isfinite(value):
            raise UsageError(f"Expected domain.{side}.{name} as a finite number, got {value}; leave it out.")
        end = float(getattr(box, side)[i])
        if value >= end if side == "lower" else value <= end:
            raise UsageError(
                f"Expected domain.{side}.{name} {'<' if side == 'lower' else '>'} {end:g}, where X₀ ends, got "
                f"{value:g}; move the border, or shrink initial_states."
            )
        borders.append(Border(name, side, value, "as declared"))
    return borders

"""Builds the domain of a problem from declared borders and those found by a search."""

import math

from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly.classes import section
from lyapnet.experiment.assembly.entries import by_state
from lyapnet.experiment.config import DomainConfig
from lyapnet.task.domain import Border
from lyapnet.task.problem import Problem


def in_domain(config: DomainConfig, problem: Problem) -> Problem:
    """The problem restricted to its domain; the problem itself if it needs none or has one already.

    Raises:
        UsageError: a border names no state, is not finite, or touches X₀.
    """
    if problem.domain is not None:  # set by the user
        return problem
    with section("domain"):
        declared = [border for side in ("lower", "upper") for border in _declared(side, config, problem)]
    return problem.within([*problem.borders(), *declared])


def _declared(side: str, config: DomainConfig, problem: Problem) -> list[Border]:
    """The declared borders of one side; X₀ has to be strictly inside."""
    box, borders = problem.initial_states, list[Border]()
    for i, value in by_state(getattr(config, side), f"domain.{side}", problem.system).items():
        name = problem.system.state_names[i]
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

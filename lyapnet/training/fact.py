"""A fact of a task, and the facts that its config alone tells, for which nothing is loaded."""

from collections.abc import Sequence
from typing import NamedTuple

from lyapnet.experiment.config import Config


class Fact(NamedTuple):
    """A line: what it is about, what was found, and what to do where that is a reason to."""

    name: str
    found: str
    advice: str = ""


def facts_of_config(config: Config) -> list[Fact]:
    """The horizon and X₀ as they are written."""
    horizon, box = config.horizon, config.initial_states
    steps = f"{horizon.steps} step{'s' * (horizon.steps > 1)}"
    end = ", and on: without end" if horizon.stationary else ""
    return [
        Fact("horizon", f"T = {horizon.steps * horizon.dt:g} s in {steps} of {horizon.dt:g} s{end}"),
        Fact("X₀", f"between {listed(box.lower)} and {listed(box.upper)}"),
    ]


def listed(numbers: Sequence[float]) -> str:
    """Numbers as a tuple of three digits each."""
    return "(" + ", ".join(f"{number:.3g}" for number in numbers) + ")"

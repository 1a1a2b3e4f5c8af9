"""A fact about a task, and the facts that follow from its config alone, without building the task."""

from collections.abc import Sequence
from typing import NamedTuple

from lyapnet.experiment.config import Config


class Fact(NamedTuple):
    """One line of a report: subject, finding, and advice if the finding calls for a change."""

    name: str
    found: str
    advice: str = ""


def facts_of_config(config: Config) -> list[Fact]:
    """The horizon and X₀ as the config gives them."""
    horizon, box = config.horizon, config.initial_states
    steps = f"{horizon.steps} step{'s' * (horizon.steps > 1)}"
    end = ", and on: without end" if horizon.stationary else ""
    return [
        Fact("horizon", f"T = {horizon.steps * horizon.dt:g} s in {steps} of {horizon.dt:g} s{end}"),
        Fact("X₀", f"between {format_numbers(box.lower)} and {format_numbers(box.upper)}"),
    ]


def format_numbers(numbers: Sequence[float]) -> str:
    """Format numbers as a tuple, with three digits each."""
    return "(" + ", ".join(f"{number:.3g}" for number in numbers) + ")"

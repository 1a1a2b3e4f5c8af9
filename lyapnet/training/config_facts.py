"""A fact about a task, and the facts that follow from its config alone, without building the task."""

from collections.abc import Sequence
from typing import NamedTuple

from lyapnet.experiment.config import Config, OutputsConfig

OUTPUTS, OBSERVABLE = "outputs", "observable"  # names of facts: the outputs, and whether they determine the state


class Fact(NamedTuple):
    """One line of a report: subject, finding, and advice if the finding calls for a change."""

    name: str
    found: str
    advice: str = ""


def facts_of_config(config: Config) -> list[Fact]:
    """The horizon, X₀ and the outputs as the config gives them."""
    horizon, box = config.horizon, config.initial_states
    steps = f"{horizon.steps} step{'s' * (horizon.steps > 1)}"
    end = ", and on: without end" if horizon.stationary else ""
    return [
        Fact("horizon", f"T = {horizon.steps * horizon.dt:g} s in {steps} of {horizon.dt:g} s{end}"),
        Fact("X₀", between(box.lower, box.upper)),
        *_outputs_facts(config.outputs),
    ]


def _outputs_facts(outputs: OutputsConfig) -> list[Fact]:
    """The outputs, if the config has some."""
    if outputs.noise is None:
        return []
    noise = outputs.noise * len(outputs.measure) if len(outputs.noise) == 1 else outputs.noise
    if not outputs.measure:
        return [Fact(OUTPUTS, f"output(x) of the system ± {format_numbers(outputs.noise)}")]
    read = (f"{name} ± {each:.3g}" for name, each in zip(outputs.measure, noise, strict=False))
    return [Fact(OUTPUTS, ", ".join(read))]


def between(lower: Sequence[float], upper: Sequence[float]) -> str:
    """Describe a box; a single number on both sides holds for each state."""
    if len(lower) == len(upper) == 1:
        return f"each state between {lower[0]:.3g} and {upper[0]:.3g}"
    return f"between {format_numbers(lower)} and {format_numbers(upper)}"


def format_numbers(numbers: Sequence[float]) -> str:
    """Format numbers as a tuple, with three digits each."""
    return "(" + ", ".join(f"{number:.3g}" for number in numbers) + ")"

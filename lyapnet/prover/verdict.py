"""The verdict on a claim."""

from typing import Literal

Verdict = Literal["certified", "falsified", "unknown"]


def verdict_on(proved: float, wanted: float, failing: float | None, least: float) -> Verdict:
    """The verdict on the claim that a condition holds on a sublevel set of W that contains X₀.

    Args:
        proved: the level up to which the condition was proved.
        wanted: a level whose sublevel set contains X₀.
        failing: W at a point where the condition fails; None if none was found.
        least: every sublevel set that contains X₀ has at least this level.
    """
    if proved >= wanted:
        return "certified"
    return "falsified" if failing is not None and failing <= least else "unknown"


def time_limit_reason(set_up: float) -> str:
    """The reason, for messages, why a search that ran out of time left boxes undecided.

    Args:
        set_up: seconds of the budget that were used before the first box was bounded (imports, tracing, the domain).
    """
    return f"seconds spent, {set_up:.0f} of them before the first box"

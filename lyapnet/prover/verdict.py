"""The verdict on a claim."""

from typing import Literal

Verdict = Literal["certified", "falsified", "unknown"]


def verdict_on(proved: float, wanted: float, fails: float | None, least: float) -> Verdict:
    """The verdict on the claim that a condition holds on a sublevel set of W that contains X₀.

    Args:
        proved: the level up to which the condition was proved.
        wanted: a level whose sublevel set contains X₀.
        fails: W at a point where the condition fails; None if none was found.
        least: a level below which no sublevel set contains X₀.
    """
    if proved >= wanted:
        return "certified"
    return "falsified" if fails is not None and fails <= least else "unknown"


def time_spent(set_up: float) -> str:
    """Why a search ended with boxes undecided.

    Args:
        set_up: seconds of the budget that passed before the first box: imports, tracing, the domain and its levels.
    """
    return f"seconds spent, {set_up:.0f} of them before the first box"

"""What is said of a claim in the end."""

from typing import Literal

Verdict = Literal["certified", "falsified", "unknown"]


def verdict_on(proved: float, wanted: float, fails: float | None, least: float) -> Verdict:
    """On the claim that a sublevel set of W on which a condition holds contains all of X₀.

    Args:
        proved: the level up to which the condition was proved.
        wanted: a level whose sublevel set contains X₀.
        fails: W where the condition fails; None where no such point was found.
        least: sublevel sets of lower levels do not contain X₀.
    """
    if proved >= wanted:
        return "certified"
    return "falsified" if fails is not None and fails <= least else "unknown"


def time_spent(set_up: float) -> str:
    """Why a search ended with boxes undecided.

    Args:
        set_up: seconds of the budget that had passed before the first box: importing, tracing, D and its levels.
    """
    return f"seconds spent, {set_up:.0f} of them before the first box"

"""What a training may start from: each candidate with what it costs, and the one that was chosen."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from lyapnet.value.linearisation import Missing

MISSED = 0.02  # of the cost: what steps may miss of continuous time without a word
ALIKE = 5e-4  # of a cost: candidates that differ by less are told as equal
MUCH = 0.03  # of the cost: what a law that looks ahead has to gain, as it takes longer
CALM = "V = 0"


class Candidate(NamedTuple):
    """A start that was tried, or that could not be."""

    name: str
    cost: float  # mean J_N from states of X₀; infinite where a closed loop is not finite
    finite: float  # share of the closed loops
    seconds: float  # from when starts began to be sought until it was rolled out
    missing: Missing | None = None  # why there is nothing to try
    note: str = ""  # what was done to have it
    kept: bool = False  # by an earlier search, whose seconds these are


class Start(NamedTuple):
    """The start of a training: the candidate of least cost, and the others."""

    chosen: Candidate
    candidates: Sequence[Candidate]
    held_cost: float  # of the chosen one in continuous time, u held for Δt
    gain_ahead: float = 0.0  # share of the cost that the law that looks ahead saves, with the chosen V

    @property
    def steps_miss(self) -> str:
        """What the steps of the rollout miss of continuous time; empty where that is little."""
        if self.chosen.finite < 1 or not self.chosen.cost or self.chosen.name == CALM:
            return ""
        ratio = self.held_cost / self.chosen.cost
        if abs(ratio - 1) <= MISSED:
            return ""
        by = f"{ratio:.3g} times as much" if math.isfinite(ratio) else "more than any number"
        if self.chosen.cost < 0 and math.isfinite(ratio):
            by = f"{self.held_cost:.4g} in the place of {self.chosen.cost:.4g}"
        return f"in continuous time, u held for Δt, the law that training starts from costs {by}"

    @property
    def should_look_ahead(self) -> bool:
        """Whether V's sampled law costs much more than the one that looks ahead."""
        return self.gain_ahead > MUCH

    @property
    def about_law(self) -> str:
        """What looking ahead saves."""
        return f"rollout.policy=lookahead, with V as it is, costs {self.gain_ahead:.2g} of the cost less than sampled"

    def __str__(self) -> str:
        others = "; ".join(self._beside(other) for other in self.candidates if other != self.chosen)
        finite = "" if self.chosen.finite == 1 else f", {format_cost(self.chosen)} of X₀"
        tried = sum(each.missing is None for each in self.candidates)
        said = f"start: {self.chosen.name}, the cheapest of {tried}{finite}" + (others and f" ({others})")
        earlier = ["found by an earlier search"] if self.chosen.kept else []
        return "; ".join([said, *(f"{each.name}: {each.note}" for each in self.candidates if each.note), *earlier])

    def _beside(self, other: Candidate) -> str:
        """What is said of a candidate that was not chosen: a ratio, as other states than these are told costs of."""
        if other.missing is not None:
            return f"no {other.name.removeprefix('the ')}: {other.missing.reason}"
        if other.finite < 1 or not 0 < self.chosen.cost < math.inf:
            return f"{other.name}: {format_cost(other)}"
        ratio = other.cost / self.chosen.cost
        return f"{other.name}: {'as cheap' if abs(ratio - 1) < ALIKE else f'{ratio:.4g} times its cost'}"

    def as_json(self) -> dict[str, Any]:
        notes = {c.name: c.note for c in self.candidates if c.note}
        return {
            "chosen": self.chosen.name,
            "tried": {c.name: c.cost if c.finite == 1 else None for c in self.candidates},
            "held_cost": self.held_cost if math.isfinite(self.held_cost) else None,
            "gain_ahead": self.gain_ahead,
            "seconds": {c.name: round(c.seconds, 2) for c in self.candidates},
            **({"notes": notes} if notes else {}),
        }


def format_cost(candidate: Candidate) -> str:
    """A mean cost, or on what share of the states it is not finite."""
    return f"{candidate.cost:.4g}" if candidate.finite == 1 else f"not finite on {1 - candidate.finite:.0%}"

"""Candidates for the initial V of a training with their costs, and the chosen one."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from lyapnet.value.linearisation import Missing

REPORTED_STEP_ERROR = 0.02  # largest relative difference of rollout and continuous-time cost that is not reported
EQUAL_COST_TOLERANCE = 5e-4  # relative difference below which two candidates are reported as equally cheap
MIN_LOOKAHEAD_GAIN = 0.03  # relative gain in cost that justifies the slower lookahead law
ZERO_VALUE = "V = 0"  # name of the candidate V = 0


class Candidate(NamedTuple):
    """An initial V that was tried, or the reason why it could not be tried."""

    name: str
    cost: float  # mean J_N from states of X₀; infinite where a closed loop is not finite
    finite: float  # share of the closed loops that are finite
    seconds: float  # from the beginning of the search to the end of this rollout
    missing: Missing | None = None  # why the candidate does not exist
    note: str = ""  # how it was obtained, where that needs a remark
    kept: bool = False  # found by an earlier search; `seconds` are those of that search


class Start(NamedTuple):
    """The initial V of a training: the candidate of least cost, and the others."""

    chosen: Candidate
    candidates: Sequence[Candidate]
    held_cost: float  # cost of the chosen candidate in continuous time with u held for Δt
    gain_ahead: float = 0.0  # relative cost that the lookahead law saves with the chosen V

    @property
    def steps_miss(self) -> str:
        """Compare the cost in continuous time with that of the rollout; empty if they nearly agree."""
        if self.chosen.finite < 1 or not self.chosen.cost or self.chosen.name == ZERO_VALUE:
            return ""
        ratio = self.held_cost / self.chosen.cost
        if abs(ratio - 1) <= REPORTED_STEP_ERROR:
            return ""
        by = f"{ratio:.3g} times as much" if math.isfinite(ratio) else "more than any number"
        if self.chosen.cost < 0 and math.isfinite(ratio):
            by = f"{self.held_cost:.4g} in the place of {self.chosen.cost:.4g}"
        return f"in continuous time, u held for Δt, the law that training starts from costs {by}"

    @property
    def should_look_ahead(self) -> bool:
        """Whether the sampled law of V costs much more than the lookahead law."""
        return self.gain_ahead > MIN_LOOKAHEAD_GAIN

    @property
    def about_law(self) -> str:
        """State how much the lookahead law saves."""
        return f"rollout.policy=lookahead, with V as it is, costs {self.gain_ahead:.2g} of the cost less than sampled"

    def __str__(self) -> str:
        others = "; ".join(self._describe_other(other) for other in self.candidates if other != self.chosen)
        finite = "" if self.chosen.finite == 1 else f", {format_cost(self.chosen)} of X₀"
        tried = sum(each.missing is None for each in self.candidates)
        line = f"start: {self.chosen.name}, the cheapest of {tried}{finite}" + (others and f" ({others})")
        earlier = ["found by an earlier search"] if self.chosen.kept else []
        return "; ".join([line, *(f"{each.name}: {each.note}" for each in self.candidates if each.note), *earlier])

    def _describe_other(self, other: Candidate) -> str:
        """Describe a candidate that was not chosen by its cost relative to the chosen one."""
        if other.missing is not None:
            return f"no {other.name.removeprefix('the ')}: {other.missing.reason}"
        if other.finite < 1 or not 0 < self.chosen.cost < math.inf:
            return f"{other.name}: {format_cost(other)}"
        ratio = other.cost / self.chosen.cost
        return f"{other.name}: {'as cheap' if abs(ratio - 1) < EQUAL_COST_TOLERANCE else f'{ratio:.4g} times its cost'}"

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
    """Format the mean cost, or the share of states on which it is not finite."""
    return f"{candidate.cost:.4g}" if candidate.finite == 1 else f"not finite on {1 - candidate.finite:.0%}"

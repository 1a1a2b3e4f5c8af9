"""Tubes from two sides: what the controller costs at most by its tube, and what any control costs at least by V."""

import time
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any, ClassVar

from lyapnet.certification.branch_and_bound import Budget
from lyapnet.certification.from_below import FromBelow
from lyapnet.certification.least_cost import LowerClaim, lower_claim
from lyapnet.certification.proof import Progress
from lyapnet.certification.sound_certificate import default_delta, parse_set
from lyapnet.certification.tubes import figures
from lyapnet.certification.tubes.certificate import TubeCertificate
from lyapnet.certification.tubes.tube import TubeClaim, tube_claim
from lyapnet.certification.verdict import Verdict
from lyapnet.controller import Controller
from lyapnet.random_streams import CERTIFICATION, stream
from lyapnet.types import PerState

FOR_TUBE = 0.5  # of the seconds; what it leaves is for the bound from below


class TwoSidedTube(TubeCertificate):
    """The tube of all closed loops from X₀ with their cost in it, and the optimum from below."""

    picture: ClassVar[str] = "two_sided_tube.png"
    labels: ClassVar[Mapping[str, str]] = {
        **{key: label for key, label in TubeCertificate.labels.items() if key not in ("seconds", "fingerprint")},
        "beta": "β", "delta": "δ in cost per second",
        **FromBelow.labels,
        "seconds": "seconds",
        "fingerprint": "fingerprint of what was bounded",
        "lower_fingerprint": "fingerprint from below",
    }  # fmt: skip

    def __init__(self, controller: Controller, claim: TubeClaim, lower: LowerClaim, options: Mapping[str, Any]):
        super().__init__(controller, claim, options)
        self.below = FromBelow(lower)

    @property
    def verdict(self) -> Verdict:
        """On both: a tube for all of X₀, and the bound from below on all of it."""
        return self.below.verdict(self.claim.verdict)

    @cached_property
    def value(self) -> PerState:
        """V(0, x₀) of the states that are compared."""
        return self.controller.value(0.0, self.compared.x0).double()

    def numbers(self) -> dict[str, Any]:
        lower, high = self.below.claim, self.compared.high
        return {
            **super().numbers(), "beta": lower.beta, "delta": lower.delta, **self.below.proved(),
            **self.below.against(self.value, high),
            **self.below.around_optima(self.value, high, self.compared.optimum),
            "seconds": self.claim.seconds + lower.seconds,
        }  # fmt: skip

    def in_words(self) -> str:
        return f"{super().in_words()} {self.below.in_words()}"

    def in_formulas(self) -> list[str]:
        return [*super().in_formulas(), *self.below.in_formulas()]

    def of_the_verdict(self) -> str:
        return f"{super().of_the_verdict()} {self.below.of_the_verdict()}"

    def figure(self) -> figures.Figure:
        lower = self.below.claim
        least = lower.least_cost(self.value), self.below.whose
        headline = self.below.headline(self.verdict, self.result.get("certified_ratio"))
        numbers = f"{self._proved()}; β = {lower.beta:g}, δ = {lower.delta:.3g}; {self.below.holds_for}"
        return figures.tube(self.claim, self.controller, self.compared, f"{headline}\n{numbers}", least)


def two_sided_tube(
    controller: Controller,
    beta: float = 0.95,
    delta: float | None = None,
    set: str | None = None,
    radius: float | None = None,
    seconds: float = 60.0,
    workers: int = 1,
    seed: int = 0,
    report: Callable[[Progress], None] | None = None,
    *,
    started: float | None = None,
) -> TwoSidedTube:
    """What the controller costs at most by the tube of its closed loops, and what any control costs at least.

    Args:
        beta: the share of V that is the bound from below.
        delta: its slack in cost per second; default_delta if None.
        set: D of the bound from below; found if None.
        radius, seed: of tube_certificate.
        seconds: of which the tube has half, and the bound from below the rest.
        workers, report, started: as of tube_certificate.
    """
    begun = time.monotonic() if started is None else started
    states = None if set is None else parse_set(set)
    slack = default_delta(controller) if delta is None else delta
    claim = tube_claim(controller, Budget(FOR_TUBE * seconds, workers=workers, started=begun), radius, report)
    budget = Budget(seconds, workers=workers, started=begun)
    lower = lower_claim(
        controller.closed_loop, controller.problem, beta, slack, states, budget, stream(seed, CERTIFICATION), report
    )
    options = {
        "two-sided": True, "beta": beta, "delta": delta, "set": set, "radius": radius, "seconds": seconds,
        "workers": workers, "seed": seed,
    }  # fmt: skip
    return TwoSidedTube(controller, claim, lower, options)

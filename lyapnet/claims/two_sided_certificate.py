"""Certificates from two sides: what the controller costs at most, and what any control costs at least."""

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar

from lyapnet.base.random_streams import CERTIFICATION, stream
from lyapnet.claims import figures
from lyapnet.claims.from_below import FromBelow
from lyapnet.claims.funnel import SoundClaim, sound_claim
from lyapnet.claims.least_cost import DEGREE, LowerClaim, lower_claim
from lyapnet.claims.sound_certificate import (
    SoundCertificate,
    default_delta,
    parse_set,
    states_inside,
)
from lyapnet.controller.controller import Controller
from lyapnet.prover.branch_and_bound import Budget
from lyapnet.prover.proof import Progress
from lyapnet.prover.verdict import Verdict

FOR_UPPER = 0.55  # of the seconds; the others are for the bound from below


class TwoSidedCertificate(SoundCertificate):
    """The funnel of a sound certificate with the cost in it, and the optimum from below."""

    picture: ClassVar[str] = "two_sided.png"
    labels: ClassVar[Mapping[str, str]] = FromBelow.labels_after(SoundCertificate.labels)

    def __init__(self, controller: Controller, claim: SoundClaim, lower: LowerClaim, options: Mapping[str, Any]):
        super().__init__(controller, claim, options)
        self.below = FromBelow(lower)

    @property
    def verdict(self) -> Verdict:
        """On both: a funnel for all of X₀, and the bound from below on all of it."""
        return self.below.verdict(self.claim.verdict)

    def numbers(self) -> dict[str, Any]:
        return {**super().numbers(), **self.below.around_optima(*self.compared)}

    def proved(self) -> dict[str, Any]:
        _, value, guaranteed = states_inside(self.controller, self.claim)
        return {
            **super().proved(), **self.below.proved(), **self.below.against(value, guaranteed),
            "seconds": self.claim.seconds + self.below.claim.seconds,
        }  # fmt: skip

    def in_words(self) -> str:
        return f"{super().in_words()} {self.below.in_words()}"

    def in_formulas(self) -> list[str]:
        return [*super().in_formulas(), *self.below.in_formulas()]

    def of_the_verdict(self) -> str:
        return f"{super().of_the_verdict()} {self.below.of_the_verdict()}"

    def figure(self) -> figures.Figure:
        value, guaranteed, optimum = self.compared
        least, claim = self.below.claim.least_cost(value), self.claim
        numbers = f"α = β = {claim.alpha:g}, δ = {claim.delta:.3g}"
        headline = self.below.headline(self.verdict, self.result.get("certified_ratio"), numbers)
        return figures.two_sided(value, guaranteed, least, optimum, headline, self.below.whose)


def two_sided_certificate(
    controller: Controller,
    alpha: float = 0.95,
    delta: float | None = None,
    set: str | None = None,
    seconds: float = 60.0,
    workers: int = 1,
    device: str = "cpu",
    keep: str | None = None,
    seed: int = 0,
    report: Callable[[Progress], None] | None = None,
    *,
    ray: str | None = None,
    started: float | None = None,
) -> TwoSidedCertificate:
    """What the controller costs at most, and what any control costs at least, from X₀.

    Args:
        alpha: the share of ℓ that V pays for from above, and β, the share of V that is the bound from below.
        delta: slack of both in cost per second; default_delta if None.
        set: D of both; each found if None.
        seconds: of which each side has about half.
        keep: a file in which both proofs are kept, and from which they go on.
        workers, device, seed, report, ray, started: as of sound_certificate.
    """
    begun = time.monotonic() if started is None else started
    states = None if set is None else parse_set(set)
    slack = default_delta(controller) if delta is None else delta
    loop, problem, file = controller.closed_loop, controller.problem, None if keep is None else Path(keep)
    above = Budget(FOR_UPPER * seconds, workers=workers, device=device, ray=ray, started=begun)
    upper = sound_claim(
        loop, problem, alpha, slack, states, above, stream(seed, CERTIFICATION), report, file, degree=DEGREE
    )
    budget = Budget(seconds, workers=workers, device=device, ray=ray, started=begun)
    lower = lower_claim(loop, problem, alpha, slack, states, budget, stream(seed, CERTIFICATION), report, file)
    options = {
        "alpha": alpha, "delta": delta, "set": set, "seconds": seconds, "workers": workers, "device": device,
        "ray": ray, "two-sided": True, "keep": keep, "seed": seed,
    }  # fmt: skip
    return TwoSidedCertificate(controller, upper, lower, options)

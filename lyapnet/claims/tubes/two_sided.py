"""Tubes from two sides: what the controller costs at most by its tube, and what any control costs at least by V."""

import math
import time
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any, ClassVar

import torch

from lyapnet.base.contracts import copied
from lyapnet.base.errors import Interrupted
from lyapnet.base.random_streams import CERTIFICATION, stream
from lyapnet.base.types import PerState
from lyapnet.claims.from_below import FromBelow
from lyapnet.claims.least_cost import LowerClaim, lower_claim, require_bound_from_below
from lyapnet.claims.sound_certificate import default_delta, parse_set
from lyapnet.claims.tubes import figures
from lyapnet.claims.tubes.certificate import TubeCertificate
from lyapnet.claims.tubes.tube import NOTHING_KEPT, TubeClaim, tube_claim
from lyapnet.controller.controller import Controller
from lyapnet.prover.branch_and_bound import Budget
from lyapnet.prover.proof import Progress
from lyapnet.prover.verdict import Verdict

FOR_TUBE = 0.5  # of the seconds; what it leaves is for the bound from below


class TwoSidedTube(TubeCertificate):
    """The tube of all closed loops from X₀ with their cost in it, and the optimum from below."""

    picture: ClassVar[str] = "two_sided_tube.png"
    labels: ClassVar[Mapping[str, str]] = FromBelow.labels_after({
        **TubeCertificate.labels, "beta": "β", "delta": "δ in cost per second",
        "tube_in_set": "whether the tube lies in D",
    })  # fmt: skip

    def __init__(self, controller: Controller, claim: TubeClaim, lower: LowerClaim, options: Mapping[str, Any]):
        super().__init__(controller, claim, options)
        self.below = FromBelow(lower)

    @property
    def verdict(self) -> Verdict:
        """On both: a tube for all of X₀, and the bound from below on all of it, for controls like the controller."""
        both = self.below.verdict(self.claim.verdict)
        return "unknown" if both == "certified" and not self.comparable else both

    @property
    def in_set(self) -> bool:
        """Whether the tube lies in D, so that the controller itself is among those that keep the state there."""
        claim, lower = self.claim, self.below.claim
        axes = [k for k, i in enumerate(claim.seen) if i not in lower.left_out]
        D, ranges = lower.states, claim.ranges[:, axes]
        low, high = (side.double()[[claim.seen[k] for k in axes]] for side in (D.lower, D.upper))
        return bool(((low <= ranges[..., 0]) & (ranges[..., 1] <= high)).all())

    @property
    def comparable(self) -> bool:
        """Whether both bounds are about the controller."""
        return self.below.claim.everywhere or self.in_set

    @cached_property
    def value(self) -> PerState:
        """V(0, x₀) of the states that are compared, as it was bounded."""
        x0 = self.compared.x0.double()
        with torch.no_grad():
            return copied(self.controller.V)(x0.new_zeros(len(x0)), x0)

    def numbers(self) -> dict[str, Any]:
        lower, high = self.below.claim, self.compared.high
        return {
            **super().numbers(), "beta": lower.beta, "delta": lower.delta, "tube_in_set": self.in_set,
            **self.below.proved(),
            **self.below.against(self.value, high),
            **self.below.around_optima(self.value, high, self.compared.optimum),
            "seconds": self.claim.seconds + lower.seconds,
        }  # fmt: skip

    def in_words(self) -> str:
        return f"{super().in_words()} {self.below.in_words()}"

    def in_formulas(self) -> list[str]:
        return [*super().in_formulas(), *self.below.in_formulas()]

    def of_the_verdict(self) -> str:
        both = f"{super().of_the_verdict()} {self.below.of_the_verdict()}"
        return both if self.comparable else f"{both} But the tube leaves D: choose a larger one."

    def figure(self) -> figures.Figure:
        lower = self.below.claim
        least = (lower.least_cost(self.value), self.below.whose) if lower.level > -math.inf else None
        numbers = f"{self._proved()}; β = {lower.beta:g}, δ = {lower.delta:.3g}"
        headline = self.below.headline(self.verdict, self.result.get("certified_ratio"), numbers)
        return figures.tube(self.claim, self.controller, self.compared, headline, least)


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
    loop, problem, budget = controller.closed_loop, controller.problem, Budget(seconds, workers=workers, started=begun)
    require_bound_from_below(loop, problem, beta, states)
    claim = tube_claim(controller, Budget(FOR_TUBE * seconds, workers=workers, started=begun), radius, report)
    try:
        lower = lower_claim(loop, problem, beta, slack, states, budget, stream(seed, CERTIFICATION), report)
    except Interrupted as error:
        raise Interrupted(NOTHING_KEPT, error.exit_status) from error
    options = {
        "two-sided": True, "beta": beta, "delta": delta, "set": set, "radius": radius, "seconds": seconds,
        "workers": workers, "seed": seed,
    }  # fmt: skip
    return TwoSidedTube(controller, claim, lower, options)

"""Certificates of tubes: where all closed loops from X₀ go, and what they cost."""

import time
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any, ClassVar

from lyapnet.base.random_streams import CERTIFICATION, stream
from lyapnet.claims.certificates import FROZEN, Certificate
from lyapnet.claims.sound_certificate import (
    COMPARED,
    listed,
    optima_of,
)
from lyapnet.claims.tables import floored
from lyapnet.claims.tubes import figures
from lyapnet.claims.tubes.tube import TubeClaim, tube_claim
from lyapnet.controller.controller import Controller
from lyapnet.evaluation.optimality import ratio_of_means
from lyapnet.prover.branch_and_bound import Budget
from lyapnet.prover.proof import Progress


class Compared:
    """The proved bounds of the cost of some states of X₀, and the optimum of the first of them, where it is known."""

    def __init__(self, controller: Controller, claim: TubeClaim, seconds: float):
        x0 = controller.initial_states.sample(COMPARED, stream(1, CERTIFICATION))
        low, high = claim.bounds_of_cost(x0)
        inside = high.isfinite()
        self.x0, self.low, self.high = x0[inside], low[inside], high[inside]
        self.optimum, self.has_goal = optima_of(controller, self.x0, seconds), controller.problem.has_goal

    @property
    def ratio(self) -> float | None:
        """Mean guaranteed cost over the mean optimum; None where costs may be of any sign."""
        return (
            None
            if self.optimum is None or not self.has_goal
            else ratio_of_means(self.high[: len(self.optimum)], self.optimum)
        )


class TubeCertificate(Certificate):
    """The tube of all closed loops from X₀, and their cost in it."""

    kind: ClassVar[str] = "tube"
    picture: ClassVar[str] = "tube.png"
    labels: ClassVar[Mapping[str, str]] = {
        "reason": "why",
        "states_left_out": "states that nothing depends on",
        "volume_share": "share of X₀ in the tube, at least",
        "constraints": "constraints that no closed loop of the tube violates",
        "violating": "a state whose closed loop violates one",
        "mean_cost": "mean cost from there, between",
        "greatest_cost": "cost from there, at most",
        "guaranteed_cost_ratio": "guaranteed cost there / optimum of the steps of Δt, ratio of the means",
        "ends": "x(T) between",
        "reach": "‖x(T) − goal‖, at most",
        "missing": "a state whose closed loop ends further from the goal than --radius",
        "cells": "boxes of X₀ that are proved",
        "boxes": "boxes of X₀ that were tried",
        "steps": "steps of them",
        "seconds": "seconds",
        "fingerprint": "fingerprint of what was bounded",
    }
    claim: TubeClaim

    @cached_property
    def compared(self) -> Compared:
        """The guaranteed cost against the optimum, which is beside the claim."""
        return Compared(self.controller, self.claim, max(1.0, 0.1 * self.options["seconds"]))

    def numbers(self) -> dict[str, Any]:
        claim, names = self.claim, self.controller.system.state_names
        proved = {
            "mean_cost": list(claim.mean_cost), "greatest_cost": claim.greatest_cost,
            "guaranteed_cost_ratio": self.compared.ratio, "reach": claim.reach,
            "ends": {
                names[i]: [float(low), float(high)]
                for i, low, high in zip(claim.seen, claim.ends[..., 0].amin(0), claim.ends[..., 1].amax(0), strict=True)
            },
        } if len(claim.slack) else {}  # fmt: skip
        return {
            "duration": claim.duration, "reason": claim.reason,
            "states_left_out": [name for i, name in enumerate(names) if i not in claim.seen],
            "volume_share": claim.volume_share, "constraints": list(claim.constraints) if len(claim.slack) else [],
            "violating": claim.violating, "missing": claim.missing, "radius": claim.radius, **proved,
            "cells": len(claim.slack), "boxes": claim.boxes, "steps": claim.steps, "seconds": claim.seconds,
            "fingerprint": claim.fingerprint,
        }  # fmt: skip

    def in_words(self) -> str:
        claim = self.claim
        if not len(claim.slack):
            return "No box of X₀ has a tube that was proved: nothing is claimed. The conditions below were sought."
        low, high = claim.mean_cost
        kept = f" violates a constraint ({'; '.join(claim.constraints)}), and" if claim.constraints else ""
        return (
            f"Boxes that make up at least {floored(claim.volume_share)} of X₀ by volume have a tube, proved in "
            f"continuous time for this model up to T = {claim.duration:g} s with u = policy(t, x) read at every t: "
            f"no closed loop from there{kept} leaves it, and each costs no more, and no less, than the bounds "
            f"of its box: {low:.6g} to {high:.6g} in the mean, {claim.greatest_cost:.6g} at most. It is about the "
            f"operations that f, g, ℓ, φ and u were traced to, of this fingerprint; {FROZEN}{self.of_parameters}"
        )

    def in_formulas(self) -> list[str]:
        T = f"{self.claim.duration!r}".removesuffix(".0")
        return [
            f"ẋ = f(x) + g(x) u(t, x),  x(t) = p_k(t, ε) + Φ_k(t) z(t),  |z(t)| ≤ r_k(t)  at each t ∈ [0, {T}]",
            "from each x₀ = middle_k + half_k ε, |ε_i| ≤ 1, of each box k",
            f"∫ℓ dt + φ(x({T})) = P_k(ε) + r,  low_k ≤ r ≤ high_k  from the same x₀",
        ]

    def of_the_verdict(self) -> str:
        claim = self.claim
        if claim.violating is not None:
            return f"The verdict: closed loops from around {listed(claim.violating)} violate a constraint."
        if claim.missing is not None:
            return (
                f"The verdict: closed loops from around {listed(claim.missing)} end further from the goal than asked."
            )
        why = "it is" if claim.verdict == "certified" else "undecided within the budget"
        asked = "" if claim.radius is None else f", and ends within {claim.radius:g} of the goal"
        return f"The verdict is on the claim that each closed loop from X₀ is in a proved tube{asked}: {why}."

    def figure(self) -> figures.Figure:
        return figures.tube(self.claim, self.controller, self.compared, f"{self.verdict}: {self._proved()}")

    def _proved(self) -> str:
        return f"{floored(self.claim.volume_share)} of X₀, {len(self.claim.slack):,} boxes"


def tube_certificate(
    controller: Controller,
    radius: float | None = None,
    seconds: float = 60.0,
    workers: int = 1,
    seed: int = 0,
    report: Callable[[Progress], None] | None = None,
    *,
    started: float | None = None,
) -> TubeCertificate:
    """The tube of all closed loops from X₀.

    Args:
        radius: within which of the goal they are asked to end, in the norm of x; not asked for if None.
        seconds: when to stop undecided, within a chunk of boxes.
        workers: processes that enclose boxes side by side.
        report: is told how far the proof is.
        started: time.monotonic() from which the seconds count; now if None.
    """
    begun = time.monotonic() if started is None else started
    claim = tube_claim(controller, Budget(seconds, workers=workers, started=begun), radius, report)
    options = {"radius": radius, "seconds": seconds, "workers": workers, "seed": seed}
    return TubeCertificate(controller, claim, options)

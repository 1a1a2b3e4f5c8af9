"""Certificates of tubes: bounds of all closed loops from X₀, and of their costs."""

import math
from collections.abc import Mapping
from functools import cached_property
from typing import Any, ClassVar

import torch

from lyapnet.base.contracts import copied
from lyapnet.base.random_streams import CERTIFICATION, stream
from lyapnet.claims.arguments import COMPARED
from lyapnet.claims.certificates import FROZEN, format_state
from lyapnet.claims.costs import CostCertificate, Inside
from lyapnet.claims.least_cost import ProvedLowerBound
from lyapnet.claims.tables import floored
from lyapnet.claims.tubes import figures
from lyapnet.claims.tubes.tube import ProvedTube


class TubeCertificate(CostCertificate):
    """A tube around all closed loops from X₀, with bounds of their costs."""

    kind: str = "tube"
    picture: str = "tube.png"
    picture_of_both: ClassVar[str] = "two_sided_tube.png"
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
        "missing": "a state whose closed loop ends further from the goal than the radius",
        "cells": "proved boxes of X₀",
        "boxes": "tested boxes of X₀",
        "steps": "steps, summed over boxes",
        "seconds": "seconds",
        "fingerprint": "fingerprint of what was bounded",
    }
    labels_beside: ClassVar[Mapping[str, str]] = {
        "beta": "β", "delta": "δ in cost per second", "tube_in_set": "whether the tube lies in D",
    }  # fmt: skip
    claim: ProvedTube

    @cached_property
    def inside(self) -> Inside:
        x0 = self.controller.initial_states.sample(COMPARED, stream(1, CERTIFICATION))
        low, high = self.claim.bounds_of_cost(x0)
        known = high.isfinite()
        x0, low, high = x0[known], low[known], high[known]
        with torch.no_grad():  # V in float64, as in the proof
            value = copied(self.controller.V)(x0.new_zeros(len(x0)).double(), x0.double())
        return Inside(x0, value, high, low)

    def beside(self, lower: ProvedLowerBound) -> dict[str, Any]:
        return {"beta": lower.beta, "delta": lower.delta, "tube_in_set": self.lies_in(lower)}

    def lies_in(self, lower: ProvedLowerBound) -> bool:
        """Whether the tube lies in the D of a bound from below, so that the controller keeps the state in D."""
        claim = self.claim
        axes = [k for k, i in enumerate(claim.seen) if i not in lower.left_out]
        D, ranges = lower.states, claim.ranges[:, axes]
        low, high = (side.double()[[claim.seen[k] for k in axes]] for side in (D.lower, D.upper))
        return bool(((low <= ranges[..., 0]) & (ranges[..., 1] <= high)).all())

    def mismatch(self, lower: ProvedLowerBound) -> str:
        covered = lower.everywhere or self.lies_in(lower)
        return "" if covered else "But the tube leaves D: choose a larger D."

    def in_short(self, lower: ProvedLowerBound) -> str:
        return f"{self._proved()}; β = {lower.beta:g}, δ = {lower.delta:.3g}"

    def figure_of_both(self, lower: ProvedLowerBound, whose: str, headline: str) -> figures.Figure:
        least = (lower.least_cost(self.inside.value), whose) if lower.level > -math.inf else None
        return figures.tube(self.claim, self.controller, self.inside, self.optimum, headline, least)

    def proved(self) -> dict[str, Any]:
        claim, names = self.claim, self.controller.system.state_names
        proved = {
            "mean_cost": list(claim.mean_cost), "greatest_cost": claim.greatest_cost,
            "reach": claim.reach,
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
            return "No box of X₀ has a tube that was proved: nothing is claimed. The conditions below were not proved."
        low, high = claim.mean_cost
        constraints = f" violates a constraint ({'; '.join(claim.constraints)}), and" if claim.constraints else ""
        return (
            f"Boxes that make up at least {floored(claim.volume_share)} of X₀ by volume have a tube, proved in "
            f"continuous time for this model up to T = {claim.duration:g} s with u = policy(t, x) at every t: "
            f"no closed loop from there{constraints} leaves it, and each costs no more, and no less, than the bounds "
            f"of its box: {low:.6g} to {high:.6g} in the mean, {claim.greatest_cost:.6g} at most. It is about the "
            f"traced operations of f, g, ℓ, φ and u, which have this fingerprint; {FROZEN}{self.parameters_text}"
        )

    def in_formulas(self) -> list[str]:
        T = f"{self.claim.duration!r}".removesuffix(".0")
        return [
            f"ẋ = f(x) + g(x) u(t, x),  x(t) = p_k(t, ε) + Φ_k(t) z(t),  |z(t)| ≤ r_k(t)  at each t ∈ [0, {T}]",
            "from each x₀ = middle_k + half_k ε, |ε_i| ≤ 1, of each box k",
            f"∫ℓ dt + φ(x({T})) = P_k(ε) + r,  low_k ≤ r ≤ high_k  from the same x₀",
        ]

    def verdict_text(self) -> str:
        claim = self.claim
        if claim.violating is not None:
            return f"All closed loops from a box around {format_state(claim.violating)} violate a constraint."
        if claim.missing is not None:
            return f"All closed loops from a box around {format_state(claim.missing)} end outside of the radius."
        why = "it is" if claim.verdict == "certified" else "undecided within the budget"
        asked = "" if claim.radius is None else f", and ends within {claim.radius:g} of the goal"
        return f"The verdict is on the claim that each closed loop from X₀ is in a proved tube{asked}: {why}."

    def figure(self) -> figures.Figure:
        return figures.tube(
            self.claim, self.controller, self.inside, self.optimum, f"{self.verdict}: {self._proved()}"
        )  # fmt: skip

    def _proved(self) -> str:
        return f"{floored(self.claim.volume_share)} of X₀, {len(self.claim.slack):,} boxes"

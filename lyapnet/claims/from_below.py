"""Certificates of what any control costs at least, alone or beside a bound of the controller's cost from above."""

import math
from collections.abc import Mapping
from functools import cached_property
from typing import Any, ClassVar

import torch
from torch import Tensor

from lyapnet.base.random_streams import CERTIFICATION, stream
from lyapnet.claims import figures
from lyapnet.claims.arguments import COMPARED
from lyapnet.claims.certificates import FROZEN, Certificate, listed
from lyapnet.claims.costs import Inside, optima_of
from lyapnet.claims.least_cost import ProvedLowerBound
from lyapnet.evaluation.optimality import ratio_of_means
from lyapnet.prover.verdict import Verdict, time_spent


class LowerBoundCertificate(Certificate):
    """What any control costs at least, and how far what is guaranteed of a controller lies above it."""

    kind: str = "lower"
    picture: str = "lower_bound.png"
    labels: ClassVar[Mapping[str, str]] = {
        "lower_reason": "why not from below",
        "lower_set": "D from below",
        "lower_level_wanted": "c for all of X₀, from below",
        "lower_level": "largest c proved",
        "lower_excess": "e, βV(T, ·) beyond φ, at most",
        "holds_for": "the bound from below holds for",
        "lower_counterexample": "counterexample from below",
        "lower_remaining_volume": "share of [0, T] × D undecided, from below",
        "lower_boxes": "boxes from below",
        "lower_cost_ratio": "least cost there / optimum, ratio of the means",
        "certified_ratio": "certified ratio: guaranteed / least cost, ratio of the means",
        "certified_gap": "largest gap between the two / mean least cost",
        "optima_between": "optima of the steps of Δt between the bounds, share of the states",
        "seconds": "seconds",
        "fingerprint": "fingerprint of what was bounded",
        "lower_fingerprint": "fingerprint from below",
    }

    claim: ProvedLowerBound

    @property
    def holds_for(self) -> str:
        """Which controls the bound from below is about."""
        return "every control" if self.claim.everywhere else "controls that keep the state in D"

    @property
    def whose(self) -> str:
        """The same, in a figure."""
        return "any control" if self.claim.everywhere else "any control that stays in D"

    def numbers(self) -> dict[str, Any]:
        claim, inside = self.claim, self.inside
        optimum = optima_of(self.controller, inside.x0, max(1.0, 0.1 * self.options["seconds"]))
        return {
            "beta": claim.beta, "delta": claim.delta, **self.proved(), "seconds": claim.seconds,
            **self.around(inside, optimum),
        }  # fmt: skip

    @cached_property
    def inside(self) -> Inside:
        """States of X₀, with no bound from above."""
        x0 = self.controller.initial_states.sample(COMPARED, stream(1, CERTIFICATION))
        value = self.controller.value(0.0, x0).double()
        return Inside(x0, value, torch.full_like(value, torch.inf))

    def proved(self) -> dict[str, Any]:
        claim, proved = self.claim, self.claim.level > -math.inf
        return {
            "lower_set": [claim.states.lower.tolist(), claim.states.upper.tolist()],
            "lower_level": claim.level if proved else None, "lower_level_wanted": claim.wanted,
            "lower_excess": claim.excess if proved else None, "holds_for": self.holds_for if proved else None,
            "lower_reason": self._why_not(), "lower_boxes": claim.boxes,
            "lower_remaining_volume": claim.remaining_volume, "lower_fingerprint": claim.fingerprint,
            "lower_counterexample": None if claim.counterexample is None else claim.counterexample._asdict(),
        }  # fmt: skip

    def against(self, inside: Inside) -> dict[str, Any]:
        """What the two bounds say of some states; nothing where one of them says nothing."""
        least, guaranteed = self.claim.least_cost(inside.value), inside.guaranteed
        if not len(least) or not bool(least.isfinite().all()) or not (mean := float(least.mean())) > 0:
            return {}
        return {
            "certified_ratio": ratio_of_means(guaranteed, least),
            "certified_gap": float((guaranteed - least).max()) / mean,
        }

    def around(self, inside: Inside, optimum: Tensor | None) -> dict[str, Any]:
        """How the two bounds lie around the optima of the first of these states, as far as an oracle knows them."""
        least, guaranteed = self.claim.least_cost(inside.value), inside.guaranteed
        if optimum is None or not len(least) or not bool(least.isfinite().all()):
            return {}
        some, known = slice(len(optimum)), optimum.isfinite()
        between = (least[some] <= optimum) & (optimum <= guaranteed[some])
        return {
            "optima_between": float(between[known].double().mean()) if known.any() else None,
            "lower_cost_ratio": ratio_of_means(least[some], optimum),
        }

    def _why_not(self) -> str | None:
        claim = self.claim
        if claim.verdict == "certified":
            return None
        if claim.level >= claim.wanted:
            return "e, what βV(T, ·) has beyond φ, or q below 0, leaves nothing: allow more seconds, or lower V there"
        if claim.verdict == "falsified" or claim.counterexample is not None:
            return "V rises faster than a control pays for: claim less of V, allow more --delta, or train its residual"
        return f"{time_spent(claim.set_up)}: allow more"

    def in_words(self, before: str = "") -> str:
        """The same as of any certificate.

        Args:
            before: how it goes on from a bound from above.
        """
        claim = self.claim
        if claim.level == -math.inf:
            return "Nothing is proved of the optimum from below."
        return (
            f"{before}{self.holds_for} cost at least min(β V(0, x₀) − δT, c) − e, with "
            f"β = {claim.beta!r}, c = {claim.level!r} and e = {claim.excess!r}, from each x₀ ∈ D. It is about the "
            f"operations that f, g, ℓ, R and V were traced to; {FROZEN}"
        )

    def in_formulas(self) -> list[str]:
        claim = self.claim
        beta, delta, T = (f"{value!r}".removesuffix(".0") for value in (claim.beta, claim.delta, claim.duration))
        c, e = (repr(claim.level), repr(claim.excess)) if claim.level > -math.inf else ("c", "e")
        return [
            f"{beta} V_t + min_u [ℓ(x, u) + {beta} V_xᵀ(f + g u)] ≥ −{delta}  "
            f"at each (t, x) ∈ [0, {T}] × D with {beta} V(t, x) − {delta} ({T} − t) ≤ {c}",
            f"∫ℓ dt + φ(x(T)) ≥ min({beta} V(0, x₀) − {delta} · {T}, {c}) − {e}  for {self.holds_for}",
        ]

    def of_the_verdict(self, before: str = "The verdict is") -> str:
        found = self.claim.counterexample
        where = "" if found is None else f" At t = {found.t:.6g} s, x = {listed(found.x)} the second fails."
        below = {"certified": "it does", "falsified": "it does not", "unknown": "undecided within the budget"}
        return (
            f"{before} on the claim that the bound from below holds on all of X₀: {below[self.claim.verdict]}.{where}"
        )

    def headline(self, verdict: Verdict, ratio: float | None, numbers: str) -> str:
        """The title of a figure of both sides."""
        means = "" if ratio is None else f": from above / from below {ratio:.3f}, means over states of X₀"
        whose = f"; {self.holds_for}" if self.claim.level > -math.inf else ""
        return f"{verdict}{means}\n{numbers}{whose}"

    def figure(self) -> figures.Figure:
        claim, value = self.claim, self.inside.value
        headline = self.headline(self.verdict, None, f"β = {claim.beta:g}, δ = {claim.delta:.3g}")
        return figures.two_sided(value, None, claim.least_cost(value), None, headline, self.whose)

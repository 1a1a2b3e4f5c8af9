"""Certificates of a lower bound of the cost of any control, alone or beside an upper bound of the controller's cost."""

import math
from collections.abc import Mapping
from functools import cached_property
from typing import Any, ClassVar

import torch
from torch import Tensor

from lyapnet.base.random_streams import CERTIFICATION, stream
from lyapnet.claims import figures
from lyapnet.claims.arguments import COMPARED
from lyapnet.claims.certificates import FROZEN, Certificate, format_state
from lyapnet.claims.costs import Inside, optima_of
from lyapnet.claims.least_cost import ProvedLowerBound
from lyapnet.evaluation.optimality import ratio_of_means
from lyapnet.prover.verdict import Verdict, time_limit_reason


class LowerBoundCertificate(Certificate):
    """A lower bound of the cost of any control, and its distance from an upper bound of the controller's cost."""

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
        """The controls for which the bound holds."""
        return "every control" if self.claim.everywhere else "controls that keep the state in D"

    @property
    def whose(self) -> str:
        """The same in the words of a figure."""
        return "any control" if self.claim.everywhere else "any control that stays in D"

    def numbers(self) -> dict[str, Any]:
        claim, inside = self.claim, self.inside
        optimum = optima_of(self.controller, inside.x0, max(1.0, 0.1 * self.options["seconds"]))
        return {
            "beta": claim.beta, "delta": claim.delta, **self.proved(), "seconds": claim.seconds,
            **self.compare_optima(inside, optimum),
        }  # fmt: skip

    @cached_property
    def inside(self) -> Inside:
        """Random states of X₀, with ∞ as the bound from above."""
        x0 = self.controller.initial_states.sample(COMPARED, stream(1, CERTIFICATION))
        value = self.controller.value(0.0, x0).double()
        return Inside(x0, value, torch.full_like(value, torch.inf))

    def proved(self) -> dict[str, Any]:
        claim, proved = self.claim, self.claim.level > -math.inf
        return {
            "lower_set": [claim.states.lower.tolist(), claim.states.upper.tolist()],
            "lower_level": claim.level if proved else None, "lower_level_wanted": claim.wanted,
            "lower_excess": claim.excess if proved else None, "holds_for": self.holds_for if proved else None,
            "lower_reason": self._reason, "lower_boxes": claim.boxes,
            "lower_remaining_volume": claim.remaining_volume, "lower_fingerprint": claim.fingerprint,
            "lower_counterexample": None if claim.counterexample is None else claim.counterexample._asdict(),
        }  # fmt: skip

    def compare_bounds(self, inside: Inside) -> dict[str, Any]:
        """Ratio and gap of the two bounds for some states; empty if one bound is missing."""
        least, guaranteed = self.claim.least_cost(inside.value), inside.guaranteed
        if not len(least) or not bool(least.isfinite().all()) or not (mean := float(least.mean())) > 0:
            return {}
        return {
            "certified_ratio": ratio_of_means(guaranteed, least),
            "certified_gap": float((guaranteed - least).max()) / mean,
        }

    def compare_optima(self, inside: Inside, optimum: Tensor | None) -> dict[str, Any]:
        """A comparison of both bounds with the optimal costs of the first of these states; empty without optima."""
        least, guaranteed = self.claim.least_cost(inside.value), inside.guaranteed
        if optimum is None or not len(least) or not bool(least.isfinite().all()):
            return {}
        first, known = slice(len(optimum)), optimum.isfinite()
        between = (least[first] <= optimum) & (optimum <= guaranteed[first])
        return {
            "optima_between": float(between[known].double().mean()) if known.any() else None,
            "lower_cost_ratio": ratio_of_means(least[first], optimum),
        }

    @property
    def _reason(self) -> str | None:
        """The reason why the bound is not certified."""
        claim = self.claim
        if claim.verdict == "certified":
            return None
        if claim.level >= claim.wanted:
            return "e is as large as the bound: βV(T, ·) exceeds φ, or q < 0; allow more seconds, or lower V(T, ·)"
        if claim.verdict == "falsified" or claim.counterexample is not None:
            return "V rises faster than ℓ along some control: choose a smaller beta or a larger delta, or train on"
        return f"{time_limit_reason(claim.set_up)}: allow more"

    def in_words(self, before: str = "") -> str:
        """As Certificate.in_words.

        Args:
            before: the words that join it to a bound from above.
        """
        claim = self.claim
        if claim.level == -math.inf:
            return "Nothing is proved of the optimum from below."
        return (
            f"{before}{self.holds_for} cost at least min(β V(0, x₀) − δT, c) − e, with "
            f"β = {claim.beta!r}, c = {claim.level!r} and e = {claim.excess!r}, from each x₀ ∈ D. It is about the "
            f"traced operations of f, g, ℓ, R and V; {FROZEN}"
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

    def verdict_text(self, before: str = "The verdict is") -> str:
        found = self.claim.counterexample
        where = "" if found is None else f" At t = {found.t:.6g} s, x = {format_state(found.x)} the second fails."
        below = {"certified": "it does", "falsified": "it does not", "unknown": "undecided within the budget"}
        return (
            f"{before} on the claim that the bound from below holds on all of X₀: {below[self.claim.verdict]}.{where}"
        )

    def headline(self, verdict: Verdict, ratio: float | None, numbers: str) -> str:
        """The title of a figure of both bounds."""
        means = "" if ratio is None else f": from above / from below {ratio:.3f}, means over states of X₀"
        whose = f"; {self.holds_for}" if self.claim.level > -math.inf else ""
        return f"{verdict}{means}\n{numbers}{whose}"

    def figure(self) -> figures.Figure:
        claim, value = self.claim, self.inside.value
        headline = self.headline(self.verdict, None, f"β = {claim.beta:g}, δ = {claim.delta:.3g}")
        return figures.two_sided(value, None, claim.least_cost(value), None, headline, self.whose)

"""What a bound of the optimum from below says in a certificate, beside a bound of the controller's cost from above."""

import math
from collections.abc import Mapping
from typing import Any, ClassVar

from torch import Tensor

from lyapnet.base.types import PerState
from lyapnet.claims.certificates import FROZEN
from lyapnet.claims.least_cost import LowerClaim
from lyapnet.claims.sound_certificate import listed
from lyapnet.evaluation.optimality import ratio_of_means
from lyapnet.prover.verdict import Verdict, time_spent


class FromBelow:
    """The bound from below in numbers, words and formulas, and how far what is guaranteed lies above it."""

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

    def __init__(self, claim: LowerClaim):
        self.claim = claim

    @classmethod
    def labels_after(cls, above: Mapping[str, str]) -> dict[str, str]:
        """The labels of both sides; those of seconds and fingerprints at the end."""
        return {**{key: label for key, label in above.items() if key not in cls.labels}, **cls.labels}

    def verdict(self, above: Verdict) -> Verdict:
        """On both sides."""
        both = above, self.claim.verdict
        return "falsified" if "falsified" in both else "unknown" if "unknown" in both else "certified"

    @property
    def holds_for(self) -> str:
        """Which controls the bound from below is about."""
        return "every control" if self.claim.everywhere else "controls that keep the state in D"

    @property
    def whose(self) -> str:
        """The same, in a figure."""
        return "any control" if self.claim.everywhere else "any control that stays in D"

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

    def against(self, value: PerState, guaranteed: PerState) -> dict[str, Any]:
        """What the two bounds say of some states; nothing where one of them says nothing."""
        least = self.claim.least_cost(value)
        if not len(least) or not bool(least.isfinite().all()) or not (mean := float(least.mean())) > 0:
            return {}
        return {
            "certified_ratio": ratio_of_means(guaranteed, least),
            "certified_gap": float((guaranteed - least).max()) / mean,
        }

    def around_optima(self, value: PerState, guaranteed: PerState, optimum: Tensor | None) -> dict[str, Any]:
        """How the two bounds lie around the optima of the first of these states, as far as an oracle knows them."""
        least = self.claim.least_cost(value)
        if optimum is None or not len(value) or not bool(least.isfinite().all()):
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

    def in_words(self) -> str:
        claim = self.claim
        if claim.level == -math.inf:
            return "Nothing is proved of the optimum from below."
        return (
            f"And from below: {self.holds_for} cost at least min(β V(0, x₀) − δT, c) − e, with "
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

    def of_the_verdict(self) -> str:
        found = self.claim.counterexample
        where = "" if found is None else f" At t = {found.t:.6g} s, x = {listed(found.x)} the second fails."
        below = {"certified": "it does", "falsified": "it does not", "unknown": "undecided within the budget"}
        return f"And on the claim that the bound from below holds on all of X₀: {below[self.claim.verdict]}.{where}"

    def headline(self, verdict: Verdict, ratio: float | None, numbers: str) -> str:
        """The title of a figure of both sides."""
        means = "" if ratio is None else f": from above / from below {ratio:.3f}, means over states of X₀"
        whose = f"; {self.holds_for}" if self.claim.level > -math.inf else ""
        return f"{verdict}{means}\n{numbers}{whose}"

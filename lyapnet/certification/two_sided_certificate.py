"""Certificates from two sides: what the controller costs at most, and what any control costs at least."""

import math
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar

from lyapnet.certification import figures
from lyapnet.certification.branch_and_bound import Budget
from lyapnet.certification.certificates import FROZEN
from lyapnet.certification.funnel import SoundClaim, sound_claim
from lyapnet.certification.least_cost import DEGREE, LowerClaim, lower_claim
from lyapnet.certification.proof import Progress
from lyapnet.certification.sound_certificate import (
    SoundCertificate,
    default_delta,
    listed,
    parse_set,
    states_inside,
)
from lyapnet.certification.verdict import Verdict
from lyapnet.controller import Controller
from lyapnet.evaluation.optimality import ratio_of_means
from lyapnet.random_streams import CERTIFICATION, stream

FOR_UPPER = 0.55  # of the seconds; the others are for the bound from below


class TwoSidedCertificate(SoundCertificate):
    """The funnel of a sound certificate with the cost in it, and the optimum from below."""

    picture: ClassVar[str] = "two_sided.png"
    labels: ClassVar[Mapping[str, str]] = {
        **{key: label for key, label in SoundCertificate.labels.items() if key not in ("seconds", "fingerprint")},
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
        "optima_between": "optima between the bounds, share of the states",
        "seconds": "seconds",
        "fingerprint": "fingerprint of what was bounded",
        "lower_fingerprint": "fingerprint from below",
    }

    def __init__(self, controller: Controller, claim: SoundClaim, lower: LowerClaim, options: Mapping[str, Any]):
        super().__init__(controller, claim, options)
        self.lower = lower

    @property
    def verdict(self) -> Verdict:
        """On both: a funnel for all of X₀, and the bound from below on all of it."""
        both = self.claim.verdict, self.lower.verdict
        return "falsified" if "falsified" in both else "unknown" if "unknown" in both else "certified"

    @property
    def holds_for(self) -> str:
        """Which controls the bound from below is about."""
        return "every control" if self.lower.everywhere else "controls that keep the state in D"

    def numbers(self) -> dict[str, Any]:
        return {**super().numbers(), **self._against_the_optimum()}

    def proved(self) -> dict[str, Any]:
        lower, proved = self.lower, self.lower.level > -math.inf
        return {
            **super().proved(),
            "lower_set": [lower.states.lower.tolist(), lower.states.upper.tolist()],
            "lower_level": lower.level if proved else None, "lower_level_wanted": lower.wanted,
            "lower_excess": lower.excess if proved else None, "holds_for": self.holds_for if proved else None,
            "lower_reason": self._why_not_below(), "lower_boxes": lower.boxes,
            "lower_remaining_volume": lower.remaining_volume, "lower_fingerprint": lower.fingerprint,
            "lower_counterexample": None if lower.counterexample is None else lower.counterexample._asdict(),
            "seconds": self.claim.seconds + lower.seconds, **self._against_each_other(),
        }  # fmt: skip

    def _against_each_other(self) -> dict[str, Any]:
        """What the two bounds say of states of X₀ inside the funnel; nothing where one of them says nothing."""
        inside = states_inside(self.controller, self.claim)
        least = self.lower.least_cost(inside.value)
        if not len(least) or not bool(least.isfinite().all()) or not (mean := float(least.mean())) > 0:
            return {}
        return {
            "certified_ratio": ratio_of_means(inside.guaranteed, least),
            "certified_gap": float((inside.guaranteed - least).max()) / mean,
        }

    def _against_the_optimum(self) -> dict[str, Any]:
        """How the two bounds lie around the optima of these states, as far as an oracle knows them."""
        value, guaranteed, optimum = self.compared
        least = self.lower.least_cost(value)
        if optimum is None or not len(value) or not bool(least.isfinite().all()):
            return {}
        some = slice(len(optimum))
        between = (least[some] <= optimum) & (optimum <= guaranteed[some])
        return {
            "optima_between": float(between.double().mean()),
            "lower_cost_ratio": ratio_of_means(least[some], optimum),
        }

    def _why_not_below(self) -> str | None:
        lower = self.lower
        if lower.verdict == "certified":
            return None
        if lower.level >= lower.wanted:
            return "e, what βV(T, ·) has beyond φ, or q below 0, leaves nothing: allow more seconds, or lower V there"
        if lower.verdict == "falsified" or lower.counterexample is not None:
            return "V rises faster than a control pays for: lower --alpha, allow more --delta, or train its residual"
        return "seconds spent: allow more"

    def in_words(self) -> str:
        if self.lower.level == -math.inf:
            return f"{super().in_words()} Nothing is proved of the optimum from below."
        lower = self.lower
        return (
            f"{super().in_words()} And from below: {self.holds_for} cost at least min(β V(0, x₀) − δT, c) − e, with "
            f"β = {lower.beta!r}, c = {lower.level!r} and e = {lower.excess!r}, from each x₀ ∈ D. It is about the "
            f"operations that f, g, ℓ, R and V were traced to; {FROZEN}"
        )

    def in_formulas(self) -> list[str]:
        lower = self.lower
        beta, delta, T = (f"{value!r}".removesuffix(".0") for value in (lower.beta, lower.delta, lower.duration))
        c, e = (repr(lower.level), repr(lower.excess)) if lower.level > -math.inf else ("c", "e")
        return [
            *super().in_formulas(),
            f"{beta} V_t + min_u [ℓ(x, u) + {beta} V_xᵀ(f + g u)] ≥ −{delta}  "
            f"at each (t, x) ∈ [0, {T}] × D with {beta} V(t, x) − {delta} ({T} − t) ≤ {c}",
            f"∫ℓ dt + φ(x(T)) ≥ min({beta} V(0, x₀) − {delta} · {T}, {c}) − {e}  for {self.holds_for}",
        ]

    def of_the_verdict(self) -> str:
        found = self.lower.counterexample
        where = "" if found is None else f" At t = {found.t:.6g} s, x = {listed(found.x)} the second fails."
        below = {"certified": "it does", "falsified": "it does not", "unknown": "undecided within the budget"}
        return (
            f"{super().of_the_verdict()} And on the claim that the bound from below holds on all of X₀: "
            f"{below[self.lower.verdict]}.{where}"
        )

    def figure(self) -> figures.Figure:
        value, guaranteed, optimum = self.compared
        whose = "any control" if self.lower.everywhere else "any control that stays in D"
        return figures.two_sided(value, guaranteed, self.lower.least_cost(value), optimum, self._headline(), whose)

    def _headline(self) -> str:
        ratio = self.result.get("certified_ratio")
        means = "" if ratio is None else f": from above / from below {ratio:.3f}, means over X₀"
        return f"{self.verdict}{means}\nα = β = {self.claim.alpha:g}, δ = {self.claim.delta:.3g}; {self.holds_for}"


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
    started: float | None = None,
) -> TwoSidedCertificate:
    """What the controller costs at most, and what any control costs at least, from X₀.

    Args:
        alpha: the share of ℓ that V pays for from above, and β, the share of V that is the bound from below.
        delta: slack of both in cost per second; default_delta if None.
        set: D of both; each found if None.
        seconds: of which each side has about half.
        keep: a file in which both proofs are kept, and from which they go on.
        workers, device, seed, report, started: as of sound_certificate.
    """
    begun = time.monotonic() if started is None else started
    states = None if set is None else parse_set(set)
    slack = default_delta(controller) if delta is None else delta
    loop, problem, file = controller.closed_loop, controller.problem, None if keep is None else Path(keep)
    upper = sound_claim(
        loop, problem, alpha, slack, states, Budget(FOR_UPPER * seconds, workers=workers, device=device, started=begun),
        stream(seed, CERTIFICATION), report, file, degree=DEGREE,
    )  # fmt: skip
    budget = Budget(seconds, workers=workers, device=device, started=begun)
    lower = lower_claim(loop, problem, alpha, slack, states, budget, stream(seed, CERTIFICATION), report, file)
    options = {
        "alpha": alpha, "delta": delta, "set": set, "seconds": seconds, "workers": workers, "device": device,
        "two-sided": True, "keep": keep, "seed": seed,
    }  # fmt: skip
    return TwoSidedCertificate(controller, upper, lower, options)

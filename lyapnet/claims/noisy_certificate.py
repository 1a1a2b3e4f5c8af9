"""Certificates of a funnel under noise: the probability of leaving it, and the expected cost, by proof."""

from collections.abc import Mapping
from functools import cached_property
from typing import Any, ClassVar

from lyapnet.claims.certificates import FROZEN, NOT_PROVED, format_state
from lyapnet.claims.costs import Inside
from lyapnet.claims.noisy_funnel import ProvedNoisyFunnel
from lyapnet.claims.sound_certificate import SoundCertificate
from lyapnet.claims.tables import floored


class NoisyCertificate(SoundCertificate):
    """A funnel that closed loops under noise leave with a small probability, and the expected cost up to then."""

    kind: str = "noisy"
    labels: ClassVar[Mapping[str, str]] = {
        "reason": "why",
        "probability": "probability of staying up to T",
        "alpha": "α",
        "delta": "δ, cost per second",
        "decay": "a, 1/s",
        "risk": "λ, 1/cost",
        "leak": "η, cost per second",
        "set": "D",
        "states_left_out": "states that nothing depends on",
        "rho_wanted": "ρ for all of X₀",
        "rho": "largest ρ proved",
        "volume_share": "share of X₀ from which closed loops stay with that probability, at least",
        "leave_probability": "P(leave), mean over these states of X₀, at most",
        "constraints": "constraints that hold in the funnel",
        "end": "x(T) lies in, if the funnel is not left",
        "terminal_excess": "κ, cost at T beyond V(T, ·)/α, at most",
        "guaranteed_cost": "expected cost up to T or leaving, mean over these states, at most",
        "guaranteed_cost_ratio": "the same / optimum, ratio of the means",
        "counterexample": "counterexample of lowest V e^(at)",
        "remaining_volume": "share of [0, T] × D undecided",
        "boxes": "boxes",
        "seconds": "seconds",
        "fingerprint": "fingerprint of what was bounded",
    }
    claim: ProvedNoisyFunnel

    @cached_property
    def inside(self) -> Inside:
        """The states from which closed loops stay with the probability of the claim, among random ones of X₀."""
        x0, value, guaranteed, _ = super().inside
        likely = self.claim.leave_probability(value) <= 1 - self.claim.probability
        return Inside(x0[likely], value[likely], guaranteed[likely])

    def numbers(self) -> dict[str, Any]:
        inside, some = self.inside, len(self.inside.x0) > 0
        return {
            **super().numbers(),
            "leave_probability": float(self.claim.leave_probability(inside.value).mean()) if some else None,
            "guaranteed_cost": float(inside.guaranteed.mean()) if some else None,
        }

    def proved(self) -> dict[str, Any]:
        claim = self.claim
        end = None if claim.end is None else [claim.end.lower.tolist(), claim.end.upper.tolist()]
        constraints = {"constraints": list(claim.constraints) if claim.volume_share else []}
        numbers = {name: value for name, value in super().proved().items() if name != "disturbance"}
        return {
            **numbers,
            **constraints,
            "probability": claim.probability,
            "risk": claim.risk,
            "leak": claim.leak,
            "decay": claim.decay,
            "end": end,
        }

    def in_words(self) -> str:
        claim = self.claim
        if claim.end is None:
            return NOT_PROVED
        constraints = f" or violates a constraint ({'; '.join(claim.constraints)})" if claim.constraints else ""
        return (
            f"Under dx = (f + gu) dt + σ(x) dW, in continuous time and for this model: a closed loop from x₀ ∈ D with "
            f"V(0, x₀) ≤ {claim.rho!r} leaves the funnel {{V(t, ·) ≤ {claim.rho!r} e^(−{claim.decay:g} t)}}"
            f"{constraints} up to T = {claim.duration:g} s with the probability below at most; from at least "
            f"{floored(claim.volume_share)} of X₀ by volume that is at most {1 - claim.probability:.6g}. Its expected "
            "cost up to T, or until it leaves, is bounded as below; nothing is claimed about what follows then. It is "
            "about every solution of the equation with the traced operations of f, g, σ, ℓ, V and u, which have this "
            f"fingerprint; {FROZEN}{self.parameters_text}{' ' * bool(claim.assumed)}{claim.assumed}"
        )

    def in_formulas(self) -> list[str]:
        claim = self.claim
        alpha, delta, T, risk, leak, decay = (
            f"{value!r}".removesuffix(".0")
            for value in (claim.alpha, claim.delta, claim.duration, claim.risk, claim.leak, claim.decay)
        )
        proved = claim.end is not None
        rho, kappa = (repr(claim.rho), repr(claim.terminal_excess)) if proved else ("ρ'", "κ")
        where = f"at each (t, x) ∈ [0, {T}] × D with V(t, x) ≤ {rho} e^(−{decay} t)"
        return [
            f"𝓛V + {alpha} ℓ(x, u) ≤ {delta}  {where}, 𝓛V = V_t + V_xᵀ(f + g u) + ½ tr(σσᵀV_xx)",
            f"𝓛V + ½ {risk} ‖σᵀV_x‖² ≤ ṙ + {leak} exp({risk} (r − V))  there, r(t) = {claim.wanted!r} e^(−{decay} t)",
            f"P(V(t, x(t)) > {rho} e^(−{decay} t) at some t ≤ {T}) ≤ exp({risk} ({claim.wanted!r} − {rho})) "
            f"(exp(−{risk} ({claim.wanted!r} − V(0, x₀))) + {risk} · {leak} · {T})  from each x₀ ∈ D with "
            f"V(0, x₀) ≤ {rho}",
            f"E[∫ℓ dt up to T or leaving, + φ(x(T)) if not left] ≤ (V(0, x₀) + {delta} · {T}) / {alpha} + {kappa}  "
            "from the same x₀",
        ]

    def verdict_text(self) -> str:
        claim, found = self.claim, self.claim.counterexample
        why = {
            "certified": "they do",
            "falsified": "the condition fails inside the funnel for it",
            "unknown": "undecided within the budget",
        }[self.verdict]
        where = ""
        if found is not None:
            where = f" At t = {found.t:.6g} s, x = {format_state(found.x)} it fails by {found.condition:.3g}."
        return (
            f"The verdict is on the claim that closed loops from all of X₀ stay in a funnel with probability "
            f"{claim.probability:g}, proved with λ = {claim.risk:.4g}: {why}.{where}"
        )

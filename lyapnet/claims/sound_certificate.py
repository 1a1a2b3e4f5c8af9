"""Certificates of a funnel and the cost that it guarantees, by proof."""

from collections.abc import Mapping
from functools import cached_property
from typing import Any, ClassVar

from lyapnet.base.contracts import copied
from lyapnet.base.random_streams import CERTIFICATION, stream
from lyapnet.base.types import Corner
from lyapnet.claims import figures
from lyapnet.claims.arguments import COMPARED
from lyapnet.claims.certificates import (
    FROZEN,
    NOT_PROVED,
    disturbance_text,
    format_state,
    named_disturbance,
)
from lyapnet.claims.costs import CostCertificate, Inside
from lyapnet.claims.funnel import ProvedFunnel
from lyapnet.claims.held_laws import READINGS, computed_text, control_of, readings_facts, readings_text
from lyapnet.claims.least_cost import ProvedLowerBound
from lyapnet.claims.preconditions import over_time
from lyapnet.claims.stepped_decrease import SteppedPayment
from lyapnet.claims.tables import floored
from lyapnet.prover.condition import DecreaseCondition


class SoundCertificate(CostCertificate):
    """A funnel that no closed loop leaves, and the cost that it guarantees."""

    kind: str = "sound"
    picture: str = "funnel.png"
    picture_of_both: ClassVar[str] = "two_sided.png"
    labels: ClassVar[Mapping[str, str]] = {
        "reason": "why",
        "alpha": "α",
        "delta": "δ, cost per second",
        "disturbance": "disturbances, at most",
        **READINGS,
        "steps": "about steps of",
        "set": "D",
        "states_left_out": "states that nothing depends on",
        "rho_wanted": "ρ for all of X₀",
        "rho": "largest ρ proved",
        "volume_share": "share of X₀ in that funnel, at least",
        "constraints": "constraints that no closed loop of the funnel violates",
        "crossing_level": "V − δt where one could be violated, at least",
        "violation": "a closed loop from X₀ that violates one",
        "terminal_excess": "κ, cost at T beyond V(T, ·)/α, at most",
        "guaranteed_cost_ratio": "guaranteed cost there / optimum, ratio of the means",
        "counterexample": "counterexample of lowest V − δt",
        "remaining_volume": "share of [0, T] × D undecided",
        "boxes": "boxes",
        "seconds": "seconds",
        "fingerprint": "fingerprint of what was bounded",
    }
    claim: ProvedFunnel

    @property
    def is_complete(self) -> bool:
        """Whether no larger funnel is needed: it contains X₀."""
        return self.verdict == "certified"

    def searched_condition(self) -> tuple[DecreaseCondition, tuple[Corner, Corner], float]:
        """The condition in plain arithmetic, [0, T] × D, and the level up to which it was to be proved."""
        claim = self.claim
        loop = copied(self.controller.closed_loop)
        if claim.steps is not None:
            condition = SteppedPayment(loop, claim.alpha, claim.delta, copied(self.controller.problem))
            return condition, condition.domain_of(claim.states, claim.left_out), claim.wanted
        condition = DecreaseCondition(
            loop, claim.alpha, claim.delta, disturbance=claim.disturbance, readings=claim.readings
        )
        return condition, over_time(claim.states, claim.duration), claim.wanted

    @cached_property
    def inside(self) -> Inside:
        x0 = self.controller.initial_states.sample(COMPARED, stream(1, CERTIFICATION))
        value = self.controller.value(0.0, x0).double()
        guaranteed = self.claim.guaranteed_cost(value)
        x0, value, guaranteed = (y[guaranteed.isfinite()] for y in (x0, value, guaranteed))
        return Inside(x0, value, guaranteed)

    def proved(self) -> dict[str, Any]:
        claim, names = self.claim, self.controller.system.state_names
        constraints = {
            "constraints": list(claim.constraints) if claim.volume_share else [], "crossing_level": claim.crossing,
            "violation": None if claim.violation is None else claim.violation._asdict(),
        } if claim.constraints else {}  # fmt: skip
        return {
            "alpha": claim.alpha, "delta": claim.delta, "disturbance": self.disturbance, "duration": claim.duration,
            "rho": claim.rho if claim.volume_share else None, "rho_wanted": claim.wanted,
            "set": [claim.states.lower.tolist(), claim.states.upper.tolist()],
            "states_left_out": [names[i] for i in claim.left_out], "volume_share": claim.volume_share,
            "terminal_excess": claim.terminal_excess if claim.volume_share else None, "reason": claim.reason,
            "boxes": claim.boxes, "seconds": claim.seconds, "remaining_volume": claim.remaining_volume,
            "counterexample": None if claim.counterexample is None else claim.counterexample._asdict(),
            "fingerprint": claim.fingerprint, **constraints, **readings_facts(claim.readings, self.controller.system),
            **({} if claim.steps is None else {"steps": f"{claim.steps.dt!r} s, {claim.steps.method}"}),
        }  # fmt: skip

    @property
    def disturbance(self) -> dict[str, float]:
        """The bound w_i of each disturbed state, by its name."""
        return named_disturbance(self.claim.disturbance, self.controller.system.state_names)

    def in_words(self) -> str:
        claim = self.claim
        if not claim.volume_share:
            return NOT_PROVED
        proved = f"in continuous time for this model {readings_text(claim.readings, self.controller.system)}"
        if claim.steps is not None:
            proved = (
                f"in discrete time about the steps of this model ({claim.steps.method}, Δt = {claim.steps.dt!r} s, u "
                "held over each), and not about the plant between them"
            )
        return (
            f"{{V(0, ·) ≤ ρ}} with ρ = {claim.rho!r} is the mouth of a funnel, proved {proved}: no closed loop that "
            f"starts in it leaves the funnel, or D,{self._or_violates} up to "
            f"T = {claim.duration:g} s, {self._under_disturbances}and its cost is bounded as below. It holds at least "
            f"{floored(claim.volume_share)} of X₀ by volume. "
            f"{computed_text(claim.readings, self.controller.system, claim.left_out)}It is about the traced "
            f"operations of f, g, ℓ, V and u, which have this fingerprint; {FROZEN}{self.parameters_text}"
            f"{' ' * bool(claim.assumed)}{claim.assumed}"
        )

    @property
    def _under_disturbances(self) -> str:
        """Words on disturbances; empty without any."""
        return f"{disturbance_text(self.disturbance)}, " if self.disturbance else ""

    @property
    def _or_violates(self) -> str:
        """Words on constraints; empty without any."""
        return f" or violates a constraint ({'; '.join(self.claim.constraints)})," if self.claim.constraints else ""

    def in_formulas(self) -> list[str]:
        claim = self.claim
        # not rounded, since the proof is about these numbers
        alpha, delta, T = (f"{value!r}".removesuffix(".0") for value in (claim.alpha, claim.delta, claim.duration))
        rho, kappa = (repr(claim.rho), repr(claim.terminal_excess)) if claim.volume_share else ("ρ", "κ")
        h = ("  and  h(x) ≤ 0", "  and  h(x(t)) ≤ 0", "  and  h(x₀) ≤ 0") if self.claim.constraints else [""] * 3
        where = f"at each (t, x) ∈ [0, {T}] × D with V(t, x) ≤ {rho} + {delta} t{h[0]}"
        if claim.readings is not None:
            longest = f"{claim.readings.longest!r}"
            where = (
                f"with u = {control_of(claim.readings, 'policy(t̂, x̂{})')} at (t̂ + a, x(t̂ + a)), 0 ≤ a ≤ {longest}, "
                f"t̂ + a ≤ {T}, after each reading (t̂, x̂) ∈ [0, {T}] × D with V(t̂, x̂) ≤ {rho} + {delta} t̂"
            )
        if claim.steps is not None:
            dt = repr(claim.steps.dt)
            return [
                f"(V(t + {dt}, F(x, u)) − V(t, x))/{dt} + {alpha} ℓ̄(x, u) ≤ {delta} and F(x, u) ∈ D  with "
                f"u = policy(t, x), F and ℓ̄ of one step, at each (t, x) ∈ [0, {T} − {dt}] × D with V(t, x) ≤ "
                f"{rho} + {delta} t",
                f"V(t_n, x_n) ≤ {rho} + {delta} t_n  and  x_n ∈ D  from each x₀ ∈ D with V(0, x₀) ≤ {rho}",
                f"J(x₀) = Σ {dt} ℓ̄ + φ ≤ (V(0, x₀) + {delta} · {T}) / {alpha} + {kappa}  from the same x₀",
            ]
        return [
            f"V_t + V_xᵀ(f + g u){' + Σ w_i |∂V/∂x_i|' if self.disturbance else ''} + {alpha} ℓ(x, u) ≤ {delta}  "
            f"{where}",
            f"V(t, x(t)) ≤ {rho} + {delta} t{h[1]}  and  x(t) ∈ D  from each x₀ ∈ D with V(0, x₀) ≤ {rho}{h[2]}",
            f"J(x₀) ≤ (V(0, x₀) + {delta} · {T}) / {alpha} + {kappa}  from the same x₀",
        ]

    def verdict_text(self) -> str:
        found, violation = self.claim.counterexample, self.claim.violation
        if violation is not None:
            return (
                "The verdict is on the claim that no closed loop from X₀ violates a constraint: the one from "
                f"x₀ = {format_state(violation.x0)} does at t = {violation.t:.6g} s, {violation.constraint}, by h = "
                f"{violation.h:.3g} (Runge-Kutta steps of a quarter of Δt)."
            )
        why = {
            "certified": "it does",
            "falsified": "the condition fails inside this funnel",
            "unknown": "undecided within the budget",
        }[self.verdict]
        where = ""
        if found is not None:
            after = "" if self.claim.readings is None else f" read there, {found.after:.3g} s later"
            where = f" At t = {found.t:.6g} s, x = {format_state(found.x)}{after} it fails by {found.condition:.3g}."
        return f"The verdict is on the claim that a funnel holds all of X₀: {why}.{where}"

    def in_short(self, lower: ProvedLowerBound) -> str:
        return f"α = β = {self.claim.alpha:g}, δ = {self.claim.delta:.3g}"

    def figure_of_both(self, lower: ProvedLowerBound, whose: str, headline: str) -> figures.Figure:
        _, value, guaranteed, _ = self.inside
        return figures.two_sided(value, guaranteed, lower.least_cost(value), self.optimum, headline, whose)

    def figure(self) -> figures.Figure:
        controller, problem = self.controller, self.controller.problem
        labels = controller.system.state_labels
        return figures.funnel(
            self.claim, controller.V, problem.initial_states, problem.goal, labels, problem.constraints
        )

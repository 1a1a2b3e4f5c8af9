"""Certificates that a target is reached under noise with a probability, by proof."""

import math
from collections.abc import Mapping
from functools import cached_property
from typing import Any, ClassVar

import torch
from torch import Tensor

from lyapnet.base.contracts import copied
from lyapnet.base.random_streams import CERTIFICATION, stream
from lyapnet.claims import figures
from lyapnet.claims.arguments import COMPARED
from lyapnet.claims.certificates import FROZEN, NOT_PROVED, Certificate, format_state
from lyapnet.claims.reach import ProvedReach
from lyapnet.claims.reach_decrease import sides
from lyapnet.claims.tables import floored
from lyapnet.controller.controller import Controller
from lyapnet.loop.rollout.closed_loop import ClosedLoop

PATHS, SUBSTEPS = 12, 10  # closed loops to draw, and Euler–Maruyama steps for each step of Δt
MOST_HORIZONS = 20  # length of a drawn closed loop, in horizons, if it neither reaches the target nor leaves D


class ReachCertificate(Certificate):
    """The probability with which closed loops reach a target before they leave a set, and their mean time to it.

    Args:
        loop: the closed loop with the noise of the claim.
    """

    kind: str = "reach"
    picture: str = "reach.png"
    labels: ClassVar[Mapping[str, str]] = {
        "reason": "why",
        "probability": "probability of reaching the target",
        "noise": "σ of the noise, per √s",
        "target": "target",
        "avoided": "boxes not met before",
        "set": "D",
        "risk": "λ, 1/cost",
        "rate": "ε, cost per second",
        "rho_wanted": "ρ for all of X₀",
        "rho": "largest ρ proved",
        "rim": "V(0, ·) on the boundary of D and on what is avoided, at least",
        "volume_share": "share of X₀ from which it is reached with that probability, at least",
        "miss_probability": "P(miss), largest over these states, at most",
        "mean_time": "mean time to the target or out, s, over these states, at most",
        "constraints": "constraints that hold before",
        "counterexample": "counterexample of lowest V",
        "remaining_volume": "share of D undecided",
        "boxes": "boxes",
        "seconds": "seconds",
        "fingerprint": "fingerprint of what was bounded",
    }
    claim: ProvedReach

    def __init__(self, controller: Controller, claim: ProvedReach, options: Mapping[str, Any], loop: ClosedLoop):
        super().__init__(controller, claim, options)
        self.loop = loop

    @cached_property
    def _values(self) -> Tensor:
        """V(0, x₀) at random states of X₀ from which the target is reached with the probability of the claim."""
        x0 = self.controller.initial_states.sample(COMPARED, stream(1, CERTIFICATION))
        value = self.controller.value(0.0, x0).double()
        return value[self.claim.reach_probability(value) >= self.claim.probability]

    @property
    def _noise(self) -> str:
        """σ in words."""
        if self.claim.noise is None:
            return "that of the task"
        return ", ".join(f"{name}: {strength!r}" for name, strength in self.claim.noise.items())

    def numbers(self) -> dict[str, Any]:
        claim, value, found = self.claim, self._values, self.claim.counterexample
        proved, proof = claim.rho > -math.inf, claim.proof
        means = {} if not len(value) else {
            "miss_probability": float(1 - claim.reach_probability(value).min()),
            "mean_time": float(claim.mean_time(value).max()),
        }  # fmt: skip
        return {
            "probability": claim.probability, "noise": self._noise, "target": sides(claim.target),
            "avoided": [sides(box) for box in claim.avoided], "set": sides(claim.states), "risk": claim.risk,
            "rate": claim.rate, "rho_wanted": claim.wanted, "rho": claim.rho if proved else None, "rim": claim.rim,
            "lowest": claim.lowest, "volume_share": claim.volume_share, **means,
            "constraints": list(claim.constraints) if proved else [], "reason": claim.reason,
            "counterexample": found and {"x": found.x, "condition": found.condition, "V": found.height},
            "boxes": proof.boxes, "remaining_volume": proof.remaining_volume, "seconds": claim.seconds,
            "fingerprint": proof.fingerprint,
        }  # fmt: skip

    def in_words(self) -> str:
        claim = self.claim
        if claim.rho == -math.inf:
            return NOT_PROVED
        avoided = ", or meets one of the boxes to avoid" if claim.avoided else ""
        constraints = f", or violates a constraint ({'; '.join(claim.constraints)})" if claim.constraints else ""
        return (
            f"Under dx = (f + gu) dt + σ(x) dW with u = u(0, x) at every t and this σ: {self._noise}; in continuous "
            f"time, without end and for this model: a closed loop from x₀ ∈ D with V(0, x₀) ≤ {claim.rho!r} reaches "
            "the target before it leaves "
            f"D{avoided}{constraints}, with a probability bounded as below; from at least "
            f"{floored(claim.volume_share)} of X₀ by volume that is at least {claim.probability!r}. The mean time "
            "until it does, or leaves {V(0, ·) ≤ ρ}, is bounded as below. Nothing is claimed about what follows then. "
            "It is about every solution of the equation with the traced operations of f, g, σ, V and u, which have "
            f"this fingerprint; {FROZEN}{' ' * bool(claim.assumed)}{claim.assumed}"
        )

    def in_formulas(self) -> list[str]:
        claim = self.claim
        rho = repr(claim.rho) if claim.rho > -math.inf else "ρ'"
        avoided = ", on the boxes to avoid" if claim.avoided else ""
        constraints = " and wherever h_j(x) ≥ 0" if claim.constraints else ""
        boxes = "".join(f";  to avoid: {sides(box)}" for box in claim.avoided)
        return [
            f"𝓛V + ½ {claim.risk!r} ‖σᵀV_x‖² ≤ −{claim.rate!r}  at each x ∈ D outside of the interior of G with "
            f"V(0, x) ≤ {rho}, 𝓛V = V_xᵀ(f + g u) + ½ tr(σσᵀV_xx), V = V(0, x), u = u(0, x); σ: "
            f"{self._noise}; G = {sides(claim.target)}{boxes}",
            f"V > {rho} on the boundary of D{avoided}{constraints}",
            f"P(x(t) reaches G before it leaves {{x ∈ D: V(0, x) ≤ {rho}}}) ≥ 1 − exp(−{claim.risk!r} ({rho} − "
            f"V(0, x₀)))  from each x₀ ∈ D with V(0, x₀) ≤ {rho}",
            f"E[time until then] ≤ (V(0, x₀) − {claim.lowest!r}) / {claim.rate!r}  from the same x₀",
        ]

    def verdict_text(self) -> str:
        claim, found = self.claim, self.claim.counterexample
        why = {
            "certified": "they do",
            "falsified": "V does not fall so inside the sublevel set that this needs (closed loops may still do so)",
            "unknown": claim.reason,
        }[self.verdict]
        where = "" if found is None else f" At x = {format_state(found.x)} it fails by {found.condition:.3g}."
        return (
            f"The verdict is on the claim that closed loops from all of X₀ reach the target with probability "
            f"{claim.probability!r}, proved with λ = {claim.risk:.4g}: {why}.{where}"
        )

    def figure(self) -> figures.Figure:
        problem, labels = self.controller.problem, self.controller.system.state_labels
        V = self.controller.V
        return figures.reach(
            self.claim, V, problem.initial_states, problem.goal, labels, problem.constraints, self._paths()
        )

    def _paths(self) -> list[Tensor]:
        """Closed loops under noise from X₀, (times, n) each, until they are in the target or leave D."""
        claim, horizon = self.claim, self.controller.horizon
        if claim.states.dimension != 2:  # closed loops would not lie in the slice
            return []
        loop, dt, generator = copied(self.loop), horizon.dt / SUBSTEPS, stream(0, CERTIFICATION)
        assert loop.noise is not None
        x = self.controller.initial_states.sample(PATHS, generator).double()
        ended, path = torch.zeros(PATHS, dtype=torch.bool), [x]
        with torch.no_grad():
            for _ in range(MOST_HORIZONS * horizon.steps * SUBSTEPS):
                ended = ended | _within(x, claim.target) | ~_within(x, claim.states)
                if bool(ended.all()):
                    break
                step = dt * loop.system.dynamics(x, loop.policy(x.new_zeros(()), x))
                step = step + loop.noise.displacement(x, loop.noise.draw(1, dt, x, generator)[0])
                x = torch.where(ended[:, None], x, x + step)
                path.append(x)
        return list(torch.stack(path).unbind(1))


def _within(x: Tensor, box: Any) -> Tensor:
    """Whether states lie in a box."""
    return ((x >= box.lower) & (x <= box.upper)).all(-1)

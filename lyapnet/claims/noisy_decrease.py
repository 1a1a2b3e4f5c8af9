"""The condition of a funnel under noise, which a proof bounds on boxes."""

import math
from typing import Any

import torch

from lyapnet.base.errors import UsageError
from lyapnet.base.types import Corner, PerState, State, Time
from lyapnet.loop.rollout.closed_loop import ClosedLoop
from lyapnet.prover.branches import CHOICES, JUMPS, KINKS
from lyapnet.prover.condition import DecreaseCondition, own_operations
from lyapnet.value.calculus import noise_derivative, time_derivative

LEAK_SHARE = 0.1  # share of 1 − p for closed loops that leave from low V, where the second inequality has the slack η


class NoisyDecrease(DecreaseCondition):
    """c(t, x) = max(𝓛V + α ℓ(x, u) − δ, 𝓛V + ½ λ ‖σᵀV_x‖² − ṙ − s(λ(r − V))) with the law u = policy(t, x), where

        𝓛V = V_t + V_xᵀ(f + g u) + ½ tr(σσᵀV_xx),     r(t) = ρ e^(−at),
        s(y) = S min(max(1 + y − ln(S/η), 0), 1) ≤ η e^y,     S = aρ + δ.

    By Itô's formula 𝓛V is the mean of dV/dt, and for Z = exp(λ(V − r)) that of dZ/dt is λZ(𝓛V − ṙ + ½ λ ‖σᵀV_x‖²).
    So where c ≤ 0, V + ∫(αℓ − δ) dt and Z − ληt are supermartingales. The slack s allows V to rise where it is low,
    from where a closed loop hardly leaves {V ≤ r}. It is used instead of η e^y, whose bounds on boxes are wide.

    Args:
        closed_loop: the system with its noise σ, its cost, and a control law that V defines.
        alpha, delta: α and δ.
        decay: a ≥ 0, in 1/s, at which the funnel narrows.
        probability: p, the probability of staying in the funnel {V ≤ r}, from which `aim` computes ρ and η.
        duration: T in s.
    """

    proves = "noisy"

    def __init__(
        self,
        closed_loop: ClosedLoop,
        alpha: float,
        delta: float,
        decay: float = 0.0,
        probability: float = 0.99,
        duration: float = 1.0,
    ):
        super().__init__(closed_loop, alpha, delta)
        if closed_loop.noise is None:
            raise UsageError(
                "Expected a task with noise for a noisy certificate, got one without; lyapnet certify sound proves a "
                "funnel without noise."
            )
        self.noise, self.decay, self.probability, self.duration = closed_loop.noise, decay, probability, duration
        self.risk, self.largest, self.level, self.leak = 0.0, math.nan, math.inf, math.inf

    def aim(self, risk: float, largest: float) -> None:
        """Set λ, and ρ and η so that closed loops from V(0, x₀) ≤ largest leave with a probability of at most 1 − p.

        exp(−λ(ρ − largest)) is 90 % of 1 − p, and ληT is the rest.
        """
        if not 0 < risk < math.inf:
            raise UsageError(f"Expected risk > 0, got {risk}; give it in 1/cost.")
        self.risk, self.largest, leaves = risk, largest, 1 - self.probability
        self.level = largest - math.log((1 - LEAK_SHARE) * leaves) / risk
        self.leak = LEAK_SHARE * leaves / (risk * self.duration)

    @property
    def facts(self) -> dict[str, Any]:
        names = ("alpha", "delta", "decay", "probability", "risk", "largest")
        return {name: getattr(self, name) for name in names}

    def forward(self, t: Time, x: State) -> PerState:
        paid, _, leaves = self.parts(t, x)
        return torch.maximum(paid, leaves)

    def parts(self, t: Time, x: State) -> tuple[PerState, PerState, PerState]:
        """(first term of c, W, second term of c), where W = V e^(at), so that the funnel is {W ≤ ρ}."""
        mean, steepness = self.rates(t, x)
        paid = mean + self.alpha * self.closed_loop.cost.running(x, self.closed_loop.policy(t, x)) - self.delta
        return paid, self.height(t, x), self.excess(t, self.V(t, x), mean, steepness) if self.risk else mean

    def excess(self, t: Time, V: PerState, mean: PerState | float, steepness: PerState) -> PerState:
        """𝓛V + ½ λ ‖σᵀV_x‖² − ṙ − s(λ(r − V))."""
        r, most = self.level * torch.exp(-self.decay * t), self.decay * abs(self.level) + self.delta
        room = 0.0
        if most > 0:
            room = most * (1 + self.risk * (r - V) - math.log(most / self.leak)).clamp(0.0, 1.0)
        return mean + self.risk / 2 * steepness + self.decay * r - room

    def height(self, t: Time, x: State) -> PerState:
        return self.V(t, x) * torch.exp(self.decay * t) if self.decay else self.V(t, x)

    def rates(self, t: Time, x: State) -> tuple[PerState, PerState]:
        """(𝓛V, ‖σᵀV_x‖²): the mean of dV/dt, and the variance of V per second."""
        loop, sigma = self.closed_loop, self.noise(x)
        mean = time_derivative(self.V, loop.system, t, x, loop.policy(t, x)) + noise_derivative(self.V, sigma, t, x)
        slope = self.V.value_and_state_gradient(t, x)[1]
        return mean, ((sigma * slope[..., None]).sum(-2) ** 2).sum(-1)


def require_smooth(condition: DecreaseCondition, domain: tuple[Corner, Corner]) -> None:
    """Refuse a V with kinks or branches in x, for which Itô's formula does not hold; kinks in t alone are allowed.

    Raises:
        UsageError: the message names the operators.
    """
    graph, unsmooth = own_operations(condition.V, domain).graph.graph, {*KINKS, *JUMPS, *CHOICES}
    _, x = (node for node in graph.nodes if node.op == "placeholder")
    moved, found = {x}, set[str]()
    for node in graph.nodes:
        if moved.intersection(node.all_input_nodes):
            moved.add(node)
            if node.target in unsmooth:
                found.add(str(node.target))
    if found:
        raise UsageError(
            f"Expected a V with two derivatives in x under noise, got {' and '.join(sorted(found))}; write V with "
            "smooth operations, as network.name=expansion and fcn with activation tanh do."
        )

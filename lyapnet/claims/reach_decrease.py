"""The condition under which closed loops under noise reach a target before they leave a sublevel set of V."""

import math
from collections.abc import Mapping, Sequence
from functools import reduce
from typing import Any

import torch
from torch import Tensor

from lyapnet.base.errors import UsageError
from lyapnet.base.types import PerState, State, Time
from lyapnet.loop.rollout.closed_loop import ClosedLoop
from lyapnet.prover.branch_and_bound import just_above
from lyapnet.prover.condition import DecreaseCondition
from lyapnet.task.constraints import Constraints
from lyapnet.task.sets import Box
from lyapnet.value.calculus import noise_derivative

WITHIN = 1 - 1e-9  # size of the target in which the condition is not required, relative to the target, for rounding


class ReachDecrease(DecreaseCondition):
    """c(x) = 𝓛V + ½ λ ‖σᵀV_x‖² + ε with V = V(0, x) and u = u(0, x), to be ≤ 0 outside of the target, where

        𝓛V = V_xᵀ(f + g u) + ½ tr(σσᵀV_xx).

    By Itô's formula 𝓛V is the mean of dV/dt, and for Z = exp(λV) that of dZ/dt is λZ(𝓛V + ½ λ ‖σᵀV_x‖²). So where
    c ≤ 0, V + εt and Z are supermartingales.

    Args:
        closed_loop: the system with its noise σ, and a control law that V defines.
        target: a box; c ≤ 0 is not required in its interior.
        avoided: boxes that closed loops must not meet, for the facts of the condition.
        probability: p, the probability of reaching the target, from which `aim` computes ρ.
        named: σ of the noise by state, if it is not that of the task, for the facts of the condition.
    """

    proves = "reach"

    def __init__(
        self,
        closed_loop: ClosedLoop,
        target: Box,
        avoided: Sequence[Box],
        probability: float,
        named: Mapping[str, float] | None = None,
    ):
        super().__init__(closed_loop, 1.0, 0.0)
        if closed_loop.noise is None:
            raise UsageError(
                "Expected a task with noise for a reach certificate, got one without; name the noise (--noise "
                "velocity=0.1), or prove a region of attraction: lyapnet certify region."
            )
        if not 0 < probability < 1:
            raise UsageError(f"Expected 0 < probability < 1, got {probability}; noise allows no other.")
        self.noise, self.probability, self.named = closed_loop.noise, probability, named
        self.target, self.avoided = target, list(avoided)
        self.risk, self.rate, self.largest, self.level = 0.0, 0.0, math.nan, math.inf

    @property
    def gap(self) -> float:
        """ρ − max V on X₀, rounded upwards, so that exp(−λ gap) ≤ 1 − p."""
        return just_above(-math.log(1 - self.probability) / self.risk)

    def aim(self, risk: float, rate: float, largest: float) -> None:
        """Set λ and ε, and a ρ that V exceeds with a probability of at most 1 − p from V(x₀) ≤ largest."""
        for name, value, unit in (("risk", risk, "1/cost"), ("rate", rate, "cost per second")):
            if not 0 < value < math.inf:
                raise UsageError(f"Expected {name} > 0, got {value}; give it in {unit}.")
        self.risk, self.rate, self.largest = risk, rate, largest
        self.level = just_above(largest + self.gap)

    @property
    def facts(self) -> dict[str, Any]:
        boxes = {"target": sides(self.target), "avoided": [sides(box) for box in self.avoided]}
        noise = {"noise": None if self.named is None else dict(self.named)}
        return {**boxes, **noise, **{name: getattr(self, name) for name in ("probability", "risk", "rate", "largest")}}

    def parts(self, t: Time, x: State) -> tuple[PerState, PerState, PerState]:
        """(c, V, c)."""
        mean, variance = self.rates(t, x)
        excess = mean + self.risk / 2 * variance + self.rate
        return excess, self.V(t, x), excess

    def rates(self, t: Time, x: State) -> tuple[PerState, PerState]:
        """(𝓛V, ‖σᵀV_x‖²): the mean of dV(0, x)/dt, and the variance of V(0, x) per second."""
        loop, sigma = self.closed_loop, self.noise(x)
        slope = self.V.value_and_state_gradient(t, x)[1]
        mean = (slope * loop.system.dynamics(x, loop.policy(t, x))).sum(-1) + noise_derivative(self.V, sigma, t, x)
        return mean, ((sigma * slope[..., None]).sum(-2) ** 2).sum(-1)


class OutsideBox(Constraints):
    """h(x) > 0 in the interior of a box, where the condition need not hold."""

    names = ("outside the target",)

    def __init__(self, box: Box):
        super().__init__()
        self.ends = list(zip(box.center.tolist(), box.widths.tolist(), strict=True))

    def forward(self, x: State) -> Tensor:
        within = [WITHIN - (x[..., i] - middle).abs() / (width / 2) for i, (middle, width) in enumerate(self.ends)]
        return reduce(torch.minimum, within)[..., None]


def sides(box: Box) -> list[list[float]]:
    """[lower, upper] of a box, as plain data."""
    return [box.lower.tolist(), box.upper.tolist()]

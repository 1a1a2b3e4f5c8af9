"""The functions to bound: decrease conditions with known truth, and that of a network like trained ones."""

import copy
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from lyapnet.base.errors import UsageError
from lyapnet.base.types import PerState, State, Time
from lyapnet.claims.arguments import slack_of
from lyapnet.controller.controller import Controller
from lyapnet.evaluation.oracles import continuous_riccati
from lyapnet.loop.rollout.closed_loop import ClosedLoop
from lyapnet.prover.condition import DecreaseCondition
from lyapnet.task.cost import QuadraticCost
from lyapnet.task.horizon import Horizon
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box, Unbounded
from lyapnet.task.systems import DoubleIntegrator, IntegratorChain, Linear
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.networks import FCN, GoalAnchor, Scaling
from lyapnet.value.policy import HJBPolicy

ALPHA = 0.9


class Bounded(NamedTuple):
    """A decrease condition, and a box of (t, x) on which it is bounded."""

    name: str
    condition: DecreaseCondition
    lower: Tensor  # (1 + n,)
    upper: Tensor


class Quadratic(ValueFunction):
    """V(t, x) = xᵀPx, plus N(t, x) if a network is given."""

    P: Float[Tensor, "n n"]

    def __init__(self, P: Tensor, network: ValueFunction | None = None):
        super().__init__()
        self.register_buffer("P", P)
        self.network = network

    def forward(self, t: Time, x: State) -> PerState:
        value = ((x @ self.P) * x).sum(-1)
        return value + (0 * t if self.network is None else self.network(t, x))


def stationary(system: Linear, cost: QuadraticCost) -> Tensor:
    """P of the infinite horizon, (n, n), approximated by the Riccati solution 40 s before the end of a horizon."""
    return continuous_riccati(system, cost, Horizon(200, 0.2)).P[0]


def condition_of_network(seed: int = 0) -> Bounded:
    """The condition on the double integrator with V = xᵀPx + N(t, x).

    P is the Riccati solution, N a tanh network with two layers of 32, zero at the goal. Like a trained V, this one is
    close to the value function, so that the terms of V̇ + αℓ nearly cancel, and it is not quadratic.
    """
    system, cost = DoubleIntegrator().double(), _cost([10.0, 0.1])
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = GoalAnchor(FCN(Scaling([1.0, 0.7], 4.0, 1.0), hidden=(32, 32))).double()
    V = Quadratic(stationary(system, cost), network)
    sides = torch.tensor([[0.0, -1.0, -0.7], [4.0, 1.0, 0.7]], dtype=torch.float64)
    return Bounded("double integrator, Riccati + tanh 32-32", _condition(system, cost, V, 0.02), *sides)


def condition_of_controller(controller: Controller) -> Bounded:
    """The condition that `lyapnet certify` proves of a checkpoint, at α = 0.9 and its default δ, on [0, T] × X₀."""
    closed_loop = copy.deepcopy(controller.closed_loop).double().requires_grad_(False)
    condition, X0 = DecreaseCondition(closed_loop, ALPHA, slack_of(None, controller)), controller.initial_states
    ends = torch.tensor([[0.0], [controller.horizon.duration]], dtype=torch.float64)
    lower, upper = (torch.cat(pair) for pair in zip(ends, (X0.lower.double(), X0.upper.double()), strict=True))
    return Bounded(controller.config.experiment, condition, lower, upper)


def condition_of_chain(n: int, delta: float = 0.5, holds: bool = True) -> Bounded:
    """The condition of V = s xᵀPx on a chain of n integrators.

    With ℓ = ‖x‖² + u², |x_i| ≤ 1 and S = PBR⁻¹BᵀP it is c = xᵀMx − δ with

        M = (1 − s)(sS + Q) − (1 − α)(Q + s²S).

    At s = 1, c = −(1 − α)ℓ − δ < 0 everywhere. The twin takes the s < 1 at which c is δ/10 in a corner of the box. As V
    does not depend on t, the instant t = 0 stands for all.

    Args:
        delta: δ as a share of the mean of ℓ over the box at s = 1.

    Raises:
        UsageError: there are no integrators; or no s ≥ ½ breaks the condition.
    """
    if n < 1:
        raise UsageError(f"Expected chains of n ≥ 1 integrators, got {n}; for example --dimensions 2,3.")
    system, cost = IntegratorChain(n).double(), _cost([1.0] * n)
    P = stationary(system, cost)
    Q, S = cost.Q.double(), P[:, -1:] @ P[-1:]
    slack = delta * float((Q + S).trace()) / 3
    s = 1.0 if holds else _breaking_factor(Q, S, slack)
    sides = torch.ones(1 + n, dtype=torch.float64).index_fill(0, torch.tensor(0), 0.0)
    return Bounded(f"chain of {n}", _condition(system, cost, Quadratic(s * P), slack), -sides, sides)


def _breaking_factor(Q: Tensor, S: Tensor, slack: float) -> float:
    """The s ∈ [½, 1] with max xᵀMx = 1.1 δ over the corners of the box; on this interval M decreases in s."""
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0], dtype=torch.float64)] * len(Q)).reshape(-1, len(Q))

    def largest(s: float) -> float:
        M = (1 - s) * (s * S + Q) - (1 - ALPHA) * (Q + s * s * S)
        return float(((corners @ M) * corners).sum(-1).max())

    low, high = 0.5, 1.0
    if largest(low) < 1.1 * slack:
        raise UsageError(f"Expected a delta that some s ≥ ½ breaks, got {slack:g}; give a smaller share.")
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (middle, high) if largest(middle) > 1.1 * slack else (low, middle)
    return low


def _condition(system: Linear, cost: QuadraticCost, V: ValueFunction, delta: float) -> DecreaseCondition:
    box = Box([-1.0] * system.n, [1.0] * system.n)
    problem = Problem(system, cost, Unbounded(), box, Horizon(1, 1.0)).double()  # conditions do not use the horizon
    closed_loop = ClosedLoop(problem, HJBPolicy(problem, V)).requires_grad_(False)
    return DecreaseCondition(closed_loop, ALPHA, delta)


def _cost(diagonal: list[float]) -> QuadraticCost:
    Q = torch.tensor(diagonal, dtype=torch.float64).diag()
    return QuadraticCost(Q, torch.ones(1, 1, dtype=torch.float64), Q).double()

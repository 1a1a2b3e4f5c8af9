"""The one evaluator of a comparison: what a policy costs from each of a batch of states, and the optimum there."""

from typing import Any, NamedTuple

import numpy as np
import torch

from lyapnet.base.errors import OracleError
from lyapnet.base.types import PerState, State
from lyapnet.evaluation.oracles import optimal_cost, oracle_of
from lyapnet.lab.comparison.environments import Episodes
from lyapnet.lab.comparison.reference_problems import BoundedProblem


class Costs(NamedTuple):
    """What a policy costs from each of a batch (b,) of states."""

    cost: PerState  # J_N = Δt Σℓ_n + φ; ∞ where the closed loop left the finite numbers
    sum: PerState  # Σℓ_n + φ, as the paper has it
    clipped_fraction: float  # share of controls at the bounds of the action box


def costs_of(policy: Any, bounded: BoundedProblem, observe_time: bool, x0: State) -> Costs:
    """What a policy with SB3's `predict` costs from each of x₀ (b, n), without exploration; clipped as in training."""
    episodes, dt = Episodes(bounded, observe_time), bounded.problem.horizon.dt
    episodes.start(x0)
    cost, memory, start = torch.zeros_like(x0[:, 0]), None, np.ones(len(x0), dtype=bool)
    while not episodes.over:
        action, memory = policy.predict(episodes.observation, state=memory, episode_start=start, deterministic=True)
        cost, start = cost - episodes.advance(action), np.zeros(len(x0), dtype=bool)
        lost = ~torch.isfinite(episodes.state).all(-1)
        cost[lost] = torch.inf
        episodes.state[lost] = 0  # a policy cannot be asked about what is no number
    terminal = bounded.problem.cost.terminal(episodes.state)
    cost = torch.nan_to_num(cost, nan=torch.inf, posinf=torch.inf)
    return Costs(cost, (cost - terminal) / dt + terminal, episodes.clipped_fraction)


def optima_of(bounded: BoundedProblem, x0: State) -> PerState | None:
    """J* from each of x₀ (b, n), NaN where none was found; None where there is no oracle."""
    oracle = optimal_cost(bounded.problem)
    return None if oracle is None else oracle.solve(x0).cost


def why_no_optimum(bounded: BoundedProblem) -> str | None:
    """What keeps J* of a task from being known; None if nothing does."""
    try:
        oracle_of(bounded.problem)
    except OracleError as error:
        return str(error)
    return None

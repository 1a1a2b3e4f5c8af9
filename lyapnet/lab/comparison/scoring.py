"""The evaluator of a comparison: the cost of a policy from each of a batch of states, and the optimum.

With noise a cost is the mean over paths of it, the same for every policy.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lyapnet.base.errors import OracleError
from lyapnet.base.random_streams import NOISE, stream
from lyapnet.base.types import PerState, State
from lyapnet.evaluation.oracles import optimal_cost, oracle_of
from lyapnet.lab.comparison.environments import Episodes
from lyapnet.lab.comparison.reference_problems import BoundedProblem

PathIncrements = Float[Tensor, "steps paths b sources"]  # ΔW, in √s


class Costs(NamedTuple):
    """The costs of a policy from each of a batch (b,) of states."""

    cost: PerState  # J_N = Δt Σℓ_n + φ; ∞ where the closed loop left the finite numbers
    sum: PerState  # Σℓ_n + φ, as the paper has it
    clipped_fraction: float  # share of controls at the bounds of the action box
    paths: Tensor | None = None  # J_N of each path of noise, (paths, b), of which `cost` is the mean; None without


def increments_of(bounded: BoundedProblem, x0: State, paths: int, seed: int, purpose: int) -> PathIncrements | None:
    """ΔW of some paths of noise from each of x₀ (b, n), those of `lyapnet evaluate`; None without noise.

    Args:
        purpose: that of the random stream, TEST or VALIDATION.
    """
    noise, horizon = bounded.problem.noise, bounded.problem.horizon
    if noise is None:
        return None
    drawn = [noise.draw(horizon.steps, horizon.dt, x0, stream(seed, purpose, NOISE, path)) for path in range(paths)]
    return torch.stack(drawn, 1)


def costs_of(
    policy: Any, bounded: BoundedProblem, observe_time: bool, x0: State, increments: PathIncrements | None = None
) -> Costs:
    """What a policy with SB3's `predict` costs from each of x₀ (b, n), without exploration; clipped as in training.

    Args:
        increments: ΔW of some paths from each of x₀; None: the task has no noise.
    """
    if increments is None:
        return _costs_of_loops(policy, bounded, observe_time, x0, [None] * bounded.problem.horizon.steps)
    paths = increments.shape[1]
    each = _costs_of_loops(policy, bounded, observe_time, x0.repeat(paths, 1), increments.flatten(1, 2))
    cost, sums = (values.unflatten(0, (paths, len(x0))) for values in (each.cost, each.sum))
    return Costs(cost.mean(0), sums.mean(0), each.clipped_fraction, cost)


def _costs_of_loops(
    policy: Any, bounded: BoundedProblem, observe_time: bool, x0: State, increments: Iterable[Tensor | None]
) -> Costs:
    """The same for one closed loop from each of x₀, with ΔW of each step."""
    episodes, dt = Episodes(bounded, observe_time), bounded.problem.horizon.dt
    episodes.start(x0)
    cost, memory, start = torch.zeros_like(x0[:, 0]), None, np.ones(len(x0), dtype=bool)
    for increment in increments:
        action, memory = policy.predict(episodes.observation, state=memory, episode_start=start, deterministic=True)
        cost, start = cost - episodes.advance(action, increment), np.zeros(len(x0), dtype=bool)
        lost = ~torch.isfinite(episodes.state).all(-1)
        cost[lost] = torch.inf
        episodes.state[lost] = 0  # policies may fail for NaN
    terminal = bounded.problem.cost.terminal(episodes.state)
    cost = torch.nan_to_num(cost, nan=torch.inf, posinf=torch.inf)
    return Costs(cost, (cost - terminal) / dt + terminal, episodes.clipped_fraction)


def optima_of(bounded: BoundedProblem, x0: State) -> PerState | None:
    """J* from each of x₀ (b, n), NaN where none was found; None where there is no oracle."""
    oracle = optimal_cost(bounded.problem)
    return None if oracle is None else oracle.solve(x0).cost


def why_no_optimum(bounded: BoundedProblem) -> str | None:
    """The reason why J* of a task cannot be computed; None if it can."""
    try:
        oracle_of(bounded.problem)
    except OracleError as error:
        return str(error)
    return None

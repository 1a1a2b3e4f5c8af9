"""Optimal trajectories from states that a law visits at later times, far from the optimal trajectories from X₀."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from lyapnet.task.problem import Problem
from lyapnet.training.optima import minima, nearest
from lyapnet.value.expansions import (
    Expansion,
    Optimum,
    Path,
    cheapest,
    follow_expansions,
    in_float64,
    optimal_trajectories,
    path_under,
    sizes,
)

LOST_EXCESS = 0.02  # cost of a closed loop above the optimum, relative to it, above which its states are used
MAX_LOST_LOOPS = 96  # largest number of closed loops whose states are used
TIMES = (0.1, 0.25, 0.4, 0.55, 0.7, 0.85)  # times of these states, as shares of the horizon


class LaterOptimum(NamedTuple):
    """Optimal trajectories from some states at time t_k."""

    node: int  # k
    problem: Problem  # that of the remaining N − k steps
    optimum: Optimum


def later_optima(
    problem: Problem,
    optimum: Optimum,
    path: Path,
    is_known: Tensor,
    generator: torch.Generator,
    seconds: float,
    progress: Callable[[int, int], None],
) -> list[LaterOptimum]:
    """Optimal trajectories from states of closed loops that cost more than their optimum.

    Near an optimal trajectory V is known from its expansion. A law that has left it visits states where V is only
    extrapolated, and may be wrong there. The optimum from such a state is computed, with the laws of the nearest optima
    at that time as initial guesses, and with the controls of the closed loop.

    Args:
        optimum: the optima from the initial states of the closed loops.
        path: the closed loops.
        is_known: (N, b), whether V is known from the expansion around the optimum.
        generator: chooses among more than MAX_LOST_LOOPS loops.
        seconds: seconds of work for each time.
        progress: called with the number of finished searches and their total.
    """
    problem = in_float64(problem)
    size = sizes(problem, optimum.path.cost)
    lost = torch.nonzero(path.cost.isfinite() & (path.cost - optimum.path.cost > LOST_EXCESS * size)).flatten()
    lost = lost[torch.randperm(len(lost), generator=generator)[:MAX_LOST_LOOPS]]
    N, found = problem.horizon.steps, list[LaterOptimum]()
    nodes = sorted({round(share * N) for share in TIMES} - {0, N})
    searches = [(k, lost[~is_known[k, lost]]) for k in nodes]
    total, done = sum(len(rows) for _, rows in searches), 0
    for k, rows in searches:
        if len(rows):
            later = problem.in_steps(steps=N - k)
            solved = _solve_from(later, optimum, path, k, rows, seconds)
            found.append(LaterOptimum(k, later, minima(later, solved)))
            done += len(rows)
            progress(done, total)
    return [each for each in found if len(each.optimum.path.cost)]


def _solve_from(later: Problem, optimum: Optimum, path: Path, k: int, rows: Tensor, seconds: float) -> Optimum:
    """The optima from x_k of some closed loops over the remaining steps."""
    x, known = path.x[k, rows], Expansion(*(part[k:] for part in optimum.expansion))
    neighbours = nearest(x, optimum.path.x[k])
    guesses = [
        follow_expansions(later, known.member(column), optimum.path.u[k:, column], x) for column in neighbours.unbind(1)
    ]
    own = path.u[k:, rows]
    guesses.append(path_under(later, lambda n, _: own[n], x))
    return optimal_trajectories(later, x, cheapest(guesses).u, seconds=seconds, softer_first=False)

"""Optimal trajectories from states that a law visits at later times, far from the optimal trajectories from X₀."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

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
)


class LaterOptimum(NamedTuple):
    """Optimal trajectories from some states at time t_k."""

    node: int  # k
    problem: Problem  # that of the remaining N − k steps
    optimum: Optimum


def later_optima(
    problem: Problem,
    optimum: Optimum,
    path: Path,
    starts: Mapping[int, Tensor],
    seconds: float,
    progress: Callable[[int, int], None],
) -> list[LaterOptimum]:
    """Optimal trajectories from states of closed loops.

    Near an optimal trajectory V is known from its expansion. A law that has left it visits states where V is only
    extrapolated, and may be wrong there. The optimum from such a state is computed, with the laws of the nearest optima
    at that time as initial guesses, and with the controls of the closed loop.

    Args:
        optimum: the optima from the initial states of the closed loops.
        path: the closed loops.
        starts: node k ↦ the closed loops whose states x_k are used.
        seconds: seconds of work for all.
        progress: called with the number of finished searches and their total.
    """
    problem, found = in_float64(problem), list[LaterOptimum]()
    total, done = sum(map(len, starts.values())), 0
    for k, rows in starts.items():
        if len(rows):
            later = problem.in_steps(steps=problem.horizon.steps - k)
            solved = _solve_from(later, optimum, path, k, rows, seconds / len(starts))
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

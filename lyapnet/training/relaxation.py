"""How dear training makes it to come close to what the constraints exclude: found on optima before the first step."""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

from torch import Tensor

from lyapnet.base.random_streams import START, stream
from lyapnet.task.cost import PenaltyCost
from lyapnet.task.problem import Problem
from lyapnet.training.stages import Report
from lyapnet.training.start import expansions_of
from lyapnet.value.expansions import (
    Expansion,
    Path,
    at_rest,
    cheapest,
    greedy_law,
    in_float64,
    optimal_trajectories,
    path_under,
    sizes,
)

STATES = 24  # of X₀, from which optima are sought
FIRST, FACTOR, WEIGHTS = 1e-2, 10**0.25, 60  # the least weight, in units of the cost per second, and further ones
STALLED, MOVED = 8, 1e-2  # weights in a row by which h, in units of the margin, does not move any more
RESERVE = 0.5  # of the margin, which is left for a law that is not quite the optimum


class Relaxation(NamedTuple):
    """A penalty, and what it keeps."""

    weight: float  # in cost per second
    kept: int  # of the optima, how many stay within the constraints, with the reserve
    cost_ratio: float | None  # their mean cost, penalty included, against that without constraints; None without a goal
    states: int
    price: float  # the difference of the two
    largest: float  # the largest weight that was tried
    worst: float  # the greatest h of the optima

    def __str__(self) -> str:
        said = f"constraints: penalty of {self.weight:.3g}/s at h = 0"
        if self.kept == self.states:
            ratio, price = self.cost_ratio, f"{self.price:.3g} more than without"
            at = price if ratio is None else f"{ratio:.3g} times the cost without"
            return f"{said}; optima from {self.states} states keep them, at {at}"
        return (
            f"{said}; from {self.states - self.kept} of {self.states} states no path was found that keeps them with "
            f"half of the margin left, by penalties up to {self.largest:.3g}/s (greatest h {self.worst:.3g}): look at "
            "limits, horizon and X₀"
        )

    def as_json(self) -> dict[str, Any]:
        return self._asdict()


def find_relaxation(problem: Problem, report: Report) -> Relaxation:
    """The weight of a relaxed problem's penalty: the least of a series that keeps optima within h ≤ 0.

    The optima are those without constraints at first, and then follow the weight as it grows, until all of them are
    kept; or until the penalty is most of what they cost and a hundredfold weight moves none of them any more. Then the
    weight is the first of those that keep most.

    Args:
        problem: as Problem.relaxed gives it.
        report: told what is being done.
    """
    exact = in_float64(problem)
    cost = exact.cost
    assert isinstance(cost, PenaltyCost)
    report("optima without constraints")
    path = _free_optima(exact.replaced(cost=cost.cost, constraints=None), report)
    finite = path.cost[path.cost.isfinite()]
    free = float(finite.mean()) if len(finite) else 0.0
    unit = (float(sizes(exact, finite).mean()) if len(finite) else 0.0) or 1.0
    tried, closest = list[Relaxation](), list[Tensor]()
    for k in range(WEIGHTS):
        weight = unit / problem.horizon.duration * FIRST * FACTOR**k
        cost.weight.fill_(weight)
        report("optima with a penalty, dearer each time", k, 0)
        path = optimal_trajectories(exact, path.x[0], path.u).path
        worst = _worst(exact, path)
        closest.append((worst / cost.margin).amax(-1))
        kept = int((closest[-1] <= -RESERVE).sum())
        mean = float(path.cost.mean())
        ratio = mean / free if exact.has_goal and free else None
        tried.append(Relaxation(weight, kept, ratio, STATES, mean - free, weight, float(worst.max())))
        if kept == STATES or (mean - free > abs(free) + unit and _is_stalled(closest)):
            break
    return max(tried, key=lambda each: each.kept)._replace(largest=tried[-1].weight, worst=tried[-1].worst)


def _is_stalled(closest: Sequence[Tensor]) -> bool:
    """Whether the greatest h of no trajectory, in units of its margin, has moved much by the last STALLED weights."""
    return len(closest) > STALLED and bool(((closest[-1 - STALLED] - closest[-1]).abs() <= MOVED).all())


def _free_optima(problem: Problem, report: Report) -> Path:
    """Optimal trajectories of a problem from a few states of X₀."""
    x0 = problem.initial_states.sample(STATES, stream(0, START, 5))
    expansions = [known for _, known in expansions_of(problem, report) if isinstance(known, Expansion)]
    laws = [*(greedy_law(problem, expansion) for expansion in expansions), at_rest(problem)]
    path = cheapest([path_under(problem, law, x0) for law in laws])
    progress = partial(report, "optima without constraints")
    return optimal_trajectories(problem, x0, path.u, progress=progress).path


def _worst(problem: Problem, path: Path) -> Tensor:
    """The greatest h_j of each of some trajectories from the first step on, (states, k)."""
    assert problem.constraints is not None
    return problem.constraints(path.x[1:]).amax(0)

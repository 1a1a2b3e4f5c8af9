"""How dear training makes it to come close to what the constraints exclude: found on optima before the first step."""

from functools import partial
from typing import Any, NamedTuple

from lyapnet.cost import PenaltyCost
from lyapnet.expansions import (
    Expansion,
    Path,
    at_rest,
    cheapest,
    greedy_law,
    in_float64,
    optimal_trajectories,
    path_under,
)
from lyapnet.problem import Problem
from lyapnet.random_streams import START, stream
from lyapnet.training.stages import Report
from lyapnet.training.start import expansions_of

STATES = 24  # of X₀, from which optima are sought
FIRST, FACTOR, WEIGHTS = 1e-2, 10**0.25, 25  # the least weight, in units of the mean cost per second, and further ones
RESERVE = 0.5  # of the margin, which is left for a law that is not quite the optimum


class Relaxation(NamedTuple):
    """A penalty, and what it keeps."""

    weight: float  # in cost per second
    kept: int  # of the optima, how many stay within the constraints, with the reserve
    cost_ratio: float  # their mean cost, penalty included, against that of optima without constraints
    states: int

    def __str__(self) -> str:
        said = f"constraints: penalty of {self.weight:.3g}/s at h = 0"
        if self.kept == self.states:
            ratio = f"{self.cost_ratio:.3g} times the cost without"
            return f"{said}; optima from {self.states} states keep them, at {ratio}"
        return (
            f"{said}; from {self.states - self.kept} of {self.states} states no path was found that keeps them: look "
            "at limits, horizon and X₀"
        )

    def as_json(self) -> dict[str, Any]:
        return self._asdict()


def find_relaxation(problem: Problem, report: Report) -> Relaxation:
    """The weight of a relaxed problem's penalty: the least of a series that keeps optima within h ≤ 0.

    The optima are those without constraints at first, and then follow the weight as it grows. Where none keeps all of
    them, it is the first of those that keep most.

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
    free = (float(finite.mean()) if len(finite) else 0.0) or 1.0
    tried = list[Relaxation]()
    for k in range(WEIGHTS):
        cost.weight.fill_(free / problem.horizon.duration * FIRST * FACTOR**k)
        report("optima with a penalty, dearer each time", k, WEIGHTS)
        path = optimal_trajectories(exact, path.x[0], path.u).path
        tried.append(Relaxation(float(cost.weight), _kept(exact, path), float(path.cost.mean()) / free, STATES))
        if tried[-1].kept == STATES:
            break
    return max(tried, key=lambda each: each.kept)


def _free_optima(problem: Problem, report: Report) -> Path:
    """Optimal trajectories of a problem from a few states of X₀."""
    x0 = problem.initial_states.sample(STATES, stream(0, START, 5))
    expansions = [known for _, known in expansions_of(problem, report) if isinstance(known, Expansion)]
    laws = [*(greedy_law(problem, expansion) for expansion in expansions), at_rest(problem)]
    path = cheapest([path_under(problem, law, x0) for law in laws])
    progress = partial(report, "optima without constraints")
    return optimal_trajectories(problem, x0, path.u, progress=progress).path


def _kept(problem: Problem, path: Path) -> int:
    """How many of some trajectories keep the constraints with the reserve, from the first step on."""
    constraints, cost = problem.constraints, problem.cost
    assert constraints is not None
    assert isinstance(cost, PenaltyCost)
    return int((constraints.worst(path.x[1:]).amax(0) <= -RESERVE * cost.margin).sum())

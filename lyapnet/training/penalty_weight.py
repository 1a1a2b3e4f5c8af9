"""Chooses the constraint penalty weight from optimal trajectories, before the first training step."""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

from torch import Tensor

from lyapnet.base.random_streams import START, stream
from lyapnet.task.cost import PenaltyCost
from lyapnet.task.problem import Problem
from lyapnet.training.stage_messages import StageReport
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

OPTIMA = 24  # number of optimal trajectories, from random states of X₀
FIRST_WEIGHT = 1e-2  # smallest weight, in units of the mean cost per second
WEIGHT_FACTOR = 10**0.25  # ratio of successive weights
MAX_WEIGHTS = 60  # largest number of weights
STALL_WEIGHTS = 8  # number of consecutive weights, a factor of 100, that must not move h for the search to end
STALL_TOLERANCE = 1e-2  # change of h, in units of the margin, that counts as no movement
MARGIN_RESERVE = 0.5  # share of the margin that optima must leave free for the error of a trained law


class PenaltyWeight(NamedTuple):
    """A penalty weight, and how well the optima with this penalty keep the constraints."""

    weight: float  # cost per second at h = 0
    kept: int  # number of optima that keep the constraints, with the reserve
    cost_ratio: float | None  # mean cost with penalty, relative to that without constraints; None without a goal
    states: int  # number of optima
    price: float  # mean cost with penalty, minus that without constraints
    largest: float  # largest weight that was tried, in cost per second
    worst: float  # largest h of the optima

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


def find_penalty_weight(problem: Problem, report: StageReport) -> PenaltyWeight:
    """Choose the smallest penalty weight of a geometric series for which the optima keep h ≤ 0 with a reserve.

    The optima without constraints are the first initial guesses; each weight is warm-started from the previous one. The
    search stops when all optima keep the constraints, or when the penalty is most of their cost and a hundredfold
    weight has not moved any of them. Then it returns the smallest weight that keeps the most optima.

    Args:
        problem: a problem with a penalty, made by Problem.relaxed; its weight is overwritten.
        report: called with each stage of the work.
    """
    exact = in_float64(problem)
    cost = exact.cost
    assert isinstance(cost, PenaltyCost)
    report("optima without constraints")
    path = _free_optima(exact.replaced(cost=cost.cost, constraints=None), report)
    finite = path.cost[path.cost.isfinite()]
    free = float(finite.mean()) if len(finite) else 0.0
    unit = (float(sizes(exact, finite).mean()) if len(finite) else 0.0) or 1.0
    tried, closest = list[PenaltyWeight](), list[Tensor]()
    for k in range(MAX_WEIGHTS):
        weight = unit / problem.horizon.duration * FIRST_WEIGHT * WEIGHT_FACTOR**k
        cost.weight.fill_(weight)
        report("optima with an increasing penalty", k, 0)
        path = optimal_trajectories(exact, path.x[0], path.u).path
        worst = _largest_constraint(exact, path)
        closest.append((worst / cost.margin).amax(-1))
        kept = int((closest[-1] <= -MARGIN_RESERVE).sum())
        mean = float(path.cost.mean())
        ratio = mean / free if exact.has_goal and free else None
        tried.append(PenaltyWeight(weight, kept, ratio, OPTIMA, mean - free, weight, float(worst.max())))
        if kept == OPTIMA or (mean - free > abs(free) + unit and _is_stalled(closest)):
            break
    return max(tried, key=lambda each: each.kept)._replace(largest=tried[-1].weight, worst=tried[-1].worst)


def _is_stalled(closest: Sequence[Tensor]) -> bool:
    """Whether the last STALL_WEIGHTS weights have moved no trajectory's largest h, in units of the margin."""
    return len(closest) > STALL_WEIGHTS and bool(
        ((closest[-1 - STALL_WEIGHTS] - closest[-1]).abs() <= STALL_TOLERANCE).all()
    )


def _free_optima(problem: Problem, report: StageReport) -> Path:
    """Optimal trajectories of the problem without constraints."""
    x0 = problem.initial_states.sample(OPTIMA, stream(0, START, 5))
    expansions = [known for _, known in expansions_of(problem, report) if isinstance(known, Expansion)]
    laws = [*(greedy_law(problem, expansion) for expansion in expansions), at_rest(problem)]
    path = cheapest([path_under(problem, law, x0) for law in laws])
    progress = partial(report, "optima without constraints")
    return optimal_trajectories(problem, x0, path.u, progress=progress).path


def _largest_constraint(problem: Problem, path: Path) -> Tensor:
    """The largest value of each h_j along each trajectory, from the first step on; (states, k)."""
    assert problem.constraints is not None
    return problem.constraints(path.x[1:]).amax(0)

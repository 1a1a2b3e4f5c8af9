"""The seeds of one method on one task: their costs, and the steps at which they came close to the optimum."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from statistics import fmean, median
from typing import NamedTuple

import torch
from torch import Tensor

from lyapnet.evaluation.intervals import half_width_of_mean
from lyapnet.lab.comparison.results import Result
from lyapnet.lab.comparison.statistics.one_result import (
    best_until,
    best_validation,
    cost_ratio,
    first_within,
    optimum,
    relative_costs,
)
from lyapnet.lab.comparison.statistics.spread import Spread, spread

NEAR, CONVERGED = 1.1, 1.02  # cost / optimum: where speeds are compared, and where ours has converged


class Reach(NamedTuple):
    """The steps and seconds at which the seeds first came within a ratio of the optimum.

    Medians are over all the seeds, one that never got there being later than any other: they are known where more than
    half of the seeds got there, and None otherwise.
    """

    reached: int
    seeds: int
    steps: float | None
    seconds: float | None
    seconds_at_least: float  # the median where a seed that never got there has the seconds of its whole training


class AtStep(NamedTuple):
    """A method and ours at the same environment step: where ours had converged, or where the method's training ended.

    Costs are over the optimum of each seed's own validation states, since those are others for each seed, and the least
    so far: a training that has forgotten what it knew has kept its checkpoint. Between two validations of a baseline
    the later one counts too, in its favour: they are coarse.
    """

    steps: float
    ended: bool  # the method's training, before ours had converged
    cost: float  # mean over the seeds
    ours: float

    @property
    def factor(self) -> float | None:
        """A method's cost / ours."""
        return quotient(self.cost, self.ours)


@dataclass(frozen=True)
class Group:
    """One method on one task: a result for each seed, in their order."""

    task: str
    method: str
    results: Sequence[Result]

    @property
    def seeds(self) -> list[int]:
        """The seeds with a result."""
        return [result.seed for result in self.results]

    @cached_property
    def cost(self) -> Spread:
        """The costs J_N = Δt Σℓ_n + φ."""
        return spread([result.costs for result in self.results])

    @cached_property
    def sum(self) -> Spread:
        """The sums Σℓ_n + φ, the form of the paper's tables."""
        return spread([result.sums for result in self.results])

    @cached_property
    def relative_cost(self) -> Spread | None:
        """J(x₀) / J*(x₀), state by state where 0 < J* is known: comparable between tasks."""
        ratios = [relative_costs(result) for result in self.results]
        known = [one for one in ratios if one is not None]
        return spread(known) if len(known) == len(ratios) else None

    @property
    def under_noise(self) -> bool:
        """Whether costs are means over paths of noise."""
        return all(result.path_costs is not None for result in self.results)

    @cached_property
    def path_costs(self) -> Tensor:
        """The cost of each path of noise from each state, (paths, states), mean over the seeds."""
        return torch.tensor([result.path_costs for result in self.results], dtype=torch.float64).mean(0)

    @property
    def half_width(self) -> float:
        """The half-width of the 95 % interval of the mean cost under noise, for these seeds and states."""
        return half_width_of_mean(self.path_costs)

    def cost_above(self, other: "Group") -> tuple[float, float]:
        """By how much its mean cost is above that of another method, and the half-width of its 95 % interval.

        Both costs are of the same paths of noise, whose luck the difference does not have.
        """
        difference = self.path_costs - other.path_costs
        return self.cost.mean - other.cost.mean, half_width_of_mean(difference)

    @property
    def optimum(self) -> float | None:
        """The mean optimum of the evaluation states where it is known."""
        return next((known for known in map(optimum, self.results) if known is not None), None)

    @property
    def cost_ratio(self) -> float | None:
        """Mean cost / mean optimum; each seed has the same states, so that it is the mean over the seeds."""
        return _mean_of_all(cost_ratio(result) for result in self.results)

    @property
    def constraint_loss(self) -> Spread | None:
        """The constraint losses, where the method is a lyapnet program."""
        losses = [[result.constraint_loss] for result in self.results if result.constraint_loss is not None]
        return spread(losses) if losses else None

    @property
    def clipped_fraction(self) -> float | None:
        """Share of controls at the bounds of the action box, mean over the seeds."""
        shares = [result.clipped_fraction for result in self.results if result.clipped_fraction is not None]
        return fmean(shares) if shares else None

    def within(self, ratio: float, *, compiled: bool = False) -> Reach | None:
        """When the seeds first came within a ratio of the optimum; None without an oracle.

        Args:
            compiled: leave out the seconds of compilation.
        """
        if all(point.cost_ratio is None for result in self.results for point in result.curve):
            return None
        firsts = [(first_within(result, ratio), result) for result in self.results]
        left_out = [result.compilation_seconds if compiled else 0.0 for result in self.results]
        steps = median(math.inf if first is None else first.environment_steps for first, _ in firsts)
        ends = [(result if first is None else first).seconds for first, result in firsts]
        seconds = [end - out for end, out in zip(ends, left_out, strict=True)]
        known = [math.inf if one is None else end for (one, _), end in zip(firsts, seconds, strict=True)]
        reached = sum(first is not None for first, _ in firsts)
        return Reach(reached, len(firsts), _finite(steps), _finite(median(known)), median(seconds))

    @property
    def best_steps(self) -> float:
        """Environment steps of the validation of least cost, median over the seeds."""
        return median(best_validation(result).environment_steps for result in self.results)

    @property
    def last_cost(self) -> float | None:
        """Cost / optimum of the last validation, mean over the seeds."""
        return _mean_of_all(result.curve[-1].cost_ratio for result in self.results)

    def best_until(self, steps: float, *, and_next: bool = False) -> float | None:
        """Mean over the seeds of the least cost / optimum until an environment step; see `best_until` of a result."""
        return _mean_of_all(best_until(result, steps, and_next=and_next) for result in self.results)


def _mean_of_all(values: Iterable[float | None]) -> float | None:
    """None where one of them is missing."""
    given = list(values)
    known = [value for value in given if value is not None]
    return fmean(known) if len(known) == len(given) else None


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def quotient(theirs: float | None, ours: float | None) -> float | None:
    """None where it says nothing: one of the two is missing, ours is 0, or both diverged."""
    if theirs is None or not ours or (math.isinf(theirs) and math.isinf(ours)):
        return None
    return theirs / ours

"""What the seeds of a method reach, how sure that is, and how methods compare: pure functions of results."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from statistics import fmean, median
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import trim_mean

from lyapnet.comparison.results import METHODS, OURS, Measurement, Result
from lyapnet.errors import UsageError

NEAR, CONVERGED = 1.1, 1.02  # cost / optimum: where speeds are compared, and where ours has converged
TASKS = ("double_integrator", "cartpole_balancing", "cartpole_swingup", "reacher")  # the order of tables and figures

CONFIDENCE, RESAMPLES, RESAMPLING_SEED = 0.95, 2000, 0


class Spread(NamedTuple):
    """A measure of n seeds × k states.

    mean and std are those of the seeds' means, std with n − 1. iqm is the mean of the middle half of all n·k values,
    [low, high] its percentile bootstrap interval: seeds are drawn with replacement, each with all its states, because
    the states of a seed share its network. One seed has neither std nor interval.

    Source: Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice", NeurIPS 2021.
    """

    mean: float  # inf if a seed diverges somewhere
    std: float | None
    iqm: float
    low: float | None
    high: float | None
    diverged: int  # seeds with a state of infinite cost
    seeds: int


def spread(values: ArrayLike) -> Spread:
    """The spread of values (n, k); NaN counts as diverged, as inf does."""
    table = np.asarray(values, dtype=float)
    table = np.where(np.isnan(table), np.inf, table)
    means = table.mean(-1)
    several, finite = len(means) > 1, bool(np.isfinite(means).all())
    std = float(means.std(ddof=1)) if several and finite else None
    low, high = bootstrap_interval(table) if several else (None, None)
    return Spread(
        float(means.mean()), std, interquartile_mean(table), low, high, int(np.isinf(means).sum()), len(means)
    )


def interquartile_mean(values: ArrayLike) -> float:
    """The mean without the lowest and the highest quarter, ⌊n/4⌋ values each."""
    return float(trim_mean(np.ravel(values), 0.25))


def bootstrap_interval(table: np.ndarray) -> tuple[float, float]:
    """Of the interquartile mean of (n, k) values, by resampling rows; the same for the same table.

    Quantiles are values of the sample (inverted distribution function): between inf and a number nothing interpolates.
    """
    n = len(table)
    chosen = np.random.default_rng(RESAMPLING_SEED).integers(n, size=(RESAMPLES, n))
    means = trim_mean(table[chosen].reshape(RESAMPLES, -1), 0.25, axis=1)
    tail = (1 - CONFIDENCE) / 2
    low, high = np.quantile(means, [tail, 1 - tail], method="inverted_cdf")
    return float(low), float(high)


# One result


def cost_ratio(result: Result) -> float | None:
    """Mean cost / mean optimum over the states whose optimum is known."""
    known = _known(result)
    if known is None:
        return None
    costs, optima = known
    return float(costs.mean() / optima.mean())


def optimum(result: Result) -> float | None:
    """The mean optimum of the states where it is known."""
    known = _known(result)
    return None if known is None else float(known[1].mean())


def first_within(result: Result, ratio: float) -> Measurement | None:
    """The first validation whose cost is within a ratio of the optimum; later ones may be worse again."""
    return next((one for one in result.curve if one.cost_ratio is not None and one.cost_ratio <= ratio), None)


def best_until(result: Result, steps: float, *, and_next: bool = False) -> float | None:
    """The least cost / optimum of the validations at or before an environment step; None where one is not known.

    Args:
        and_next: where none is at that very step, the next one counts too.
    """
    points = [one for one in result.curve if one.environment_steps <= steps]
    if and_next and points and points[-1].environment_steps < steps:
        points += result.curve[len(points) : len(points) + 1]
    known = [one.cost_ratio for one in points if one.cost_ratio is not None]
    return min(known) if known and len(known) == len(points) else None


def best_validation(result: Result) -> Measurement:
    """That of least cost, the later of two: whose checkpoint a baseline is evaluated with."""
    return min(reversed(result.curve), key=lambda one: one.cost)


def _known(result: Result) -> tuple[np.ndarray, np.ndarray] | None:
    if result.optima is None:
        return None
    costs, optima = np.asarray(result.costs, dtype=float), np.asarray(result.optima, dtype=float)
    known = np.isfinite(optima)
    return (costs[known], optima[known]) if known.any() else None


# The seeds of one method on one task


class Reach(NamedTuple):
    """When the seeds first came within a ratio of the optimum.

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
    so far: a training that has forgotten what it knew has kept its checkpoint. Between
    two validations of a baseline the later one counts too, in its favour: they are coarse.
    """

    steps: float
    ended: bool  # the method's training, before ours had converged
    cost: float  # mean over the seeds
    ours: float

    @property
    def factor(self) -> float | None:
        """A method's cost / ours."""
        return _quotient(self.cost, self.ours)


@dataclass(frozen=True)
class Group:
    """One method on one task: a result for each seed, in their order."""

    task: str
    method: str
    results: Sequence[Result]

    @property
    def seeds(self) -> list[int]:
        """Those that finished."""
        return [result.seed for result in self.results]

    @cached_property
    def cost(self) -> Spread:
        """Of J_N = Δt Σℓ_n + φ."""
        return spread([result.costs for result in self.results])

    @cached_property
    def sum(self) -> Spread:
        """Of Σℓ_n + φ, the form of the paper's tables."""
        return spread([result.sums for result in self.results])

    @cached_property
    def relative_cost(self) -> Spread | None:
        """Of J(x₀) / J*(x₀), state by state where 0 < J* is known: comparable between tasks."""
        ratios = [relative_costs(result) for result in self.results]
        known = [one for one in ratios if one is not None]
        return spread(known) if len(known) == len(ratios) else None

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
        """Of a lyapnet program."""
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


def relative_costs(result: Result) -> np.ndarray | None:
    """J(x₀) / J*(x₀) of the states whose optimum is known and not 0."""
    known = _known(result)
    if known is None:
        return None
    costs, optima = known
    return costs[optima > 0] / optima[optima > 0]


def _mean_of_all(values: Iterable[float | None]) -> float | None:
    """None where one of them is missing."""
    given = list(values)
    known = [value for value in given if value is not None]
    return fmean(known) if len(known) == len(given) else None


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


# All of them


class Speedup(NamedTuple):
    """A baseline's seconds to within 10 % of the optimum / ours."""

    factor: float
    at_least: bool  # too few seeds of the baseline ever got there: its true factor is greater


@dataclass(frozen=True)
class Comparison:
    """Every method on every task, as far as there are results: (task, method) ↦ Group."""

    groups: dict[tuple[str, str], Group]

    @property
    def tasks(self) -> list[str]:
        """The paper's first, in one order."""
        return in_order((task for task, _ in self.groups), TASKS)

    @property
    def methods(self) -> list[str]:
        """Ours first."""
        return in_order((method for _, method in self.groups), METHODS)

    def of(self, task: str, method: str) -> Group | None:
        """The seeds of a method on a task."""
        return self.groups.get((task, method))

    def of_task(self, task: str) -> list[Group]:
        """The methods that there are on a task."""
        return [group for method in self.methods if (group := self.of(task, method))]

    def convergence_step(self, task: str) -> float | None:
        """Environment steps of the first validation within 2 % of the optimum, median over our seeds.

        None: half of our seeds or more never come so close, ours is missing, or the optimum is not known.
        """
        ours = self.of(task, OURS)
        reach = ours.within(CONVERGED) if ours else None
        return reach.steps if reach else None

    def at_convergence(self, task: str, method: str) -> AtStep | None:
        """What a method and ours had reached where ours had converged, or where the method's training ended before."""
        converged, group, ours = self.convergence_step(task), self.of(task, method), self.of(task, OURS)
        if converged is None or group is None or ours is None:
            return None
        end = min(result.environment_steps for result in group.results)
        steps = min(converged, end)
        theirs, own = group.best_until(steps, and_next=method != OURS), ours.best_until(steps)
        return None if theirs is None or own is None else AtStep(steps, end < converged, theirs, own)

    def improvement(self, task: str, method: str, form: str = "cost") -> float | None:
        """A method's mean cost / ours, of the best checkpoints.

        Args:
            form: "cost" of J_N, "sum" of the paper's form.
        """
        ours, theirs = self.of(task, OURS), self.of(task, method)
        return _quotient(*(getattr(group, form).mean if group else None for group in (theirs, ours)))

    def speedup(self, task: str, method: str, *, compiled: bool = False) -> Speedup | None:
        """Of ours against a method, to within 10 % of the optimum; None where ours does not get there, or unmeasured.

        Args:
            compiled: leave out the seconds of compilation, as the second run of a task does.
        """
        groups = self.of(task, OURS), self.of(task, method)
        ours, theirs = (group and group.within(NEAR, compiled=compiled) for group in groups)
        if ours is None or theirs is None or not ours.seconds:
            return None
        if theirs.seconds is not None:
            return Speedup(theirs.seconds / ours.seconds, at_least=False)
        bound = theirs.seconds_at_least / ours.seconds
        return Speedup(bound, at_least=True) if bound > 1 else None  # of a shorter training than ours: nothing said


def compared(results: Iterable[Result]) -> Comparison:
    """Results put together, whatever their order.

    Raises:
        UsageError: two results of the same seed, or methods of a task that were not evaluated on the same states.
    """
    groups: dict[tuple[str, str], list[Result]] = {}
    for result in sorted(results, key=lambda one: one.seed):
        groups.setdefault((result.task, result.method), []).append(result)
    comparison = Comparison({key: Group(*key, chosen) for key, chosen in groups.items()})
    for (task, method), group in comparison.groups.items():
        if len(set(group.seeds)) < len(group.seeds):
            raise UsageError(f"Expected one result a seed of {method} on {task}, got seeds {group.seeds}; drop some.")
    for task in comparison.tasks:
        _require_equal_states([result for group in comparison.of_task(task) for result in group.results])
    return comparison


def _require_equal_states(results: Sequence[Result]) -> None:
    """Refuse to compare what was not evaluated alike; equal states have equal optima."""
    first = next((result for result in results if result.optima is not None), results[0])
    for result in results:
        alike = len(result.costs) == len(result.sums) == len(first.costs)
        if alike and first.optima is not None and result.optima is not None:
            here, there = np.asarray(result.optima, dtype=float), np.asarray(first.optima, dtype=float)
            both = np.isfinite(here) & np.isfinite(there)
            alike = np.allclose(here[both], there[both], rtol=1e-3)
        if not alike:
            one, other = (f"{each.method}, seed {each.seed}" for each in (first, result))
            raise UsageError(
                f"Expected equal evaluation states of {first.task}, got others of {other} than of {one}; run the jobs "
                "again with one evaluation section."
            )


def in_order(names: Iterable[str], order: Sequence[str]) -> list[str]:
    """Each name once: those of `order` in its order, then the others as they came."""
    unique = list(dict.fromkeys(names))
    return [name for name in order if name in unique] + [name for name in unique if name not in order]


def _quotient(theirs: float | None, ours: float | None) -> float | None:
    """None where it says nothing: one of the two is missing, ours is 0, or both diverged."""
    if theirs is None or not ours or (math.isinf(theirs) and math.isinf(ours)):
        return None
    return theirs / ours

"""Every method on every task, compared with ours."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lyapnet.base.errors import UsageError
from lyapnet.lab.comparison.results import METHODS, OURS, Result
from lyapnet.lab.comparison.statistics.groups import CONVERGED, NEAR, AtStep, Group, quotient

TASKS = ("double_integrator", "cartpole_balancing", "cartpole_swingup", "reacher")  # the order of tables and figures


class Speedup(NamedTuple):
    """A baseline's seconds to within 10 % of the optimum / ours."""

    factor: float
    at_least: bool  # whether the true factor is larger, because too few seeds of the baseline came so close


@dataclass(frozen=True)
class Comparison:
    """Every method on every task, as far as there are results: (task, method) ↦ Group."""

    groups: dict[tuple[str, str], Group]

    @property
    def tasks(self) -> list[str]:
        """The tasks, the paper's first, in a fixed order."""
        return in_order((task for task, _ in self.groups), TASKS)

    @property
    def methods(self) -> list[str]:
        """The methods, ours first."""
        return in_order((method for _, method in self.groups), METHODS)

    def without(self, methods: Sequence[str]) -> "Comparison":
        """All other methods."""
        return Comparison({key: group for key, group in self.groups.items() if group.method not in methods})

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
            form: "cost" for J_N, "sum" for the paper's form.
        """
        ours, theirs = self.of(task, OURS), self.of(task, method)
        return quotient(*(getattr(group, form).mean if group else None for group in (theirs, ours)))

    def speedup(self, task: str, method: str, *, compiled: bool = False) -> Speedup | None:
        """Our speedup over a method, to within 10 % of the optimum; None where ours does not get there, or unmeasured.

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
        return Speedup(bound, at_least=True) if bound > 1 else None  # its training was shorter than ours: nothing said


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
    """Check that all results of a task have the same evaluation states, by their optima."""
    first = next((result for result in results if result.optima is not None), results[0])
    for result in results:
        alike = len(result.costs) == len(result.sums) == len(first.costs)
        alike = alike and np.shape(result.path_costs or ()) == np.shape(first.path_costs or ())
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

"""The interface of planners, and a policy with the interface of Stable-Baselines3 that uses one."""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyapnet.lab.comparison.reference_problems import BoundedProblem
from lyapnet.lab.comparison.results import ControlTimes

LoopLaw = Callable[[int, NDArray], NDArray]  # (n, x_n) ↦ u_n of one closed loop; it may store a plan


class Planner(ABC):
    """Makes the law of each closed loop from the model.

    Attributes:
        solved, unsolved: its optimisations so far, that converged and that did not; none where it has none.
    """

    solved = unsolved = 0

    @abstractmethod
    def law(self) -> LoopLaw:
        """The law of one new closed loop."""

    def count(self, converged: bool) -> None:
        """Count an optimisation."""
        self.solved, self.unsolved = self.solved + converged, self.unsolved + (not converged)


class PlannerPolicy:
    """a = u(t, x) / control_scale, with SB3's `predict`; each row is a closed loop of its own, and each call is timed.

    Args:
        planner: what controls.
        bounded: the task, observed with time.
    """

    def __init__(self, planner: Planner, bounded: BoundedProblem):
        self.planner, self.dt = planner, bounded.problem.horizon.dt
        self.control_scale = np.asarray(bounded.control_scale)
        self.seconds = list[list[float]]()  # (steps, closed loops)

    def predict(
        self, observation: NDArray, state: tuple[Any, ...] | None = None, episode_start: Any = None, **_: Any
    ) -> tuple[NDArray, tuple[Any, ...]]:
        """The actions for observations (b, n + 1), and the laws of the closed loops."""
        laws = [self.planner.law() for _ in observation] if state is None else list(state)
        controls, taken = [], []
        for law, row in zip(laws, observation, strict=True):
            step, x = round(float(row[-1]) / self.dt), np.asarray(row[:-1], dtype=np.float64)
            began = time.perf_counter()
            controls.append(law(step, x))
            taken.append(time.perf_counter() - began)
        self.seconds.append(taken)
        return np.stack(controls) / self.control_scale, tuple(laws)

    @property
    def times(self) -> ControlTimes:
        """The durations of its calls so far."""
        first, *later = self.seconds
        return ControlTimes.of(list(chain(*(later or [first]))), first)

    @property
    def unsolved_fraction(self) -> float | None:
        """Share of its optimisations that did not converge; None where it has none."""
        asked = self.planner.solved + self.planner.unsolved
        return self.planner.unsolved / asked if asked else None

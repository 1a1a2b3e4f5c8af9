"""What an oracle is: the least cost from each initial state, and how it is known."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from lyapnet.base.types import ControlPath, PerState, State

Report = Callable[[int, int], None]  # (initial states done, of how many)


def silent(done: int, total: int) -> None:
    """No progress shown."""


@dataclass(frozen=True)
class Optima:
    """The least costs from a batch (b,) of initial states.

    Attributes:
        cost: J*(x₀); NaN where no optimum was found.
        reasons: why not, one for each initial state; empty where it was found.
        u: the optimal controls (N, b, m), where the oracle has them.
    """

    cost: PerState
    reasons: Sequence[str]
    u: ControlPath | None = None

    @property
    def failures(self) -> int:
        """How many have no optimum."""
        return int(torch.isnan(self.cost).sum())


class Oracle(ABC):
    """x₀ ↦ J*(x₀), the least cost, in the dtype and on the device of x₀."""

    @abstractmethod
    def solve(
        self, x0: State, known: ControlPath | None = None, progress: Report = silent, seconds: float = math.inf
    ) -> Optima:
        """The optima of a batch (b, n).

        Args:
            known: a control sequence from each x₀, (N, b, m), which an iterative oracle takes for one of its starts.
            progress: is told how many states are done.
            seconds: of this thread's work, after which an iterative oracle tries no further state.
        """

    def __call__(self, x0: State) -> PerState:
        """J*(x₀) for any leading shape; NaN where no optimum was found."""
        return self.solve(x0.reshape(-1, x0.shape[-1])).cost.reshape(x0.shape[:-1])

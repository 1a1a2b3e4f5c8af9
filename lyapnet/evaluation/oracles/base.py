"""The base class of oracles, which compute the least cost from each initial state."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from lyapnet.base.types import ControlPath, PerState, State

Report = Callable[[int, int], None]  # called with (initial states done, total)


def silent(done: int, total: int) -> None:
    """A report that shows nothing."""


@dataclass(frozen=True)
class Optima:
    """The least costs from a batch (b,) of initial states.

    Attributes:
        cost: J*(x₀); NaN where no optimum was found.
        reasons: for each initial state the reason why no optimum was found; empty if it was found.
        u: the optimal controls (N, b, m), NaN where no controls lead along the optimum; None if the oracle has none.
    """

    cost: PerState
    reasons: Sequence[str]
    u: ControlPath | None = None

    @property
    def failures(self) -> int:
        """The number of states without optimum."""
        return int((~self.cost.isfinite()).sum())


class Oracle(ABC):
    """x₀ ↦ J*(x₀), the least cost, in the dtype and on the device of x₀."""

    @abstractmethod
    def solve(
        self, x0: State, known: ControlPath | None = None, progress: Report = silent, seconds: float = math.inf
    ) -> Optima:
        """The optima of a batch (b, n).

        Args:
            known: controls from each x₀, (N, b, m), an additional initial guess for an iterative oracle.
            progress: called with the number of states that are done.
            seconds: seconds of work after which an iterative oracle tries no further state.
        """

    def __call__(self, x0: State) -> PerState:
        """J*(x₀) for any leading shape; NaN where no optimum was found."""
        return self.solve(x0.reshape(-1, x0.shape[-1])).cost.reshape(x0.shape[:-1])

"""Certificates that bound the cost of the controller from above, compared with the optimum."""

import math
import time
from abc import abstractmethod
from collections.abc import Mapping
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

from torch import Tensor

from lyapnet.base.errors import OracleError
from lyapnet.base.types import PerState, State
from lyapnet.claims import figures
from lyapnet.claims.certificates import Certificate
from lyapnet.claims.least_cost import ProvedLowerBound
from lyapnet.controller.controller import Controller
from lyapnet.evaluation.optimality import ratio_of_means
from lyapnet.evaluation.oracles import RiccatiOracle, oracle_of

MOST_SOLVED = 64  # largest number of states for which an oracle solves an optimal control problem each


class Inside(NamedTuple):
    """States of X₀ for which bounds of the cost are proved, with V(0, x₀) and these bounds."""

    x0: State
    value: PerState  # V(0, x₀)
    guaranteed: PerState  # upper bound of the cost
    low: PerState | None = None  # lower bound of the cost, if one is proved


class CostCertificate(Certificate):
    """An upper bound of the cost of the controller, for the states of X₀ for which it is proved."""

    picture_of_both: ClassVar[str]  # file name of the figure of a two-sided certificate
    labels_beside: ClassVar[Mapping[str, str]] = {}  # table labels of the numbers of `beside`

    @cached_property
    @abstractmethod
    def inside(self) -> Inside:
        """The states for which the bound is proved, among COMPARED random states of X₀."""

    @cached_property
    def optimum(self) -> PerState | None:
        """The optimal costs of the first of these states, for comparison; None if they are not computed in time."""
        return optima_of(self.controller, self.inside.x0, max(1.0, 0.1 * self.options["seconds"]))

    @property
    def cost_ratio(self) -> float | None:
        """Mean guaranteed cost divided by the mean optimum; None for tasks whose costs may have any sign."""
        if self.optimum is None or not self.controller.problem.has_goal:
            return None
        return ratio_of_means(self.inside.guaranteed[: len(self.optimum)], self.optimum)

    @abstractmethod
    def proved(self) -> dict[str, Any]:
        """The numbers of the claim, without a comparison with the optimum."""

    def numbers(self) -> dict[str, Any]:
        return {**self.proved(), "guaranteed_cost_ratio": self.cost_ratio}

    def beside(self, lower: ProvedLowerBound) -> dict[str, Any]:
        """Further numbers of a two-sided certificate."""
        return {}

    def mismatch(self, lower: ProvedLowerBound) -> str:
        """Why the bound from below may not hold for this controller; empty if it does."""
        return ""

    @abstractmethod
    def in_short(self, lower: ProvedLowerBound) -> str:
        """The numbers of both bounds for the title of a figure."""

    @abstractmethod
    def figure_of_both(self, lower: ProvedLowerBound, whose: str, headline: str) -> figures.Figure:
        """A figure of both bounds.

        Args:
            whose: the controls for which the bound from below holds.
        """


def optima_of(controller: Controller, x0: State, seconds: float = math.inf) -> Tensor | None:
    """The optimal costs of the first of some states; None without states, without an oracle, or if time runs out.

    IPOPT solves only the first MOST_SOLVED states, starting from the controller's trajectories.
    """
    end = time.monotonic() + seconds

    def in_time(done: int, total: int) -> None:
        if done < total and time.monotonic() > end:
            raise OracleError("Expected the optimum within the budget, got none; allow more seconds.")

    if not len(x0):
        return None
    try:
        oracle = oracle_of(controller.problem, controller.method)
        some = x0 if isinstance(oracle, RiccatiOracle) else x0[:MOST_SOLVED]
        return oracle.solve(some, controller.closed_loops(some).u, in_time).cost.double()
    except OracleError:
        return None

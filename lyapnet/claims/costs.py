"""Certificates of what the controller costs at most, against the optimum."""

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

SEARCHED = 64  # largest number of states for an oracle that solves each by a search


class Inside(NamedTuple):
    """States of X₀ for which something is proved, V(0, x₀), and what the controller is proved to cost from there."""

    x0: State
    value: PerState
    guaranteed: PerState  # at most
    low: PerState | None = None  # at least, where that is proved


class CostCertificate(Certificate):
    """A bound of what the controller costs, from those states of X₀ for which it is proved."""

    picture_of_both: ClassVar[str]  # what a report calls the figure of both sides
    labels_beside: ClassVar[Mapping[str, str]] = {}  # labels in a table of the numbers of `beside`

    @cached_property
    @abstractmethod
    def inside(self) -> Inside:
        """The states for which the bound is proved, among random states of X₀."""

    @cached_property
    def optimum(self) -> PerState | None:
        """The optimum of the first of these states, which is beside the claim; None where it is not known in time."""
        return optima_of(self.controller, self.inside.x0, max(1.0, 0.1 * self.options["seconds"]))

    @property
    def cost_ratio(self) -> float | None:
        """Mean guaranteed cost over the mean optimum; None where costs may be of any sign."""
        if self.optimum is None or not self.controller.problem.has_goal:
            return None
        return ratio_of_means(self.inside.guaranteed[: len(self.optimum)], self.optimum)

    @abstractmethod
    def proved(self) -> dict[str, Any]:
        """The numbers of the claim, without the optimum, which takes an oracle."""

    def numbers(self) -> dict[str, Any]:
        return {**self.proved(), "guaranteed_cost_ratio": self.cost_ratio}

    def beside(self, lower: ProvedLowerBound) -> dict[str, Any]:
        """What else there is to say beside a bound from below."""
        return {}

    def why_apart(self, lower: ProvedLowerBound) -> str:
        """Why the two bounds are not about the same controls; empty where they are."""
        return ""

    @abstractmethod
    def in_short(self, lower: ProvedLowerBound) -> str:
        """The numbers of both bounds in the title of a figure."""

    @abstractmethod
    def figure_of_both(self, lower: ProvedLowerBound, whose: str, headline: str) -> figures.Figure:
        """Both bounds, drawn.

        Args:
            whose: which controls the one from below is about.
        """


def optima_of(controller: Controller, x0: State, seconds: float = math.inf) -> Tensor | None:
    """The optimum of the first of some states; None where there are no states or no oracle, or it takes longer.

    IPOPT solves the first SEARCHED states only, starting from the controller's trajectories.
    """
    end = time.monotonic() + seconds

    def in_time(done: int, total: int) -> None:
        if done < total and time.monotonic() > end:
            raise OracleError("Expected the optimum within the budget, got none; allow more seconds.")

    if not len(x0):
        return None
    try:
        oracle = oracle_of(controller.problem, controller.method)
        some = x0 if isinstance(oracle, RiccatiOracle) else x0[:SEARCHED]
        return oracle.solve(some, controller.rollout(some).u, in_time).cost.double()
    except OracleError:
        return None

"""Local minima of one problem for each initial state, each from several starts and from its neighbours' ends."""

import math
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from lyapnet.evaluation.oracles.base import Report

HOPELESS = 8  # failures from the first states on, after which there is nothing to be expected for the others
SECONDS = 15.0  # of the starts of one state, after which no further one is made
EXPLORED = 16  # first states on which all starts are tried, before it is judged whether there are several minima
EXPLORED_AGAIN = 8  # the same, where an earlier batch over the same X₀ has shown one minimum from each of its states
NEIGHBOURS = 3  # nearest initial states, whose optima are starts for each other
SAME = 1e-6  # relative difference of two costs that are the same


class Candidate(NamedTuple):
    """A trajectory from an initial state: a start, or the local minimum that one led to."""

    x: np.ndarray  # (N, n), from x₁ on
    u: np.ndarray  # (N, m)
    cost: float


def is_better(one: Candidate | None, other: Candidate | None) -> bool:
    """Whether one costs less than the other, by more than rounding; anything is better than none."""
    if one is None or other is None:
        return one is not None
    return one.cost < other.cost - SAME * abs(other.cost)


class MultiStart:
    """The best candidate of each initial state, improved start by start.

    Which local minimum a start leads to is luck, but the least cost is continuous in x₀: what was found from one state
    is the first start of those after it that are near. Of the first `explored` states all starts are tried, and what
    was found from the states around. Where none of them improves on a minimum that is known, the other states have that
    first start alone, and those that cost less than where it led. Else they have all of them too, and in the end what
    was found from one state is tried from the states around it, and from theirs, as long as that improves any.

    Args:
        x0: (b, n).
        best: what is known already, one entry for each state.
        minimise: (x₀, start, briefly) ↦ the local minimum, or why there is none; briefly where one is known already.
        explored: how many of the first states are explored.
    """

    def __init__(
        self,
        x0: np.ndarray,
        best: Sequence[Candidate | None],
        minimise: Callable[[np.ndarray, Candidate, bool], Candidate | str],
        explored: int = EXPLORED,
    ):
        self.x0, self.best, self.minimise, self.explored = x0, list(best), minimise, explored
        self.reasons = [""] * len(x0)  # why the last start that led nowhere did so
        self.several = False  # whether a start has improved on a minimum that was known
        self._tried = dict[tuple[int, int], Candidate]()  # by state and identity, as no start is tried twice

    def run(self, starts: Mapping[int, Iterable[Candidate]], progress: Report, until: float = math.inf) -> None:
        """Try the starts of some states, given by their indices, and what was found from the states around.

        Args:
            until: when this thread's work has taken so many seconds, no further state is tried.
        """
        failures, last = 0, ""  # in a row, from the first state on; the reason of the last one
        for done, (i, own) in enumerate(starts.items()):
            progress(done, len(starts))
            if time.thread_time() > until:
                self.reasons[i] = self.reasons[i] or "no time was left for it"
                continue
            if failures == HOPELESS:
                self.reasons[i] = self.reasons[i] or f"{last}, from {HOPELESS} states in a row; this one was not tried"
                continue
            began, solved = time.monotonic(), [j for j in starts if j != i and self.best[j] is not None]
            if solved:  # the optimum of the nearest of them, from where IPOPT most often has the shortest way
                self._try(i, self.best[solved[int(self._distances(i)[solved].argmin())]])
            is_enough = done >= self.explored and not self.several and self.best[i] is not None
            for start in own:
                if not is_enough or is_better(start, self.best[i]):
                    self._try(i, start)
                if time.monotonic() - began > SECONDS:
                    break
            failures = failures + 1 if self.best[i] is None and failures == done else -1
            last = self.reasons[i]
            if done == min(self.explored, len(starts)) - 1:
                explored = [*starts][: self.explored]
                self._exchange(explored, explored)
        if self.several and time.thread_time() <= until:
            self._exchange(starts, range(len(self.x0)))
        progress(len(starts), len(starts))

    def _exchange(self, states: Iterable[int], others: Sequence[int]) -> None:
        """Try from some states what was found from those of others that are around."""
        nearest = {i: self._nearest(i, others) for i in others}
        followers = defaultdict(list)
        for i, neighbours in nearest.items():
            for j in neighbours:
                followers[j].append(i)
        pairs = deque((i, j) for i in states for j in nearest[i])
        while pairs:
            i, j = pairs.popleft()
            if self._try(i, self.best[j]):
                pairs.extend((k, i) for k in followers[i])

    def _try(self, i: int, start: Candidate | None) -> bool:
        """Whether a start improves a state's best."""
        if start is None or (i, id(start)) in self._tried:
            return False
        self._tried[i, id(start)] = start
        end = self.minimise(self.x0[i], start, self.best[i] is not None)
        if isinstance(end, str):
            self.reasons[i] = end
            return False
        improved = is_better(end, self.best[i])
        if improved:
            self.several |= self.best[i] is not None
            self.best[i] = end
        return improved

    def _distances(self, i: int) -> np.ndarray:
        """Squared distances from a state to all, each component measured against its spread in the batch."""
        spread = np.ptp(self.x0, axis=0)
        return (((self.x0 - self.x0[i]) / np.where(spread > 0, spread, 1)) ** 2).sum(1)

    def _nearest(self, i: int, others: Sequence[int]) -> list[int]:
        """The nearest of some other states, nearest first."""
        distance = self._distances(i)
        return sorted((j for j in others if j != i), key=lambda j: distance[j])[:NEIGHBOURS]

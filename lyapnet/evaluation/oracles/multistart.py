"""Multi-start search: local minima from several initial guesses for each state, and from the neighbours' minima."""

import math
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from lyapnet.base.threads import seconds_of_work
from lyapnet.evaluation.oracles.base import Report

HOPELESS = 8  # if this number of first states fail, the others are not tried
SECONDS = 15.0  # seconds for one state, after which no further initial guess is tried
EXPLORED = 16  # first states on which all initial guesses are tried, to detect several local minima
EXPLORED_AGAIN = 4  # the same, if an earlier batch over the same X₀ had a single minimum from each state
NEIGHBOURS = 3  # nearest initial states, whose optima are initial guesses for each other
SAME = 1e-6  # relative difference below which two costs count as equal


class Candidate(NamedTuple):
    """A trajectory from an initial state: an initial guess, or a local minimum."""

    x: np.ndarray  # (N, n), from x₁ on
    u: np.ndarray  # (N, m)
    cost: float


def is_better(one: Candidate | None, other: Candidate | None) -> bool:
    """Whether one candidate costs less than the other by more than rounding; any candidate is better than None."""
    if one is None or other is None:
        return one is not None
    return one.cost < other.cost - SAME * abs(other.cost)


class MultiStart:
    """The best candidate of each initial state, improved by one initial guess after another.

    The result of a local solver may be only a local minimum, but the least cost is continuous in x₀. Therefore optima
    of nearby states serve as initial guesses:

    1. Each state starts with the optimum of the nearest solved state.
    2. The first `explored` states also try all their own guesses and the optima of the states around.
    3. If none of these improves a known minimum, the other states skip their own guesses, except those that are cheaper
       than the minimum they have. Otherwise they try all guesses, and at the end optima are passed on from neighbour to
       neighbour as long as any state improves.

    Args:
        x0: (b, n).
        best: a known candidate for each state, or None.
        minimise: (x₀, guess, briefly) ↦ the local minimum, or the reason for none; briefly if one is known already.
        explored: number of explored states.
    """

    def __init__(
        self,
        x0: np.ndarray,
        best: Sequence[Candidate | None],
        minimise: Callable[[np.ndarray, Candidate, bool], Candidate | str],
        explored: int = EXPLORED,
    ):
        self.x0, self.best, self.minimise, self.explored = x0, list(best), minimise, explored
        self.reasons = [""] * len(x0)  # for each state why its last unsuccessful guess failed
        self.several = False  # whether a guess has improved a known minimum
        self._tried = dict[tuple[int, int], Candidate]()  # (state, id of the guess), so that none is tried twice

    def run(self, starts: Mapping[int, Iterable[Candidate]], progress: Report, until: float = math.inf) -> None:
        """Try the initial guesses of some states, given by their indices, and the optima of the states around.

        Args:
            until: value of seconds_of_work after which no further state is tried.
        """
        failures, last = 0, ""  # consecutive failures from the first state on, -1 after a success; the last reason
        for done, (i, own) in enumerate(starts.items()):
            progress(done, len(starts))
            if seconds_of_work() > until:
                self.reasons[i] = self.reasons[i] or "no time was left for it"
                continue
            if failures == HOPELESS:
                self.reasons[i] = self.reasons[i] or f"{last}, from {HOPELESS} states in a row; this one was not tried"
                continue
            began, solved = time.monotonic(), [j for j in starts if j != i and self.best[j] is not None]
            if solved:  # the nearest optimum is usually the best initial guess for IPOPT
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
        if self.several and seconds_of_work() <= until:
            self._exchange(starts, range(len(self.x0)))
        progress(len(starts), len(starts))

    def _exchange(self, states: Iterable[int], others: Sequence[int]) -> None:
        """Try from some states the optima of their neighbours among others; improved states pass theirs on."""
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
        """Try an initial guess; return whether it improves the best candidate of a state."""
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
        """Squared distances from a state to all, with each component scaled by its range in the batch."""
        spread = np.ptp(self.x0, axis=0)
        return (((self.x0 - self.x0[i]) / np.where(spread > 0, spread, 1)) ** 2).sum(1)

    def _nearest(self, i: int, others: Sequence[int]) -> list[int]:
        """The NEIGHBOURS nearest of some other states, nearest first."""
        distance = self._distances(i)
        return sorted((j for j in others if j != i), key=lambda j: distance[j])[:NEIGHBOURS]

"""Where a condition c ≤ 0 holds: on sublevel sets of W = V − δt, proved on boxes."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from lyapnet.certification.boxes import Boxes, single
from lyapnet.certification.branch_and_bound import Budget, Question, Search, axis_to_cut, just_below
from lyapnet.certification.condition import DecreaseCondition, bounded_condition
from lyapnet.certification.counterexamples import Counterexample, find_counterexample, lowest_violation
from lyapnet.certification.kept_proofs import KeptProof, Unfinished
from lyapnet.certification.verdict import Verdict
from lyapnet.graphs.bounds import BoundedFunction
from lyapnet.types import Corner, Points


@dataclass(frozen=True)
class Proof:
    """c ≤ 0 at every (t, x) of a box with W(t, x) = V(t, x) − δt ≤ `level`; −∞ where nothing is proved.

    What remains undecided lies above that level.
    """

    level: float
    wanted: float  # the level up to which it was tried
    counterexample: Counterexample | None  # the one of lowest W that was found
    boxes: int
    seconds: float
    remaining_volume: float  # share of the box
    undecided: Points  # centres (t, x) of boxes that remain

    @property
    def verdict(self) -> Verdict:
        """Whether c ≤ 0 wherever W ≤ `wanted`."""
        if self.counterexample is not None and self.counterexample.height <= self.wanted:
            return "falsified"
        return "certified" if self.level >= self.wanted else "unknown"


class Progress(NamedTuple):
    """How far a proof is."""

    boxes: int  # bounded so far
    remaining: float  # share of the domain that is undecided
    seconds: float


BELOW = 1e-2  # of a counterexample's W: how far under it the level goes on, or ever smaller boxes would follow its edge
KEEP_EVERY = 30.0  # seconds
KEPT = 1000  # undecided boxes whose centres a proof names


def prove(
    condition: DecreaseCondition,
    domain: tuple[Corner, Corner],
    wanted: float = float("inf"),
    budget: Budget | None = None,
    stop_at_counterexample: bool = True,
    generator: torch.Generator | None = None,
    report: Callable[[Progress], None] | None = None,
    keep: Path | None = None,
) -> Proof:
    """Prove c ≤ 0 on {W ≤ wanted}, or on as high a sublevel set as the budget and the counterexamples allow.

    Counterexamples are sought first, by samples and by ascent from the worst of them. Then boxes of lowest W are
    bounded first. A box is dropped where c ≤ 0 on all of it or W > level on all of it, and else cut in two. A
    counterexample that turns up among their centres lowers the level, and the search goes on under it.

    Args:
        condition: in float64.
        domain: (lower, upper) of (t, x).
        stop_at_counterexample: give up the level that is wanted rather than look for a lower one.
        report: is told how far it is, after every few thousand boxes.
        keep: a file in which an unfinished proof is kept, and from which it goes on.

    Raises:
        UsageError: the file keeps the proof of something else.
    """
    budget = budget or Budget()
    lower, upper = (side.double() for side in domain)
    bounded = bounded_condition(condition, (lower, upper))
    kept = None if keep is None else KeptProof(keep, bounded.fingerprint, lower, upper, wanted)
    begun = None if kept is None else kept.read()
    question = WhereItHolds(condition, bounded, wanted, stop_at_counterexample)
    if begun is None:
        question.lower_to(find_counterexample(condition, bounded, lower, upper, wanted, generator))
        begun = Unfinished(Search(single(lower, upper)), question.level, question.worst)
    search, question.level, question.worst, earlier = begun
    saved = budget.elapsed
    with ThreadPoolExecutor(budget.workers) as pool:
        for _ in search.rounds(question, budget, pool.map):
            seconds = earlier + budget.elapsed
            if kept is not None and budget.elapsed > saved + KEEP_EVERY:
                kept.write(Unfinished(search, question.level, question.worst, seconds))
                saved = budget.elapsed
            if report is not None:
                report(Progress(search.boxes, float(search.frontier.volumes(lower, upper).sum()), seconds))
    seconds, unfinished = earlier + budget.elapsed, len(search.frontier.key) and not question.settled
    if kept is not None and unfinished:
        kept.write(Unfinished(search, question.level, question.worst, seconds))
    proved = -torch.inf if question.settled else min(question.level, just_below(search.least))
    remaining = float(search.frontier.volumes(lower, upper).sum())
    return Proof(proved, wanted, question.worst, search.boxes, seconds, remaining, search.frontier.center[:KEPT])


@dataclass
class WhereItHolds(Question):
    """Up to which level of W the condition c ≤ 0 holds; boxes are sorted by their lower bound of W."""

    condition: DecreaseCondition
    bounded: BoundedFunction  # of (c, W)
    level: float  # it can only fall
    stop_at_counterexample: bool
    worst: Counterexample | None = None

    def undecided(self, boxes: Boxes) -> tuple[Boxes, Tensor]:
        c, W = self.bounded.forms(boxes.lower, boxes.upper)
        (_, c_high), (W_low, _) = c.interval(), W.interval()
        boxes = Boxes(boxes.lower, boxes.upper, torch.maximum(W_low, boxes.key))
        chosen = ~(c_high <= 0) & (boxes.key <= self.level)
        return boxes[chosen], axis_to_cut(self.bounded, c, boxes, chosen)

    def look_at(self, boxes: Boxes) -> None:
        self.lower_to(lowest_violation(self.condition, self.bounded, boxes.center, self.level))

    def lower_to(self, found: Counterexample | None) -> None:
        """Go on under a counterexample, if there is one."""
        if found is not None:
            self.worst, self.level = found, found.height - BELOW * abs(found.height)

    @property
    def highest(self) -> float:
        return self.level

    @property
    def settled(self) -> bool:
        return self.worst is not None and self.stop_at_counterexample

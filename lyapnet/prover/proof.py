"""Where a condition c ≤ 0 holds: on sublevel sets of W = V − δt, proved on boxes."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from lyapnet.base.errors import UsageError
from lyapnet.base.types import Corner, Points
from lyapnet.prover.bounds import BoundedFunction
from lyapnet.prover.boxes import Boxes, single
from lyapnet.prover.branch_and_bound import MARGIN, Budget, Question, Search, axis_to_cut
from lyapnet.prover.condition import DecreaseCondition, bounded_condition
from lyapnet.prover.counterexamples import Counterexample, find_counterexample, lowest_violation
from lyapnet.prover.kept_proofs import KeptProof, Standing, about, hash_of_sources
from lyapnet.prover.verdict import Verdict
from lyapnet.prover.workers import bounding


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
    fingerprint: str  # of (c, W) as it was traced: what the proof is about

    @property
    def verdict(self) -> Verdict:
        """Whether c ≤ 0 wherever W ≤ `wanted`."""
        if self.counterexample is not None and self.counterexample.height <= self.wanted:
            return "falsified"
        return "certified" if self.level >= self.wanted else "unknown"


class Progress(NamedTuple):
    """How far a proof is; or what is done before its first box, and after its last one."""

    boxes: int  # bounded so far
    remaining: float  # share of the domain that is undecided
    seconds: float
    stage: str = "bounding boxes"


def tell(report: Callable[[Progress], None] | None, budget: Budget, stage: str) -> None:
    """Tell a report what is done while no boxes of a proof are bounded."""
    if report is not None:
        report(Progress(0, 1.0, budget.elapsed, stage))


CPU = torch.device("cpu")
BELOW = (
    1e-2  # of a counterexample's W, by which the level stays below it; else ever smaller boxes would follow its edge
)
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
    replay: bool = False,
    degree: int = 2,
) -> Proof:
    """Prove c ≤ 0 and Ẇ ≤ 0 on {W ≤ wanted}, or on as high a sublevel set as the budget and the counterexamples allow.

    Counterexamples are sought first, by samples and ascent, then boxes of lowest W are bounded: dropped where both hold
    on all of them, or W > level, or some h > 0, and else cut in two. A counterexample among centres lowers the level.

    Args:
        condition, degree: in float64, and of the forms that bound it.
        domain: (lower, upper) of (t, x).
        stop_at_counterexample: give up the level that is wanted rather than look for a lower one.
        report: is told how far it is, after every few thousand boxes.
        keep: a file in which the proof is kept, and from which it goes on; a finished one is bounded once more.
        replay: bound each leaf of the kept proof once, in place of a search. Nothing in the file is believed: were its
            cuts or level wrong, a leaf would stay undecided. 1 % may be cut again, as rounding differs by machine.

    Raises:
        UsageError: the file keeps the proof of something else.
    """
    budget = budget or Budget()
    lower, upper = (side.double() for side in domain)
    bounded = bounded_condition(condition, (lower, upper), degree)
    question = WhereItHolds(condition, bounded, wanted, stop_at_counterexample, torch.device(budget.device))
    kept = None if keep is None else KeptProof(keep, about(bounded, condition, lower, upper), wanted)
    if kept is not None and replay:
        begun, kept = kept.claim((lower, upper), condition.partial), None
        leaves, question.level = len(begun.search.frontier.key), min(wanted, begun.level)
        budget = dataclasses.replace(budget, boxes=leaves + leaves // 100 + 100)
    else:
        begun = (kept.read((lower, upper), question.again) if kept else None) or question.begin(lower, upper, generator)
    search, earlier, saved = begun.search, begun.seconds, budget.elapsed

    def standing() -> Standing:
        return Standing(search, question.level, question.worst, earlier + budget.elapsed)

    again = partial(bounded_again, condition, (lower, upper), degree, proved_by(bounded))
    with bounding(question, budget.workers, budget.ray, again) as run:
        for _ in search.rounds(question, budget, run):
            if kept is not None and budget.elapsed > saved + KEEP_EVERY:
                kept.write(standing())
                saved = budget.elapsed
            if report is not None:
                report(Progress(search.boxes, search.frontier.share(lower, upper), earlier + budget.elapsed))
    end = standing()
    if kept is not None:
        kept.write(end)
    return Proof(
        -torch.inf if question.settled else end.proved, wanted, end.worst, search.boxes, end.seconds,
        search.frontier.share(lower, upper), search.frontier.center[:KEPT], bounded.fingerprint,
    )  # fmt: skip


def proved_by(bounded: BoundedFunction) -> tuple[str, str, str]:
    """What is bounded, by which sources of lyapnet, and by which torch."""
    return bounded.fingerprint, hash_of_sources(), str(torch.__version__)


def bounded_again(
    condition: DecreaseCondition, domain: tuple[Corner, Corner], degree: int, by: tuple[str, str, str]
) -> "WhereItHolds":
    """The same question on another machine, where the condition is traced anew.

    Raises:
        UsageError: something else was traced there, or is bounded by other code.
    """
    bounded = bounded_condition(condition, domain, degree)
    if proved_by(bounded) != by:
        raise UsageError(
            "Expected the same condition, lyapnet and torch on each machine of the cluster, got others; install the "
            "same versions, and the same code of yours, there."
        )
    return WhereItHolds(condition, bounded, torch.inf, True)


@dataclass
class WhereItHolds(Question):
    """Up to which level of W the condition c ≤ 0 holds; boxes are sorted by their lower bound of W."""

    condition: DecreaseCondition
    bounded: BoundedFunction  # of (c, W, Ẇ)
    level: float  # it can only fall
    stop_at_counterexample: bool
    device: torch.device = CPU  # on which boxes are bounded
    worst: Counterexample | None = None

    def __post_init__(self) -> None:
        self.there = self.bounded.on(self.device)

    def undecided(self, boxes: Boxes) -> tuple[Boxes, Tensor]:
        if self.device == CPU:  # where such a context would only cost
            return self._undecided(boxes)
        with self.device:
            boxes, axis = self._undecided(boxes.to(self.device))
        return boxes.to(CPU), axis.to(CPU)

    def _undecided(self, boxes: Boxes) -> tuple[Boxes, Tensor]:
        c, W, rise, *h = self.there.forms(boxes.lower, boxes.upper)
        (_, c_high), (W_low, _), (_, rise_high) = c.interval(), W.interval(), rise.interval()
        boxes = boxes._replace(key=torch.maximum(W_low, boxes.key))
        chosen = ~((c_high <= 0) & (rise_high <= 0)) & (boxes.key <= self.level)
        for constraints in h:
            chosen &= ~(constraints.interval()[0] > 0).any(-1)
        return boxes[chosen], axis_to_cut(self.there, c, boxes, chosen)

    def look_at(self, boxes: Boxes) -> None:
        if len(boxes.key):  # code of others need not know batches of none
            self.lower_to(lowest_violation(self.condition, self.bounded, boxes.center, self.level))

    def lower_to(self, found: Counterexample | None) -> None:
        """Go on under a counterexample, if there is one."""
        if found is not None:
            self.worst, self.level = found, found.height - BELOW * abs(found.height)

    def begin(self, lower: Corner, upper: Corner, generator: torch.Generator | None) -> Standing:
        """The whole box, under the lowest counterexample that is found without bounds."""
        self.lower_to(find_counterexample(self.condition, self.bounded, lower, upper, self.level, generator))
        return Standing(Search(single(lower, upper)), self.level, self.worst)

    def again(self, worst: Counterexample | None) -> float:
        """The level under a counterexample of an earlier search, which is evaluated again.

        Raises:
            ValueError: it is none.
        """
        if worst is not None:
            point = torch.tensor([[worst.t, *worst.x]], dtype=torch.float64)
            found = lowest_violation(self.condition, self.bounded, point, float("inf"))
            if found is None or not abs(found.height - worst.height) <= MARGIN * abs(found.height):
                raise ValueError("the condition does not fail there")
        self.lower_to(worst)
        return self.level

    @property
    def highest(self) -> float:
        return self.level

    @property
    def settled(self) -> bool:
        return self.worst is not None and self.stop_at_counterexample

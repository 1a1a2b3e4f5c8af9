"""Proves a condition c ≤ 0 on sublevel sets of W = V − δt, by bounds on boxes."""

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
from lyapnet.prover.bounds import Bounds
from lyapnet.prover.boxes import Boxes, root_box
from lyapnet.prover.branch_and_bound import MARGIN, Budget, Question, Search, choose_axis
from lyapnet.prover.condition import DecreaseCondition, bounded_condition
from lyapnet.prover.counterexamples import Counterexample, find_counterexample, lowest_violation
from lyapnet.prover.kept_proofs import KeptProof, ProofState, describe_condition, hash_of_sources
from lyapnet.prover.verdict import Verdict
from lyapnet.prover.workers import workers_for_boxes


@dataclass(frozen=True)
class Proof:
    """The result of `prove`: c ≤ 0 at every (t, x) of a box with W(t, x) = V(t, x) − δt ≤ `level`."""

    level: float  # −∞ if nothing is proved
    wanted: float  # the level up to which c ≤ 0 was to be proved
    counterexample: Counterexample | None  # the one of lowest W among those found
    boxes: int  # number of bounded boxes
    seconds: float
    remaining_volume: float  # volume of the undecided boxes, as a share of the box
    undecided: Points  # centres (t, x) of undecided boxes, all with W > level; at most MAX_CENTRES
    fingerprint: str  # hash of the traced function that was bounded

    @property
    def verdict(self) -> Verdict:
        """Whether c ≤ 0 wherever W ≤ `wanted`."""
        if self.counterexample is not None and self.counterexample.height <= self.wanted:
            return "falsified"
        return "certified" if self.level >= self.wanted else "unknown"


class Progress(NamedTuple):
    """The progress of a proof, or a stage of the work before its first box or after its last one."""

    boxes: int  # bounded so far
    remaining: float  # share of the domain that is undecided
    seconds: float
    stage: str = "bounding boxes"


def report_stage(report: Callable[[Progress], None] | None, budget: Budget, stage: str) -> None:
    """Report a stage of the work in which no boxes are bounded."""
    if report is not None:
        report(Progress(0, 1.0, budget.elapsed, stage))


CPU = torch.device("cpu")
LEVEL_DROP = 1e-2  # the level is 1 % below W of a counterexample: boxes closer to it would have to be ever smaller
CHUNK_OF_READINGS = 4096  # least chunk where u is held: each box is bounded by several calls, which large chunks share
SAVE_INTERVAL = 30.0  # seconds between two writes of the file that keeps a proof
MAX_CENTRES = 1000  # largest number of undecided boxes whose centres are in the result


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

    First, sampling and gradient ascent look for counterexamples. Then boxes are bounded, those of lowest W first. A box
    is decided if the bounds show on all of it that c ≤ 0 and Ẇ ≤ 0, or that W > level, or that some h > 0; otherwise it
    is cut in two. A counterexample at the centre of a box lowers the level. The boxes cover the domain, so c ≤ 0 is
    proved up to the lowest W of the boxes that stay undecided.

    Args:
        condition: the condition, in float64.
        domain: (lower, upper) of (t, x).
        wanted: the level up to which c ≤ 0 is to be proved.
        stop_at_counterexample: stop at the first counterexample, instead of proving a lower level.
        report: called with the progress after each round of the search.
        keep: a file that keeps the proof, and from which it continues; a finished proof is bounded again.
        replay: bound each leaf of the kept proof once, instead of searching. Nothing in the file is assumed to be true:
            with wrong cuts or a wrong level, a leaf would stay undecided. 1 % of the leaves may be cut again, because
            rounding differs between machines.
        degree: degree of the Taylor forms.

    Raises:
        UsageError: the file keeps the proof of something else.
    """
    budget = budget or Budget()
    if condition.readings is not None:
        budget = dataclasses.replace(budget, chunk=max(budget.chunk, CHUNK_OF_READINGS))
    lower, upper = (side.double() for side in domain)
    bounded = bounded_condition(condition, (lower, upper), degree, wanted)
    lower, upper = condition.search_box((lower, upper))
    question = ProvedLevel(condition, bounded, wanted, stop_at_counterexample, torch.device(budget.device))
    kept = None if keep is None else KeptProof(keep, describe_condition(bounded, condition, lower, upper), wanted)
    if kept is not None and replay:
        start, kept = kept.read_claim((lower, upper), condition.partial), None
        leaves, question.level = len(start.search.frontier.key), min(wanted, start.level)
        budget = dataclasses.replace(budget, boxes=leaves + leaves // 100 + 100)
    else:
        start = kept.read((lower, upper), question.level_below) if kept else None
        start = start or question.start(lower, upper, generator)
    search, earlier, saved = start.search, start.seconds, budget.elapsed

    def state() -> ProofState:
        return ProofState(search, question.level, question.worst, earlier + budget.elapsed)

    make_question = partial(remake_question, condition, domain, degree, wanted, identify_bounds(bounded))
    with workers_for_boxes(question, budget.workers, budget.ray, make_question) as run:
        for _ in search.rounds(question, budget, run):
            if kept is not None and budget.elapsed > saved + SAVE_INTERVAL:
                kept.write(state())
                saved = budget.elapsed
            if report is not None:
                report(Progress(search.boxes, search.frontier.share(lower, upper), earlier + budget.elapsed))
    end = state()
    if kept is not None:
        kept.write(end)
    return Proof(
        -torch.inf if question.is_settled else end.proved, wanted, end.worst, search.boxes, end.seconds,
        search.frontier.share(lower, upper), search.frontier.center[:MAX_CENTRES, : len(domain[0])],
        bounded.fingerprint,
    )  # fmt: skip


def identify_bounds(bounded: Bounds) -> tuple[str, str, str]:
    """(hash of the bounded function, hash of the code that bounds it, version of torch)."""
    return bounded.fingerprint, hash_of_sources(), str(torch.__version__)


def remake_question(
    condition: DecreaseCondition,
    domain: tuple[Corner, Corner],
    degree: int,
    wanted: float,
    by: tuple[str, str, str],
) -> "ProvedLevel":
    """The question on another machine, made from a condition that is traced again there.

    Args:
        by: identify_bounds of the first machine.

    Raises:
        UsageError: the traced function or the code that bounds it differs from that of the first machine.
    """
    bounded = bounded_condition(condition, domain, degree, wanted)
    if identify_bounds(bounded) != by:
        raise UsageError(
            "Expected the same condition, lyapnet and torch on each machine of the cluster, got others; install the "
            "same versions, and your own code, on all machines."
        )
    return ProvedLevel(condition, bounded, torch.inf, True)


@dataclass
class ProvedLevel(Question):
    """The question up to which level of W the condition c ≤ 0 holds; the key of a box is a lower bound of W on it."""

    condition: DecreaseCondition
    bounded: Bounds  # of (c, W, Ẇ) and, with constraints, h
    level: float  # counterexamples lower it
    stop_at_counterexample: bool
    device: torch.device = CPU  # on which boxes are bounded
    worst: Counterexample | None = None  # the one that lowered the level last

    def __post_init__(self) -> None:
        self.on_device = self.bounded.on(self.device)

    def find_undecided(self, boxes: Boxes) -> tuple[Boxes, Tensor]:
        if self.device == CPU:  # the context of a default device slows torch down
            return self._find_undecided(boxes)
        with self.device:
            boxes, axis = self._find_undecided(boxes.to(self.device))
        return boxes.to(CPU), axis.to(CPU)

    def _find_undecided(self, boxes: Boxes) -> tuple[Boxes, Tensor]:
        c, W, rise, *h = self.on_device.forms(boxes.lower, boxes.upper)
        (_, c_high), (W_low, _), (_, rise_high) = c.interval(), W.interval(), rise.interval()
        boxes = boxes._replace(key=torch.maximum(W_low, boxes.key))
        chosen = ~((c_high <= 0) & (rise_high <= 0)) & (boxes.key <= self.level)
        for constraints in h:
            chosen &= ~(constraints.interval()[0] > 0).any(-1)
        axis, other = choose_axis(self.on_device, c, boxes, chosen), (c_high <= 0)[chosen]
        if bool(other.any()):  # c ≤ 0 is proved there, and only Ẇ ≤ 0 is undecided
            axis = torch.where(other, choose_axis(self.on_device, rise, boxes, chosen, 2), axis)
        return boxes[chosen], axis

    def learn_from(self, boxes: Boxes) -> None:
        if len(boxes.key):  # systems and costs of users need not accept empty batches
            self.lower_level(lowest_violation(self.condition, self.bounded, boxes.center, self.level))

    def lower_level(self, found: Counterexample | None) -> None:
        """Lower the level below a counterexample, if one was found."""
        if found is not None:
            self.worst, self.level = found, found.height - LEVEL_DROP * abs(found.height)

    def start(self, lower: Corner, upper: Corner, generator: torch.Generator | None) -> ProofState:
        """The state before the search: one box, and the level below the lowest counterexample that sampling finds."""
        self.lower_level(find_counterexample(self.condition, self.bounded, lower, upper, self.level, generator))
        return ProofState(Search(root_box(lower, upper)), self.level, self.worst)

    def level_below(self, worst: Counterexample | None) -> float:
        """The level below the counterexample of a kept proof; the condition is evaluated there again.

        Raises:
            ValueError: the condition holds at that point.
        """
        if worst is not None:
            point = self.condition.point_of(worst.t, worst.x, worst.after)
            found = lowest_violation(self.condition, self.bounded, point, float("inf"))
            if found is None or not abs(found.height - worst.height) <= MARGIN * abs(found.height):
                raise ValueError("the condition does not fail there")
        self.lower_level(worst)
        return self.level

    @property
    def highest_key(self) -> float:
        return self.level

    @property
    def is_settled(self) -> bool:
        return self.worst is not None and self.stop_at_counterexample

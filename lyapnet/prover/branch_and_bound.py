"""Branch and bound over boxes of (t, x): the search, and two of the questions that it answers.

Both answers follow from rigorous bounds (lyapnet.prover.taylor); values at points only guide the search. The main
question, up to which level of W a condition holds, is in lyapnet.prover.proof.
"""

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from lyapnet.base.devices import require_device
from lyapnet.base.errors import UsageError
from lyapnet.base.types import Corner, Corners, PerBox, Value
from lyapnet.prover.bounds import BoundedFunction, Bounds
from lyapnet.prover.boxes import Boxes, CutTree, root_box, root_boxes
from lyapnet.prover.stopping import Stop
from lyapnet.prover.taylor import TaylorForm, wide_axes


@dataclass(frozen=True)
class Budget:
    """Limits on the work of a search; when one is reached, the search stops and the remaining boxes stay undecided.

    Args:
        seconds, boxes: largest time, and largest number of bounded boxes.
        chunk: number of boxes that each worker bounds at once.
        frontier: largest number of undecided boxes in memory; beyond it, those of highest key are given up.
        workers: number of processes.
        ray: address of a Ray cluster, of which `workers` cores bound the boxes of a proof instead of local processes.
        device: "cpu" or "cuda", where the boxes of a proof are bounded; a GPU is used by one process, in large chunks.
    """

    seconds: float = 60.0
    boxes: int = 100_000_000
    chunk: int = 512
    frontier: int = 1_000_000
    workers: int = 1
    device: str = "cpu"
    ray: str | None = None
    started: float = field(default_factory=time.monotonic)
    stop: Stop = field(default_factory=Stop)  # set by the user's Ctrl-C or by SIGTERM

    def __post_init__(self) -> None:
        if min(self.chunk, self.frontier, self.workers) < 1:
            raise UsageError(
                f"Expected chunk, frontier and workers ≥ 1, got {self.chunk}, {self.frontier} and {self.workers}."
            )
        if self.device != "cpu":
            require_device(self.device, torch.float64)
            if self.workers > 1:
                raise UsageError(f"Expected one worker on {self.device}, got {self.workers}; leave --workers out.")
            if self.ray is not None:
                raise UsageError(f"Expected --device {self.device} or --ray, got both; leave one out.")

    @property
    def at_once(self) -> int:
        """Number of boxes that are bounded at once."""
        return self.chunk if self.device == "cpu" else max(self.chunk, GPU_CHUNK)

    @property
    def elapsed(self) -> float:
        """Seconds since the budget was made."""
        return time.monotonic() - self.started

    def spent(self, boxes: int) -> bool:
        """Whether a search that has bounded this many boxes must stop."""
        return self.stop.asked or self.elapsed >= self.seconds or boxes >= self.boxes

    @property
    def left(self) -> float:
        """Remaining seconds."""
        return max(0.0, self.seconds - self.elapsed)


CHUNKS_PER_ROUND = 4  # chunks of each worker in a round, if there are several: they wait only between rounds
GPU_CHUNK = 65_536  # least number of boxes that a GPU bounds at once; fewer do not occupy it fully
MARGIN = 1e-9
"""Distance of just_below and just_above from a number, relative to the number.

Sublevel sets {W ≤ ρ} are closed, so ρ must be strictly below the least W of the boxes that the set must not contain.
1e-9 is far above the rounding of the few float64 operations in between (1e-15), and too small to see in a figure.
"""


def just_below(value: float) -> float:
    """The number, lowered by MARGIN; an infinite one stays."""
    return value - MARGIN * abs(value) if math.isfinite(value) else value


def just_above(value: float) -> float:
    """The number, raised by MARGIN; an infinite one stays."""
    return value + MARGIN * abs(value) if math.isfinite(value) else value


class Question(ABC):
    """A question about the points of a set of boxes, with the answer as far as it is known."""

    @abstractmethod
    def find_undecided(self, boxes: Boxes) -> tuple[Boxes, Tensor]:
        """(the boxes that stay undecided, with the key of their halves; the axis across which to cut each, (boxes,)).

        Calls may run in copies of this process, in parallel; changes of the question in a copy are lost.
        """

    def learn_from(self, boxes: Boxes) -> None:  # noqa: B027  (most questions learn from bounds alone)
        """Learn from boxes that stay undecided, as from values at their centres; called in this process, in order."""

    @property
    def highest_key(self) -> float:
        """Undecided boxes of a higher key are dropped, as they do not matter for the answer."""
        return float("inf")

    @property
    def is_settled(self) -> bool:
        """Whether the answer is known although boxes are undecided."""
        return False


@dataclass
class Search:
    """The state of a search: the undecided boxes, of which those of lowest key are bounded next."""

    frontier: Boxes  # undecided
    boxes: int = 0  # number of boxes bounded so far
    given_up: float = float("inf")  # the lowest key of the boxes that were given up for lack of memory
    tree: CutTree = field(default_factory=CutTree)

    @property
    def least(self) -> float:
        """The lowest key of the undecided boxes and of those given up; ∞ if there are none."""
        return min(self.frontier.least, self.given_up)

    def rounds(self, question: Question, budget: Budget, run: Callable[..., Iterable[Any]] = map) -> Iterator[None]:
        """Bound boxes in rounds until all are decided, the question is settled or the budget is spent.

        Args:
            run: maps a function over chunks of boxes: `map`, or one of lyapnet.prover.workers.workers_for_boxes.
        """
        budget.stop.searching = True
        while len(self.frontier.key) and not question.is_settled and not budget.spent(self.boxes):
            chunks = 1 if budget.workers == 1 else CHUNKS_PER_ROUND * budget.workers
            lowest, rest = self.frontier.first(budget.at_once * chunks)
            self.boxes += len(lowest.key)
            for undecided, axis in run(question.find_undecided, lowest.split(budget.at_once)):
                question.learn_from(undecided)
                rest = rest.joined(self.tree.cut(undecided, axis))
            self.frontier, dropped = rest[rest.key <= question.highest_key].first(budget.frontier)
            self.given_up = min(self.given_up, dropped.least)
            yield


def run_search(question: Question, frontier: Boxes, budget: Budget) -> Search:
    """Search for the answer to a question until it is known or the budget is spent; the final state of the search."""
    search = Search(frontier)
    for _ in search.rounds(question, budget):
        pass
    return search


PROBES = 12  # number of boxes of a chunk on which cuts across each axis are compared, about
UNKNOWN_EXCESS = 1e100  # takes the place of an infinite or unknown excess when cuts are compared


def choose_axis(bounded: Bounds, form: TaylorForm, boxes: Boxes, chosen: Tensor, result: int = 0) -> Tensor:
    """For each chosen box, the axis whose cut lowers the excess (`TaylorForm.excess`) of one result most.

    The linear part of a form is bounded exactly on any box; only the excess can prevent the proof of a true inequality.
    For a box of widths w the excess is about Σ_k m_k w_k², so a cut across axis k lowers it by a share of m_k w_k². All
    boxes take the same m, the mean of what cuts of at most about PROBES boxes give.

    Args:
        form: the result on the boxes.
        chosen: which boxes are cut, (boxes,) booleans.
        result: the position of the result among those of `bounded`.
    """
    widths = boxes.upper - boxes.lower
    excess = form.excess.nan_to_num(nan=UNKNOWN_EXCESS, posinf=UNKNOWN_EXCESS)
    some = torch.nonzero(chosen).flatten()[:: max(1, int(chosen.sum()) // PROBES)]
    if not len(some):
        return some
    axes = torch.arange(widths.shape[-1])
    probes = boxes[some.repeat_interleave(len(axes))]
    lower, upper, *_ = probes.halves(axes.repeat(len(some)))
    halved = bounded.forms(lower[: len(probes.key)], upper[: len(probes.key)])[result].excess
    halved = halved.nan_to_num(nan=UNKNOWN_EXCESS, posinf=UNKNOWN_EXCESS).reshape(len(some), -1)
    drop = excess[some, None] - halved
    drop = drop.clamp_min(0) / drop.amax(-1, keepdim=True).clamp_min(1e-300)  # all probes count equally
    m = (drop / (widths[some] ** 2).clamp_min(1e-300)).mean(0)
    # small terms decide between axes of equal m w²: the linear part where it is finite, then the widths
    tie = 1e-12 * widths
    tie[:, wide_axes(boxes.lower, boxes.upper)] += 1e-3 * form.coefficients.abs().T.nan_to_num(posinf=0.0)
    return torch.where(widths > 0, m * widths**2 + tie, -1.0)[chosen].argmax(-1)


# Least values


@dataclass
class LeastValue(Question):
    """A lower bound of min f over the points of boxes with where(t, x) ≤ level; the fields are those of `minimum`."""

    function: Value
    where: Value
    bounded: Bounds  # of (f, where)
    level: float
    enough: float
    unit: float
    tolerance: float
    best: float = float("inf")  # the least value of f at a point so far
    found: float = float("inf")  # the least lower bound of f on the boxes that are decided

    def find_undecided(self, boxes: Boxes) -> tuple[Boxes, Tensor]:
        f, w = self.bounded.forms(boxes.lower, boxes.upper)
        (f_low, f_high), w_low = f.interval(), w.interval()[0]
        t, x = boxes.center[:, 0], boxes.center[:, 1:]
        with torch.no_grad():
            at, inside = self.function(t, x), self.where(t, x) <= self.level
        self.best = min(self.best, _least(at[inside]))
        room = self.tolerance * max(abs(self.best), self.unit) if self.best < torch.inf else 0.0
        close = self.best - room
        possible, done = w_low <= self.level, f_low >= min(close, self.enough)
        self.found = min(self.found, _least(f_low[possible & done]))
        boxes, chosen = boxes._replace(key=f_low), possible & ~done
        axis, known = choose_axis(self.bounded, f, boxes, chosen), (f_high - f_low <= room)[chosen]
        if bool(known.any()):  # f is known to the tolerance there: cut to decide whether w ≤ level
            axis = torch.where(known, choose_axis(self.bounded, w, boxes, chosen, 1), axis)
        return boxes[chosen], axis


def _least(values: PerBox) -> float:
    """The least number that is not nan; ∞ if there is none."""
    return min([float("inf"), *values.sort().values[:1].tolist()])


def minimum(
    function: Value,
    lower: Corners,
    upper: Corners,
    budget: Budget,
    where: Value | None = None,
    level: float = float("inf"),
    enough: float = float("inf"),
    unit: float = 0.0,
    tolerance: float = 1e-3,
    bounded: Bounds | None = None,
) -> float:
    """A lower bound of min f over the points of boxes with where(t, x) ≤ level; ∞ if there are none.

    Boxes are cut until the bound is within tolerance · max(|min|, unit) of a value of f, or at least `enough`, or the
    budget is spent. The result is the least of the lower bounds on decided and on undecided boxes, which cover all
    points.

    Args:
        where, level: the points with where(t, x) ≤ level count; all of them by default.
        bounded: (f, where) with bounds, if they exist already; tracing takes longer than bounding a few boxes.
    """
    where = where or function
    if bounded is None:
        bounded = BoundedFunction(lambda t, x: (function(t, x), where(t, x)), (lower.amin(0), upper.amax(0)))
    question = LeastValue(function, where, bounded, level, enough, unit, tolerance)
    undecided = run_search(question, root_boxes(lower, upper), budget).least
    return min(question.found, undecided)


# Shares

SMALLEST_SHARE = 1e-7  # of the volume; smaller boxes on the boundary of {V ≤ level} are not cut any more


@dataclass
class ShareBelow(Question):
    """A lower bound of the share of a box, by volume, on which V ≤ level."""

    bounded: Bounds  # of V
    lower: Corner
    upper: Corner
    level: float
    inside: float = 0.0  # the share of the boxes on which an upper bound of V is at most the level

    def find_undecided(self, boxes: Boxes) -> tuple[Boxes, Tensor]:
        (form,) = self.bounded.forms(boxes.lower, boxes.upper)
        low, high = form.interval()
        volume = boxes.volumes(self.lower, self.upper)
        self.inside += float(volume[high <= self.level].sum())
        chosen = (low <= self.level) & ~(high <= self.level) & (volume > SMALLEST_SHARE)
        boxes = boxes._replace(key=-volume / 2)  # the largest halves first
        return boxes[chosen], choose_axis(self.bounded, form, boxes, chosen)


def share_below(V: Value, lower: Corner, upper: Corner, level: float, budget: Budget) -> float:
    """A lower bound of the share of a box, by volume, on which V ≤ level; axes of width 0 do not count."""
    bounded = BoundedFunction(lambda t, x: (V(t, x),), (lower, upper))
    question = ShareBelow(bounded, lower, upper, level)
    run_search(question, root_box(lower, upper), budget)
    return min(question.inside, 1.0)

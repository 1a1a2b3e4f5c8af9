"""Branch and bound over boxes of (t, x): one search, and two questions that it answers.

What it finds is found by bounds that are sound up to what lyapnet.prover.taylor says of rounding; plain evaluations
serve to guess well. The third question, where a condition is proved, is lyapnet.prover.proof.
"""

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
from lyapnet.prover.bounds import BoundedFunction
from lyapnet.prover.boxes import Boxes, CutTree, roots, single
from lyapnet.prover.stopping import Stop
from lyapnet.prover.taylor import TaylorForm, wide_axes


@dataclass(frozen=True)
class Budget:
    """When to stop undecided.

    Args:
        seconds, boxes: the work.
        chunk: boxes that are bounded at once by each worker.
        frontier: undecided boxes that are kept; beyond, those of highest key are given up.
        workers: processes.
        ray: the address of a cluster of which so many cores bound the boxes of a proof, in place of processes here.
        device: where the boxes of a proof are bounded, "cpu" or "cuda"; a GPU by one process, in chunks that fill it.
    """

    seconds: float = 60.0
    boxes: int = 100_000_000
    chunk: int = 512
    frontier: int = 1_000_000
    workers: int = 1
    device: str = "cpu"
    ray: str | None = None
    started: float = field(default_factory=time.monotonic)
    stop: Stop = field(default_factory=Stop)  # asked by the user

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
                raise UsageError(f"Expected --device {self.device} or --ray, got both; cores of a cluster bound boxes.")

    @property
    def at_once(self) -> int:
        """How many boxes are bounded at once."""
        return self.chunk if self.device == "cpu" else max(self.chunk, ON_DEVICE)

    @property
    def elapsed(self) -> float:
        """Seconds since the budget was opened."""
        return time.monotonic() - self.started

    def spent(self, boxes: int) -> bool:
        """Whether no more work is to be begun."""
        return self.stop.asked or self.elapsed >= self.seconds or boxes >= self.boxes

    @property
    def left(self) -> float:
        """Seconds that are left."""
        return max(0.0, self.seconds - self.elapsed)


AHEAD = 4  # chunks of each of several workers in a round, so that none waits for what is done between rounds
ON_DEVICE = 65_536  # boxes that fill a GPU
MARGIN = 1e-9
"""How far "just below" and "just above" are, relative to the number itself.

Levels are compared as closed sets are: {W ≤ ρ} against boxes on which W reaches ρ, its boundary against a rim. The
width is far above the rounding of the few float64 operations in between (1e-15), and far below what a figure shows.
"""


def just_below(value: float) -> float:
    """A number below, by MARGIN."""
    return value - MARGIN * abs(value)


def just_above(value: float) -> float:
    """A number above, by MARGIN."""
    return value + MARGIN * abs(value)


class Question(ABC):
    """What is asked of boxes, and what is known of the answer so far."""

    @abstractmethod
    def undecided(self, boxes: Boxes) -> tuple[Boxes, Tensor]:
        """(the boxes that must be cut, by the key under which their halves wait; the axis to cut each across).

        Calls may run in copies of this process, side by side: what they learn is lost but for what they return.
        """

    def look_at(self, boxes: Boxes) -> None:  # noqa: B027  (most questions learn from bounds alone)
        """Learn from boxes that stay undecided; in the order of the search, one call at a time."""

    @property
    def highest(self) -> float:
        """The highest key of boxes that are still of interest."""
        return float("inf")

    @property
    def settled(self) -> bool:
        """Whether the answer is known, whatever is undecided."""
        return False


@dataclass
class Search:
    """A search on the way: the boxes that wait, those of lowest key being next."""

    frontier: Boxes
    boxes: int = 0  # bounded so far
    given_up: float = float("inf")  # the least key among boxes for which there was no room
    tree: CutTree = field(default_factory=CutTree)

    @property
    def least(self) -> float:
        """The least key among boxes that are undecided; ∞ where none is."""
        return min(self.frontier.least, self.given_up)

    def rounds(self, question: Question, budget: Budget, run: Callable[..., Iterable[Any]] = map) -> Iterator[None]:
        """Bound some chunks for each worker, again and again, until all is decided, settled or the budget is spent.

        Args:
            run: maps a function over chunks, as `map` does or lyapnet.prover.workers.
        """
        budget.stop.searching = True
        while len(self.frontier.key) and not question.settled and not budget.spent(self.boxes):
            ahead = 1 if budget.workers == 1 else AHEAD * budget.workers
            lowest, rest = self.frontier.first(budget.at_once * ahead)
            self.boxes += len(lowest.key)
            for undecided, axis in run(question.undecided, lowest.split(budget.at_once)):
                question.look_at(undecided)
                rest = rest.joined(self.tree.cut(undecided, axis))
            self.frontier, beyond = rest[rest.key <= question.highest].first(budget.frontier)
            self.given_up = min(self.given_up, beyond.least)
            yield


def searched(question: Question, frontier: Boxes, budget: Budget) -> Search:
    """The search of a question, as far as the budget takes it."""
    search = Search(frontier)
    for _ in search.rounds(question, budget):
        pass
    return search


PROBES = 12  # boxes of a chunk that are cut along every axis


def axis_to_cut(bounded: BoundedFunction, form: TaylorForm, boxes: Boxes, chosen: Tensor, result: int = 0) -> Tensor:
    """For each chosen box, the axis along which a cut lowers the excess of one result most, the first by default.

    A linear part is bounded exactly on any box: only the excess of the other part prevents the proof of a true
    inequality. The excess is about Σ_k m_k w_k² for widths w; m is measured on a few boxes.

    Args:
        form: that result on the boxes.
        chosen: (boxes,) truths.
    """
    widths, excess = boxes.upper - boxes.lower, form.excess.nan_to_num(nan=1e100, posinf=1e100)
    some = torch.nonzero(chosen).flatten()[:: max(1, int(chosen.sum()) // PROBES)]
    if not len(some):
        return some
    axes = torch.arange(widths.shape[-1])
    probes = boxes[some.repeat_interleave(len(axes))]
    lower, upper, *_ = probes.halves(axes.repeat(len(some)))
    halved = bounded.forms(lower[: len(probes.key)], upper[: len(probes.key)])[result].excess
    drop = excess[some, None] - halved.nan_to_num(nan=1e100, posinf=1e100).reshape(len(some), -1)
    m = (drop.clamp_min(0) / (widths[some] ** 2).clamp_min(1e-300)).mean(0)
    # the linear part and the widths decide where the excess does not
    tie = 1e-12 * widths
    tie[:, wide_axes(boxes.lower, boxes.upper)] += 1e-3 * form.coefficients.abs().T.nan_to_num()
    return torch.where(widths > 0, m * widths**2 + tie, -1.0)[chosen].argmax(-1)


# Least values


@dataclass
class LeastValue(Question):
    """A lower bound of min f on boxes, on the part with where(t, x) ≤ level."""

    function: Value
    where: Value
    bounded: BoundedFunction  # of (f, where)
    level: float
    enough: float
    unit: float
    tolerance: float
    best: float = float("inf")  # the least value of f that was seen
    found: float = float("inf")  # the least bound among boxes that need no more cutting

    def undecided(self, boxes: Boxes) -> tuple[Boxes, Tensor]:
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
        axis, known = axis_to_cut(self.bounded, f, boxes, chosen), (f_high - f_low <= room)[chosen]
        if bool(known.any()):  # of these it is open whether they count
            axis = torch.where(known, axis_to_cut(self.bounded, w, boxes, chosen, 1), axis)
        return boxes[chosen], axis


def _least(values: PerBox) -> float:
    """The least of some numbers that is not nan; ∞ where there is none."""
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
    bounded: BoundedFunction | None = None,
) -> float:
    """A lower bound of min f over boxes, on the part with where(t, x) ≤ level; ∞ where it is empty.

    Boxes are cut until the bound comes within tolerance · max(|min|, unit) of a value of f or reaches what is enough,
    or the budget is spent.

    Args:
        bounded: of (f, where), if it is at hand: a trace takes longer than a few boxes.
    """
    where = where or function
    if bounded is None:
        bounded = BoundedFunction(lambda t, x: (function(t, x), where(t, x)), (lower.amin(0), upper.amax(0)))
    question = LeastValue(function, where, bounded, level, enough, unit, tolerance)
    left = searched(question, roots(lower, upper), budget).least
    return min(question.found, left)


# Shares


@dataclass
class ShareBelow(Question):
    """A lower bound of the share by volume of a box on which V ≤ level."""

    bounded: BoundedFunction  # of V
    lower: Corner
    upper: Corner
    level: float
    inside: float = 0.0

    def undecided(self, boxes: Boxes) -> tuple[Boxes, Tensor]:
        (form,) = self.bounded.forms(boxes.lower, boxes.upper)
        low, high = form.interval()
        volume = boxes.volumes(self.lower, self.upper)
        self.inside += float(volume[high <= self.level].sum())
        chosen = (low <= self.level) & ~(high <= self.level) & (volume > 1e-7)
        boxes = boxes._replace(key=-volume / 2)  # the largest halves first
        return boxes[chosen], axis_to_cut(self.bounded, form, boxes, chosen)


def share_below(V: Value, lower: Corner, upper: Corner, level: float, budget: Budget) -> float:
    """A lower bound of the share by volume of a box on which V ≤ level; axes without width do not count."""
    bounded = BoundedFunction(lambda t, x: (V(t, x),), (lower, upper))
    question = ShareBelow(bounded, lower, upper, level)
    searched(question, single(lower, upper), budget)
    return min(question.inside, 1.0)

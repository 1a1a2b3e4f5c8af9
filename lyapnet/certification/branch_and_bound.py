"""Inequalities proved on boxes by bisection: where W = V − δt is low, and least values over boxes.

Every box of (t, x) is (1 + n,) long, time first. What is proved is proved by bounds that are sound up to what
lyapnet.certification.taylor says of rounding; plain evaluations serve to find counterexamples and to guess well.
"""

import hashlib
import io
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lyapnet.atomic import write_atomically
from lyapnet.certification.bounds import BoundedFunction, DecreaseCondition
from lyapnet.certification.statistical import Verdict
from lyapnet.certification.taylor import TaylorForm, wide_axes
from lyapnet.errors import UsageError


@dataclass(frozen=True)
class Budget:
    """When to stop undecided.

    Args:
        seconds, boxes: the work.
        chunk: boxes that are bounded at once by each worker.
        frontier: undecided boxes that are kept; beyond, those of highest W are given up.
        workers: threads.
    """

    seconds: float = 60.0
    boxes: int = 100_000_000
    chunk: int = 512
    frontier: int = 1_000_000
    workers: int = 1
    started: float = field(default_factory=time.monotonic)

    @property
    def elapsed(self) -> float:
        """Seconds since the budget was opened."""
        return time.monotonic() - self.started

    def spent(self, boxes: int) -> bool:
        """Whether no more work is to be begun."""
        return self.elapsed >= self.seconds or boxes >= self.boxes


class Counterexample(NamedTuple):
    """A point at which the condition fails, in plain arithmetic and by a lower bound of its value."""

    t: float
    x: list[float]
    condition: float  # c(t, x) > 0
    height: float  # W(t, x) = V(t, x) − δt


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
    undecided: Tensor  # (k, 1 + n), centres (t, x) of boxes that remain

    @property
    def verdict(self) -> Verdict:
        """Of the claim that c ≤ 0 wherever W ≤ `wanted`."""
        if self.counterexample is not None and self.counterexample.height <= self.wanted:
            return "falsified"
        return "certified" if self.level >= self.wanted else "unknown"


class Boxes(NamedTuple):
    """Boxes of (t, x), (boxes, 1 + n) each, and a number for each by which they are sorted."""

    lower: Tensor
    upper: Tensor
    key: Tensor

    def __getitem__(self, chosen: Tensor) -> "Boxes":  # pyright: ignore[reportIncompatibleMethodOverride]
        return Boxes(*(y[chosen] for y in tuple(self)))

    def joined(self, other: "Boxes") -> "Boxes":
        """Both."""
        return Boxes(*(torch.cat(pair) for pair in zip(self, other, strict=True)))

    @property
    def center(self) -> Tensor:
        """(boxes, 1 + n)."""
        return (self.lower + self.upper) / 2

    def first(self, count: int) -> tuple["Boxes", "Boxes"]:
        """(those of smallest key, the others)."""
        if len(self.key) <= count:
            return self, self[torch.zeros(len(self.key), dtype=torch.bool)]
        chosen = torch.zeros(len(self.key), dtype=torch.bool)
        chosen[self.key.topk(count, largest=False).indices] = True
        return self[chosen], self[~chosen]

    @property
    def least(self) -> float:
        """The smallest key; ∞ of no boxes."""
        return float(self.key.min()) if len(self.key) else float("inf")

    def volumes(self, lower: Tensor, upper: Tensor) -> Tensor:
        """The share of each in the box (lower, upper), (boxes,); axes of no width do not count."""
        sides = torch.where(upper > lower, upper - lower, 1.0)
        return torch.where(upper > lower, (self.upper - self.lower) / sides, 1.0).prod(-1)

    def halves(self, axis: Tensor) -> "Boxes":
        """Each box cut in two in the middle of an axis of its own."""
        cut = torch.nn.functional.one_hot(axis, self.lower.shape[-1]).bool()
        lower, upper = torch.where(cut, self.center, self.lower), torch.where(cut, self.center, self.upper)
        return Boxes(self.lower, upper, self.key).joined(Boxes(lower, self.upper, self.key))


BELOW = 1e-2  # of a counterexample's W: how far under it the level goes on, lest ever smaller boxes follow its edge


class Progress(NamedTuple):
    """How far a proof is."""

    boxes: int  # bounded so far
    remaining: float  # share of the domain that is undecided
    seconds: float


def prove(
    condition: DecreaseCondition,
    domain: tuple[Tensor, Tensor],
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
        report: hears how far it is, after every few thousand boxes.
        keep: a file in which an unfinished proof is kept, and from which it goes on.

    Raises:
        UsageError: the file keeps the proof of something else.
    """
    budget = budget or Budget()
    lower, upper = (side.double() for side in domain)
    bounded = BoundedFunction(lambda t, x: (condition(t, x), condition.height(t, x)), (lower, upper))
    search = _kept(keep, bounded, lower, upper, wanted)
    if search is None:
        worst = find_counterexample(condition, bounded, lower, upper, wanted, generator)
        everything = Boxes(lower[None], upper[None], torch.full((1,), -torch.inf, dtype=torch.float64))
        search = Search(everything, wanted if worst is None else _under(worst), worst)
    earlier, saved = search.seconds, budget.elapsed
    with ThreadPoolExecutor(budget.workers) as pool:
        while len(search.frontier.key) and not (search.worst is not None and stop_at_counterexample):
            search.seconds = earlier + budget.elapsed
            over = budget.spent(search.boxes)
            if keep is not None and (over or budget.elapsed > saved + KEEP_EVERY):
                search.save(keep, bounded.fingerprint, lower, upper, wanted)
                saved = budget.elapsed
            if over:
                break
            search.advance(condition, bounded, budget, pool.map)
            if report is not None:
                report(Progress(search.boxes, search.remaining(lower, upper), search.seconds))
    stopped = search.worst is not None and stop_at_counterexample
    proved = -torch.inf if stopped else min(search.level, _just_below(min(search.frontier.least, search.given_up)))
    remaining = search.remaining(lower, upper)
    return Proof(
        proved, wanted, search.worst, search.boxes, earlier + budget.elapsed, remaining, search.frontier.center[:KEPT]
    )


KEEP_EVERY = 30.0  # seconds
KEPT = 1000  # undecided boxes whose centres a proof names


@dataclass
class Search:
    """A proof on the way: what is undecided, and below which level the rest is proved."""

    frontier: Boxes
    level: float
    worst: Counterexample | None
    boxes: int = 0
    seconds: float = 0.0
    given_up: float = float("inf")  # the least W among boxes for which there was no room

    def remaining(self, lower: Tensor, upper: Tensor) -> float:
        """The share of the domain that is undecided."""
        return float(self.frontier.volumes(lower, upper).sum())

    def advance(
        self, condition: DecreaseCondition, bounded: BoundedFunction, budget: Budget, run: Callable[..., Any]
    ) -> None:
        """Bound the boxes of lowest W, a chunk for each worker; the level they read can only fall meanwhile."""
        lowest, rest = self.frontier.first(budget.chunk * budget.workers)
        self.boxes += len(lowest.key)
        chunks = [lowest[part] for part in torch.arange(len(lowest.key)).split(budget.chunk)]
        for undecided, axis in run(lambda chunk: _undecided(bounded, chunk, self.level), chunks):
            found = _lowest_violation(condition, bounded, undecided.center, self.level)
            if found is not None:
                self.worst, self.level = found, _under(found)
            rest = rest.joined(undecided.halves(axis))
        self.frontier, beyond = rest[rest.key <= self.level].first(budget.frontier)
        self.given_up = min(self.given_up, beyond.least)

    def save(self, path: Path, fingerprint: str, lower: Tensor, upper: Tensor, wanted: float) -> None:
        """Keep it in a file, all or nothing."""
        content = {
            "of": _identity(fingerprint, lower, upper, wanted), "frontier": list(self.frontier),
            "worst": None if self.worst is None else self.worst._asdict(), "level": self.level,
            "boxes": self.boxes, "seconds": self.seconds, "given_up": self.given_up,
        }  # fmt: skip
        buffer = io.BytesIO()
        torch.save(content, buffer)
        write_atomically(path, buffer.getbuffer())


def _identity(fingerprint: str, lower: Tensor, upper: Tensor, wanted: float) -> list[Any]:
    """What a kept proof is about, and the rules that it was made by: others might not have dropped what it dropped."""
    rules = hashlib.sha256(b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py"))))
    return [fingerprint, rules.hexdigest(), lower.tolist(), upper.tolist(), wanted]


def _kept(path: Path | None, bounded: BoundedFunction, lower: Tensor, upper: Tensor, wanted: float) -> Search | None:
    """The search that a file keeps; None where there is no file."""
    if path is None or not path.exists():
        return None
    try:
        content = torch.load(path, weights_only=True)
        same = content.pop("of") == _identity(bounded.fingerprint, lower, upper, wanted)
        found = content.pop("worst")
        frontier = Boxes(*content.pop("frontier"))
        search = Search(frontier=frontier, worst=None if found is None else Counterexample(**found), **content)
    except Exception as error:
        raise UsageError(f"Expected a proof in {str(path)!r}, got another file; name a new one.") from error
    if not same:
        raise UsageError(
            f"Expected the proof of this V, α, δ, set and version in {str(path)!r}, got another; take a new file."
        )
    return search


def _undecided(bounded: BoundedFunction, chunk: Boxes, level: float) -> tuple[Boxes, Tensor]:
    """(the boxes on which c > 0 and W ≤ level are both possible, by their lower bounds of W; the axis to cut each)."""
    c, W = bounded.forms(chunk.lower, chunk.upper)
    (_, c_high), (W_low, _) = c.interval(), W.interval()
    chunk = Boxes(chunk.lower, chunk.upper, torch.maximum(W_low, chunk.key))
    chosen = ~(c_high <= 0) & (chunk.key <= level)
    return chunk[chosen], axis_to_cut(bounded, c, chunk, chosen)


PROBES = 12  # boxes of a chunk that are cut along every axis


def axis_to_cut(bounded: BoundedFunction, form: TaylorForm, boxes: Boxes, chosen: Tensor) -> Tensor:
    """For each chosen box, the axis along which a cut lowers the excess of its first result most.

    A linear part is bounded exactly on a box of any size: where an inequality holds and is not proved yet, what the
    bounds have beyond it is in the way. About Σ_k m_k w_k² of it is the widths'; m is measured on a few boxes.
    """
    widths, excess = boxes.upper - boxes.lower, form.excess.nan_to_num(nan=1e100, posinf=1e100)
    some = torch.nonzero(chosen).flatten()[:: max(1, int(chosen.sum()) // PROBES)]
    if not len(some):
        return some
    axes = torch.arange(widths.shape[-1])
    probes = boxes[some.repeat_interleave(len(axes))]
    lower, upper, _ = probes.halves(axes.repeat(len(some)))
    halved = bounded.forms(lower[: len(probes.key)], upper[: len(probes.key)])[0].excess
    drop = excess[some, None] - halved.nan_to_num(nan=1e100, posinf=1e100).reshape(len(some), -1)
    m = (drop.clamp_min(0) / (widths[some] ** 2).clamp_min(1e-300)).mean(0)
    # the linear part and the widths decide where the excess does not
    tie = 1e-12 * widths
    tie[:, wide_axes(boxes.lower, boxes.upper)] += 1e-3 * form.coefficients.abs().T.nan_to_num()
    return torch.where(widths > 0, m * widths**2 + tie, -1.0)[chosen].argmax(-1)


# Counterexamples


def find_counterexample(
    condition: DecreaseCondition,
    bounded: BoundedFunction,
    lower: Tensor,
    upper: Tensor,
    level: float,
    generator: torch.Generator | None = None,
) -> Counterexample | None:
    """A point with c > 0 and W ≤ level, of the lowest W found: among samples, and by ascent of c from the worst 64."""
    points = _likely_violations(condition, lower, upper, level, generator)
    return _lowest_violation(condition, bounded, points, level)


def violations(
    condition: DecreaseCondition,
    domain: tuple[Tensor, Tensor],
    level: float,
    count: int,
    generator: torch.Generator | None = None,
) -> Tensor:
    """The worst points (t, x) found with c > 0 and W ≤ level, in plain arithmetic; (k, 1 + n), k ≤ count."""
    points = _likely_violations(condition, *domain, level, generator)
    c, W = _values(condition, points)
    worst = torch.where(level >= W, c, -torch.inf).topk(min(count, len(points)))
    return points[worst.indices[worst.values > 0]]


def _likely_violations(
    condition: DecreaseCondition,
    lower: Tensor,
    upper: Tensor,
    level: float,
    generator: torch.Generator | None,
    samples: int = 20_000,
    steps: int = 40,
) -> Tensor:
    """Samples of the box, and what ascent from the worst 64 of them with W ≤ level passes."""
    points = lower + (upper - lower) * torch.rand(samples, len(lower), generator=generator, dtype=torch.float64)
    c, W = _values(condition, points)
    start = points[torch.where(level >= W, c, -torch.inf).topk(64).indices]
    return torch.cat([points, _ascend(condition, start, lower, upper, steps)])


def _ascend(condition: DecreaseCondition, points: Tensor, lower: Tensor, upper: Tensor, steps: int) -> Tensor:
    """Points on the way up c, by the signs of its gradient in units of the box, with shrinking steps."""
    path = [points]
    for step in range(steps):
        with torch.enable_grad():
            leaf = path[-1].detach().requires_grad_()
            (slope,) = torch.autograd.grad(condition(leaf[:, 0], leaf[:, 1:]).sum(), leaf)
        length = 0.05 * 0.9**step * (upper - lower)
        path.append((path[-1] + length * slope.sign().nan_to_num()).clamp(lower, upper))
    return torch.cat(path)


def _values(condition: DecreaseCondition, points: Tensor) -> tuple[Tensor, Tensor]:
    with torch.no_grad():
        t, x = points[:, 0], points[:, 1:]
        return condition(t, x), condition.height(t, x)


def _lowest_violation(
    condition: DecreaseCondition, bounded: BoundedFunction, points: Tensor, level: float
) -> Counterexample | None:
    """Among points at which c > 0 and W ≤ level, by bounds too, the one of lowest W."""
    c, W = _values(condition, points)
    candidates = torch.nonzero((c > 0) & (level >= W)).flatten()
    candidates = candidates[W[candidates].argsort()][:256]
    if not len(candidates):
        return None
    (c_low, _), _ = bounded.bounds(points[candidates], points[candidates])
    candidates = candidates[c_low > 0]
    if not len(candidates):
        return None
    first = candidates[0]
    return Counterexample(float(points[first, 0]), points[first, 1:].tolist(), float(c[first]), float(W[first]))


def _under(found: Counterexample) -> float:
    return found.height - BELOW * abs(found.height)


def _just_below(value: float) -> float:
    return value - 1e-12 * abs(value)


# Least values


def minimum(
    function: Callable[[Tensor, Tensor], Tensor],
    lower: Tensor,
    upper: Tensor,
    budget: Budget,
    where: Callable[[Tensor, Tensor], Tensor] | None = None,
    level: float = float("inf"),
    enough: float = float("inf"),
    unit: float = 0.0,
    tolerance: float = 1e-3,
) -> float:
    """A lower bound of min f over boxes (boxes, 1 + n), on the part with where(t, x) ≤ level; ∞ where it is empty.

    Boxes are cut until the bound comes within tolerance · max(|min|, unit) of a value of f or reaches what is enough,
    or the budget is spent.
    """
    sides = lower.amin(0), upper.amax(0)
    bounded = BoundedFunction(lambda t, x: (function(t, x), (where or function)(t, x)), sides)
    frontier = Boxes(lower, upper, torch.full((len(lower),), -torch.inf, dtype=torch.float64))
    best, boxes = torch.inf, 0
    settled = torch.inf  # the lowest bound among boxes that need no more cutting
    while len(frontier.key) and not budget.spent(boxes):
        chunk, rest = frontier.first(budget.chunk)
        boxes += len(chunk.key)
        f, w = bounded.forms(chunk.lower, chunk.upper)
        f_low, w_low = f.interval()[0], w.interval()[0]
        center = chunk.center
        with torch.no_grad():
            at, inside = (
                function(center[:, 0], center[:, 1:]),
                (where or function)(center[:, 0], center[:, 1:]) <= level,
            )
        best = min([best, *at[inside].sort().values[:1].tolist()])
        chunk = Boxes(chunk.lower, chunk.upper, f_low)
        possible = w_low <= level
        done = f_low >= min(best - tolerance * max(abs(best), unit) if best < torch.inf else torch.inf, enough)
        settled = min([settled, *f_low[possible & done].sort().values[:1].tolist()])
        chosen = possible & ~done
        frontier = rest.joined(chunk[chosen].halves(axis_to_cut(bounded, f, chunk, chosen)))
    return min(settled, frontier.least)


def share_below(
    V: Callable[[Tensor, Tensor], Tensor], lower: Tensor, upper: Tensor, level: float, budget: Budget
) -> float:
    """A lower bound of the share by volume of a box (1 + n,) on which V ≤ level; axes of no width do not count."""
    bounded = BoundedFunction(lambda t, x: (V(t, x),), (lower, upper))
    frontier = Boxes(lower[None], upper[None], torch.zeros(1, dtype=torch.float64))
    inside, boxes = 0.0, 0
    while len(frontier.key) and not budget.spent(boxes):
        chunk, rest = frontier.first(budget.chunk)  # the largest boxes first
        boxes += len(chunk.key)
        (form,) = bounded.forms(chunk.lower, chunk.upper)
        low, high = form.interval()
        volume = chunk.volumes(lower, upper)
        inside += float(volume[high <= level].sum())
        chosen = (low <= level) & ~(high <= level) & (volume > 1e-7)
        chunk = Boxes(chunk.lower, chunk.upper, -volume / 2)
        frontier = rest.joined(chunk[chosen].halves(axis_to_cut(bounded, form, chunk, chosen)))
    return min(inside, 1.0)


def faces(lower: Tensor, upper: Tensor, axes: Iterable[int]) -> tuple[Tensor, Tensor]:
    """The faces of a box (d,) perpendicular to some of its axes, as boxes (2 · axes, d) without width there."""
    low, high = [], []
    for axis in axes:
        for side in (lower, upper):
            at = torch.arange(len(lower)) == axis
            low.append(torch.where(at, side, lower))
            high.append(torch.where(at, side, upper))
    return torch.stack(low), torch.stack(high)

"""The claim of a tube: bounds of the closed loop from each initial state, and of its cost."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from lyapnet.base.contracts import copied
from lyapnet.base.errors import Interrupted, signals_taken
from lyapnet.base.types import State
from lyapnet.claims.ignorable_states import ignorable_states
from lyapnet.claims.preconditions import over_time, slice_at_zero
from lyapnet.claims.tubes.enclosure import BINS, Cells, Enclosed, Enclosure
from lyapnet.claims.tubes.field import DEGREE, Field
from lyapnet.claims.tubes.nominal import places
from lyapnet.controller.controller import Controller
from lyapnet.prover.boxes import Boxes, root_boxes
from lyapnet.prover.branch_and_bound import Budget
from lyapnet.prover.proof import Progress, report_stage
from lyapnet.prover.verdict import Verdict, time_limit_reason
from lyapnet.prover.workers import workers_for_calls
from lyapnet.task.constraints import names_of
from lyapnet.task.sets import Box

CELLS = 128  # largest number of cells into which X₀ is cut at first
AT_ONCE = 128  # number of cells of a chunk, whose tubes take the same steps
SIMULATED = 256  # number of simulated closed loops; the largest |x_i| on them is the unit of state i
SMALLEST = 1e-9  # share of X₀ below which cells are not cut further
NOTHING_KEPT = "Stopped while certifying: the proof of a tube cannot be kept."


@dataclass(frozen=True, kw_only=True)
class ProvedTube:
    """For ẋ = f + g u with u = policy(t, x) at every t, in continuous time, and for every x₀ in one of the cells, which
    are boxes in X₀ with coordinates ε_k ∈ [−1, 1]:

        x(t) exists up to T and lies within `ranges` on each of BINS equal parts of [0, T], and x(T) within `ends`;
        h(x(t)) ≤ 0 at each t where there are constraints;
        J(x₀) = ∫ℓ dt + φ(x(T)) = P(ε(x₀)) + r, with a polynomial P of degree three and slack_low ≤ r ≤ slack_high.

    If f, g, u or ℓ jump, the claim is about Filippov's solutions. Ignorable states are fixed at 0.
    """

    duration: float
    initial_states: Box  # X₀, with ignorable states fixed at 0
    seen: Sequence[int]  # the indices of the other states
    axes: Sequence[int]  # the positions in `seen` of states along which X₀ has a width
    cells: Cells  # the proved cells, (cells, seen)
    cost: Tensor  # P, in the order of monomials(axes, DEGREE)
    slack: Tensor  # (cells, 2)
    ends: Tensor  # (cells, seen, 2)
    ranges: Tensor  # for all cells together, (BINS, seen, 2)
    volume_share: float  # share of X₀ in the cells
    violating: list[float] | None  # the middle of a cell all of whose closed loops violate a constraint
    boxes: int  # tested cells
    steps: int  # summed over the tested cells
    seconds: float
    fingerprint: str
    constraints: Sequence[str] = ()
    radius: float | None = None  # the claim requires ‖x(T) − goal‖ ≤ radius; None for no requirement
    reach: float = float("nan")  # an upper bound of ‖x(T) − goal‖
    missing: list[float] | None = None  # the middle of a cell all of whose closed loops end outside of the radius
    set_up: float = 0.0  # seconds of the budget before the first cell

    @property
    def verdict(self) -> Verdict:
        """The verdict on the claim that the cells cover X₀ and that closed loops end within the radius."""
        if self.violating is not None or self.missing is not None:
            return "falsified"
        ends = self.radius is None or self.reach <= self.radius
        return "certified" if self.volume_share >= 1 and ends else "unknown"

    @property
    def reason(self) -> str | None:
        """The reason for the verdict unknown, and advice."""
        if self.verdict != "unknown":
            return None
        if self.volume_share < 1:
            return f"{time_limit_reason(self.set_up)}: allow more"
        return "the bound of ‖x(T) − goal‖ is larger than the radius: allow more seconds, or a larger radius"

    @property
    def mean_cost(self) -> tuple[float, float]:
        """Bounds of the mean of J for x₀ uniform on the cells; nan without cells."""
        volumes = self._volumes()
        mean = self.cost[0].clone()
        for axes, k in places(len(self.axes), DEGREE).items():
            if len(axes) == 2 and axes[0] == axes[1]:
                mean += self.cost[k] / 3
        low, high = ((volumes * (mean + self.slack[:, side])).sum() / volumes.sum() for side in (0, 1))
        return float(low), float(high)

    @property
    def greatest_cost(self) -> float:
        """An upper bound of J on all cells; −∞ without cells."""
        reach = self.cost[0] + self.cost[1:].abs().sum(0) + self.slack[:, 1]
        return float(reach.max()) if len(reach) else -torch.inf

    def bounds_of_cost(self, x0: State) -> tuple[Tensor, Tensor]:
        """Bounds (low, high) of J(x₀) for states with all n components, (k, n); −∞ and ∞ outside of the cells."""
        x0 = x0.double()[:, list(self.seen)]
        low, high = torch.full((len(x0),), -torch.inf).double(), torch.full((len(x0),), torch.inf).double()
        for i, x in enumerate(x0):
            inside = torch.nonzero(((self.cells.lower <= x) & (x <= self.cells.upper)).all(-1)).flatten()
            if len(inside):
                k = inside[0]
                lower, upper = self.cells.lower[k], self.cells.upper[k]
                epsilon = ((2 * x - lower - upper) / (upper - lower))[list(self.axes)]
                P = sum(
                    self.cost[place, k] * epsilon[list(axes)].prod()
                    for axes, place in places(len(self.axes), DEGREE).items()
                )
                low[i], high[i] = P + self.slack[k, 0], P + self.slack[k, 1]
        return low, high

    def _volumes(self) -> Tensor:
        return (self.cells.upper - self.cells.lower)[:, list(self.axes)].prod(-1)


class _TubeResults:
    """The results for all cells so far."""

    def __init__(self, n: int):
        self.parts: list[tuple[Tensor, ...]] = []
        self.ranges = torch.tensor([torch.inf, -torch.inf], dtype=torch.float64).repeat(BINS, n, 1)
        self.share, self.boxes, self.steps = 0.0, 0, 0
        self.violating: list[float] | None = None

    def add(self, cells: Cells, enclosed: Enclosed, share: Tensor) -> None:
        ok, bad = enclosed.proved, torch.nonzero(enclosed.violated).flatten()
        self.boxes += len(ok)
        self.steps += enclosed.bounded
        if len(bad) and self.violating is None:
            self.violating = ((cells.lower + cells.upper)[bad[0]] / 2).tolist()
        if bool(ok.any()):
            ranges = enclosed.ranges[:, ok]
            self.ranges[..., 0] = torch.minimum(self.ranges[..., 0], ranges[..., 0].amin(1))
            self.ranges[..., 1] = torch.maximum(self.ranges[..., 1], ranges[..., 1].amax(1))
            self.parts.append((*cells[ok], enclosed.cost[:, ok].T, enclosed.cost_slack[ok], enclosed.ends[ok]))
            self.share += float(share[ok].sum())


def prove_tube(
    controller: Controller,
    budget: Budget | None = None,
    radius: float | None = None,
    report: Callable[[Progress], None] | None = None,
) -> ProvedTube:
    """Prove tubes around the closed loops from X₀ within a budget.

    X₀ is cut into cells. A cell whose tube does not reach T is cut in two, along the axis in which F is most nonlinear.

    Args:
        radius: the claim requires that closed loops end within this distance of the goal.
        report: called with stages and progress.
    """
    budget = budget or Budget()
    problem, loop = controller.problem, copied(controller.closed_loop)
    report_stage(report, budget, "calling and tracing f, g, the cost and u")
    left_out = ignorable_states(loop, problem.constraints)
    seen = [i for i in range(problem.system.n) if i not in left_out]
    X0 = slice_at_zero(problem.initial_states, left_out)
    lower, upper = X0.lower[seen], X0.upper[seen]
    axes = [i for i in range(len(seen)) if upper[i] > lower[i]]
    enclosure = _enclosure_of(controller, loop, seen)
    found, waiting = _TubeResults(len(seen)), _halve_repeatedly(root_boxes(lower[None], upper[None], 0.0), axes, CELLS)
    with torch.no_grad(), signals_taken(budget.stop.ask), workers_for_calls(enclosure, budget.workers) as answers:
        budget.stop.searching, set_up = True, budget.elapsed
        while len(waiting.key) and not budget.spent(found.boxes) and found.violating is None:
            some, waiting = _choose_cells(waiting, waiting.volumes(lower, upper), AT_ONCE * budget.workers)
            chunks = [Cells(chunk.lower, chunk.upper) for chunk in some.split(AT_ONCE)]
            results = list(answers([(cells, axes) for cells in chunks]))
            for boxes, cells, enclosed in zip(some.split(AT_ONCE), chunks, results, strict=True):
                found.add(cells, enclosed, boxes.volumes(lower, upper))
                to_cut = ~enclosed.proved & ~enclosed.violated & (boxes.volumes(lower, upper) > SMALLEST)
                if axes and bool(to_cut.any()):
                    cut_axes = _choose_axes(boxes[to_cut], enclosed.bend[to_cut], axes, lower, upper)
                    waiting = waiting.joined(boxes[to_cut].halves(cut_axes))
            if report is not None:
                report(Progress(found.boxes, max(0.0, 1 - found.share), budget.elapsed))
    if budget.stop.asked:
        raise Interrupted(NOTHING_KEPT, 130)
    return _claim_of(controller, enclosure, X0, seen, axes, found, budget, radius, set_up)


def _enclosure_of(controller: Controller, loop: Any, seen: list[int]) -> Enclosure:
    """The enclosure of the closed loop, with units from simulations."""
    problem = controller.problem
    x0 = torch.cat([controller.initial_states.corners(), controller.initial_states.sample(SIMULATED, _seeded())])
    x = controller.rollout(x0).x.double().flatten(0, -2)
    unit = x.abs().amax(0)
    unit = torch.where(unit > 0, unit, 1.0)
    around = over_time(Box(x.amin(0) - 0.1 * unit, x.amax(0) + 0.1 * unit), problem.horizon.duration)
    constraints = None if problem.constraints is None else copied(problem.constraints)
    field = Field(loop, constraints, seen, around)
    return Enclosure(field, problem.horizon.duration, problem.horizon.dt, unit[seen])


def _choose_cells(waiting: Boxes, sizes: Tensor, count: int) -> tuple[Boxes, Boxes]:
    """(the next cells, the others).

    Half of the next cells are the smallest, which are likely to be proved; half are the largest, so that small cells
    that cannot be proved do not take all of the time.
    """
    order = sizes.argsort(stable=True)
    half = min(count, len(order)) // 2
    chosen = torch.zeros(len(order), dtype=torch.bool)
    chosen[order[: min(count, len(order)) - half]] = chosen[order[len(order) - half :]] = True
    return waiting[chosen], waiting[~chosen]


def _seeded() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def _halve_repeatedly(boxes: Boxes, axes: Sequence[int], count: int) -> Boxes:
    """Halve boxes across each of the axes in turn, as long as there are at most `count` boxes."""
    turn = 0
    while axes and 2 * len(boxes.key) <= count:
        boxes = boxes.halves(torch.full((len(boxes.key),), axes[turn % len(axes)]))
        turn += 1
    return boxes


def _choose_axes(boxes: Boxes, bend: Tensor, axes: Sequence[int], lower: State, upper: State) -> Tensor:
    """The axis across which to cut each box: that of the largest bend, among those that are not too narrow."""
    widths = ((boxes.upper - boxes.lower) / (upper - lower).where(upper > lower, 1.0))[:, list(axes)]
    score = torch.where(widths >= widths.amax(-1, keepdim=True) / 64, bend + 1e-12 * widths, -1.0)
    return torch.tensor(list(axes))[score.argmax(-1)]


def _claim_of(
    controller: Controller, enclosure: Enclosure, X0: Box, seen: list[int], axes: list[int], found: _TubeResults,
    budget: Budget, radius: float | None, set_up: float,
) -> ProvedTube:  # fmt: skip
    n, terms = len(seen), len(places(len(axes), DEGREE))
    empty = [torch.zeros(0, *shape, dtype=torch.float64) for shape in ((n,), (n,), (terms,), (2,), (n, 2))]
    lower, upper, cost, slack, ends = (torch.cat(parts) for parts in zip(empty, *found.parts, strict=True))
    goal = controller.problem.goal.double()[seen]
    far, near = _distances(ends, goal)
    missing = None
    if radius is not None and bool((near > radius).any()):
        missing = ((lower + upper)[near.argmax()] / 2).tolist()
    return ProvedTube(
        duration=enclosure.duration, initial_states=X0, seen=seen, axes=axes, cells=Cells(lower, upper), cost=cost.T,
        slack=slack, ends=ends, ranges=found.ranges,
        volume_share=min(1.0, found.share) if found.share < 1 - 1e-12 else 1.0,
        violating=found.violating, boxes=found.boxes, steps=found.steps, seconds=time.monotonic() - budget.started,
        fingerprint=enclosure.field.defect.fingerprint, constraints=names_of(controller.problem.constraints),
        radius=radius, reach=float(far.max()) if len(far) else float("nan"), missing=missing, set_up=set_up,
    )  # fmt: skip


def _distances(ends: Tensor, goal: State) -> tuple[Tensor, Tensor]:
    """Bounds (greatest, least) of ‖x(T) − goal‖ for each cell; a relative 1e-12 is added for rounding."""
    low, high = ends[..., 0] - goal, ends[..., 1] - goal
    far = torch.maximum(low.abs(), high.abs()).norm(dim=-1) * (1 + 1e-12)
    near = torch.maximum(low, -high).clamp_min(0).norm(dim=-1) * (1 - 1e-12)
    return far, near

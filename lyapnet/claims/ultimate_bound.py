"""The ultimate bound of practical stability: the level above which V falls, also under every disturbance."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from lyapnet.base.types import Corner, Corners, PerState, State, Time, Value
from lyapnet.claims.preconditions import at_time
from lyapnet.claims.receding_decrease import RecedingDecrease
from lyapnet.prover.bounds import BoundedFunction, Bounds
from lyapnet.prover.boxes import Boxes, divide_box, root_box
from lyapnet.prover.branch_and_bound import Budget, Question, choose_axis, minimum, run_search
from lyapnet.prover.condition import bounded_condition
from lyapnet.prover.taylor import TaylorForm, negate, shift
from lyapnet.task.sets import Box

SAMPLES, SCALES = 5_000, 10  # number of samples in each box, and of boxes around the goal, each half as large
MARGIN = 0.01  # relative margin above the highest level at which V may rise, and around a hull, as bounds are wide
HELD_MARGIN = 0.3  # the former if u is held: V may rise by so much while a control is in use
BOXES = 30_000  # largest number of boxes for the highest level at which V may rise while a control is held
LEAST_SHARE = 0.003  # least share of D between two levels without samples at which V rises; less may be chance
PIECES = 16  # number of boxes, about, into which the box of the constants is cut
LEAST_LEVEL = 1e-6  # the smallest c under a disturbance or a held control, relative to the middle level
LEAST_LEVEL_UNDISTURBED = 1e-3  # the same without these: V may fall everywhere, and a smaller c takes more boxes


def ultimate_level(
    condition: RecedingDecrease, domain: tuple[Corner, Corner], goal: State, level: float, budget: Budget
) -> float:
    """An estimate, with a margin, of the least c with V̇ + λV ≤ 0 on {c ≤ V ≤ ρ} for some ρ; 0 if none is found.

    Samples give two levels between which the condition seems to hold. Below their mean, the highest V at which the
    condition may fail is bounded from above, on pieces of the constants' box; for steps, the highest V that they lead
    to from there. The result needs a proof.

    Args:
        condition: V̇ + λV, for V > 0.
        domain: {0} × D, extended by the box of the constants.
        level: the highest ρ.
    """
    constants = condition.closed_loop.system.constants
    between = _levels_of_fall(condition, domain, goal, level, constants)
    if between is None:
        return 0.0
    middle, bounded = sum(between) / 2, None

    def value(t: Time, x: State) -> PerState:
        return condition.values(torch.cat([t[..., None], x], -1))[1] if condition.readings else condition.V(t, x)

    def possible(t: Time, x: State) -> PerState:
        """At most 0 where V ≤ middle and the condition is ≥ 0."""
        c = condition.values(torch.cat([t[..., None], x], -1))[0] if condition.readings else condition(t, x)
        return torch.maximum(-c, value(t, x) - middle)

    room = MARGIN
    if condition.readings is not None:
        room, budget = HELD_MARGIN, replace(budget, boxes=BOXES)
        bounded = _PossibleRise(bounded_condition(condition, domain, level=level), middle)
    lower, upper = divide_box(*condition.search_box(domain), [1 + i for i in constants], PIECES)
    reached = value if condition.readings is not None else condition.level_reached
    least = (LEAST_LEVEL_UNDISTURBED if condition.is_undisturbed else LEAST_LEVEL) * middle
    highest = -minimum(
        lambda t, x: -reached(t, x).clamp_min(least), lower, upper, budget, possible, 0.0, bounded=bounded
    )
    return min(middle, max((1 + room) * highest, least))


class _PossibleRise(Bounds):
    """Bounds of −V, and of a function that is at most 0 wherever V ≤ middle and a condition may be ≥ 0."""

    def __init__(self, condition: Bounds, middle: float):
        self.condition, self.middle, self.degree = condition, middle, condition.degree

    def forms(self, lower: Corners, upper: Corners) -> list[TaylorForm]:
        c, V, *_ = self.condition.forms(lower, upper)
        above = V.interval()[0] > self.middle
        rises = shift(V, V.center.new_tensor(-self.middle))
        either = (torch.where(above, one, other) for one, other in ((rises.terms, -c.terms), (rises.radius, c.radius)))
        return [negate(V), c.with_parts(*either)]

    def on(self, device: torch.device) -> "_PossibleRise":
        """The same, for boxes on another device."""
        return _PossibleRise(self.condition.on(device), self.middle)

    @property
    def fingerprint(self) -> str:
        return self.condition.fingerprint


def _levels_of_fall(
    condition: RecedingDecrease,
    domain: tuple[Corner, Corner],
    goal: State,
    level: float,
    constants: Sequence[int],
) -> tuple[float, float] | None:
    """The two levels with the largest volume of D between them such that V falls at all samples there, or None."""
    x, weight = _sample_around_goal(*domain, goal, constants)
    points = torch.cat([x.new_zeros(len(x), 1), x], -1)
    if condition.readings is not None:  # at the end of the use of each control
        points = torch.cat([points, x.new_ones(len(x), 1)], -1)
    with torch.no_grad():
        c, value = condition.values(points)
        falls = c < 0
    within = (value > 0) & (value < level)
    rises = torch.cat([value.new_tensor([0.0, level]), value[within & ~falls]]).sort().values
    shares = value.new_zeros(len(rises) + 1)
    shares.index_add_(0, torch.searchsorted(rises, value[within & falls]), weight[within & falls])
    above = int(shares.argmax())  # the index of the upper level
    enough = shares[above] > LEAST_SHARE * weight[within].sum()
    return (float(rises[above - 1]), float(rises[above])) if enough else None


def _sample_around_goal(lower: Corner, upper: Corner, goal: State, constants: Sequence[int]) -> tuple[Tensor, Tensor]:
    """(x, weights): samples of D and of smaller and smaller boxes around the goal, for levels near 0."""
    share = torch.rand(SAMPLES, len(goal), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    x = lower[1:] + (upper - lower)[1:] * share
    scales = 0.5 ** torch.arange(SCALES, dtype=torch.float64)
    closer = goal + scales[:, None, None] * (x - goal)
    closer[..., [*constants]] = x[:, [*constants]].expand(SCALES, -1, -1)
    return closer.reshape(-1, len(goal)), scales.repeat_interleave(SAMPLES)


def extent_of(V: Value, states: Box, level: float, budget: Budget, t: float = 0.0) -> Box:
    """A box around {x ∈ D: V(t, x) ≤ level}, as tight as the budget allows; at worst D."""
    (lower,), (upper,) = at_time(t, states.lower, states.upper)
    question = HullBelow(V, BoundedFunction(lambda t, x: (V(t, x),), (lower, upper)), level)
    search = run_search(question, root_box(lower, upper), Budget(budget.left, chunk=budget.chunk))
    low, high = question.around(search.frontier)
    if search.given_up < torch.inf or not bool((low <= high).all()):
        return states
    return Box(torch.maximum(low[1:], states.lower), torch.minimum(high[1:], states.upper))


class HullBelow(Question):
    """A box around {V ≤ level}: the slightly enlarged hull of points with V ≤ level, and all undecided boxes."""

    def __init__(self, V: Value, bounded: BoundedFunction, level: float):
        self.V, self.bounded, self.level = V, bounded, level
        self.hull: tuple[Tensor, Tensor] = torch.tensor(torch.inf), torch.tensor(-torch.inf)  # of points with V ≤ level

    def find_undecided(self, boxes: Boxes) -> tuple[Boxes, Tensor]:
        (form,), x = self.bounded.forms(boxes.lower, boxes.upper), boxes.center
        with torch.no_grad():
            low = x[self.V(x[:, 0], x[:, 1:]) <= self.level]
        self.hull = _join_hulls(*self.hull, low, low)
        lower, upper = self._enlarged
        within = ((boxes.lower >= lower) & (boxes.upper <= upper)).all(-1)
        chosen = ~(form.interval()[0] > self.level) & ~within
        boxes = boxes._replace(key=-(boxes.upper - boxes.lower).sum(-1))  # the largest first
        return boxes[chosen], choose_axis(self.bounded, form, boxes, chosen)

    @property
    def _enlarged(self) -> tuple[Tensor, Tensor]:
        """The hull with a margin; boxes inside it need not be cut further."""
        lower, upper = self.hull
        room = MARGIN * (upper - lower)
        return lower - room, upper + room

    def around(self, undecided: Boxes) -> tuple[Tensor, Tensor]:
        """(lower, upper) of a box around {V ≤ level}, given the undecided boxes."""
        return _join_hulls(*self._enlarged, undecided.lower, undecided.upper)


def _join_hulls(lower: Tensor, upper: Tensor, lows: Tensor, highs: Tensor) -> tuple[Tensor, Tensor]:
    """The hull of a box and of other boxes."""
    if not len(lows):
        return lower, upper
    return torch.minimum(lower, lows.amin(0)), torch.maximum(upper, highs.amax(0))

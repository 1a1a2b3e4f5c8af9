"""Where pushes that do not fade keep closed loops: the level of V above which it falls whatever they are."""

from collections.abc import Sequence

import torch
from torch import Tensor

from lyapnet.base.types import Corner, PerState, State, Time, Value
from lyapnet.claims.preconditions import at_time
from lyapnet.prover.bounds import BoundedFunction
from lyapnet.prover.boxes import Boxes, pieces, single
from lyapnet.prover.branch_and_bound import Budget, Question, axis_to_cut, minimum, searched
from lyapnet.prover.condition import DecreaseCondition
from lyapnet.task.sets import Box

SAMPLES, SCALES = 5_000, 10  # states of D, and boxes that are drawn from, each half as large around the goal
ROOM = 0.01  # above the highest level at which V may rise, and around a hull: bounds decide nothing on the very edge
FEW = 0.003  # of what is below the highest level: what falls between two levels by chance
PIECES = 16  # of the box of the constants, about
LEAST = 1e-6  # of the levels that are tried, where V rises nowhere


def ultimate_level(
    condition: DecreaseCondition, domain: tuple[Corner, Corner], goal: State, level: float, budget: Budget
) -> float:
    """The least c that is found with V̇ + λV ≤ 0 at c ≤ V ≤ some ρ, 1 % above it; 0 where there is none.

    Samples say between which two levels the condition is to hold. Under the middle of these, the highest V at which it
    may fail is bounded from above, on pieces of the constants' box. Whether it holds from there on is for a proof to
    say.

    Args:
        condition: V̇ + λV, at V > 0.
        domain: {0} × D, and the box of the constants.
        level: no ρ is higher.
    """
    constants = condition.closed_loop.system.constants
    between = _longest_fall(condition, domain, goal, level, constants)
    if between is None:
        return 0.0
    V, middle = condition.V, sum(between) / 2

    def possible(t: Time, x: State) -> PerState:
        """At most 0 where the condition fails under the middle, or is 0."""
        return torch.maximum(-condition(t, x), V(t, x) - middle)

    lower, upper = pieces(*domain, [1 + i for i in constants], PIECES)
    highest = -minimum(lambda t, x: -V(t, x), lower, upper, budget, possible, 0.0)
    return min(middle, max((1 + ROOM) * highest, LEAST * middle))


def _longest_fall(
    condition: DecreaseCondition,
    domain: tuple[Corner, Corner],
    goal: State,
    level: float,
    constants: Sequence[int],
) -> tuple[float, float] | None:
    """The two levels between which V falls at all samples and there is most of D; None where that is little."""
    x, weight = _samples(*domain, goal, constants)
    with torch.no_grad():
        t = x.new_zeros(len(x))
        value, falls = condition.height(t, x), condition(t, x) < 0
    within = (value > 0) & (value < level)
    rises = torch.cat([value.new_tensor([0.0, level]), value[within & ~falls]]).sort().values
    of_each = value.new_zeros(len(rises) + 1)
    of_each.index_add_(0, torch.searchsorted(rises, value[within & falls]), weight[within & falls])
    above = int(of_each.argmax())  # number of levels at which V rises, below
    enough = of_each[above] > FEW * weight[within].sum()
    return (float(rises[above - 1]), float(rises[above])) if enough else None


def _samples(lower: Corner, upper: Corner, goal: State, constants: Sequence[int]) -> tuple[Tensor, Tensor]:
    """(x, weights): states of D, and of boxes ever smaller around the goal, where levels are close to each other."""
    share = torch.rand(SAMPLES, len(goal), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    x = lower[1:] + (upper - lower)[1:] * share
    scales = 0.5 ** torch.arange(SCALES, dtype=torch.float64)
    closer = goal + scales[:, None, None] * (x - goal)
    closer[..., [*constants]] = x[:, [*constants]].expand(SCALES, -1, -1)
    return closer.reshape(-1, len(goal)), scales.repeat_interleave(SAMPLES)


def extent_of(V: Value, states: Box, level: float, budget: Budget) -> Box:
    """A box around {x ∈ D: V(0, x) ≤ level}, as tight as the budget allows; D itself where time is short."""
    (lower,), (upper,) = at_time(0.0, states.lower, states.upper)
    question = HullBelow(V, BoundedFunction(lambda t, x: (V(t, x),), (lower, upper)), level)
    search = searched(question, single(lower, upper), Budget(budget.left, chunk=budget.chunk))
    low, high = question.around(search.frontier)
    if search.given_up < torch.inf or not bool((low <= high).all()):
        return states
    return Box(torch.maximum(low[1:], states.lower), torch.minimum(high[1:], states.upper))


class HullBelow(Question):
    """The hull of {V ≤ level} in a box: that of where V is seen so low, a little enlarged, and of all that is left."""

    def __init__(self, V: Value, bounded: BoundedFunction, level: float):
        self.V, self.bounded, self.level = V, bounded, level
        self.hull: tuple[Tensor, Tensor] = torch.tensor(torch.inf), torch.tensor(-torch.inf)  # of what was seen

    def undecided(self, boxes: Boxes) -> tuple[Boxes, Tensor]:
        (form,), x = self.bounded.forms(boxes.lower, boxes.upper), boxes.center
        with torch.no_grad():
            low = x[self.V(x[:, 0], x[:, 1:]) <= self.level]
        self.hull = _joined(*self.hull, low, low)
        lower, upper = self._enlarged
        within = ((boxes.lower >= lower) & (boxes.upper <= upper)).all(-1)
        chosen = ~(form.interval()[0] > self.level) & ~within
        boxes = boxes._replace(key=-(boxes.upper - boxes.lower).sum(-1))  # the largest first
        return boxes[chosen], axis_to_cut(self.bounded, form, boxes, chosen)

    @property
    def _enlarged(self) -> tuple[Tensor, Tensor]:
        """The hull in which a box needs no more cutting."""
        lower, upper = self.hull
        room = ROOM * (upper - lower)
        return lower - room, upper + room

    def around(self, left: Boxes) -> tuple[Tensor, Tensor]:
        """(lower, upper) of a box around {V ≤ level}, where some boxes are left."""
        return _joined(*self._enlarged, left.lower, left.upper)


def _joined(lower: Tensor, upper: Tensor, lows: Tensor, highs: Tensor) -> tuple[Tensor, Tensor]:
    """The hull of a box and of some others."""
    if not len(lows):
        return lower, upper
    return torch.minimum(lower, lows.amin(0)), torch.maximum(upper, highs.amax(0))

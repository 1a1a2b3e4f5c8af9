"""Bounds of a condition along the use of each control of a law that is read at times and held.

After a reading at (t̂, x̂) the control in use is u = policy(t̂, x̂ + e) + r from some time on. With F = f + gu,

    x(t̂ + a) = x̂ + a (F(x̂, u) + Δ),

where Δ is the mean of F(x(τ), u(τ)) − F(x̂, u), and of a disturbance, over the time since the reading. With bounds of Δ
after readings in a box, the condition at (t̂ + a, x, u) is a function of (t̂, x̂, a, Δ, e, r) with bounds. The search cuts
boxes of (t̂, x̂, a). Bounds hold for every sequence of readings: nothing is simulated.
"""

import copy
import hashlib
from collections.abc import Callable, Sequence
from functools import cache

import torch
from torch import Tensor
from torch.utils._pytree import tree_map_only

from lyapnet.base.types import Control, Corner, Corners, OnBoxes, Points, State, Time, Value
from lyapnet.loop.rollout.closed_loop import ClosedLoop
from lyapnet.prover.bounds import BoundedFunction, Bounds
from lyapnet.prover.boxes import pieces
from lyapnet.prover.readings import Readings, Run
from lyapnet.prover.taylor import EPSILON, TaylorForm, monomials, wide_axes

PIECES = 4096  # boxes into which the domain is cut, about, to bound controls and speeds on all of it
GUESSES, ROOM = 3, 0.1  # guesses of the speeds within the use of a control, each wider by this share than the last
ENCLOSURES = 6  # enclosures of the states before a reading, each with the speeds in the one before
TINY = 1e-12  # by which a guess of a speed is wider at least

Sides = tuple[Tensor, Tensor]  # lower and upper bounds, (boxes, …) each


class BoundedReadings(Bounds):
    """Parts of a condition along the use of each control, with bounds on boxes of readings (t̂, x̂).

    Args:
        parts: (t, x, u) ↦ (c, W, …) at the states that the closed loop meets.
        loop: the closed loop, in float64.
        domain: a box of (t, x) in which the closed loop has been since t = 0.
        height, level: W, which is taken at the reading; the closed loop has been in {W ≤ level} since t = 0.
        still: constants, and states on which nothing depends: their derivative is taken as 0.
        push: the largest disturbance of ẋ, (n,); None without one.
    """

    def __init__(
        self,
        parts: Callable[[Time, State, Control], tuple[Tensor, ...]],
        loop: ClosedLoop,
        readings: Readings,
        domain: tuple[Corner, Corner],
        height: Value,
        level: float,
        still: Sequence[int],
        push: State | None = None,
        degree: int = 2,
    ):
        n, m, (lower, upper) = len(readings.errors), len(readings.control_errors), domain
        self.readings, self.domain, self.degree, self.n = readings, domain, degree, n
        self._errors, self._control_errors = (
            torch.tensor(each, dtype=torch.float64) for each in (readings.errors, readings.control_errors)
        )
        moves = torch.tensor([float(i not in still) for i in range(n)], dtype=torch.float64)
        self._push = torch.zeros_like(moves) if push is None else push * moves

        def rate(x: State, u: Control) -> State:
            return loop.system.dynamics(x, u) * moves

        def change(t: Time, y: Tensor) -> tuple[State]:
            """F(x + q, u + w) − F(x, u) for y = (x, q, u, w)."""
            x, q, u, w = y[:n], y[n : 2 * n], y[2 * n : 2 * n + m], y[2 * n + m :]
            return (rate(x + q, u + w) - rate(x, u),)

        def along(t: Time, y: Tensor) -> tuple[Tensor, ...]:
            """The parts after a reading at (t, x), for y = (x, a/span, Δ, e, r)."""
            x, share, drift, e, r = y[:n], y[n], y[n + 1 : 2 * n + 1], y[2 * n + 1 : 3 * n + 1], y[3 * n + 1 :]
            u, age = readings.control(loop, t, x, e, r), share * readings.span(t)
            c, _, *others = parts(t + age, x + age * (rate(x, u) + drift), u)
            return c, height(t, x), *others

        one, step = torch.ones(m, dtype=torch.float64), (upper - lower)[1:] / PIECES
        self._law = BoundedFunction(lambda t, x: (loop.policy(t, x),), domain)
        self._rate = BoundedFunction(
            lambda t, y: (rate(y[:n], y[n:]),), (torch.cat([lower, -one]), torch.cat([upper, one]))
        )
        self._change = BoundedFunction(
            change, (torch.cat([lower, -step, -one, -one]), torch.cat([upper, step, one, one]))
        )
        self._range, self._fastest = self._whole_ranges(height, level)
        at_reading = torch.zeros(2 * n + m + 1, dtype=torch.float64)
        at_end = torch.nn.functional.one_hot(torch.tensor(0), len(at_reading)).double()
        self._parts = BoundedFunction(along, (torch.cat([lower, at_reading]), torch.cat([upper, at_end])), degree)

    def forms(self, lower: Corners, upper: Corners) -> list[TaylorForm]:
        """The parts on boxes of (t̂, x̂, a/span), (boxes, n + 2) each, as Taylor forms in the coordinates of the box."""
        low, high = self._drift(lower[:, :-1], upper[:, :-1], self.readings.longest * upper[:, -1:])
        off, count = torch.cat([self._errors, self._control_errors]).expand(len(lower), -1), wide_axes(lower, upper)
        found = self._parts.forms(torch.cat([lower, low, -off], -1), torch.cat([upper, high, off], -1))
        return [_in_first_axes(each, len(count)) for each in found]

    def at(self, points: Points, run: Run) -> list[tuple[OnBoxes, OnBoxes]]:
        """Bounds of the parts at points (t̂, x̂, a/span), (points, n + 2), for known states of closed loops there."""
        every = torch.cat([points, run.drift, run.e, run.r], -1)
        return self._parts.bounds(every, every)

    def on(self, device: torch.device) -> "BoundedReadings":
        """The same parts, for boxes on another device."""
        other = copy.copy(self)
        for name, value in vars(self).items():
            if isinstance(value, BoundedFunction):
                setattr(other, name, value.on(device))
            elif isinstance(value, Tensor | tuple):
                setattr(other, name, tree_map_only(Tensor, lambda part: part.to(device), value))
        return other

    @property
    def fingerprint(self) -> str:
        """A hash of the traced parts, law and dynamics."""
        traced = (self._parts, self._law, self._rate)
        return hashlib.sha256(" ".join(each.fingerprint for each in traced).encode()).hexdigest()

    def _drift(self, lower: Corners, upper: Corners, age: Tensor) -> Sides:
        """Bounds of Δ up to an age, (boxes, 1), of readings in boxes of (t̂, x̂); infinite where none are proved."""
        x, controls = (lower[:, 1:], upper[:, 1:]), self._controls(lower, upper)
        none = torch.zeros_like(controls[0]), torch.zeros_like(controls[1])
        if not self.readings.delay:
            return self._changes(x, self._moved_in_use(x, controls, age), controls, none)
        speeds, earlier = self._before_use(lower, upper)
        before = _displacements(*speeds, self.readings.delay)
        moved = _sum(before, self._moved_in_use(_sum(x, before), controls, age))
        waiting = self._changes(x, before, controls, _sum(earlier, (-controls[1], -controls[0])))
        in_use = self._changes(x, moved, controls, none)
        return waiting[0].minimum(in_use[0]), waiting[1].maximum(in_use[1])

    def _changes(self, x: Sides, moved: Sides, controls: Sides, other: Sides) -> Sides:
        """Bounds of F(x + q, u + w) − F(x, u), and a disturbance, for x, q, u and w between bounds."""
        time = torch.zeros_like(x[0][:, :1])
        inputs = (torch.cat([time, *ends], -1) for ends in zip(x, moved, controls, other, strict=True))
        ((low, high),) = self._change.bounds(*inputs)
        return low - self._push, high + self._push

    def _moved_in_use(self, start: Sides, controls: Sides, age: Tensor) -> Sides:
        """Bounds of how far closed loops from `start` move while a control is in use, up to an age of its reading.

        Those that start in a box B stay in B + [0, s][v] for s seconds if ẋ ∈ [v] there (Picard). Guesses of [v] are
        tried; where none is proved, the bounds are infinite.
        """
        low, high = self._rates(*start, *controls)
        proved = torch.zeros_like(low[:, :1], dtype=torch.bool)
        slowest, fastest = torch.full_like(low, -torch.inf), torch.full_like(high, torch.inf)
        for k in range(GUESSES):
            wider = ROOM * (k + 1) * (high - low) + TINY
            low, high = low - wider, high + wider
            states = _sum(start, _displacements(low, high, age))
            found = self._rates(*states, *controls)
            holds = ((low <= found[0]) & (found[1] <= high)).all(-1, keepdim=True) & ~proved
            slowest, fastest = found[0].where(holds, slowest), found[1].where(holds, fastest)
            proved, (low, high) = proved | holds, found
        return _displacements(slowest, fastest, age)

    def _before_use(self, lower: Corners, upper: Corners) -> tuple[Sides, Sides]:
        """Bounds of ẋ, and of the controls in use, from a reading in a box of (t, x) on until its control is used.

        These controls were read before, but not earlier than `longest` before t̂. Where all states of these times are
        known to lie, controls and speeds have bounds: at first those of all states, then closer ones that follow. The
        k-th box from the last has to reach k times so far back, that of its readings once more.
        """
        fastest = self._fastest
        speeds = controls = -fastest.expand(len(lower), -1), fastest.expand(len(lower), -1)
        for k in reversed(range(ENCLOSURES)):
            controls = self._controls(*self._around(lower, upper, speeds, (k + 1) * self.readings.longest, 0.0))
            states = self._around(lower, upper, speeds, k * self.readings.longest, self.readings.delay)
            low, high = self._rates(states[0][:, 1:], states[1][:, 1:], *controls)
            speeds = low.maximum(-fastest), high.minimum(fastest)
        return speeds, controls

    def _around(self, lower: Corners, upper: Corners, speeds: Sides, back: float, on: float) -> Sides:
        """Boxes around all (t + τ, x(t + τ)) with −back ≤ τ ≤ on, in the domain."""
        earlier, later = _displacements(-speeds[1], -speeds[0], back), _displacements(*speeds, on)
        low, high = _sum((lower[:, 1:], upper[:, 1:]), (earlier[0].minimum(later[0]), earlier[1].maximum(later[1])))
        span = 0.0 if self.readings.receding else 1.0
        times = (
            lower[:, :1] - span * back * (1 + 4 * EPSILON),
            upper[:, :1] + span * on * (1 + 4 * EPSILON),
        )  # fmt: skip
        first, last = self.domain
        return torch.cat([times[0], low], -1).maximum(first), torch.cat([times[1], high], -1).minimum(last)

    def _whole_ranges(self, height: Value, level: float) -> tuple[Sides, State]:
        """(bounds of the controls, a bound of |ẋ_i|) in the domain where height ≤ level."""
        lower, upper = pieces(*self.domain, range(1 + self.n), PIECES)
        ((heights, _),) = BoundedFunction(lambda t, x: (height(t, x),), self.domain).bounds(lower, upper)
        if not bool((heights > level).all()):  # else no closed loop is there, and any bounds hold
            lower, upper = lower[~(heights > level)], upper[~(heights > level)]
        least, most = self._controls_read(lower, upper)
        controls = least.amin(0), most.amax(0)
        low, high = self._rates(lower[:, 1:], upper[:, 1:], *(side.expand(len(lower), -1) for side in controls))
        return controls, torch.maximum(-low, high).amax(0)

    def _controls(self, lower: Corners, upper: Corners) -> Sides:
        """Bounds of the controls that are read in boxes of (t, x), where the closed loop can be."""
        low, high = self._controls_read(lower, upper)
        return low.maximum(self._range[0]), high.minimum(self._range[1])

    def _controls_read(self, lower: Corners, upper: Corners) -> Sides:
        """Bounds of the controls that are read in boxes of (t, x)."""
        errors = torch.cat([torch.zeros(1, dtype=torch.float64).to(lower), self._errors])
        ((low, high),) = self._law.bounds(lower - errors, upper + errors)
        return low - self._control_errors, high + self._control_errors

    def _rates(self, lower: State, upper: State, least: Control, most: Control) -> Sides:
        """Bounds of ẋ on boxes of states with controls between bounds."""
        none = torch.zeros_like(lower[:, :1])
        ((low, high),) = self._rate.bounds(torch.cat([none, lower, least], -1), torch.cat([none, upper, most], -1))
        return low - self._push, high + self._push


def _displacements(low: State, high: State, span: float | Tensor) -> Sides:
    """Bounds of x(s) − x(0) for 0 ≤ s ≤ span and low ≤ ẋ ≤ high, with room for rounding."""
    span = span * (1 + 4 * EPSILON)
    return span * low.clamp_max(0), span * high.clamp_min(0)


def _sum(one: Sides, other: Sides) -> Sides:
    """Bounds of a sum, with room for rounding."""
    low, high = one[0] + other[0], one[1] + other[1]
    room = 2 * EPSILON * (one[0].abs() + one[1].abs() + other[0].abs() + other[1].abs())
    return low - room, high + room


def _in_first_axes(form: TaylorForm, count: int) -> TaylorForm:
    """A form in the first `count` coordinates of a box: terms with others go into the center and the remainder.

    |ε_j ε_k| ≤ 1, and 0 ≤ ε_k² ≤ 1 for the square of another coordinate.
    """
    kept, squares, others = _terms_by_axes(form.dimension, form.degree, count)
    terms, half = form.terms[kept].clone(), form.terms[squares] / 2
    terms[0] += half.sum(0)
    radius = form.radius + half.abs().sum(0) + form.terms[others].abs().sum(0)
    return TaylorForm(terms, radius, count).with_rounding(len(form.terms))


@cache
def _terms_by_axes(dimension: int, degree: int, count: int) -> tuple[list[int], list[int], list[int]]:
    """The places of the terms in the first `count` coordinates alone, of squares of another one, and of all others."""
    every = monomials(dimension, degree)
    kept = [k for k, axes in enumerate(every) if all(axis < count for axis in axes)]
    squares = [k for k, axes in enumerate(every) if len(axes) == 2 and axes[0] == axes[1] >= count]
    others = {*range(len(every))} - {*kept, *squares}
    return kept, squares, sorted(others)

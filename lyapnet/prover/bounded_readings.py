"""Bounds of a condition while a control is held that was computed from an earlier reading (lyapnet.prover.readings).

A reading at (t̂, x̂) gives u = policy(t̂, x̂ + e) + r, which is used from some time on. With F(x, u) = f + gu,

    x(t̂ + a) = x̂ + a (F(x̂, u) + Δ),

where Δ is the mean of F(x(τ), u(τ)) − F(x̂, u) plus a disturbance over the time τ since the reading. First Δ is bounded
for all readings in a box; the condition at (t̂ + a, x(t̂ + a), u) is then a function of (t̂, x̂, a, Δ, e, r), which is
bounded as usual. The search cuts boxes of (t̂, x̂, a). The bounds hold for every sequence of readings.
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
from lyapnet.prover.boxes import divide_box
from lyapnet.prover.readings import Readings, Run
from lyapnet.prover.taylor import EPSILON, TaylorForm, monomials, wide_axes

DOMAIN_PIECES = 4096  # number of boxes, about, into which the domain is cut to bound controls and speeds on all of it
GUESSES = 3  # largest number of guesses [v] of ẋ while a control is in use
WIDENING = 0.1  # widening of the first guess relative to the last known range; guess k is widened k times as much
LEAST_WIDENING = 1e-12  # least widening of a guess, in the unit of ẋ
ENCLOSURES = 6  # number of successive enclosures of the states before a reading, each with the speeds of the one before

Sides = tuple[Tensor, Tensor]  # lower and upper bounds, (boxes, …) each


class BoundedReadings(Bounds):
    """Parts (c, W, …) of a condition on boxes of (t̂, x̂, a/span), for all controls that the readings allow.

    Args:
        parts: (t, x, u) ↦ (c, W, …) at a state x of the closed loop with the control u in use.
        loop: the closed loop, in float64.
        domain: a box of (t, x) in which the closed loop has been since t = 0.
        height, level: W and a level; the closed loop has been in {W ≤ level} since t = 0. W is evaluated at (t̂, x̂).
        still: indices of constants, and of states on which nothing depends: their derivative is taken as 0.
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

        one, step = torch.ones(m, dtype=torch.float64), (upper - lower)[1:] / DOMAIN_PIECES
        self._law = BoundedFunction(lambda t, x: (loop.policy(t, x),), domain)
        self._rate = BoundedFunction(
            lambda t, y: (rate(y[:n], y[n:]),), (torch.cat([lower, -one]), torch.cat([upper, one]))
        )
        self._change = BoundedFunction(
            change, (torch.cat([lower, -step, -one, -one]), torch.cat([upper, step, one, one]))
        )
        self._range, self._fastest = self._bound_whole_ranges(height, level)
        at_reading = torch.zeros(2 * n + m + 1, dtype=torch.float64)
        at_end = torch.nn.functional.one_hot(torch.tensor(0), len(at_reading)).double()
        self._parts = BoundedFunction(along, (torch.cat([lower, at_reading]), torch.cat([upper, at_end])), degree)

    def forms(self, lower: Corners, upper: Corners) -> list[TaylorForm]:
        """The parts on boxes of (t̂, x̂, a/span), (boxes, n + 2), as Taylor forms in the coordinates of each box."""
        low, high = self._bound_drift(lower[:, :-1], upper[:, :-1], self.readings.longest * upper[:, -1:])
        off, count = torch.cat([self._errors, self._control_errors]).expand(len(lower), -1), wide_axes(lower, upper)
        found = self._parts.forms(torch.cat([lower, low, -off], -1), torch.cat([upper, high, off], -1))
        return [_restrict_to_axes(each, len(count)) for each in found]

    def at(self, points: Points, run: Run) -> list[tuple[OnBoxes, OnBoxes]]:
        """Bounds of the parts at points (t̂, x̂, a/span), (points, n + 2), for a known run of the closed loop to each."""
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

    def _bound_drift(self, lower: Corners, upper: Corners, age: Tensor) -> Sides:
        """Bounds of Δ up to `age` seconds, (boxes, 1), after readings in boxes of (t̂, x̂); infinite if unknown."""
        x, controls = (lower[:, 1:], upper[:, 1:]), self._bound_controls(lower, upper)
        none = torch.zeros_like(controls[0]), torch.zeros_like(controls[1])
        if not self.readings.delay:
            return self._bound_changes(x, self._bound_motion_in_use(x, controls, age), controls, none)
        speeds, earlier = self._bound_before_use(lower, upper)
        before = _bound_displacements(*speeds, self.readings.delay)
        moved = _add_bounds(before, self._bound_motion_in_use(_add_bounds(x, before), controls, age))
        waiting = self._bound_changes(x, before, controls, _add_bounds(earlier, (-controls[1], -controls[0])))
        in_use = self._bound_changes(x, moved, controls, none)
        return waiting[0].minimum(in_use[0]), waiting[1].maximum(in_use[1])

    def _bound_changes(self, x: Sides, moved: Sides, controls: Sides, other: Sides) -> Sides:
        """Bounds of F(x + q, u + w) − F(x, u) plus a disturbance; q is `moved`, u is `controls` and w is `other`."""
        time = torch.zeros_like(x[0][:, :1])
        inputs = (torch.cat([time, *ends], -1) for ends in zip(x, moved, controls, other, strict=True))
        ((low, high),) = self._change.bounds(*inputs)
        return low - self._push, high + self._push

    def _bound_motion_in_use(self, start: Sides, controls: Sides, age: Tensor) -> Sides:
        """Bounds of the motion of closed loops from `start` while a control is in use, until `age` after its reading.

        Closed loops that start in a box B stay in B + [0, s][v] for s seconds if ẋ ∈ [v] on that set (Picard). Several
        [v] are tried; where this holds for none, the bounds are infinite.
        """
        low, high = self._bound_rates(*start, *controls)
        proved = torch.zeros_like(low[:, :1], dtype=torch.bool)
        slowest, fastest = torch.full_like(low, -torch.inf), torch.full_like(high, torch.inf)
        for k in range(GUESSES):
            wider = WIDENING * (k + 1) * (high - low) + LEAST_WIDENING
            low, high = low - wider, high + wider
            states = _add_bounds(start, _bound_displacements(low, high, age))
            found = self._bound_rates(*states, *controls)
            holds = ((low <= found[0]) & (found[1] <= high)).all(-1, keepdim=True) & ~proved
            slowest, fastest = found[0].where(holds, slowest), found[1].where(holds, fastest)
            proved, (low, high) = proved | holds, found
        return _bound_displacements(slowest, fastest, age)

    def _bound_before_use(self, lower: Corners, upper: Corners) -> tuple[Sides, Sides]:
        """Bounds of ẋ, and of the controls in use, from a reading in a box of (t, x) until its control is used.

        Controls in use at a time were read at most `longest` before. So an enclosure of the states from k · longest
        before t̂ on bounds ẋ there by the controls read from (k + 1) · longest before on. It follows from bounds of ẋ on
        the enclosure for k + 1; the first one takes the bounds of ẋ on the whole domain.
        """
        fastest = self._fastest
        speeds = controls = -fastest.expand(len(lower), -1), fastest.expand(len(lower), -1)
        for k in reversed(range(ENCLOSURES)):
            controls = self._bound_controls(
                *self._enclose_times(lower, upper, speeds, (k + 1) * self.readings.longest, 0.0)
            )
            states = self._enclose_times(lower, upper, speeds, k * self.readings.longest, self.readings.delay)
            low, high = self._bound_rates(states[0][:, 1:], states[1][:, 1:], *controls)
            speeds = low.maximum(-fastest), high.minimum(fastest)
        return speeds, controls

    def _enclose_times(self, lower: Corners, upper: Corners, speeds: Sides, back: float, on: float) -> Sides:
        """Boxes that contain all (t + τ, x(t + τ)) with −back ≤ τ ≤ on, cut to the domain."""
        earlier, later = _bound_displacements(-speeds[1], -speeds[0], back), _bound_displacements(*speeds, on)
        low, high = _add_bounds(
            (lower[:, 1:], upper[:, 1:]), (earlier[0].minimum(later[0]), earlier[1].maximum(later[1]))
        )
        span = 0.0 if self.readings.receding else 1.0
        times = (
            lower[:, :1] - span * back * (1 + 4 * EPSILON),
            upper[:, :1] + span * on * (1 + 4 * EPSILON),
        )  # fmt: skip
        first, last = self.domain
        return torch.cat([times[0], low], -1).maximum(first), torch.cat([times[1], high], -1).minimum(last)

    def _bound_whole_ranges(self, height: Value, level: float) -> tuple[Sides, State]:
        """(bounds of the controls, a bound of |ẋ_i|) in the domain where height ≤ level."""
        lower, upper = divide_box(*self.domain, range(1 + self.n), DOMAIN_PIECES)
        ((heights, _),) = BoundedFunction(lambda t, x: (height(t, x),), self.domain).bounds(lower, upper)
        if not bool((heights > level).all()):  # else no closed loop is there, and any bounds hold
            lower, upper = lower[~(heights > level)], upper[~(heights > level)]
        least, most = self._bound_controls_read(lower, upper)
        controls = least.amin(0), most.amax(0)
        low, high = self._bound_rates(lower[:, 1:], upper[:, 1:], *(side.expand(len(lower), -1) for side in controls))
        return controls, torch.maximum(-low, high).amax(0)

    def _bound_controls(self, lower: Corners, upper: Corners) -> Sides:
        """Bounds of the controls of readings in boxes of (t, x), also by the range of controls on {height ≤ level}."""
        low, high = self._bound_controls_read(lower, upper)
        return low.maximum(self._range[0]), high.minimum(self._range[1])

    def _bound_controls_read(self, lower: Corners, upper: Corners) -> Sides:
        """Bounds of the controls of readings in boxes of (t, x), with their errors."""
        errors = torch.cat([torch.zeros(1, dtype=torch.float64).to(lower), self._errors])
        ((low, high),) = self._law.bounds(lower - errors, upper + errors)
        return low - self._control_errors, high + self._control_errors

    def _bound_rates(self, lower: State, upper: State, least: Control, most: Control) -> Sides:
        """Bounds of ẋ on boxes of states with controls between bounds."""
        none = torch.zeros_like(lower[:, :1])
        ((low, high),) = self._rate.bounds(torch.cat([none, lower, least], -1), torch.cat([none, upper, most], -1))
        return low - self._push, high + self._push


def _bound_displacements(low: State, high: State, span: float | Tensor) -> Sides:
    """Bounds of x(s) − x(0) for 0 ≤ s ≤ span and low ≤ ẋ ≤ high, with room for rounding."""
    span = span * (1 + 4 * EPSILON)
    return span * low.clamp_max(0), span * high.clamp_min(0)


def _add_bounds(one: Sides, other: Sides) -> Sides:
    """Bounds of a sum, with room for rounding."""
    low, high = one[0] + other[0], one[1] + other[1]
    room = 2 * EPSILON * (one[0].abs() + one[1].abs() + other[0].abs() + other[1].abs())
    return low - room, high + room


def _restrict_to_axes(form: TaylorForm, count: int) -> TaylorForm:
    """A form in the first `count` coordinates of a box; terms with other coordinates go into the center and r.

    Squares of other coordinates lie in [0, 1], so c takes half of their term; all other terms lie in ± their size.
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

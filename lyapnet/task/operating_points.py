"""Operating points: states x* that a control u* holds, f(x*) + g(x*)u* = 0, with some components given."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lyapnet.base.types import Control, State
from lyapnet.task.sets import Box, ControlSet
from lyapnet.task.systems import ControlSystem

HELD = 1e-9  # largest rate of a held state, in units of the rates on X₀
INITIAL_GUESSES = 8  # initial states in X₀, and as many in a box twice as wide and in one ten times as wide
RATE_STATES = 64  # states of X₀ that give the units of the rates
CENTRE_WEIGHT = 1e-3  # weight of the distance from X₀'s centre, relative to the rates, in the least squares problem
CONTROL_WEIGHT = 1e-2  # weight of the controls in that distance
SAME_POINT_DISTANCE = 1e-6  # distance below which two points count as equal, in units of X₀
ZERO_TOLERANCE = 1e-12  # components below this count as zero, in their units
MAX_STEPS = 40  # iterations of Newton's method
MAX_ROUNDING_MOVE = 1e-2  # largest change of a given component that counts as rounding, in units of X₀'s extent
ALWAYS_ALLOWED_MOVE = 1e-3  # change that always counts as rounding, in units of X₀'s extent


class OperatingPoint(NamedTuple):
    """A state and the control that holds it."""

    x: State  # x*, (n,)
    u: Control  # u*, (m,)
    rate: State  # remaining ẋ, (n,), in units of the rates on X₀
    admitted: bool  # whether x* and u* are within their limits

    @property
    def held(self) -> bool:
        """Whether ẋ is zero up to rounding."""
        return bool(self.rate.abs().max() <= HELD)


class OperatingPoints:
    """The search for operating points of a system near X₀.

    States are in units of X₀'s extents (if zero, of the state itself, or 1), rates in units of the largest on X₀, and
    controls in units of their limits, or of the controls that hold states of X₀.

    Args:
        system: f and g, in float64.
        controls: U.
        initial_states: X₀; points near its centre are preferred.
        state_limits: smallest and largest values of states, (n,) each; None: there are none.
    """

    def __init__(
        self,
        system: ControlSystem,
        controls: ControlSet,
        initial_states: Box,
        state_limits: tuple[Tensor, Tensor] | None = None,
    ):
        self.system, self.controls, self.box = system, controls, initial_states
        unlimited = torch.full((system.n,), torch.inf, dtype=torch.float64)
        self.state_limits = (-unlimited, unlimited) if state_limits is None else state_limits
        self.center = initial_states.center.double()
        width, size = initial_states.widths.double(), self.center.abs()
        self.extent = width.where(width > 0, size.where(size > 0, 1.0))
        self.low, self.high = (torch.full((system.m,), sign * torch.inf, dtype=torch.float64) for sign in (-1, 1))
        if controls.limits is not None:
            self.low, self.high = (side.double().expand(system.m).clone() for side in controls.limits)
        with torch.no_grad():
            x = initial_states.sample(RATE_STATES, torch.Generator().manual_seed(0)).double()
            f, g = (part.nan_to_num(0, 0, 0) for part in system.affine_model(x, x.new_zeros(len(x), system.m)))
            holding = (torch.linalg.pinv(g) @ f[..., None])[..., 0].abs().amax(0)
            limits = torch.stack([self.low.abs(), self.high.abs()]).nan_to_num(posinf=0).amax(0)
            usual = limits.where(limits > 0, holding)
            self.control = usual.where(usual > 0, 1.0)
            rate = (f.abs() + (g.abs() * self.control).sum(-1)).amax(0)
        self.rate = rate.where(rate > 0, 1.0)

    def held_by(self, x: State) -> OperatingPoint:
        """A state with the control that holds it best: the least squares solution of least norm."""
        return self._point(x, self.system.holding_control(x)[0])

    def find(self, given: Mapping[int, float]) -> list[OperatingPoint]:
        """The points with given components, sorted by distance from X₀'s centre; points outside the limits come last.

        If the points form a curve or a surface, only the nearest one with a control of least norm is returned. If there
        is none, the point with the smallest rates is returned.

        Args:
            given: the given components of x* by their indices.
        """
        found, best = list[OperatingPoint](), list[OperatingPoint]()
        for x in self._initial_guesses(given):
            for bounded in (True, False):
                point, isolated = self._solve_from(x, [*given], self.center, bounded)
                if point is None:
                    continue
                best.append(point)
                if not point.held:
                    continue
                if not any(self._same(point, other) for other in found):
                    found.append(point)
                if not isolated:
                    return [point]
                break
        if not found:
            return sorted(best, key=lambda point: float(point.rate.norm()))[:1]
        return sorted(found, key=lambda point: (not point.admitted, self.distance(point.x)))

    def nearest(self, x: State, moved: Sequence[int]) -> OperatingPoint | None:
        """The operating point nearest to a state that differs from it only in some components; None if not found."""
        kept = [i for i in range(self.system.n) if i not in moved]
        for bounded in (True, False):
            point, _ = self._solve_from(x, kept, x, bounded)
            if point is not None and point.held:
                return point
        return None

    def to_move(self, x: State, given: Mapping[int, float]) -> list[int]:
        """The components to change in an almost held state so that it is held: few, and those given with many digits.

        They minimise Σ w_i |Δx_i| / extent_i to first order, a linear program with a sparse solution. The weight w_i is
        10⁻ᵈ for a component given with d digits, because 15 is probably exact and 0.4541 rounded, and 0 if not given.
        """
        from scipy.optimize import linprog  # imported here because it takes 0.25 s

        n, m = self.system.n, self.system.m
        u = self.system.holding_control(x)[0]
        rate, by_x, by_u = self._rates(x, u)
        weight = np.array([10.0 ** -_digits(given[i]) if i in given else 0.0 for i in range(n)])
        matrix = np.concatenate([by_x, -by_x, by_u, -by_u], 1)
        try:
            found = linprog(np.concatenate([weight, weight, np.zeros(2 * m)]), A_eq=matrix, b_eq=-rate)
        except ValueError:  # f or its slope is not finite there
            return []
        if not found.success:
            return []
        move = np.abs(found.x[:n] - found.x[n : 2 * n])
        return [i for i in range(n) if i not in given or move[i] > 1e-14 * max(1.0, move.max())]

    def is_rounding(self, given: Mapping[int, float], after: State) -> bool:
        """Whether given components changed by rounding: at most half a unit of their last digit, and little of X₀.

        A component with one digit may only change by ALWAYS_ALLOWED_MOVE.
        """
        for i, number in given.items():
            extent = float(self.extent[i])
            written = 0.5 * _last_digit(number) if _digits(number) > 1 else 0.0
            if abs(float(after[i]) - number) > max(
                min(written, MAX_ROUNDING_MOVE * extent), ALWAYS_ALLOWED_MOVE * extent
            ):
                return False
        return True

    def distance(self, x: State) -> float:
        """The distance of a state from X₀'s centre, in units of X₀'s extents; angles modulo 2π."""
        return float(self._difference(x, self.center).norm())

    def _difference(self, x: State, y: State) -> Tensor:
        apart = x - y
        for i in self.system.angles:
            apart[i] -= 2 * torch.pi * torch.round(apart[i] / (2 * torch.pi))
        return apart / self.extent

    def _same(self, one: OperatingPoint, other: OperatingPoint) -> bool:
        apart = torch.cat([self._difference(one.x, other.x), (one.u - other.u) / self.control])
        return bool(apart.abs().max() <= SAME_POINT_DISTANCE)

    def _initial_guesses(self, given: Mapping[int, float]) -> Iterator[State]:
        generator = torch.Generator().manual_seed(0)
        inside = self.box.sample(INITIAL_GUESSES - 1, generator).double()
        unit = 2 * torch.rand(2, INITIAL_GUESSES, self.system.n, generator=generator, dtype=torch.float64) - 1
        x = torch.cat(
            [
                self.center[None],
                inside,
                *(self.center + times * self.extent * unit[k] for k, times in enumerate((1, 5))),
            ]
        )
        for i, number in given.items():
            x[:, i] = number
        yield from x

    def _point(self, x: State, u: Control) -> OperatingPoint:
        with torch.no_grad():
            f, g = self.system.affine_model(x, u)
            rate = (f + g @ u) / self.rate
        within = [
            bool((x[i] >= low) & (x[i] <= high)) for i, (low, high) in enumerate(zip(*self.state_limits, strict=True))
        ]
        return OperatingPoint(x.detach(), u.detach() + 0.0, rate, bool(self.controls.contains(u)) and all(within))

    def _rates(self, x: State, u: Control) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """ẋ and its Jacobians in x and u, all in scaled units."""
        n = self.system.n
        with torch.enable_grad():
            copies = x.detach().expand(n, n).clone().requires_grad_()  # all rows of the Jacobian in one backward pass
            f, g = self.system.affine_model(copies, u.detach().expand(n, -1))
            rate = f + (g @ u.detach()[:, None])[..., 0]
            by_x = torch.zeros(n, n, dtype=torch.float64)
            if rate.requires_grad:
                (by_x,) = torch.autograd.grad(rate.diagonal().sum(), copies, materialize_grads=True)
        by_x, by_u = by_x * self.extent / self.rate[:, None], g[0].detach() * self.control / self.rate[:, None]
        return (rate[0].detach() / self.rate).numpy(), by_x.numpy(), by_u.numpy()

    def _solve_from(
        self, start: State, kept: Sequence[int], about: State, bounded: bool
    ) -> tuple[OperatingPoint | None, bool]:
        """The point found from an initial state with some components fixed, and whether it is isolated."""
        equations = _Equations(self, start, kept, about, bounded)
        try:
            y = equations.solve()
        except (ValueError, np.linalg.LinAlgError):  # f or its slope is not finite on the way
            return None, True
        return self._point(*equations.parts(y)), equations.isolated(y)


class _Equations:
    """The equations f(x) + g(x)u = 0 in the scaled free components y of (x, u)."""

    def __init__(self, search: OperatingPoints, start: State, kept: Sequence[int], about: State, bounded: bool):
        n, m = search.system.n, search.system.m
        self.search, self.start = search, start
        self.free = [i for i in range(n) if i not in kept]
        units = torch.cat([search.extent[self.free], search.control])
        sides = zip(search.state_limits, (search.low, search.high), strict=True)
        low, high = (torch.cat([states[self.free], controls]) for states, controls in sides)
        if not bounded:
            low, high = (torch.full_like(units, sign * torch.inf) for sign in (-1, 1))
        self.limits = low, high
        self.units, self.low, self.high = units.numpy(), (low / units).numpy(), (high / units).numpy()
        self.center = torch.cat([about[self.free], torch.zeros(m, dtype=torch.float64)]).numpy() / self.units
        self.center = self.center.clip(self.low, self.high)
        self.weight = np.concatenate([np.ones(len(self.free)), np.full(m, CONTROL_WEIGHT)])

    def parts(self, y: np.ndarray) -> tuple[State, Control]:
        """x and u from y; components at a limit are set to it exactly."""
        low, high = self.limits
        values = torch.from_numpy(y * self.units)
        values = low.where(torch.from_numpy(y <= self.low), high.where(torch.from_numpy(y >= self.high), values))
        x = self.start.clone()
        x[self.free] = values[: len(self.free)]
        return x, values[len(self.free) :]

    def rates(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """ẋ and its Jacobian in y."""
        rate, by_x, by_u = self.search._rates(*self.parts(y))
        return rate, np.concatenate([by_x[:, self.free], by_u], 1)

    def solve(self) -> np.ndarray:
        """Search for the solution nearest to the centre; the result need not be a solution."""
        from scipy.optimize import least_squares

        search = self.search
        u = search.system.holding_control(self.start)[0].nan_to_num(0, 0, 0)
        y = np.concatenate([self.start[self.free].numpy(), u.numpy()]) / self.units
        pull = np.diag(CENTRE_WEIGHT * self.weight)

        def residual(y: np.ndarray) -> np.ndarray:
            return np.concatenate([self.rates(y)[0], pull @ (y - self.center)])

        def slope(y: np.ndarray) -> np.ndarray:
            return np.concatenate([self.rates(y)[1], pull])

        bounds = (np.minimum(self.low, self.high - 1e-9), self.high)  # least_squares requires lower < upper
        jac: Any = slope  # missing in SciPy's annotations
        y = least_squares(residual, y.clip(*bounds), jac, bounds, max_nfev=MAX_STEPS).x
        return self._clear_rounding(self._newton(self._move_to_nearest(self._newton(self._unwind_angles(y)))))

    def _unwind_angles(self, y: np.ndarray) -> np.ndarray:
        """Move free angles by multiples of 2π to be nearest to the centre, if the limits admit it."""
        turn = np.array([2 * np.pi if i in self.search.system.angles else np.inf for i in self.free])
        turn = np.concatenate([turn, np.full(len(y) - len(turn), np.inf)]) / self.units
        turns = np.round((y - self.center) / turn)
        back = y - np.where(turns == 0, 0.0, turn) * turns
        return np.where((back >= self.low) & (back <= self.high), back, y)

    def _clear_rounding(self, y: np.ndarray) -> np.ndarray:
        """Set components to zero that are zero up to rounding, unless that increases the rates."""
        zeros = np.where(np.abs(y) <= ZERO_TOLERANCE, 0.0, y)
        before, after = (float(np.abs(self.rates(each)[0]).max()) for each in (y, zeros))
        return zeros if after <= max(before, ZERO_TOLERANCE) else y

    def _is_free(self, y: np.ndarray) -> np.ndarray:
        """Which components are not at a limit."""
        return (y > self.low + 1e-7) & (y < self.high - 1e-7)

    def _newton(self, y: np.ndarray) -> np.ndarray:
        """Newton's method with steps of least weighted norm, until the rates stop decreasing."""
        rate, slope = self.rates(y)
        for _ in range(MAX_STEPS):
            after = self._step(y, slope, -rate, y)
            left, slope = self.rates(after)
            if not np.abs(left).max() < np.abs(rate).max():
                break
            y, rate = after, left
        return y

    def _move_to_nearest(self, y: np.ndarray) -> np.ndarray:
        """Iterate to the solution nearest to the centre, each time in the tangent space, while the steps shrink."""
        change = np.inf
        for _ in range(MAX_STEPS):
            rate, slope = self.rates(y)
            after = self._step(y, slope, slope @ (y - self.center) - rate, self.center)
            now = float(np.abs(after - y).max())
            if not now < change:
                break
            y, change = after, now
        return y

    def _step(self, y: np.ndarray, slope: np.ndarray, right: np.ndarray, about: np.ndarray) -> np.ndarray:
        """about + Δ with Δ of least weighted norm such that slope Δ = right; components at a limit remain there."""
        inner = self._is_free(y)
        right = right - slope[:, ~inner] @ (y - about)[~inner]
        scaled = slope[:, inner] / self.weight[inner]
        after = y.copy()
        after[inner] = about[inner] + np.linalg.lstsq(scaled, right, 1e-12)[0] / self.weight[inner]
        return after.clip(self.low, self.high)

    def isolated(self, y: np.ndarray) -> bool:
        """Whether the solution y is isolated, so that no curve of solutions passes through it."""
        return int(np.linalg.matrix_rank(self.rates(y)[1], 1e-9)) == len(y)


def _digits(number: float) -> int:
    """The number of significant digits, at most 9: 1 for 0.3 and 200, 4 for 0.4541."""
    written = f"{abs(number):.9g}".partition("e")[0].replace(".", "").strip("0")
    return max(1, len(written))


def _last_digit(number: float) -> float:
    """The unit of the last significant digit: 0.0001 for 0.4541."""
    if not number:
        return 1.0
    return 10.0 ** (np.floor(np.log10(abs(number))) + 1 - _digits(number))

"""Encloses the closed loops from boxes of initial states on [0, T], step by step."""

from typing import NamedTuple

import torch
from torch import Tensor

from lyapnet.base.types import Corners, PerBox, State, Terms
from lyapnet.claims.tubes import nominal
from lyapnet.claims.tubes.coordinates import ROOM, Moving, bound_in_new_frame, bound_turn, near_inverse, ratio_of_errors
from lyapnet.claims.tubes.field import DEGREE, Field
from lyapnet.claims.tubes.nominal import at_step_end, derivative, flow, interpolate_step, places
from lyapnet.prover.taylor import EPSILON, TaylorForm, monomials

SMALLEST_RADIUS = 1e-30  # the smallest r̂, for states that do not move
TRIES = 6  # values of r̂ to test on a step
LARGEST_CONDITION = 100.0  # coordinates with a larger condition number are made orthogonal
LARGEST_TURN = 0.3  # largest relative change of the coordinates within a step, unless the step is the shortest one
HARMLESS_GROWTH = 1e-3  # growth of r over T that does not make steps shorter
SHORTEST_STEP = 1 / 2000  # shortest step, as a share of T
LARGEST_RADIUS = 0.5  # largest Σ r, in units of the states; cells beyond it are given up
BINS = 60  # number of equal parts of [0, T] for which ranges are stored


class Cells(NamedTuple):
    """Boxes of initial states {middle + half · ε}, with a coordinate ε_k for each axis with a width."""

    lower: Corners
    upper: Corners

    def __getitem__(self, chosen: Tensor) -> "Cells":  # pyright: ignore[reportIncompatibleMethodOverride]
        return Cells(self.lower[chosen], self.upper[chosen])


class Enclosed(NamedTuple):
    """The results for some cells, (cells, …) each; they hold only for cells that are `proved`."""

    proved: Tensor  # bool
    violated: Tensor  # bool: whether every closed loop of the cell violates a constraint
    cost: Tensor  # P, a polynomial near J(x₀), in the order of monomials(e, DEGREE), (terms, cells)
    cost_slack: Tensor  # bounds of J − P, (cells, 2)
    ends: Tensor  # bounds of x(T), (cells, n, 2)
    ranges: Tensor  # bounds of x(t) on BINS parts of [0, T], (BINS, cells, n, 2)
    bend: Tensor  # the nonlinearity along each axis, (cells, e)
    steps: int
    bounded: int  # number of computed Taylor forms


class Step(NamedTuple):
    """The result of a step for some cells, (cells, …) each."""

    radius: State  # a bound of |z| on the step, which is r at its end
    rest: PerBox  # the largest remainder of the Taylor forms of Yv
    cost: Tensor  # bounds of the integral of ℓ minus its polynomial, (cells, 2)
    worst: Tensor  # bounds of max_j h_j over the step, (cells, 2); −∞ without constraints
    bend: Tensor  # as _Tube._bend_sizes
    held: Tensor  # bool: whether the step is proved


class Front(NamedTuple):
    """The state of the tube of some cells at a time t."""

    t: float
    y: Tensor  # closed loops at the stencil, (points, cells, n + 1)
    flow: nominal.Flow
    end: Tensor  # p at the end of the previous step
    frame: Moving | None  # the coordinates of the previous step; None at the beginning
    radius: State  # |z| ≤ r in these coordinates
    cost: Tensor  # bounds of ∫ℓ minus its polynomial, (cells, 2)

    def select(self, chosen: Tensor) -> "Front":
        """The front of some of the cells."""
        frame = None if self.frame is None else self.frame[chosen]
        parts = nominal.Flow(self.flow.y[:, chosen], self.flow.rate[:, chosen])
        return Front(
            self.t, self.y[:, chosen], parts, self.end[:, chosen], frame, self.radius[chosen], self.cost[chosen]
        )


class Enclosure:
    """Computes the tubes of cells; all cells of one tube take the same steps.

    On a step, x(t) = p(τ, ε) + Φ(τ)z(t), where p is a polynomial near the closed loops, and Φ approximates the flow of
    the linearisation along them. With v = F(t, p + Φz) − ṗ − Φ̇z, ż = Φ⁻¹v; and with Y ≈ Φ⁻¹, |YΦ − 1| ≤ E and
    ‖E‖ ≤ ν < 1,

        |ż| ≤ w + Ew + ν/(1 − ν) max Ew,     w ≥ |Yv| wherever |z| ≤ r̂,

    so that |z| ≤ r + h max |ż| on the step if this is at most r̂; otherwise z would have to leave {|z| ≤ r̂} first. Yv is
    bounded as one Taylor form in (τ, ε, z), in which F along p and Φz cancels with ṗ and Φ̇z. Between steps a skewed Φ
    is made orthogonal, and the polynomials p of two steps agree up to rounding, which r takes into account.

    Args:
        field: F.
        duration: T.
        unit: the unit of each state, for comparisons between states.

    Source: the first-exit argument of validated integration with moving coordinates, Lohner, "Enclosing the solutions
    of ordinary initial and boundary value problems", 1987, and Berz, Makino, "Verified integration of ODEs and flows
    using differential algebraic methods on high-order Taylor models", Reliable Computing 1998.
    """

    def __init__(self, field: Field, duration: float, dt: float, unit: State):
        self.field, self.duration, self.unit = field, duration, unit
        self.n = field.n
        self.kinks = [*field.kinks(duration, dt), duration]

    def enclose(self, cells: Cells, axes: list[int]) -> Enclosed:
        """Enclose the closed loops of some cells.

        Args:
            axes: the e axes along which the cells have a width.
        """
        tube = _Tube(self, cells, axes)
        h = self.duration / 100
        while tube.front.t < self.duration and bool(tube.alive.any()):
            h = tube.step(h)
        return tube.results()


class _Tube:
    """The tube of some cells under construction."""

    def __init__(self, enclosure: Enclosure, cells: Cells, axes: list[int]):
        self.enclosure, self.axes, self.e, self.n = enclosure, axes, len(axes), enclosure.n
        self.order = monomials(1 + self.e + self.n, DEGREE)
        self.place = places(1 + self.e + self.n, DEGREE)
        self.supports = self._supports()
        middle, half = (cells.lower + cells.upper) / 2, (cells.upper - cells.lower) / 2
        count, points = len(middle), nominal.stencil(self.e)
        epsilon = torch.zeros(len(points), self.n, dtype=torch.float64)
        epsilon[:, axes] = points
        x0 = middle + epsilon[:, None] * half
        y = torch.cat([x0, torch.zeros_like(x0[..., :1])], -1)
        start = torch.zeros(len(places(self.e, DEGREE)), count, self.n + 1, dtype=torch.float64)
        start[0, :, : self.n] = middle
        for i, axis in enumerate(axes):
            start[1 + i, :, axis] = half[:, axis]
        # middle ± half differ from the box by rounding
        r = 4 * EPSILON * (cells.lower.abs() + cells.upper.abs())
        zero = torch.zeros(count, dtype=torch.float64)
        self.front = Front(
            0.0, y, flow(enclosure.field.slope, 0.0, y, self.e), start, None, r, torch.stack([zero, zero], -1)
        )
        self.alive, self.kept = torch.ones(2, count, dtype=torch.bool)
        self.violated = torch.zeros(count, dtype=torch.bool)
        self.ranges = torch.tensor([torch.inf, -torch.inf], dtype=torch.float64).repeat(BINS, count, self.n, 1)
        self.bend = torch.zeros(count, self.e, dtype=torch.float64)
        self.steps = self.bounded = 0

    def step(self, h: float) -> float:
        """Take a step of at most h seconds, and keep the cells for which it is proved; return the next h.

        The step is halved until, for 90 % of the cells, the nonlinearity of F in τ is at most that in ε and z together.
        """
        enclosure, front = self.enclosure, self.front
        kink = next(t for t in enclosure.kinks if t > front.t + 1e-7 * enclosure.duration)
        shortest = SHORTEST_STEP * enclosure.duration
        while True:
            end = front.t + h if front.t + 1.25 * h < kink else kink
            y = nominal.integrate(enclosure.field.slope, front.t, end - front.t, front.y)
            after = flow(enclosure.field.slope, end, y, self.e)
            p = interpolate_step(front.flow, after, end - front.t, self.e)
            frame, turn = self._frame(front, p, end)
            turned = float(turn.quantile(0.9, interpolation="lower"))
            if turned < LARGEST_TURN or h <= shortest:
                result = self._bound_step(self._radius_at_start(front, p, frame), p, frame, front.t, end)
                fast = result.rest > HARMLESS_GROWTH / enclosure.duration
                ratio = torch.where(
                    fast | ~result.held, result.bend[:, 0] / result.bend[:, 1:].sum(-1).clamp_min(SMALLEST_RADIUS), 0.0
                )
                share = float(ratio.nan_to_num(0.0).quantile(0.9, interpolation="lower"))
                if share <= 1 or h <= shortest:
                    break
            h = max(h / 2, shortest)
        self._accept(
            Front(end, y, after, at_step_end(p, self.e, 1), frame, result.radius, front.cost + result.cost),
            frame,
            p,
            result,
        )
        return min(1.5 * h, enclosure.duration / 50) if share < 0.1 and turned < LARGEST_TURN / 2 else h

    def _accept(self, front: Front, frame: Moving, p: Terms, result: Step) -> None:
        """Store the results of a step, and keep the cells for which it is proved."""
        enclosure, (low, high) = self.enclosure, result.worst.unbind(-1)
        living = torch.nonzero(self.alive).flatten()
        self.bend[living] = torch.maximum(self.bend[living], result.bend[:, 1:-1].nan_to_num(0.0))
        self.violated[living] |= result.held & (low > 0)
        self.kept[living] &= high <= 0
        within = ((result.radius @ torch.ones(self.n, dtype=torch.float64)) <= LARGEST_RADIUS) & ~self.violated[living]
        held = result.held & within & result.radius.isfinite().all(-1)
        self.steps += 1
        reach = self._bound_states(p, frame, result.radius)
        first = int(self.front.t / enclosure.duration * BINS * (1 - 1e-9))
        last = min(BINS - 1, int(front.t / enclosure.duration * BINS))
        for k in range(first, last + 1):
            self.ranges[k, living, :, 0] = torch.minimum(self.ranges[k, living, :, 0], reach[..., 0])
            self.ranges[k, living, :, 1] = torch.maximum(self.ranges[k, living, :, 1], reach[..., 1])
        self.alive[living] = held
        self.front = front.select(held)

    def _frame(self, front: Front, p: Terms, end: float) -> tuple[Moving, Tensor]:
        """Choose coordinates for a step; return them, and their relative change over the step as an estimate.

        They continue those of the previous step, with columns scaled to unit length in the units of the states; skewed
        ones are made orthogonal.
        """
        unit, h = self.enclosure.unit, end - front.t
        if front.frame is None:
            Q = torch.diag(unit).expand(p.shape[1], self.n, self.n)
        else:
            A = front.frame.at(1) / unit[:, None]
            A = A / A.norm(dim=1, keepdim=True)
            # a matrix that is not finite has no singular values; its cell is not proved for any choice here
            skewed = torch.linalg.cond(A.where(A.isfinite(), 0.0)) > LARGEST_CONDITION
            A_r = front.frame.at(1) / unit[:, None] * front.radius[:, None, :].clamp_min(SMALLEST_RADIUS)
            longest = A_r.norm(dim=1).argsort(-1, descending=True)[:, None].expand_as(A)
            orthogonal = torch.linalg.qr(torch.gather(A_r, 2, longest))[0]
            Q = unit[:, None] * torch.where(skewed[:, None, None], orthogonal, A)
        begins, ends = (at_step_end(p, self.e, tau)[0, :, : self.n] for tau in (-1, 1))
        J = self._jacobians([front.t, (front.t + end) / 2, end], [begins, p[0, :, : self.n], ends])
        A = torch.linalg.matrix_exp(h * J[1]) @ Q
        bend = h / 8 * (J[2] @ A - J[0] @ Q)
        frame = Moving((A + Q) / 2 - bend, (A - Q) / 2, bend)
        turn = torch.linalg.matrix_norm(near_inverse(frame.middle) @ frame.slope, torch.inf)
        return frame, turn.nan_to_num(torch.inf)

    def _jacobians(self, times: list[float], x: list[State]) -> Tensor:
        """∂ẋ/∂x by central differences at several times, (times, cells, n, n)."""
        step = torch.diag(1e-5 * self.enclosure.unit)
        points = torch.stack(x) + torch.stack([step, -step])[:, :, None, None]  # (2, n, times, cells, n)
        t = torch.tensor(times, dtype=step.dtype)[:, None].expand(points.shape[:-1])
        plus, minus = self.enclosure.field.slope(t, points)[..., : self.n]
        return ((plus - minus) / (2 * step.diagonal()[:, None, None, None])).movedim(0, -1)

    def _radius_at_start(self, front: Front, p: Terms, frame: Moving) -> tuple[Tensor, Tensor]:
        """(r, the error of ∫ℓ) at the beginning of a step, in its coordinates; both include the rounding of p."""
        begins = at_step_end(p, self.e, -1)
        size = at_step_end(p.abs(), self.e, 1) + front.end.abs()
        jump = ((begins - front.end).abs() + 16 * EPSILON * size).sum(0) * ROOM
        before = frame.at(-1) if front.frame is None else front.frame.at(1)
        size = frame.size if front.frame is None else front.frame.size
        r, jump, error = front.radius, jump[:, : self.n], jump[:, self.n]
        if front.frame is None:  # at t = 0 the radius is a bound of x − p itself
            r, jump = torch.zeros_like(r), jump + r
        return bound_in_new_frame(before, size, frame.at(-1), frame.size, jump, r), error

    def _bound_step(self, start: tuple[Tensor, Tensor], p: Terms, frame: Moving, t: float, end: float) -> Step:
        """Bound a step, with increasing r̂ until it is proved, at most TRIES times."""
        r, error = start
        h, count = end - t, len(r)
        Y, E = bound_turn(frame)
        tail = ratio_of_errors(E)
        hat = 1.1 * r + h * HARMLESS_GROWTH / self.enclosure.duration + SMALLEST_RADIUS
        result = Step(
            r.clone(), torch.zeros_like(r[:, 0]), torch.zeros(count, 2, dtype=r.dtype),
            torch.full((count, 2), -torch.inf, dtype=r.dtype), torch.zeros(count, 2 + self.e, dtype=r.dtype),
            torch.zeros(count, dtype=torch.bool),
        )  # fmt: skip
        todo = torch.arange(count)
        for _ in range(TRIES):
            w, cost, worst, defect = self._bound_defect(p[:, todo], frame[todo], Y[todo], hat[todo], t, end)
            Ew = (E[todo] @ w[..., None])[..., 0] * ROOM
            rate = (w + Ew + tail[todo] * Ew.amax(-1, keepdim=True)) * ROOM
            needed = (r[todo] + h * rate) * ROOM
            held = (needed <= hat[todo]).all(-1)
            slack = error[todo, None] * torch.tensor([-1.0, 1.0], dtype=r.dtype)
            cost = h * cost + slack
            cost = cost + cost.abs() * torch.tensor([-1e-12, 1e-12], dtype=r.dtype)
            for part, value in zip(
                result, (needed, defect.radius.amax(-1), cost, worst, self._bend_sizes(defect), held), strict=True
            ):
                part[todo] = value
            hat[todo] = torch.where(held[:, None], hat[todo], 1.2 * torch.maximum(needed, hat[todo]))
            todo = todo[~held & hat[todo].isfinite().all(-1)]
            if not len(todo):
                break
        return result

    def _bound_defect(
        self, p: Terms, frame: Moving, Y: Tensor, hat: State, t: float, end: float
    ) -> tuple[Tensor, Tensor, Tensor, TaylorForm]:
        """(a bound of |Yv|, bounds of ℓ minus its polynomial, bounds of max_j h_j, Yv) on a step, for all |z| ≤ r̂."""
        n, h, cells = self.n, end - t, p.shape[1]
        self.bounded += cells
        x, rate = self._moving_polynomials(p, frame, hat)
        rate = rate * (2 / h)
        constants = torch.zeros(len(x), cells, 1 + n * n, dtype=x.dtype)
        constants[0] = torch.cat([torch.full((cells, 1), (t + end) / 2, dtype=x.dtype), Y.flatten(1)], -1)
        constants[1, :, 0] = h / 2
        time, inverse = constants[..., :1], constants[..., 1:]
        room = (4 * time[0] + 4 * time[1], 16 * x.abs().sum(0), 16 * rate.abs().sum(0), 0 * inverse[0])
        terms, radius = torch.cat([time, x, rate, inverse], -1), EPSILON * torch.cat(room, -1)
        defect, cost, *h_form = self.enclosure.field.defect.image(
            TaylorForm(terms, radius, 1 + self.e + n), self.supports
        )
        low, high = defect.interval()
        worst = [side.amax(-1) for side in h_form[0].interval()] if h_form else [low.new_full((cells,), -torch.inf)] * 2
        return torch.maximum(low.abs(), high.abs()), torch.stack(cost.interval(), -1), torch.stack(worst, -1), defect

    def _moving_polynomials(self, p: Terms, frame: Moving, hat: State) -> tuple[Tensor, Tensor]:
        """p + Φz, and ∂/∂τ of (p + Φz, the polynomial of ∫ℓ), as polynomials in (τ, ε, z/r̂)."""
        x, rate = self._padded(p[..., : self.n]), self._padded(derivative(p, self.e))
        for j in range(self.n):
            z = 1 + self.e + j
            middle, slope, bend = (part[:, :, j] * hat[:, j : j + 1] for part in frame)
            for axes, value in (((z,), middle), ((0, z), slope), ((0, 0, z), bend)):
                x[self.place[axes]] += value
            rate[self.place[(z,)], :, : self.n] += slope
            rate[self.place[0, z], :, : self.n] += 2 * bend
        return x, rate

    def _bend_sizes(self, form: TaylorForm) -> Tensor:
        """The size of the terms of degree three in τ, each ε_k, and z, (cells, 2 + e), as a measure of nonlinearity."""
        bends = torch.zeros(form.radius.shape[0], 2 + self.e, dtype=torch.float64)
        for axes, k in self.place.items():
            if len(axes) == DEGREE:
                parts = {min(axis, 1 + self.e) for axis in axes}
                size = form.terms[k].abs().amax(-1) / len(parts)
                for part in parts:
                    bends[:, part] += size
        return bends

    def _supports(self) -> list[tuple[int, ...]]:
        """The terms of (t, x, rate, Y) that may be nonzero: t is linear in τ, Y constant, z multiplies powers of τ."""
        own = {self.place[axes] for axes in places(1 + self.e, DEGREE)}
        with_z = {self.place[axes] for axes in self.place if len(axes) and max(axes) > self.e and not any(axes[:-1])}
        moving = tuple(sorted(own | with_z))
        return [(0, 1), *[moving] * (2 * self.n + 1), *[(0,)] * self.n**2]

    def _padded(self, terms: Terms) -> Tensor:
        """Terms in (τ, ε) as terms in (τ, ε, z)."""
        found = terms.new_zeros(len(self.order), *terms.shape[1:])
        found[[self.place[axes] for axes in places(1 + self.e, DEGREE)]] = terms
        return found

    def _bound_states(self, p: Terms, frame: Moving, r: State) -> Tensor:
        """Bounds of x over a step, (cells, n, 2)."""
        p = p[..., : self.n]
        reach = (p[1:].abs().sum(0) + (frame.size @ r[..., None])[..., 0]) * ROOM + 16 * EPSILON * p[0].abs()
        return torch.stack([p[0] - reach, p[0] + reach], -1)

    def results(self) -> Enclosed:
        """The results after the last step."""
        front, n, count = self.front, self.n, len(self.alive)
        living = torch.nonzero(self.alive).flatten()
        terms = torch.zeros(len(places(self.e, DEGREE)), count, dtype=torch.float64)
        slack, ends = torch.zeros(count, 2, dtype=torch.float64), torch.zeros(count, n, 2, dtype=torch.float64)
        if len(living):
            terms[:, living], slack[living], ends[living] = self._bound_end(front)
        return Enclosed(
            self.alive & self.kept, self.violated, terms, slack, ends, self.ranges, self.bend, self.steps, self.bounded
        )

    def _bound_end(self, front: Front) -> tuple[Tensor, Tensor, Tensor]:
        """(P, a polynomial in ε near J; bounds of J − P; bounds of x(T))."""
        n, alone = self.n, list(places(self.e, DEGREE))
        assert front.frame is not None
        at_T, size = front.frame.at(1), front.frame.size
        d = self.e + n
        place = places(d, DEGREE)
        x = torch.zeros(len(place), len(front.radius), n, dtype=torch.float64)
        in_epsilon = [place[axes] for axes in alone]
        x[in_epsilon] = front.end[..., :n]
        for j in range(n):
            x[place[(self.e + j,)]] += at_T[:, :, j] * front.radius[:, j : j + 1]
        room = 16 * EPSILON * x.abs().sum(0) + 16 * EPSILON * (size @ front.radius[..., None])[..., 0]
        time = torch.zeros(len(place), len(front.radius), 1, dtype=torch.float64)
        time[0] = self.enclosure.duration
        form = TaylorForm(torch.cat([time, x], -1), torch.cat([torch.zeros_like(time[0]), room], -1), d)
        (phi,) = self.enclosure.field.end.image(form)
        others = [k for k in range(len(place)) if k not in in_epsilon]
        error = (phi.terms[others].abs().sum(0) + phi.radius) * ROOM
        terms = front.end[..., n] + phi.terms[in_epsilon]
        error = error + 4 * EPSILON * (front.end[..., n].abs() + phi.terms[in_epsilon].abs()).sum(0)
        reach = x[1:].abs().sum(0) * ROOM + room
        ends = torch.stack([x[0] - reach, x[0] + reach], -1)
        return terms, front.cost + torch.stack([-error, error], -1), ends

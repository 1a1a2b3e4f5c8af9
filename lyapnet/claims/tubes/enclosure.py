"""What closed loops from boxes of initial states do within [0, T], enclosed step by step."""

from typing import NamedTuple

import torch
from torch import Tensor

from lyapnet.base.types import Corners, PerBox, State, Terms
from lyapnet.claims.tubes import nominal
from lyapnet.claims.tubes.coordinates import ROOM, Moving, near_inverse, ratio_of, rotated, turning
from lyapnet.claims.tubes.field import DEGREE, Field
from lyapnet.claims.tubes.nominal import at_end, derivative, flow, over_step, places
from lyapnet.prover.taylor import EPSILON, TaylorForm, monomials

LEAST = 1e-30  # of r that is tried: what never moves stays within it
TRIES = 6  # sizes of r that are tried on a step
SKEW = 100.0  # condition of the coordinates, beyond which they are made orthogonal
TURN = 0.3  # of the coordinates within a step, at most
LEAK = 1e-3  # of r over T, that no step is shortened for
SHORTEST = 1 / 2000  # of T
WIDEST = 0.5  # r in units of the states' magnitudes, at which a cell is given up
BINS = 60  # of [0, T], in which ranges are kept


class Cells(NamedTuple):
    """Boxes of initial states {middle + half · ε}, with ε_k for each axis that has a width."""

    lower: Corners
    upper: Corners

    def __getitem__(self, chosen: Tensor) -> "Cells":  # pyright: ignore[reportIncompatibleMethodOverride]
        return Cells(self.lower[chosen], self.upper[chosen])


class Enclosed(NamedTuple):
    """What is proved of each of some cells, (cells, …) each; what is not `proved` says nothing."""

    proved: Tensor  # bool
    violated: Tensor  # bool: a constraint, by every closed loop of the cell
    cost: Tensor  # of J(x₀) in the order of monomials(e, DEGREE), (terms, cells) …
    cost_slack: Tensor  # … up to [low, high], (cells, 2)
    ends: Tensor  # bounds of x(T), (cells, n, 2)
    ranges: Tensor  # of x(t) over BINS parts of [0, T], (BINS, cells, n, 2)
    bend: Tensor  # how much of what is left is due to each axis, (cells, e)
    steps: int
    bounded: int  # forms


class Step(NamedTuple):
    """A step that was tried: r̂ at its end, the cost's bounds, and what else is known; (cells, …) each."""

    radius: State  # r at τ = 1, a bound of |z| over all of the step
    rest: PerBox  # what the forms of Yv do not tell
    cost: Tensor  # (cells, 2)
    worst: Tensor  # bounds of max_j h_j over the step, (cells, 2); −∞ without constraints
    bend: Tensor
    held: Tensor  # bool: whether it is proved


class Front(NamedTuple):
    """Where the tube of some cells stands at a time t."""

    t: float
    y: Tensor  # closed loops at the stencil, (points, cells, n + 1)
    flow: nominal.Flow
    end: Tensor  # p at t as the steps before leave it
    frame: Moving | None  # the coordinates that the steps before leave, at τ = 1; None at the beginning
    radius: State  # |z| ≤ r in them
    cost: Tensor  # (low, high) of ∫ℓ − its polynomial, (cells, 2)

    def of(self, chosen: Tensor) -> "Front":
        """That of some cells."""
        frame = None if self.frame is None else self.frame[chosen]
        parts = nominal.Flow(self.flow.y[:, chosen], self.flow.rate[:, chosen])
        return Front(
            self.t, self.y[:, chosen], parts, self.end[:, chosen], frame, self.radius[chosen], self.cost[chosen]
        )


class Enclosing:
    """The tube of some cells, all of whose steps are the same.

    Over a step, x(t) = p(τ, ε) + Φ(τ)z(t), with a polynomial p near closed loops, and Φ near what they do to what is
    close to them. With v = F(t, p + Φz) − ṗ − Φ̇z, ż = Φ⁻¹v; and with Y near Φ⁻¹ and |YΦ − 1| ≤ E, ‖E‖ ≤ ν < 1,

        |ż| ≤ w + Ew + ν/(1 − ν) max Ew,     w ≥ |Yv| wherever |z| ≤ r̂,

    so that |z| ≤ r + h|ż| at most at the end of the step if that is no more than r̂: z would have to leave {|z| ≤ r̂}
    first. Yv is bounded as one Taylor form in (τ, ε, z), in which what F does to p and to Φz cancels against ṗ and Φ̇z.
    Between steps Φ is made orthogonal again, and p's polynomials meet but for rounding, which |z| takes up.

    Args:
        field: F.
        duration: T.
        unit: what counts as 1 of each state.

    Source: the first-exit argument of validated integration with moving coordinates, Lohner, "Enclosing the solutions
    of ordinary initial and boundary value problems", 1987, and Berz, Makino, "Verified integration of ODEs and flows
    using differential algebraic methods on high-order Taylor models", Reliable Computing 1998.
    """

    def __init__(self, field: Field, duration: float, dt: float, unit: State):
        self.field, self.duration, self.unit = field, duration, unit
        self.n = field.n
        self.kinks = [*field.kinks(duration, dt), duration]

    def of(self, cells: Cells, axes: list[int]) -> Enclosed:
        """What is proved of some cells.

        Args:
            axes: those along which they have a width: e of them.
        """
        tube = _Tube(self, cells, axes)
        h = self.duration / 100
        while tube.front.t < self.duration and bool(tube.alive.any()):
            h = tube.step(h)
        return tube.enclosed()


class _Tube:
    """The tube of some cells while it is made."""

    def __init__(self, about: Enclosing, cells: Cells, axes: list[int]):
        self.about, self.axes, self.e, self.n = about, axes, len(axes), about.n
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
        # what middle ± half miss of the box by rounding
        r = 4 * EPSILON * (cells.lower.abs() + cells.upper.abs())
        zero = torch.zeros(count, dtype=torch.float64)
        self.front = Front(
            0.0, y, flow(about.field.slope, 0.0, y, self.e), start, None, r, torch.stack([zero, zero], -1)
        )
        self.alive, self.kept = torch.ones(2, count, dtype=torch.bool)
        self.violated = torch.zeros(count, dtype=torch.bool)
        self.ranges = torch.tensor([torch.inf, -torch.inf], dtype=torch.float64).repeat(BINS, count, self.n, 1)
        self.bend = torch.zeros(count, self.e, dtype=torch.float64)
        self.steps = self.bounded = 0

    def step(self, h: float) -> float:
        """Go on by a step of h seconds, or less, with what cells it holds for; what to try next.

        A step is as short as makes τ bend F no more than ε and z do, for most of the cells.
        """
        about, front = self.about, self.front
        kink = next(t for t in about.kinks if t > front.t + 1e-7 * about.duration)
        shortest = SHORTEST * about.duration
        while True:
            end = front.t + h if front.t + 1.25 * h < kink else kink
            y = nominal.advanced(about.field.slope, front.t, end - front.t, front.y)
            after = flow(about.field.slope, end, y, self.e)
            p = over_step(front.flow, after, end - front.t, self.e)
            frame, turn = self._frame(front, p, end)
            turned = float(turn.quantile(0.9, interpolation="lower"))
            if turned < TURN or h <= shortest:
                made = self._tried(self._at_start(front, p, frame), p, frame, front.t, end)
                fast = made.rest > LEAK / about.duration
                ratio = torch.where(fast | ~made.held, made.bend[:, 0] / made.bend[:, 1:].sum(-1).clamp_min(LEAST), 0.0)
                share = float(ratio.nan_to_num(0.0).quantile(0.9, interpolation="lower"))
                if share <= 1 or h <= shortest:
                    break
            h = max(h / 2, shortest)
        self._take(
            Front(end, y, after, at_end(p, self.e, 1), frame, made.radius, front.cost + made.cost), frame, p, made
        )
        return min(1.5 * h, about.duration / 50) if share < 0.1 and turned < TURN / 2 else h

    def _take(self, front: Front, frame: Moving, p: Terms, made: Step) -> None:
        """Keep what a step has proved, and go on with the cells that it holds for."""
        about, (low, high) = self.about, made.worst.unbind(-1)
        living = torch.nonzero(self.alive).flatten()
        self.bend[living] = torch.maximum(self.bend[living], made.bend[:, 1:-1].nan_to_num(0.0))
        self.violated[living] |= made.held & (low > 0)
        self.kept[living] &= high <= 0
        within = ((made.radius @ torch.ones(self.n, dtype=torch.float64)) <= WIDEST) & ~self.violated[living]
        held = made.held & within & made.radius.isfinite().all(-1)
        self.steps += 1
        reach = self._range(p, frame, made.radius)
        first = int(self.front.t / about.duration * BINS * (1 - 1e-9))
        last = min(BINS - 1, int(front.t / about.duration * BINS))
        for k in range(first, last + 1):
            self.ranges[k, living, :, 0] = torch.minimum(self.ranges[k, living, :, 0], reach[..., 0])
            self.ranges[k, living, :, 1] = torch.maximum(self.ranges[k, living, :, 1], reach[..., 1])
        self.alive[living] = held
        self.front = front.of(held)

    def _frame(self, front: Front, p: Terms, end: float) -> tuple[Moving, Tensor]:
        """Coordinates over a step, and how much they turn; in floating point.

        They go on from the step before, each of unit length in the states' units, and are made orthogonal where skewed.
        """
        unit, h = self.about.unit, end - front.t
        if front.frame is None:
            Q = torch.diag(unit).expand(p.shape[1], self.n, self.n)
        else:
            A = front.frame.at(1) / unit[:, None]
            A = A / A.norm(dim=1, keepdim=True)
            # singular values exist of finite matrices alone; a cell with others is not proved whatever is chosen here
            skewed = torch.linalg.cond(A.where(A.isfinite(), 0.0)) > SKEW
            A_r = front.frame.at(1) / unit[:, None] * front.radius[:, None, :].clamp_min(LEAST)
            longest = A_r.norm(dim=1).argsort(-1, descending=True)[:, None].expand_as(A)
            orthogonal = torch.linalg.qr(torch.gather(A_r, 2, longest))[0]
            Q = unit[:, None] * torch.where(skewed[:, None, None], orthogonal, A)
        begins, ends = (at_end(p, self.e, tau)[0, :, : self.n] for tau in (-1, 1))
        J = self._jacobians([front.t, (front.t + end) / 2, end], [begins, p[0, :, : self.n], ends])
        A = torch.linalg.matrix_exp(h * J[1]) @ Q
        bend = h / 8 * (J[2] @ A - J[0] @ Q)
        frame = Moving((A + Q) / 2 - bend, (A - Q) / 2, bend)
        turn = torch.linalg.matrix_norm(near_inverse(frame.middle) @ frame.slope, torch.inf)
        return frame, turn.nan_to_num(torch.inf)

    def _jacobians(self, times: list[float], x: list[State]) -> Tensor:
        """∂ẋ/∂x by central differences at several times, (times, cells, n, n)."""
        step = torch.diag(1e-5 * self.about.unit)
        points = torch.stack(x) + torch.stack([step, -step])[:, :, None, None]  # (2, n, times, cells, n)
        t = torch.tensor(times, dtype=step.dtype)[:, None].expand(points.shape[:-1])
        plus, minus = self.about.field.slope(t, points)[..., : self.n]
        return ((plus - minus) / (2 * step.diagonal()[:, None, None, None])).movedim(0, -1)

    def _at_start(self, front: Front, p: Terms, frame: Moving) -> tuple[Tensor, Tensor]:
        """(r, what ∫ℓ may be off) in the coordinates of a step at its beginning, where p meets the p before."""
        begins = at_end(p, self.e, -1)
        size = at_end(p.abs(), self.e, 1) + front.end.abs()
        jump = ((begins - front.end).abs() + 16 * EPSILON * size).sum(0) * ROOM
        before = frame.at(-1) if front.frame is None else front.frame.at(1)
        size = frame.size if front.frame is None else front.frame.size
        r, jump, off = front.radius, jump[:, : self.n], jump[:, self.n]
        if front.frame is None:  # the radius is still one of x itself
            r, jump = torch.zeros_like(r), jump + r
        return rotated(before, size, frame.at(-1), frame.size, jump, r), off

    def _tried(self, start: tuple[Tensor, Tensor], p: Terms, frame: Moving, t: float, end: float) -> Step:
        """The step, with r̂ as it has to be."""
        r, off = start
        h, count = end - t, len(r)
        Y, E = turning(frame)
        tail = ratio_of(E)
        hat = 1.1 * r + h * LEAK / self.about.duration + LEAST
        made = Step(
            r.clone(), torch.zeros_like(r[:, 0]), torch.zeros(count, 2, dtype=r.dtype),
            torch.full((count, 2), -torch.inf, dtype=r.dtype), torch.zeros(count, 2 + self.e, dtype=r.dtype),
            torch.zeros(count, dtype=torch.bool),
        )  # fmt: skip
        todo = torch.arange(count)
        for _ in range(TRIES):
            w, cost, worst, off_form = self._bounded(p[:, todo], frame[todo], Y[todo], hat[todo], t, end)
            Ew = (E[todo] @ w[..., None])[..., 0] * ROOM
            rate = (w + Ew + tail[todo] * Ew.amax(-1, keepdim=True)) * ROOM
            needed = (r[todo] + h * rate) * ROOM
            held = (needed <= hat[todo]).all(-1)
            slack = off[todo, None] * torch.tensor([-1.0, 1.0], dtype=r.dtype)
            cost = h * cost + slack
            cost = cost + cost.abs() * torch.tensor([-1e-12, 1e-12], dtype=r.dtype)
            for part, value in zip(
                made, (needed, off_form.radius.amax(-1), cost, worst, self._bends(off_form), held), strict=True
            ):
                part[todo] = value
            hat[todo] = torch.where(held[:, None], hat[todo], 1.2 * torch.maximum(needed, hat[todo]))
            todo = todo[~held & hat[todo].isfinite().all(-1)]
            if not len(todo):
                break
        return made

    def _bounded(
        self, p: Terms, frame: Moving, Y: Tensor, hat: State, t: float, end: float
    ) -> tuple[Tensor, Tensor, Tensor, TaylorForm]:
        """(|Yv|, bounds of ℓ − its rate, bounds of the worst h, Yv) on a step, where |z| ≤ r̂."""
        n, h, cells = self.n, end - t, p.shape[1]
        self.bounded += cells
        x, rate = self._moving(p, frame, hat)
        rate = rate * (2 / h)
        constants = torch.zeros(len(x), cells, 1 + n * n, dtype=x.dtype)
        constants[0] = torch.cat([torch.full((cells, 1), (t + end) / 2, dtype=x.dtype), Y.flatten(1)], -1)
        constants[1, :, 0] = h / 2
        time, inverse = constants[..., :1], constants[..., 1:]
        room = (4 * time[0] + 4 * time[1], 16 * x.abs().sum(0), 16 * rate.abs().sum(0), 0 * inverse[0])
        terms, radius = torch.cat([time, x, rate, inverse], -1), EPSILON * torch.cat(room, -1)
        off, cost, *h_form = self.about.field.defect.image(TaylorForm(terms, radius, 1 + self.e + n), self.supports)
        low, high = off.interval()
        worst = [side.amax(-1) for side in h_form[0].interval()] if h_form else [low.new_full((cells,), -torch.inf)] * 2
        return torch.maximum(low.abs(), high.abs()), torch.stack(cost.interval(), -1), torch.stack(worst, -1), off

    def _moving(self, p: Terms, frame: Moving, hat: State) -> tuple[Tensor, Tensor]:
        """p + Φz, and the derivatives of (p + Φz, the polynomial of ∫ℓ) by τ, in (τ, ε, z / r̂)."""
        x, rate = self._padded(p[..., : self.n]), self._padded(derivative(p, self.e))
        for j in range(self.n):
            z = 1 + self.e + j
            middle, slope, bend = (part[:, :, j] * hat[:, j : j + 1] for part in frame)
            for axes, value in (((z,), middle), ((0, z), slope), ((0, 0, z), bend)):
                x[self.place[axes]] += value
            rate[self.place[(z,)], :, : self.n] += slope
            rate[self.place[0, z], :, : self.n] += 2 * bend
        return x, rate

    def _bends(self, off: TaylorForm) -> Tensor:
        """The terms of third degree by who has a part in them: τ, each ε, and z, (cells, 2 + e); what is left
        is alike.
        """
        bends = torch.zeros(off.radius.shape[0], 2 + self.e, dtype=torch.float64)
        for axes, k in self.place.items():
            if len(axes) == DEGREE:
                parts = {min(axis, 1 + self.e) for axis in axes}
                size = off.terms[k].abs().amax(-1) / len(parts)
                for part in parts:
                    bends[:, part] += size
        return bends

    def _supports(self) -> list[tuple[int, ...]]:
        """The terms that (t, x, rate, Y) may have: t is τ's, Y constant, and z goes with powers of τ alone."""
        own = {self.place[axes] for axes in places(1 + self.e, DEGREE)}
        with_z = {self.place[axes] for axes in self.place if len(axes) and max(axes) > self.e and not any(axes[:-1])}
        moving = tuple(sorted(own | with_z))
        return [(0, 1), *[moving] * (2 * self.n + 1), *[(0,)] * self.n**2]

    def _padded(self, terms: Terms) -> Tensor:
        """Terms in (τ, ε) as terms in (τ, ε, z)."""
        found = terms.new_zeros(len(self.order), *terms.shape[1:])
        found[[self.place[axes] for axes in places(1 + self.e, DEGREE)]] = terms
        return found

    def _range(self, p: Terms, frame: Moving, r: State) -> Tensor:
        """Bounds of x over a step, (cells, n, 2)."""
        p = p[..., : self.n]
        reach = (p[1:].abs().sum(0) + (frame.size @ r[..., None])[..., 0]) * ROOM + 16 * EPSILON * p[0].abs()
        return torch.stack([p[0] - reach, p[0] + reach], -1)

    def enclosed(self) -> Enclosed:
        """What is proved in the end."""
        front, n, count = self.front, self.n, len(self.alive)
        living = torch.nonzero(self.alive).flatten()
        terms = torch.zeros(len(places(self.e, DEGREE)), count, dtype=torch.float64)
        slack, ends = torch.zeros(count, 2, dtype=torch.float64), torch.zeros(count, n, 2, dtype=torch.float64)
        if len(living):
            terms[:, living], slack[living], ends[living] = self._in_the_end(front)
        return Enclosed(
            self.alive & self.kept, self.violated, terms, slack, ends, self.ranges, self.bend, self.steps, self.bounded
        )

    def _in_the_end(self, front: Front) -> tuple[Tensor, Tensor, Tensor]:
        """(J as a polynomial in ε, bounds of what it is off, bounds of x(T))."""
        n, alone = self.n, list(places(self.e, DEGREE))
        assert front.frame is not None
        at_T, size = front.frame.at(1), front.frame.size
        d = self.e + n
        place = places(d, DEGREE)
        x = torch.zeros(len(place), len(front.radius), n, dtype=torch.float64)
        kept = [place[axes] for axes in alone]
        x[kept] = front.end[..., :n]
        for j in range(n):
            x[place[(self.e + j,)]] += at_T[:, :, j] * front.radius[:, j : j + 1]
        room = 16 * EPSILON * x.abs().sum(0) + 16 * EPSILON * (size @ front.radius[..., None])[..., 0]
        time = torch.zeros(len(place), len(front.radius), 1, dtype=torch.float64)
        time[0] = self.about.duration
        form = TaylorForm(torch.cat([time, x], -1), torch.cat([torch.zeros_like(time[0]), room], -1), d)
        (phi,) = self.about.field.end.image(form)
        others = [k for k in range(len(place)) if k not in kept]
        off = (phi.terms[others].abs().sum(0) + phi.radius) * ROOM
        terms = front.end[..., n] + phi.terms[kept]
        off = off + 4 * EPSILON * (front.end[..., n].abs() + phi.terms[kept].abs()).sum(0)
        reach = x[1:].abs().sum(0) * ROOM + room
        ends = torch.stack([x[0] - reach, x[0] + reach], -1)
        return terms, front.cost + torch.stack([-off, off], -1), ends

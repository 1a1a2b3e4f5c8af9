"""Costs that change another cost: with a target, periodic angles, slower growth far away, or obstacles."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lyapnet.base.interpolation import Interpolant
from lyapnet.base.linear_algebra import apply
from lyapnet.base.types import ControlMatrix, PerState, State
from lyapnet.task.cost.base import BUFFERS, Cost, quadratic_form
from lyapnet.task.cost.control_costs import ControlCosts
from lyapnet.task.cost.quadratic import is_quadratic


class CostWrapper(Cost):
    """A cost that equals another cost; subclasses change its goal, R(x), q or φ."""

    cost: Cost
    nonquadratic: ControlCosts | None
    words: str = ""  # a description of the change

    def __init__(self, cost: Cost):
        super().__init__()
        self.cost = cost
        for name in BUFFERS:
            self.register_buffer(name, getattr(cost, name), persistent=False)
        self.nonquadratic = cost.nonquadratic

    def state(self, x: State) -> PerState:
        return self.cost.state(x)

    def R(self, x: State) -> ControlMatrix:
        return self.cost.R(x)

    def terminal(self, x: State) -> PerState:
        return self.cost.terminal(x)

    def from_goal(self, x: State) -> State:
        return self.cost.from_goal(x)

    def rest_at(self, x: State) -> Tensor | None:
        return self.cost.rest_at(x)

    def ignores(self, i: int, n: int) -> bool:
        return self.cost.ignores(i, n)

    def ignores_at_end(self, i: int, n: int) -> bool:
        return self.cost.ignores_at_end(i, n)


class TargetCost(CostWrapper):
    """Another cost moved to a target: q(x − d) + (u − u*)ᵀR(x)(u − u*) and φ(x − d), d = x* − goal of that cost.

    Args:
        cost: q, R and φ.
        target: x*, (n,).
        rest: u*, (m,), the control that costs nothing; it holds x*, if any control does.
    """

    goal: Float[Tensor, " n"]
    rest: Float[Tensor, " m"]
    shift: Float[Tensor, " n"]

    def __init__(self, cost: Cost, target: Sequence[float] | Tensor, rest: Sequence[float] | Tensor):
        super().__init__(cost)
        goal, u = (torch.as_tensor(entries, dtype=torch.get_default_dtype()) for entries in (target, rest))
        self.register_buffer("shift", goal - (0 if cost.goal is None else cost.goal), persistent=False)
        self.goal, self.rest = goal, u
        self.words: str = f"about x* = {goal.tolist()} and u* = {u.tolist()}"

    def from_goal(self, x: State) -> State:
        return Cost.from_goal(self, x)

    def rest_at(self, x: State) -> Tensor | None:
        return self.rest

    def state(self, x: State) -> PerState:
        return self.cost.state(x - self.shift)

    def terminal(self, x: State) -> PerState:
        return self.cost.terminal(x - self.shift)

    def terminal_gradient(self, x: State) -> State:
        return self.cost.terminal_gradient(x - self.shift)


def is_quadratic_about_target(cost: Cost) -> bool:
    """Whether q and φ are quadratic forms of x or x − x*, determined by their matrices."""

    def own(name: str) -> bool:
        return getattr(getattr(cost, name), "__func__", None) is getattr(TargetCost, name)

    while type(cost) is TargetCost and own("state") and own("terminal"):
        cost = cost.cost
    return is_quadratic(cost) and cost.goal is None


class PeriodicCost(CostWrapper):
    """Another cost made 2π-periodic in some angles: their distance δ from the goal is replaced by 2 sin(δ/2).

    δ² becomes 2(1 − cos δ), which agrees with δ² near the goal.

    Args:
        cost: the other cost; q and φ must be even in each of these angles.
        angles: indices of the angles.
    """

    turns: Float[Tensor, " n"]  # 1 for a periodic angle, 0 for any other state

    def __init__(self, cost: Cost, angles: Sequence[int], n: int):
        super().__init__(cost)
        turns = torch.zeros(n, dtype=torch.get_default_dtype())
        turns[list(angles)] = 1
        self.register_buffer("turns", turns, persistent=False)
        self.words: str = f"δ² as 2(1 − cos δ) of the states {list(angles)}"

    def _chords(self, x: State) -> State:
        delta = x if self.cost.goal is None else x - self.cost.goal
        return x + self.turns * (2 * torch.sin(delta / 2) - delta)

    def state(self, x: State) -> PerState:
        return self.cost.state(self._chords(x))

    def terminal(self, x: State) -> PerState:
        return self.cost.terminal(self._chords(x))


class PseudoHuberCost(CostWrapper):
    """Another cost with q replaced by h(q) = 2δ²(√(1 + q/δ²) − 1), and φ likewise.

    h(q) ≈ q for √q far below δ, and h(q) ≈ 2δ√q far above it, a norm if q is quadratic. States far away then weigh
    less, and V spans fewer orders of magnitude.

    Args:
        cost: q, R and φ.
        delta: δ, in the unit of √q.

    Raises:
        ValueError: δ is not positive.

    Source: Hartley, Zisserman, "Multiple View Geometry in Computer Vision", 2003, A6.8.
    """

    def __init__(self, cost: Cost, delta: float):
        super().__init__(cost)
        if not 0 < delta < math.inf:
            raise ValueError(f"Expected delta > 0, got {delta:g}; give it in the unit of √q.")
        self.delta = delta
        self.words: str = f"q and φ as pseudo-Huber losses, δ = {delta:g}"

    def state(self, x: State) -> PerState:
        return self._pseudo_huber(self.cost.state(x))

    def terminal(self, x: State) -> PerState:
        return self._pseudo_huber(self.cost.terminal(x))

    def _pseudo_huber(self, q: PerState) -> PerState:
        """h(q), computed as 2q/(√(1 + q/δ²) + 1) to avoid cancellation near 0."""
        return 2 * q / (torch.sqrt(1 + q / self.delta**2) + 1)


class RegulatorTail(CostWrapper):
    """Another cost with φ(x) = (x − x*)ᵀP(x − x*), the infinite-horizon cost of a linear-quadratic regulator from x.

    Args:
        cost: q and R.
        P: (n, n), symmetric positive semidefinite, in units of cost.
    """

    P: Float[Tensor, "n n"]
    words: str = "with the cost of a regulator after T as φ"

    def __init__(self, cost: Cost, P: Tensor):
        super().__init__(cost)
        self.register_buffer("P", P, persistent=False)

    def terminal(self, x: State) -> PerState:
        return quadratic_form(self.P, self.from_goal(x))

    def terminal_gradient(self, x: State) -> State:
        return 2 * apply(self.P, self.from_goal(x))

    def ignores(self, i: int, n: int) -> bool:
        return self.ignores_at_end(i, n) and self.cost.ignores(i, n)

    def ignores_at_end(self, i: int, n: int) -> bool:
        return not any(self.P[i])


class RegulatorsTail(CostWrapper):
    """RegulatorTail for a family: φ(x, p) = ‖L(p)ᵀ(x − x*(p))‖², so that P(p) = L(p)L(p)ᵀ ≥ 0 for any L.

    Args:
        cost: q and R, functions of (x, p).
        root: p (*batch, k) ↦ L(p) (*batch, n, n), an Interpolant with rows of zeros for states that cost nothing.
        n: number of states x.
    """

    words: str = RegulatorTail.words

    def __init__(self, cost: Cost, root: Interpolant, n: int):
        super().__init__(cost)
        self.root, self.n = root, n

    def terminal(self, x: State) -> PerState:
        return apply(self.root(x[..., self.n :]).mT, self.from_goal(x)[..., : self.n]).square().sum(-1)

    def ignores(self, i: int, n: int) -> bool:
        return self.ignores_at_end(i, n) and self.cost.ignores(i, n)

    def ignores_at_end(self, i: int, n: int) -> bool:
        return not bool(self.root.coefficients[:, i].any()) if i < self.n else Cost.ignores_at_end(self, i, n)


class ObstacleCost(CostWrapper):
    """Another cost plus w exp(−2 d²/r²) per second, a smooth bump with d the distance of some states from a centre.

    At the radius, d = r, the bump is 0.14 w; at 2r it is 0.0003 w.

    Args:
        cost: the other cost.
        states: indices of these states, (k,).
        centre: (k,), in units of the states.
        radius: r.
        weight: w, in cost per second.

    Raises:
        ValueError: r or w is not positive.
    """

    states: Int[Tensor, " k"]
    centre: Float[Tensor, " k"]
    radius: float
    weight: float
    words: str

    def __init__(self, cost: Cost, states: Sequence[int], centre: Sequence[float], radius: float, weight: float):
        super().__init__(cost)
        if not (0 < radius < math.inf and 0 < weight < math.inf and all(math.isfinite(each) for each in centre)):
            raise ValueError(
                f"Expected an obstacle with a finite centre, radius > 0 and weight > 0, got {list(centre)}, {radius:g} "
                f"and {weight:g}; correct them."
            )
        self.radius, self.weight = radius, weight
        self.words = f"an obstacle at {list(centre)} of the states {list(states)}, radius {radius:g}, weight {weight:g}"
        self.register_buffer("states", torch.tensor(list(states), dtype=torch.long), persistent=False)
        self.register_buffer("centre", torch.tensor(list(centre), dtype=torch.get_default_dtype()), persistent=False)

    def state(self, x: State) -> PerState:
        squared = ((x[..., self.states] - self.centre) ** 2).sum(-1)
        return self.cost.state(x) + self.weight * torch.exp(-2 / self.radius**2 * squared)

    def ignores(self, i: int, n: int) -> bool:
        return i not in self.states.tolist() and self.cost.ignores(i, n)


def innermost(cost: Cost) -> Cost:
    """The innermost cost of a composition of TargetCost, PeriodicCost and ObstacleCost."""
    while isinstance(cost, CostWrapper) and type(cost) in (TargetCost, PeriodicCost, ObstacleCost):
        cost = cost.cost
    return cost

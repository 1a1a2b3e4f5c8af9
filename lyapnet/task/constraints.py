"""State constraints h(x) ≤ 0."""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from lyapnet.base.types import State


class Constraints(nn.Module, ABC):
    """h(x) ≤ 0 in every component at every time; a positive component means that its constraint is violated.

    A subclass implements `forward` with torch operations on tensors of any leading shape, smooth where h = 0. Each
    component is scaled so that its margin is a small change.
    """

    names: Sequence[str] = ()  # a description of each component
    margin: float | Sequence[float] = 0.02  # distance from h = 0, or for each h_j, at which the training penalty begins

    @abstractmethod
    def forward(self, x: State) -> Float[Tensor, "*batch k"]:
        """h(x), (*batch, k), k = len(names)."""

    def worst(self, x: State) -> Tensor:
        """max_j h_j(x), (*batch,)."""
        return self(x).amax(-1)

    def ignores(self, i: int, n: int) -> bool:
        """Whether h does not depend on x_i, of n states, tested by h(x) with NaN as x_i."""
        numbers = [*self.buffers(), *self.parameters()]
        like = next((each for each in numbers if each.is_floating_point()), torch.zeros(()))
        x = 0.1 + 0.01 * torch.arange(n, dtype=torch.float64).sqrt()
        x[i] = torch.nan
        return not bool(self(x.to(like)).isnan().any())


class StateLimits(Constraints):
    """h_j(x) = s_j (x_{i_j} − b_j) / scale_j: upper and lower limits of some states.

    Args:
        states: i_j, indices of states.
        limits: b_j, in units of the states.
        sides: s_j = 1 for an upper limit, −1 for a lower one.
        scales: scale_j, in units of the states.
        names: a description of each limit.

    Raises:
        ValueError: a scale is not positive, a limit is not finite, or two limits of a state contradict each other.
    """

    states: Int[Tensor, " k"]
    limits: Float[Tensor, " k"]
    sides: Float[Tensor, " k"]
    scales: Float[Tensor, " k"]

    def __init__(
        self,
        states: Sequence[int],
        limits: Sequence[float],
        sides: Sequence[float],
        scales: Sequence[float],
        names: Sequence[str] = (),
    ):
        super().__init__()
        if not all(math.isfinite(limit) for limit in limits):
            raise ValueError(f"Expected finite limits, got {list(limits)}; leave out a state that has none.")
        if not all(0 < scale < math.inf for scale in scales):
            raise ValueError(f"Expected scales > 0, got {list(scales)}; give the size of what counts as 1.")
        for i, low, high in _sides(states, limits, sides):
            if not low < high:
                raise ValueError(f"Expected lower < upper limits, got {low:g} and {high:g} of state {i}; part them.")
        self.names: Sequence[str] = tuple(names) or tuple(f"limit {j + 1}" for j in range(len(states)))
        self.register_buffer("states", torch.tensor(list(states), dtype=torch.long), persistent=False)
        for name, numbers in (("limits", limits), ("sides", sides), ("scales", scales)):
            like = torch.tensor(list(numbers), dtype=torch.get_default_dtype())
            self.register_buffer(name, like, persistent=False)

    def forward(self, x: State) -> Float[Tensor, "*batch k"]:
        return self.sides * (x[..., self.states] - self.limits) / self.scales


def _sides(
    states: Sequence[int], limits: Sequence[float], sides: Sequence[float]
) -> Iterator[tuple[int, float, float]]:
    """(i, largest lower limit, smallest upper limit) of each state that has a limit."""
    for i in dict.fromkeys(states):
        own = [(side, limit) for j, limit, side in zip(states, limits, sides, strict=True) if j == i]
        below, above = ([limit for side, limit in own if (side > 0) is upper] for upper in (False, True))
        yield i, max(below, default=-math.inf), min(above, default=math.inf)


class Ball(Constraints):
    """h(x) = ±½(1 − d²/r²): some states, at distance d from a centre, have to stay outside (+) or inside (−) a ball.

    Near the boundary, h is the depth of the violation in units of r.

    Args:
        states: indices of these states, (k,).
        center: (k,), in units of the states.
        radius: r.
        inside: whether they have to stay inside.
        name: a description.

    Raises:
        ValueError: r is not positive, or an entry is not finite.
    """

    states: Int[Tensor, " k"]
    center: Float[Tensor, " k"]
    radius: float
    side: float

    def __init__(self, states: Sequence[int], center: Sequence[float], radius: float, inside: bool, name: str = ""):
        super().__init__()
        if not 0 < radius < math.inf or not all(math.isfinite(each) for each in center):
            raise ValueError(
                f"Expected a ball with a finite centre and radius > 0, got {list(center)} and {radius:g}; correct them."
            )
        self.radius, self.side = float(radius), -0.5 if inside else 0.5
        self.names: Sequence[str] = (name or f"{'inside' if inside else 'outside'} a ball of radius {radius:g}",)
        self.register_buffer("states", torch.tensor(list(states), dtype=torch.long), persistent=False)
        self.register_buffer("center", torch.tensor(list(center), dtype=torch.get_default_dtype()), persistent=False)

    def forward(self, x: State) -> Float[Tensor, "*batch one"]:
        squared = ((x[..., self.states] - self.center) ** 2).sum(-1, keepdim=True)
        return self.side * (1 - squared / self.radius**2)


class AllOf(Constraints):
    """Several constraints, concatenated.

    Args:
        parts: at least one.
    """

    def __init__(self, parts: Sequence[Constraints]):
        super().__init__()
        self.parts: nn.ModuleList = nn.ModuleList(parts)
        self.names: Sequence[str] = tuple(name for part in parts for name in part.names)

    def forward(self, x: State) -> Float[Tensor, "*batch k"]:
        return torch.cat([part(x) for part in self.parts], -1)


class OfFirstStates(Constraints):
    """Constraints on x, as constraints of a family with the states (x, p).

    Args:
        constraints: constraints on x.
        n: number of states x.
    """

    constraints: Constraints
    n: int
    names: Sequence[str]

    def __init__(self, constraints: Constraints, n: int):
        super().__init__()
        self.constraints, self.n, self.names = constraints, n, constraints.names

    def forward(self, x: State) -> Float[Tensor, "*batch k"]:
        return self.constraints(x[..., : self.n])


def names_of(constraints: Constraints | None) -> Sequence[str]:
    """The descriptions of all components; empty without constraints."""
    return () if constraints is None else constraints.names


def parts_of(constraints: Constraints | None) -> list[Constraints]:
    """The elementary constraints of a composition, in order."""
    if isinstance(constraints, AllOf):
        return [each for part in constraints.parts for each in parts_of(part)]  # pyright: ignore[reportArgumentType]
    return [] if constraints is None else [constraints]


CONSTRAINTS: dict[str, type[Constraints]] = {"listed": AllOf}  # the other keys of the section list its parts

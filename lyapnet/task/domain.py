"""Domains: the states at which f, g, q and φ are defined, found by a search along each state, or declared.

Beyond a border a logarithm, a root or a power is NaN, and a single NaN spoils a whole gradient. Therefore the functions
of a task with a domain are evaluated at the nearest state just inside, where they and their slopes are finite, and
leaving the domain has a cost, the price, which grows with the distance. A task without such borders has no domain.
"""

import copy
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lyapnet.base.types import ControlMatrix, PerState, State, StatePath
from lyapnet.task.cost import Cost, CostWrapper, PenaltyCost, SmoothedCost
from lyapnet.task.sets import Box
from lyapnet.task.systems import ControlAffineSystem, ControlSystem

# Lengths are relative to a state's size, see `size_of`.
INNER_MARGIN = 1e-9  # distance inside a border at which functions are evaluated
ROUNDING_UNITS = 64  # the same in units of the machine precision of x, if that is more
PRICE_SOFTNESS = 1e-3  # distance beyond a border at which the price changes from quadratic to linear
SLACK = 1e-2  # distance by which a step may pass a border at that price; farther away the path counts as invalid
BORDER_ROUNDING = 1e-6  # distance beyond a border that counts as rounding
TEST_STATES = 8  # states of X₀ that must all have the same border
STATES_AT_ONCE = 4096  # states at which functions are evaluated at once, which limits the memory for many states
SEARCH_REACH, SEARCH_PLACES = 8.0, 64  # distance of the search for borders; number of places on it
HALVINGS = 60  # bisection steps that then locate a border
TEST_DISTANCES = (1e-6, 1e-3)  # distances beyond a border at which a function must be undefined: excludes poles
# methods that are evaluated inside the domain
SYSTEM_FUNCTIONS = ("f", "g", "dynamics", "inverse_mass", "noise", "output")


class Border(NamedTuple):
    """A border of a state: an entry of `domain` or `constraints` in a config, with the reason."""

    state: str
    side: str  # lower or upper
    value: float
    because: str

    def __str__(self) -> str:
        return f"{self.state} {'>' if self.side == 'lower' else '<'} {self.value:g}, {self.because}"


class Domain:
    """The immutable set {x : lower ≤ x ≤ upper}, where most bounds are infinite.

    Args:
        names: names of the states.
        size: (n,), the unit of each state.
        borders: at least one border.
    """

    lower: Float[Tensor, " n"]
    upper: Float[Tensor, " n"]
    size: Float[Tensor, " n"]
    borders: list[Border]

    def __init__(self, names: Sequence[str], size: Float[Tensor, " n"], borders: Sequence[Border]):
        self.size, self.borders = size.double().cpu(), []
        self.lower, self.upper = torch.full_like(self.size, -torch.inf), torch.full_like(self.size, torch.inf)
        for border in borders:
            i, bounds = list(names).index(border.state), getattr(self, border.side)
            if border.value > bounds[i] if border.side == "lower" else border.value < bounds[i]:
                bounds[i] = border.value
                others = [each for each in self.borders if each[:2] != border[:2]]
                self.borders = [*others, border]

    def __deepcopy__(self, memo: dict[int, Any]) -> "Domain":
        return self

    def __str__(self) -> str:
        return "; ".join(map(str, self.borders))

    def narrowed(self, share: float) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """(lower, upper), moved inwards by a share of each state's size."""
        return self.lower + share * self.size, self.upper - share * self.size

    def nearest(self, x: State) -> State:
        """The nearest state just inside the domain, (*batch, n)."""
        low, high = self.narrowed(max(INNER_MARGIN, ROUNDING_UNITS * torch.finfo(x.dtype).eps))
        return x.clamp(low.to(x), high.to(x))

    def _outside(self, x: State) -> State:
        """The signed distance of each state from the domain, in units of its size; zero inside."""
        return (x - x.clamp(self.lower.to(x), self.upper.to(x))) / self.size.to(x)

    def price(self, x: State) -> PerState:
        """√(d² + s²) − s at a distance d from the domain: zero inside, about ½d²/s close to it, about d far away."""
        squared = (self._outside(x) ** 2).sum(-1)
        return squared / (torch.sqrt(squared + PRICE_SOFTNESS**2) + PRICE_SOFTNESS)

    def left(self, x: StatePath, slack: float = SLACK) -> Bool[Tensor, "*batch"]:
        """Whether a path (nodes, *batch, n) is farther outside than `slack` at one of its nodes."""
        return (self._outside(x).abs() > slack).any(-1).any(0)


def within(system: ControlSystem, domain: Domain) -> ControlSystem:
    """A copy of a system whose f and g are evaluated at the nearest state of a domain; its class has the same name."""
    return _restrict(copy.deepcopy(system), domain)


def _restrict(system: ControlSystem, domain: Domain) -> ControlSystem:
    """Give a system a new subclass whose functions are evaluated inside the domain."""

    def at_nearest(function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def evaluate(self: Any, x: State, *others: Any) -> Any:
            return function(self, domain.nearest(x), *others)

        return evaluate

    def reduced(self: Any, protocol: Any) -> tuple[Any, ...]:
        """For copies and pickles: the system without its domain, and the domain."""
        plain = cls.__new__(cls)
        vars(plain).update(vars(self))
        return _restrict, (plain, domain)

    cls = type(system)
    functions = {name: at_nearest(getattr(cls, name)) for name in SYSTEM_FUNCTIONS if hasattr(cls, name)}
    if cls.dynamics is ControlAffineSystem.dynamics:
        functions.pop("dynamics")  # the sum of f and g, which are restricted already
    texts = {name: getattr(cls, name) for name in ("__module__", "__qualname__", "__doc__")}
    own = {**functions, **texts, "domain": domain, "__reduce_ex__": reduced}
    system.__class__ = type(cls.__name__, (cls,), own)
    return system


class DomainCost(CostWrapper):
    """Another cost, evaluated at the nearest state of a domain, plus w · price(x) for each step outside.

    The terminal cost includes the price of one step. Inside the domain it equals the other cost.

    Args:
        cost: the other cost.
        domain: the domain.
        weight: w, in units of cost.
        step: Δt, in s.
    """

    domain: Domain
    weight: float
    step: float
    words: str

    def __init__(self, cost: Cost, domain: Domain, weight: float, step: float):
        super().__init__(cost)
        self.domain, self.weight, self.step = domain, weight, step
        self.words = f"beyond {domain}: f, g, q and φ of the nearest state inside, plus a cost of the distance"

    def state(self, x: State) -> PerState:
        return self.cost.state(self.domain.nearest(x)) + self.weight / self.step * self.domain.price(x)

    def R(self, x: State) -> ControlMatrix:
        return self.cost.R(self.domain.nearest(x))

    def rest_at(self, x: State) -> Tensor | None:
        return self.cost.rest_at(self.domain.nearest(x))

    def terminal(self, x: State) -> PerState:
        return self.cost.terminal(self.domain.nearest(x)) + self.weight * self.domain.price(x)

    def ignores(self, i: int, n: int) -> bool:
        return self.cost.ignores(i, n) and self._is_free(i)

    def ignores_at_end(self, i: int, n: int) -> bool:
        return self.cost.ignores_at_end(i, n) and self._is_free(i)

    def _is_free(self, i: int) -> bool:
        return bool(self.domain.lower[i].isinf() & self.domain.upper[i].isinf())


def as_written(cost: Cost) -> Cost:
    """The original cost of a task: without penalties for constraints and domain, and without smoothing."""
    while isinstance(cost, PenaltyCost | DomainCost | SmoothedCost):
        cost = cost.cost
    return cost


@torch.no_grad()
def find_borders(functions: Mapping[str, Callable[[State], Tensor]], box: Box, names: Sequence[str]) -> list[Border]:
    """The borders at which some function becomes non-finite when a single state component is moved out of X₀.

    A border counts if it is the same from each of TEST_STATES states of X₀, up to rounding. √(x₁ + x₂), for example,
    has no such border.

    Args:
        functions: symbol in messages ↦ function of the state.
        box: X₀, in float64.
        names: names of the states.
    """
    x, size, n, every = (
        box.sample(TEST_STATES, torch.Generator().manual_seed(0)),
        size_of(box),
        box.dimension,
        [*functions],
    )
    i, side = torch.arange(n).repeat(2), torch.tensor([-1.0, 1.0]).to(x).repeat_interleave(n)  # 2n directions
    start, way = x[:, i].mT, (side * size[i])[:, None]

    def defined(names: Sequence[str], values: Tensor) -> Tensor:
        """Whether functions are finite at the test states with given values (2n, TEST_STATES, …) of component i."""
        own = x.reshape(1, TEST_STATES, *[1] * (values.ndim - 2), n).expand(*values.shape, n)
        chosen = i.reshape(-1, *[1] * values.ndim).expand(*values.shape, 1)
        states = own.scatter(-1, chosen, values[..., None]).reshape(-1, n)
        finite = [
            torch.stack([_is_finite(functions[name](block)) for name in names]).all(0)
            for block in states.split(STATES_AT_ONCE)
        ]
        return torch.cat(finite).reshape(values.shape)

    shares = SEARCH_REACH * torch.arange(SEARCH_PLACES + 1).to(x) / SEARCH_PLACES
    first = (~defined(every, start[..., None] + way[..., None] * shares)).int().argmax(-1)
    if not bool((first > 0).all(-1).any()):
        return []
    low, high = shares[(first - 1).clamp_min(0)], shares[first]
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        inside = defined(every, start + way * middle)
        low, high = torch.where(inside, middle, low), torch.where(inside, high, middle)
    border = start + way * low
    beyond = border[..., None] + way[..., None] * torch.tensor(TEST_DISTANCES).to(x)
    same = (border - border[:, :1]).abs().amax(-1) <= INNER_MARGIN * size[i]
    taken = (first > 0).all(-1) & same & ~defined(every, beyond).flatten(1).any(-1)
    ending = {name: ~defined([name], beyond).flatten(1).any(-1) for name in every}
    return [
        Border(
            names[int(i[k])],
            "lower" if side[k] < 0 else "upper",
            _round_border(float(border[k, 0]), INNER_MARGIN * float(size[i[k]])),
            _describe_functions([name for name in every if ending[name][k]]),
        )
        for k in torch.nonzero(taken).flatten().tolist()
    ]


def _is_finite(values: Tensor) -> Tensor:
    """Whether each of a batch of values (k, …) is finite; values expanded from one are tested once."""
    different = values[:1] if values.stride(0) == 0 else values
    return different.isfinite().flatten(1).all(-1).expand(len(values)) if values.ndim > 1 else values.isfinite()


def size_of(box: Box) -> Float[Tensor, " n"]:
    """The largest |x_i| in X₀, or 1 if it is zero."""
    return box.magnitude.where(box.magnitude > 0, 1.0)


def _round_border(value: float, room: float) -> float:
    """Round a border from bisection to the number that is meant, such as 0, 1 or 0.25."""
    return next(each for each in (0.0, float(f"{value:.6g}"), value) if abs(each - value) <= room)


def _describe_functions(names: Sequence[str]) -> str:
    """Describe the functions that have a border; "something" if none of them has it from every state."""
    *others, last = names or ["something"]
    return f"where {', '.join(others)} and {last} are defined" if others else f"where {last} is defined"

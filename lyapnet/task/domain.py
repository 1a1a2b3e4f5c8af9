"""Domains: the states at which f, g, q and φ are defined, found by asking them along each state, or declared.

Beyond a border a logarithm, a root or a power is no number, and one such number makes a whole gradient one. So the
functions of a task with a domain are asked at the nearest state just within it, where they and their slopes are finite,
and whoever leaves pays for how far. A task whose functions are finite everywhere has no domain, and stays as it is.
"""

import copy
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lyapnet.base.types import ControlMatrix, PerState, State, StatePath
from lyapnet.task.cost import Cost, MadeOfAnother, PenaltyCost, SmoothedCost
from lyapnet.task.sets import Box
from lyapnet.task.systems import ControlAffineSystem

ROOM = 1e-9  # of a state's size: how far within its border functions are asked
ROUNDINGS = 64  # of the precision that x has, where these are more
SOFT = 1e-3  # of a state's size, from which on the price of being outside is proportional to how far
SLACK = 1e-2  # of a state's size, by which a step may pass a border, at that price; beyond it the domain is left
ROUNDED = 1e-6  # of a state's size, by which rounding may pass a border
TRIED = 8  # states of X₀, from each of which a border has to be the same
REACH, PLACES, HALVINGS = 8.0, 64, 60  # in sizes, how far borders are sought; in how many places; and then by halving
BEYOND = (1e-6, 1e-3)  # sizes beyond a border at which a function is undefined still: a pole is no border
OF_SYSTEM = ("f", "g", "dynamics", "inverse_mass")


class Border(NamedTuple):
    """Where a state ends: an entry of `domain` or `constraints` in a config, and why."""

    state: str
    side: str  # lower or upper
    value: float
    because: str

    def __str__(self) -> str:
        return f"{self.state} {'>' if self.side == 'lower' else '<'} {self.value:g}, {self.because}"


class Domain:
    """{x : lower ≤ x ≤ upper}, of which most bounds are infinite. Nothing in it changes.

    Args:
        names: of the states.
        size: (n,), in their units: what of each counts as 1.
        borders: at least one.
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
        """(lower, upper), each by a share of a state's size further within."""
        return self.lower + share * self.size, self.upper - share * self.size

    def nearest(self, x: State) -> State:
        """The closest state just within, (*batch, n)."""
        low, high = self.narrowed(max(ROOM, ROUNDINGS * torch.finfo(x.dtype).eps))
        return x.clamp(low.to(x), high.to(x))

    def _outside(self, x: State) -> State:
        """How far each state is outside, in sizes and with its sign; zero within."""
        return (x - x.clamp(self.lower.to(x), self.upper.to(x))) / self.size.to(x)

    def price(self, x: State) -> PerState:
        """√(d² + s²) − s at a distance d beyond the border, in sizes: zero within, ½d²/s close to it, d far away."""
        squared = (self._outside(x) ** 2).sum(-1)
        return squared / (torch.sqrt(squared + SOFT**2) + SOFT)

    def left(self, x: StatePath, slack: float = SLACK) -> Bool[Tensor, "*batch"]:
        """Whether a path (nodes, *batch, n) is outside at one of its nodes, by more than a share of a state's size."""
        return (self._outside(x).abs() > slack).any(-1).any(0)


def within(system: ControlAffineSystem, domain: Domain) -> ControlAffineSystem:
    """A copy of a system, of a class of the same name, whose f and g are asked at the nearest state of a domain."""
    return _put_within(copy.deepcopy(system), domain)


def _put_within(system: ControlAffineSystem, domain: Domain) -> ControlAffineSystem:
    """The same object with a class of its own."""

    def at_nearest(function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def asked(self: Any, x: State, *others: Any) -> Any:
            return function(self, domain.nearest(x), *others)

        return asked

    def reduced(self: Any, protocol: Any) -> tuple[Any, ...]:
        """What copies and pickles are made of: the system without its domain, and the domain."""
        plain = cls.__new__(cls)
        vars(plain).update(vars(self))
        return _put_within, (plain, domain)

    cls = type(system)
    functions = {name: at_nearest(getattr(cls, name)) for name in OF_SYSTEM if hasattr(cls, name)}
    if cls.dynamics is ControlAffineSystem.dynamics:
        functions.pop("dynamics")  # the sum of f and g, which ask there
    said = {name: getattr(cls, name) for name in ("__module__", "__qualname__", "__doc__")}
    own = {**functions, **said, "domain": domain, "__reduce_ex__": reduced}
    system.__class__ = type(cls.__name__, (cls,), own)
    return system


class DomainCost(MadeOfAnother):
    """Another cost, asked at the nearest state of a domain, and w · price(x) for each step that is spent outside.

    The last state pays for one step too, for which it would stay. Within the domain it is the other cost.

    Args:
        cost: what is paid besides.
        domain: of its states.
        weight: w, in cost.
        step: Δt, in s.
    """

    domain: Domain
    weight: float
    step: float
    words: str

    def __init__(self, cost: Cost, domain: Domain, weight: float, step: float):
        super().__init__(cost)
        self.domain, self.weight, self.step = domain, weight, step
        self.words = f"beyond {domain}: f, g, q and φ as just within, and what a state outside pays"

    def state(self, x: State) -> PerState:
        return self.cost.state(self.domain.nearest(x)) + self.weight / self.step * self.domain.price(x)

    def R(self, x: State) -> ControlMatrix:
        return self.cost.R(self.domain.nearest(x))

    def terminal(self, x: State) -> PerState:
        return self.cost.terminal(self.domain.nearest(x)) + self.weight * self.domain.price(x)

    def ignores(self, i: int, n: int) -> bool:
        return self.cost.ignores(i, n) and self._is_free(i)

    def ignores_at_end(self, i: int, n: int) -> bool:
        return self.cost.ignores_at_end(i, n) and self._is_free(i)

    def _is_free(self, i: int) -> bool:
        return bool(self.domain.lower[i].isinf() & self.domain.upper[i].isinf())


def as_written(cost: Cost) -> Cost:
    """The cost of a task without the prices that keep closed loops off constraints and in the domain, not rounded."""
    while isinstance(cost, PenaltyCost | DomainCost | SmoothedCost):
        cost = cost.cost
    return cost


@torch.no_grad()
def found_borders(functions: Mapping[str, Callable[[State], Tensor]], box: Box, names: Sequence[str]) -> list[Border]:
    """Where some function of a state has no finite value any more when one of its numbers alone is moved out of X₀.

    A border counts if it is the same from each of TRIED states of X₀, within rounding; that of √(x₁ + x₂) is none.

    Args:
        functions: by the letters that messages have for them.
        box: X₀, in float64.
        names: of its states.
    """
    x, size, n, every = box.sample(TRIED, torch.Generator().manual_seed(0)), size_of(box), box.dimension, [*functions]
    i, side = torch.arange(n).repeat(2), torch.tensor([-1.0, 1.0]).to(x).repeat_interleave(n)  # the 2n ways out
    start, way = x[:, i].mT, (side * size[i])[:, None]

    def defined(names: Sequence[str], values: Tensor) -> Tensor:
        """Whether functions are finite where the number i of the states of X₀ has other values (2n, TRIED, …)."""
        own = x.reshape(1, TRIED, *[1] * (values.ndim - 2), n).expand(*values.shape, n)
        chosen = i.reshape(-1, *[1] * values.ndim).expand(*values.shape, 1)
        states = own.scatter(-1, chosen, values[..., None]).reshape(-1, n)
        finite = [functions[name](states).reshape(len(states), -1).isfinite().all(-1) for name in names]
        return torch.stack(finite).all(0).reshape(values.shape)

    shares = REACH * torch.arange(PLACES + 1).to(x) / PLACES
    first = (~defined(every, start[..., None] + way[..., None] * shares)).int().argmax(-1)
    if not bool((first > 0).all(-1).any()):
        return []
    low, high = shares[(first - 1).clamp_min(0)], shares[first]
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        inside = defined(every, start + way * middle)
        low, high = torch.where(inside, middle, low), torch.where(inside, high, middle)
    border = start + way * low
    beyond = border[..., None] + way[..., None] * torch.tensor(BEYOND).to(x)
    same = (border - border[:, :1]).abs().amax(-1) <= ROOM * size[i]
    taken = (first > 0).all(-1) & same & ~defined(every, beyond).flatten(1).any(-1)
    ending = {name: ~defined([name], beyond).flatten(1).any(-1) for name in every}
    return [
        Border(
            names[int(i[k])],
            "lower" if side[k] < 0 else "upper",
            _rounded(float(border[k, 0]), ROOM * float(size[i[k]])),
            _because([name for name in every if ending[name][k]]),
        )
        for k in torch.nonzero(taken).flatten().tolist()
    ]


def size_of(box: Box) -> Float[Tensor, " n"]:
    """How large the states of X₀ are; 1 where they are zero."""
    return box.magnitude.where(box.magnitude > 0, 1.0)


def _rounded(value: float, room: float) -> float:
    """A border found by halving as the number that is meant: 0, 1 or 0.25."""
    return next(each for each in (0.0, float(f"{value:.6g}"), value) if abs(each - value) <= room)


def _because(names: Sequence[str]) -> str:
    """Of which functions a border is; of some together, where none ends by itself from every state."""
    *others, last = names or ["something"]
    return f"where {', '.join(others)} and {last} are defined" if others else f"where {last} is defined"

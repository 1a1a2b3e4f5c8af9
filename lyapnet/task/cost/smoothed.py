"""A smoothed cost: roots, norms and absolute values with a kink at the goal are rounded there."""

import copy
import math
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.overrides import TorchFunctionMode

from lyapnet.base.linear_algebra import norm
from lyapnet.base.types import PerState, State
from lyapnet.task.cost.base import Cost
from lyapnet.task.cost.wrappers import CostWrapper


class SmoothedCost(CostWrapper):
    """Another cost in which each √a, |a| and ‖v‖ that vanishes at the goal is replaced by a smooth function:
    √(a + ε²) − ε, √(a² + ε²) − ε and √(‖v‖² + ε²) − ε.

    These have the same zeros, curvature 1/ε there, and are smaller by at most ε. ε is proportional to the mean result
    of the call on some states; calls are identified by their order.

    Args:
        cost: the cost to smooth.
        x: states (b, n) of typical size, which determine ε.
        goal: (n,).
        share: ε relative to the mean result of the call on x.
    """

    widths: dict[str, list[float]]  # ε of each call in q and in φ; 0 for calls that remain unchanged

    def __init__(self, cost: Cost, x: Float[Tensor, "b n"], goal: Float[Tensor, " n"], share: float):
        super().__init__(cost)
        own, x, goal = copy.deepcopy(cost).double().cpu(), x.double().cpu(), goal.double().cpu()
        self.widths = {
            symbol: list(map(partial(_width, share), _calls(function, x), _calls(function, goal[None])))
            for symbol, function in (("q", own.state), ("φ", own.terminal))
        }
        said = dict.fromkeys(f"{width:.2g}" for widths in self.widths.values() for width in widths if width)
        self.words: str = f"√(x² + ε²) − ε with ε = {', '.join(said)}" if said else ""

    def state(self, x: State) -> PerState:
        with _Rounding(self.widths["q"]):
            return self.cost.state(x)

    def terminal(self, x: State) -> PerState:
        with _Rounding(self.widths["φ"]):
            return self.cost.terminal(x)


class _Rounding(TorchFunctionMode):
    """Replaces roots, norms and absolute values, in the order of calls, by smooth ones; stores the other results."""

    def __init__(self, widths: Iterable[float] = ()):
        super().__init__()
        self.widths, self.found = iter(widths), list[Tensor]()

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        named = kwargs or {}
        squared = _square_of_result(func, args, named)
        if squared is None:
            return func(*args, **named)
        if width := next(self.widths, 0.0):
            return squared / (torch.sqrt(squared + width**2) + width)  # √(a + ε²) − ε, without cancellation near 0
        self.found.append(func(*args, **named))
        return self.found[-1]


@torch.no_grad()
def _calls(function: Callable[[State], PerState], x: State) -> list[Tensor]:
    """The results of all roots, norms and absolute values in a function."""
    with _Rounding() as mode:
        function(x)
    return mode.found


def _width(share: float, usual: Tensor, at_goal: Tensor) -> float:
    """ε of a call; 0 if its result does not vanish at the goal."""
    finite = usual[usual.isfinite()].abs()
    width = share * float(finite.mean()) if len(finite) else 0.0
    return width if math.isfinite(width) and bool((at_goal.abs() <= width).any()) else 0.0


def _square_of_result(func: Any, args: Any, named: Any) -> Tensor | None:
    """The square of the result of a root, an absolute value or a 2-norm; None for another function."""
    name = getattr(func, "__name__", "").removeprefix("linalg_")
    if not args or not isinstance(args[0], Tensor) or named.get("out") is not None or named.get("dtype") is not None:
        return None
    first, *others = args
    if func is norm:
        return (first * first).sum(*others, **named) if others or named else (first * first).sum(-1)
    if name == "sqrt" or (name in ("pow", "__pow__") and [*others, *named.values()] == [0.5]):
        return first
    if name in ("abs", "__abs__", "absolute"):
        return first * first
    if name not in ("norm", "vector_norm"):
        return None
    given = dict(zip(("p", "dim", "keepdim"), others, strict=False)) | named
    order, dim = given.get("ord", given.get("p", 2)), given.get("dim")
    if order not in (None, 2, "fro") or dim is None or not (isinstance(dim, int) or len(dim) == 1):
        return None
    return (first * first).sum(dim, keepdim=given.get("keepdim", False))

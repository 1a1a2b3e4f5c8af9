"""Jumps of functions that others wrote: signs, roundings and comparisons whose two sides differ."""

from collections.abc import Callable, Mapping, Sequence
from traceback import FrameSummary
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from lyapnet.base.errors import place_of, running_line
from lyapnet.base.types import State

SEGMENTS, POINTS = 32, 33  # straight lines through the states that are looked at, and states on each
HALVINGS = 80  # of the distance between two states on either side, at the most: until nothing lies between them
JUMP = 1e-6  # of the largest value seen in a component, above which its two sides differ
SAME = 1e-6  # of the extent, by which a state may differ where a function jumps at the same value of it
ZERO = 1e-12  # of the extent, below which a state is 0 but for rounding
CROSSINGS = 4  # lines on which that value is looked for
SLOPE = (
    "write a slope in its place, such as torch.tanh(v / ε) for torch.sign(v), with ε as wide as what v does in a step"
)

WHOLE = ("sign", "sgn", "round", "floor", "ceil", "trunc", "floor_divide", "heaviside", "signbit", "argmax", "argmin",
         "searchsorted", "bucketize", "gt", "ge", "lt", "le", "eq", "ne")  # fmt: skip
"""Operators whose results take separate values."""
TURNS: Mapping[str, Callable[..., Tensor]] = {
    "remainder": lambda result, x, y: torch.floor(torch.as_tensor(x) / y),
    "fmod": lambda result, x, y: torch.trunc(torch.as_tensor(x) / y),
    "frac": lambda result, x: torch.trunc(x),
    "atan2": lambda result, y, x: torch.signbit(torch.as_tensor(y)) & (torch.as_tensor(x) < 0),
}
"""Operators that jump somewhere ↦ what changes where they do."""


class Jump(NamedTuple):
    """Where a function jumps."""

    line: FrameSummary | None  # of the user's own code
    x: State  # on one side, (n,)
    constant: list[int]  # the states that have this value wherever it jumps, as far as was seen
    component: int  # of the function's result, flattened
    size: float  # by how much that jumps

    def told(self, name: str, state_names: Sequence[str]) -> str:
        """In words: "Block.f(x) jumps by 11.8 where speed = 0, at system.py:17 (…)"."""
        where = ", ".join(f"{state_names[i]} = {float(self.x[i]):.4g}" for i in self.constant)
        at = f"where {where}" if where else f"as at x = ({', '.join(f'{value:.4g}' for value in self.x.tolist())})"
        return f"{name} jumps by {self.size:.3g} {at}{place_of(self.line)}"


class _Decisions(TorchDispatchMode):
    """Collects what operators decide about each state of a batch, and in which line they stand."""

    def __init__(self, batch: Sequence[int], with_lines: bool = False):
        super().__init__()
        self.batch, self.with_lines = tuple(batch), with_lines
        self.found, self.lines = list[Tensor](), list[FrameSummary | None]()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        name = func.__name__.split(".")[0].rstrip("_")
        decided = result if name in WHOLE else None
        if name in TURNS:
            decided = TURNS[name](result, *args)
        elif name == "to_copy" or name == "_to_copy":
            decided = result if not result.is_floating_point() and args[0].is_floating_point() else None
        if isinstance(decided, Tensor) and tuple(decided.shape[: len(self.batch)]) == self.batch:
            self.found.append(decided.detach().reshape(*self.batch, -1).to(torch.float64))
            self.lines.append(running_line() if self.with_lines else None)
        return result


def jumps(function: Callable[[State], Tensor], low: State, high: State) -> list[Jump]:
    """The jumps of a function that are met on straight lines between states of a box, one for each line of code.

    Whatever rounds, compares or takes a sign is looked at: where it changes between two states, the change is closed
    in upon until nothing lies between, and counts if the function's values on its two sides differ. So a guard whose
    branches meet, and a table, are none.

    Args:
        function: of states (*batch, n), as check_function holds it; where it does not run under a dispatch mode of
            torch's, nothing is found.
        low, high: the box, (n,).
    """
    try:
        return _jumps(function, low, high)
    except Exception:  # of any kind: the function is the user's, and this is for a note alone
        return []


def _jumps(function: Callable[[State], Tensor], low: State, high: State) -> list[Jump]:
    generator = torch.Generator().manual_seed(0)
    ends = low + (high - low) * torch.rand(2, SEGMENTS, 1, len(low), generator=generator, dtype=torch.float64).to(low)
    share = torch.linspace(0, 1, POINTS, dtype=low.dtype)[None, :, None]
    x = ends[0] + share * (ends[1] - ends[0])
    with torch.no_grad(), _Decisions(x.shape[:-1], with_lines=True) as seen:
        value = function(x)
    scale = value.reshape(-1, *value.shape[2:]).nan_to_num(0, 0, 0).abs().amax(0).flatten()
    found, lines = list[Jump](), set[tuple[str, int] | int]()
    for k, (decided, line) in enumerate(zip(seen.found, seen.lines, strict=True)):
        place = (line.filename, line.lineno or 0) if line is not None else k
        changes = torch.nonzero(decided[:, 1:] != decided[:, :-1])
        if place in lines or not len(changes):
            continue
        first = {int(s): (int(s), int(p), int(c)) for s, p, c in changes.flip(0)}  # of each straight line
        crossings = [
            jump
            for s, p, c in list(first.values())[:CROSSINGS]
            if (jump := _closed_in(function, x[s, p], x[s, p + 1], k, c, scale, line)) is not None
        ]
        if crossings:
            lines.add(place)
            found.append(_with_constants(crossings, high - low))
    return found


def _closed_in(
    function: Callable[[State], Tensor], a: State, b: State, k: int, component: int, scale: Tensor,
    line: FrameSummary | None,
) -> Jump | None:  # fmt: skip
    """What the k-th decision changes between two states: the jump, if values on its two sides differ."""
    ends = torch.stack([a, b])
    for _ in range(HALVINGS):
        middle = ends.mean(0)
        if bool((middle == ends[0]).all() | (middle == ends[1]).all()):
            break
        three = torch.stack([ends[0], middle, ends[1]])
        with torch.no_grad(), _Decisions((3,)) as seen:
            function(three)
        if k >= len(seen.found):
            return None
        left, here, right = seen.found[k][:, component].tolist()
        if left == right:
            return None
        ends = three[1:] if here == left else three[:2]
    with torch.no_grad():
        sides = function(ends).reshape(2, -1)
    apart = (sides[1] - sides[0]).abs()
    if not sides.isfinite().all() or not bool((apart > JUMP * scale).any()):
        return None
    worst = int((apart / scale.clamp_min(torch.finfo(scale.dtype).tiny)).argmax())
    return Jump(line, ends[0], [], worst, float(apart[worst]))


def _with_constants(crossings: Sequence[Jump], extent: State) -> Jump:
    """The first crossing, with the states that have the same value at all of them; without rounding in these."""
    x, room = torch.stack([jump.x for jump in crossings]), SAME * extent
    constant = (x.amax(0) - x.amin(0) <= room) & torch.tensor(len(crossings) > 1)
    here = torch.where((x[0].abs() <= room) & (constant | (x[0].abs() <= ZERO * extent)), 0.0, x[0])
    return crossings[0]._replace(x=here, constant=torch.nonzero(constant).flatten().tolist())

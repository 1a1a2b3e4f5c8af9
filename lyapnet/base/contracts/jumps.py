"""Detects jumps of users' functions at signs, roundings and comparisons."""

from collections.abc import Callable, Mapping, Sequence
from traceback import FrameSummary
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from lyapnet.base.errors import place_of, running_line
from lyapnet.base.types import State

SEGMENTS, POINTS = 32, 33  # random straight lines, and states on each line
MAX_BISECTIONS = 80  # bisection steps that locate a jump, until no number lies between its two sides
MIN_JUMP = 1e-6  # smallest jump, relative to the largest value of a component
SAME_VALUE_TOLERANCE = 1e-6  # states at several jumps that differ by less are equal, relative to the extent
ZERO_TOLERANCE = 1e-12  # state that counts as 0, relative to the extent
CROSSINGS = 4  # lines on which a jump is located to find the states that are constant there
SLOPE = (
    "replace it by a slope, such as torch.tanh(v / ε) for torch.sign(v), with ε as large as the change of v in a step"
)

DISCRETE_OPERATORS = (
    *("sign", "sgn", "round", "floor", "ceil", "trunc", "floor_divide", "heaviside", "signbit", "argmax", "argmin"),
    *("searchsorted", "bucketize", "gt", "ge", "lt", "le", "eq", "ne"),
)
"""Operators with discrete results."""
JUMPING_OPERATORS: Mapping[str, Callable[..., Tensor]] = {
    "remainder": lambda result, x, y: torch.floor(torch.as_tensor(x) / y),
    "fmod": lambda result, x, y: torch.trunc(torch.as_tensor(x) / y),
    "frac": lambda result, x: torch.trunc(x),
    "atan2": lambda result, y, x: torch.signbit(torch.as_tensor(y)) & (torch.as_tensor(x) < 0),
}
"""Operators that jump ↦ a discrete quantity that changes at their jumps."""


class Jump(NamedTuple):
    """A jump of a function."""

    line: FrameSummary | None  # line of the user's code
    x: State  # a state on one side of the jump, (n,)
    constant: list[int]  # indices of states that had the same value at all located jumps
    component: int  # index of the component that jumps, in the flattened result
    size: float  # size of its jump

    def described(self, name: str, state_names: Sequence[str]) -> str:
        """Describe the jump: "Block.f(x) jumps by 11.8 where speed = 0, at system.py:17 (…)"."""
        where = ", ".join(f"{state_names[i]} = {float(self.x[i]):.4g}" for i in self.constant)
        at = f"where {where}" if where else f"as at x = ({', '.join(f'{value:.4g}' for value in self.x.tolist())})"
        return f"{name} jumps by {self.size:.3g} {at}{place_of(self.line)}"


class _Decisions(TorchDispatchMode):
    """Collects the discrete results of operators for each state of a batch, and the lines of these operators."""

    def __init__(self, batch: Sequence[int], with_lines: bool = False):
        super().__init__()
        self.batch, self.with_lines = tuple(batch), with_lines
        self.found, self.lines = list[Tensor](), list[FrameSummary | None]()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        name = func.__name__.split(".")[0].rstrip("_")
        decided = result if name in DISCRETE_OPERATORS else None
        if name in JUMPING_OPERATORS:
            decided = JUMPING_OPERATORS[name](result, *args)
        elif name == "to_copy" or name == "_to_copy":
            decided = result if not result.is_floating_point() and args[0].is_floating_point() else None
        if isinstance(decided, Tensor) and tuple(decided.shape[: len(self.batch)]) == self.batch:
            self.found.append(decided.detach().reshape(*self.batch, -1).to(torch.float64))
            self.lines.append(running_line() if self.with_lines else None)
        return result


def jumps(function: Callable[[State], Tensor], low: State, high: State) -> list[Jump]:
    """The jumps of a function on random straight lines in a box, one for each line of code.

    All roundings, comparisons and signs are observed. If one changes between two states, the change is located by
    bisection; it is a jump if the function's values on both sides differ. Branches that meet continuously, and tables,
    are therefore no jumps.

    Args:
        function: a function of states (*batch, n) that passes check_function. If it does not run under torch's dispatch
            mode, the result is empty.
        low, high: the box, (n,).
    """
    try:
        return _jumps(function, low, high)
    except Exception:  # the function is the user's, and the result is only for a note
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
        first = {int(s): (int(s), int(p), int(c)) for s, p, c in changes.flip(0)}  # first change on each line
        crossings = [
            jump
            for s, p, c in list(first.values())[:CROSSINGS]
            if (jump := _bisect(function, x[s, p], x[s, p + 1], k, c, scale, line)) is not None
        ]
        if crossings:
            lines.add(place)
            found.append(_with_constants(crossings, high - low))
    return found


def _bisect(
    function: Callable[[State], Tensor], a: State, b: State, k: int, component: int, scale: Tensor,
    line: FrameSummary | None,
) -> Jump | None:  # fmt: skip
    """Locate the change of the k-th discrete result between two states; the jump, or None if values agree there."""
    ends = torch.stack([a, b])
    for _ in range(MAX_BISECTIONS):
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
    if not sides.isfinite().all() or not bool((apart > MIN_JUMP * scale).any()):
        return None
    worst = int((apart / scale.clamp_min(torch.finfo(scale.dtype).tiny)).argmax())
    return Jump(line, ends[0], [], worst, float(apart[worst]))


def _with_constants(crossings: Sequence[Jump], extent: State) -> Jump:
    """The first jump of several, with the states that have the same value at all of them, without rounding."""
    x, room = torch.stack([jump.x for jump in crossings]), SAME_VALUE_TOLERANCE * extent
    constant = (x.amax(0) - x.amin(0) <= room) & torch.tensor(len(crossings) > 1)
    here = torch.where((x[0].abs() <= room) & (constant | (x[0].abs() <= ZERO_TOLERANCE * extent)), 0.0, x[0])
    return crossings[0]._replace(x=here, constant=torch.nonzero(constant).flatten().tolist())

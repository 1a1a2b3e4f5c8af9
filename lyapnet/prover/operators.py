"""A new operator in one declaration: its row in the table of operators, and its bounds.

The row (lyapnet.graphs.operators) serves numbers, C, JavaScript and CasADi. Bounds are given here, not in the row: what
a kept proof depends on is this folder, and the file that registers an operator joins it (`files`).
"""

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from lyapnet.base.errors import LyapnetError, UsageError, one_line
from lyapnet.graphs import operators as table
from lyapnet.graphs.operators import OPERATORS, Operator
from lyapnet.prover.bound_kernel import writing
from lyapnet.prover.bound_rules import RULES
from lyapnet.prover.bounds import BoundedFunction
from lyapnet.prover.branches import JUMPS, KINKS
from lyapnet.prover.composed_rules import in_programs, on_forms
from lyapnet.prover.elementary_functions import Elementary
from lyapnet.prover.taylor import TaylorForm, monomials

Bound = Elementary | Callable[..., Any]

BOXES, POINTS = 40, 40  # on which bounds are held against values
CLOSE = 1e-7  # how far a derivative may be from torch's, relative to its size, or to 1 where it is smaller

KINDS: dict[str, dict[Any, Any]] = {"smooth": {}, "kink": KINKS, "jump": JUMPS}
_files = list[bytes]()


def register(row: Operator, bound: Bound | None = None, kind: Literal["smooth", "kink", "jump"] = "smooth") -> None:
    """Put an operator of torch into the table, for all that reads traces; its derivative is torch's own.

    Args:
        row: a new one, or one of the table that has no bounds yet.
        bound: an Elementary function of one number; or (operators, *operands) ↦ the same in other operators, as
            `operators.mul(x, operators.sigmoid(x))`, of which there is machine code too. None: certificates refuse it.
        kind: whether the derivative exists everywhere, or jumps at kinks, or the function itself jumps.

    Raises:
        UsageError: the table has it already, or torch does not; or a value was found that lies outside its bounds.
    """
    if kind not in KINDS:
        raise UsageError(f"Expected kind as one of {', '.join(KINDS)}, got {kind!r}; choose one.")
    if not isinstance(row, Operator):
        raise UsageError(f"Expected an Operator, got {row!r}; take a row of OPERATORS, or make one.")
    caller = Path(sys._getframe(1).f_code.co_filename)
    is_new = OPERATORS.get(row.name) is not row
    if is_new:
        table.add(row)
    elif has_bounds(row):
        raise UsageError(f"Expected an operator without bounds, got {row.name}.")
    if bound is None:
        return
    with ExitStack() as undo:  # a rule that nobody has checked does not stay, after Ctrl-C neither
        undo.callback(forget, row, is_new)
        try:
            _put_beside(row, bound, kind)
            wrong = next(complaints(row), None)
        except Exception as error:
            raise UsageError(
                f"Expected bounds of {row.name}, got {one_line(error)} as they were tried; mend it."
            ) from error
        if wrong is not None:
            raise UsageError(f"Expected bounds of {row.name} that hold its values, got {wrong}.")
        _files.extend(_content(file) for file in dict.fromkeys([caller, *_files_of(bound)]))  # always in this order
        undo.pop_all()


def _put_beside(row: Operator, bound: Bound, kind: str) -> None:
    """Give bounds to all overloads of a row."""
    for overload in row.overloads:
        composed = not isinstance(bound, Elementary)
        rule = on_forms(bound, RULES) if composed else bound
        for rules in (RULES, KINDS[kind]):
            rules[overload] = rule
        if composed:
            writing.RULES[overload] = in_programs(bound, writing.RULES)


def _files_of(bound: Bound) -> Iterator[Path]:
    """The files in which the functions of a bound are written."""
    parts = vars(bound).values() if isinstance(bound, Elementary) else [bound]
    for part in [*parts, *(getattr(bound, "derivatives", None) or ())]:
        code = getattr(part, "__code__", None)
        if code is not None:
            yield Path(code.co_filename)


def _content(file: Path) -> bytes:
    """The content of a file; of what was typed, something else in each process."""
    return file.read_bytes() if file.is_file() else os.urandom(16)


def forget(row: Operator, is_new: bool = True) -> None:
    """Undo the registration of a row, or of its bounds alone."""
    if is_new:
        table.remove(row)
    for overload in row.overloads:
        for rules in (RULES, KINKS, JUMPS, writing.RULES):
            rules.pop(overload, None)


def files() -> list[bytes]:
    """The content of each file that has registered bounds; of what was typed, something else in each process."""
    return _files


def has_bounds(row: Operator) -> bool:
    """Whether there is a rule for bounds of the operator on tensors."""
    return row.overloads[0] in RULES


def complaints(row: Operator) -> Iterator[str]:
    """What is wrong with the bounds of a row: on random boxes of its domain, and in the parts of an Elementary."""
    rule = RULES[row.overloads[0]]
    if isinstance(rule, Elementary):
        yield from _wrong_parts(row, rule)
    box = torch.zeros(1 + row.operands).double(), torch.ones(1 + row.operands).double()
    lower, upper, points = _boxes(1 + row.operands)
    values = row(*row.at(points[..., 1:])).double()
    if not values.isfinite().all():
        yield f"a domain {row.domain} in which it is not finite"
        return
    for degree in (1, 2, 3):
        try:
            bounded = BoundedFunction(lambda t, x: (row(*row.at(x)).double(),), box, degree)
        except LyapnetError as error:
            yield one_line(error)
            return
        kernel = bounded.kernel(lower, upper)
        for form, *_ in [bounded.forms(lower, upper), *([] if kernel is None else [kernel.forms(lower, upper)])]:
            if not form.radius.isfinite().any():
                yield f"none in forms of degree {degree}"
            room = form.radius * (1 + 1e-9) + 1e-13 * form.magnitude  # for the rounding of these lines
            inside = (values - _at(form, points, lower, upper)).abs() <= room  # not where one of them is no number
            outside = int((~inside).sum())
            if outside:
                yield f"{outside} of {values.numel()} values outside, in forms of degree {degree}"


def _at(form: TaylorForm, points: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """The polynomials of forms of boxes at points in them, (points, boxes)."""
    epsilon = ((points - (lower + upper) / 2) / ((upper - lower) / 2)).clamp(-1, 1)
    powers = [epsilon[..., list(axes)].prod(-1) for axes in monomials(form.dimension, form.degree)]
    return torch.stack([term * power for term, power in zip(form.terms, powers, strict=True)]).sum(0)


def _boxes(axes: int) -> tuple[Tensor, Tensor, Tensor]:
    """Boxes in the unit cube, wide and narrow ones, and points of them, some on their sides."""
    generator = torch.Generator().manual_seed(0)
    middle, width = torch.rand(2, BOXES, axes, generator=generator, dtype=torch.float64)
    width = width * 10.0 ** -torch.arange(BOXES).remainder(4)[:, None]
    lower, upper = (middle - width / 2).clamp(0, 1), (middle + width / 2).clamp(0, 1)
    share = torch.rand(POINTS, BOXES, axes, generator=generator, dtype=torch.float64).mul(1.5).sub(0.25).clamp(0, 1)
    return lower, upper, lower + (upper - lower) * share


def _wrong_parts(row: Operator, of: Elementary) -> Iterator[str]:
    """The parts of an Elementary that are not what torch differentiates the function to."""
    (x,) = row.at(torch.linspace(0, 1, 201, dtype=torch.float64)[:, None])
    if not _are_close(of.function(x), row(x)):
        yield "another function"
    chain = [of.function, of.derivative]
    if of.derivatives is not None:
        chain += [of.derivatives.second, of.derivatives.third]
    for order in range(1, len(chain)):
        if not _are_close(chain[order](x), _slope(chain[order - 1], x)):
            yield f"another derivative of order {order}"
    if of.derivatives is None:
        return
    ranges = of.derivatives.third_range, of.derivatives.fourth_range
    for values, range_of in zip((of.derivatives.third(x), _slope(of.derivatives.third, x)), ranges, strict=True):
        if not all(_holds(range_of, x, values, steps) for steps in (2, 20, 200)):
            yield f"a range of a derivative of order {3 + ranges.index(range_of)} that does not hold it"


def _holds(range_of: Callable[..., tuple[Tensor, Tensor]], x: Tensor, values: Tensor, steps: int) -> bool:
    """Whether values at rising points lie in the range on each interval of so many steps."""
    low, high = range_of(x[:-steps], x[steps:])
    inside = values.unfold(0, steps + 1, 1)
    room = CLOSE * (1 + inside.abs())
    return bool(((low[:, None] - room <= inside) & (inside <= high[:, None] + room)).all())


def _slope(function: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    with torch.enable_grad():
        leaf = x.clone().requires_grad_()
        return torch.autograd.grad(function(leaf).sum(), leaf)[0]


def _are_close(found: Tensor, expected: Tensor) -> bool:
    return bool(((found - expected).abs() <= CLOSE * (1 + expected.abs())).all())

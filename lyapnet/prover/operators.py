"""Registration of users' operators: a row of the table of operators, and its bounds.

The row (lyapnet.graphs.operators) says how numbers, C, JavaScript and CasADi compute the operator. Bounds are not part
of the row, because a kept proof depends on the code of this folder and on the files that register bounds (`files`).
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
from lyapnet.prover.composed_rules import for_forms, for_programs
from lyapnet.prover.elementary_functions import Elementary
from lyapnet.prover.taylor import TaylorForm, monomials

Bound = Elementary | Callable[..., Any]

BOXES, POINTS = 40, 40  # number of boxes whose bounds are compared with values, and of points in each
TOLERANCE = 1e-7  # largest difference of two derivatives that should be equal, relative to 1 + |derivative|

KINDS: dict[str, dict[Any, Any]] = {"smooth": {}, "kink": KINKS, "jump": JUMPS}
_files = dict[str, list[bytes]]()  # name of a row ↦ contents of the files that define and register its bounds


def register(row: Operator, bound: Bound | None = None, kind: Literal["smooth", "kink", "jump"] = "smooth") -> None:
    """Add an operator of torch to the table of operators; its derivative is torch's own.

    Args:
        row: a new row, or one of the table that has no bounds yet.
        bound: an Elementary function of one number; or a composition (operators, *operands) ↦ result, such as
            `operators.mul(x, operators.sigmoid(x))`, which machine code can use too. With None, certificates refuse the
            operator.
        kind: "smooth" if the derivative exists everywhere, "kink" if it jumps, "jump" if the function itself jumps.

    Raises:
        UsageError: the table has the row already; torch lacks the operator; or a check finds the bounds wrong.
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
    with ExitStack() as undo:  # the registration is undone unless its check succeeds, also after Ctrl-C
        undo.callback(forget, row, is_new)
        try:
            _add_bounds(row, bound, kind)
            wrong = next(complaints(row), None)
        except Exception as error:
            raise UsageError(
                f"Expected bounds of {row.name}, got {one_line(error)} while they were checked; mend them."
            ) from error
        if wrong is not None:
            raise UsageError(f"Expected bounds that enclose the values of {row.name}, got {wrong}; mend them.")
        # dict.fromkeys has a fixed order, on which the hash of a proof's code depends
        _files[row.name] = [_content(file) for file in dict.fromkeys([caller, *_files_of(bound)])]
        undo.pop_all()


def _add_bounds(row: Operator, bound: Bound, kind: str) -> None:
    """Add rules for bounds of all overloads of a row."""
    for overload in row.overloads:
        composed = not isinstance(bound, Elementary)
        rule = for_forms(bound, RULES) if composed else bound
        for rules in (RULES, KINDS[kind]):
            rules[overload] = rule
        if composed:
            writing.RULES[overload] = for_programs(bound, writing.RULES)


def _files_of(bound: Bound) -> Iterator[Path]:
    """The files in which the functions of a bound are defined."""
    parts = vars(bound).values() if isinstance(bound, Elementary) else [bound]
    for part in [*parts, *(getattr(bound, "derivatives", None) or ())]:
        code = getattr(part, "__code__", None)
        if code is not None:
            yield Path(code.co_filename)


def _content(file: Path) -> bytes:
    """The content of a file; for code typed at a prompt random bytes, so that kept proofs refuse other processes."""
    return file.read_bytes() if file.is_file() else os.urandom(16)


def forget(row: Operator, is_new: bool = True) -> None:
    """Undo the registration of a new row, or that of bounds of an old one."""
    _files.pop(row.name, None)
    if is_new:
        table.remove(row)
    for overload in row.overloads:
        for rules in (RULES, KINKS, JUMPS, writing.RULES):
            rules.pop(overload, None)


def files() -> list[bytes]:
    """The contents of all files that define and register bounds; random bytes for code typed at a prompt."""
    return [content for contents in _files.values() for content in contents]


def has_bounds(row: Operator) -> bool:
    """Whether the operator has a rule for bounds."""
    return row.overloads[0] in RULES


def complaints(row: Operator) -> Iterator[str]:
    """Errors in the bounds of a row: values outside on random boxes of its domain; wrong parts of an Elementary."""
    rule = RULES[row.overloads[0]]
    if isinstance(rule, Elementary):
        yield from _wrong_parts(row, rule)
    box = torch.zeros(1 + row.operands).double(), torch.ones(1 + row.operands).double()
    lower, upper, points = _boxes(1 + row.operands)
    values = row(*row.at(points[..., 1:])).double()
    if not values.isfinite().all():
        yield f"values that are not finite in the domain {row.domain}"
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
                yield f"no finite bounds in forms of degree {degree}"
            room = form.radius * (1 + 1e-9) + 1e-13 * form.magnitude  # for the rounding errors of this check
            inside = (values - _at(form, points, lower, upper)).abs() <= room  # false for nan
            outside = int((~inside).sum())
            if outside:
                yield f"{outside} of {values.numel()} values outside, in forms of degree {degree}"


def _at(form: TaylorForm, points: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """The polynomials of forms at points of their boxes, (points, boxes)."""
    epsilon = ((points - (lower + upper) / 2) / ((upper - lower) / 2)).clamp(-1, 1)
    powers = [epsilon[..., list(axes)].prod(-1) for axes in monomials(form.dimension, form.degree)]
    return torch.stack([term * power for term, power in zip(form.terms, powers, strict=True)]).sum(0)


def _boxes(axes: int) -> tuple[Tensor, Tensor, Tensor]:
    """(lower, upper, points) of wide and narrow boxes in the unit cube; some points lie on their sides."""
    generator = torch.Generator().manual_seed(0)
    middle, width = torch.rand(2, BOXES, axes, generator=generator, dtype=torch.float64)
    width = width * 10.0 ** -torch.arange(BOXES).remainder(4)[:, None]
    lower, upper = (middle - width / 2).clamp(0, 1), (middle + width / 2).clamp(0, 1)
    share = torch.rand(POINTS, BOXES, axes, generator=generator, dtype=torch.float64).mul(1.5).sub(0.25).clamp(0, 1)
    return lower, upper, lower + (upper - lower) * share


def _wrong_parts(row: Operator, bound: Elementary) -> Iterator[str]:
    """Errors in the parts of an Elementary: a function or derivative that differs from torch's, a range too narrow."""
    (x,) = row.at(torch.linspace(0, 1, 201, dtype=torch.float64)[:, None])
    if not _are_close(bound.function(x), row(x)):
        yield "another function than the operator"
    chain = [bound.function, bound.derivative]
    if bound.derivatives is not None:
        chain += [bound.derivatives.second, bound.derivatives.third]
    for order in range(1, len(chain)):
        if not _are_close(chain[order](x), _slope(chain[order - 1], x)):
            yield f"another derivative of order {order} than torch"
    if bound.derivatives is None:
        return
    ranges = bound.derivatives.third_range, bound.derivatives.fourth_range
    for values, range_of in zip((bound.derivatives.third(x), _slope(bound.derivatives.third, x)), ranges, strict=True):
        if not all(_encloses(range_of, x, values, steps) for steps in (2, 20, 200)):
            yield f"a range of the derivative of order {3 + ranges.index(range_of)} that does not contain its values"


def _encloses(range_of: Callable[..., tuple[Tensor, Tensor]], x: Tensor, values: Tensor, steps: int) -> bool:
    """Whether values at increasing points lie in the range on each interval of `steps` steps between them."""
    low, high = range_of(x[:-steps], x[steps:])
    inside = values.unfold(0, steps + 1, 1)
    room = TOLERANCE * (1 + inside.abs())
    return bool(((low[:, None] - room <= inside) & (inside <= high[:, None] + room)).all())


def _slope(function: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    with torch.enable_grad():
        leaf = x.clone().requires_grad_()
        return torch.autograd.grad(function(leaf).sum(), leaf)[0]


def _are_close(found: Tensor, expected: Tensor) -> bool:
    return bool(((found - expected).abs() <= TOLERANCE * (1 + expected.abs())).all())

"""The rules of lyapnet.prover.bound_rules for machine code: each writes operations on single numbers."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from lyapnet.prover.bound_kernel.program import Entry, Forms, Program
from lyapnet.prover.composed_rules import COMPOSED, for_programs
from lyapnet.prover.rounding import ROUNDED
from lyapnet.prover.taylor import TINY

aten = torch.ops.aten

Rule = Callable[..., Any]
"""(program, arguments of the operator, some of them forms) ↦ forms."""


def registering(rules: dict[Any, Rule]) -> Callable[..., Callable[[Rule], Rule]]:
    """A decorator that adds a rule for operators to these rules."""

    def rule(*operators: Any) -> Callable[[Rule], Rule]:
        def register(function: Rule) -> Rule:
            rules.update(dict.fromkeys(operators, function))
            return function

        return register

    return rule


RULES: dict[Any, Rule] = {}
rule = registering(RULES)


def as_forms(program: Program, value: Any) -> Forms:
    """A value as forms; a constant becomes forms of its numbers."""
    if isinstance(value, Forms):
        return value
    numbers = tensor_of(value)
    entries = [program.constant(number) for number in numbers.flatten().tolist()]
    return Forms(torch.tensor(entries, dtype=torch.int64).reshape(numbers.shape))


def tensor_of(number: Any) -> Tensor:
    """A number or tensor in float64."""
    return torch.as_tensor(number, dtype=torch.float64)


def each(function: Callable[..., Entry], *values: Any) -> Forms:
    """Apply a function of single numbers, which are entries or constants, to broadcast values."""
    tensors = torch.broadcast_tensors(*(y.entries if isinstance(y, Forms) else tensor_of(y) for y in values))
    columns = [
        map(Entry, tensor.flatten().tolist()) if isinstance(y, Forms) else tensor.flatten().tolist()
        for y, tensor in zip(values, tensors, strict=True)
    ]
    entries = [function(*numbers) for numbers in zip(*columns, strict=True)]
    return Forms(torch.tensor(entries, dtype=torch.int64).reshape(tensors[0].shape))


# Sums and products


@rule(aten.add.Tensor, aten.add.Scalar)
def add(program: Program, x: Any, y: Any, alpha: float = 1) -> Forms:
    """x + αy."""
    if abs(alpha) != 1:
        y, alpha = (multiply(program, y, alpha) if isinstance(y, Forms) else tensor_of(y) * alpha), 1

    def add(a: Any, b: Any) -> Entry:
        if isinstance(a, Entry):
            return program.combine([(1, a), (alpha, b)] if isinstance(b, Entry) else [(1, a)], _plain(b) * alpha)
        return program.combine([(alpha, b)], a)

    return each(add, x, y)


def _plain(number: Any) -> float:
    return 0.0 if isinstance(number, Entry) else number


@rule(aten.sub.Tensor, aten.sub.Scalar)
def subtract(program: Program, x: Any, y: Any, alpha: float = 1) -> Forms:
    """x − αy."""
    return add(program, x, y, -alpha)


@rule(aten.mul.Tensor, aten.mul.Scalar)
def multiply(program: Program, x: Any, y: Any) -> Forms:
    """x · y; x² if both are the same value."""
    if x is y:
        return square(program, x)

    def multiply(a: Any, b: Any) -> Entry:
        if isinstance(a, Entry) and isinstance(b, Entry):
            return program.multiply(a, b)
        return program.scale(a, b) if isinstance(a, Entry) else program.scale(b, a)

    return each(multiply, x, y)


def square(program: Program, x: Forms) -> Forms:
    """x²."""
    return each(program.square, x)


@rule(aten.div.Tensor, aten.div.Scalar)
def _divide(program: Program, x: Any, y: Any) -> Forms:
    if isinstance(y, Forms):
        return multiply(program, x, reciprocal(program, y))
    return each(lambda a, factor: program.combine([(factor, a)], operations=2), x, 1 / tensor_of(y))


@rule(aten.mm.default, aten.bmm.default)
def _matrix_product(program: Program, x: Any, y: Any) -> Forms:
    if not isinstance(x, Forms):
        return Forms(_matrix_product(program, Forms(y.entries.mT), x.mT).entries.mT)
    if not isinstance(y, Forms) and y.ndim == 2:
        rows = [program.matrix_product([Entry(k) for k in row], y.double()) for row in x.entries.tolist()]
        return Forms(torch.tensor(rows, dtype=torch.int64).reshape(len(rows), y.shape[1]))
    right = Forms(y.entries.unsqueeze(-3)) if isinstance(y, Forms) else y.unsqueeze(-3)
    return total(program, multiply(program, Forms(x.entries.unsqueeze(-1)), right), [-2])


@rule(aten.mv.default)
def _matrix_vector_product(program: Program, x: Any, y: Any) -> Forms:
    column = Forms(y.entries.unsqueeze(-1)) if isinstance(y, Forms) else y.unsqueeze(-1)
    return Forms(_matrix_product(program, x, column).entries.squeeze(-1))


@rule(aten.neg.default)
def _negate(program: Program, x: Forms) -> Forms:
    return each(lambda a: program.combine([(-1, a)], operations=0), x)


@rule(aten.sum.default, aten.sum.dim_IntList)
def total(
    program: Program, x: Forms, dim: Sequence[int] | None = None, keepdim: bool = False, dtype: Any = None
) -> Forms:
    """Σ x over some axes."""
    rank = len(x.shape)
    gone = sorted(axis % rank for axis in (dim or range(rank)))
    kept = [axis for axis in range(rank) if axis not in gone]
    groups = x.entries.permute([*kept, *gone]).reshape(math.prod(x.shape[axis] for axis in kept), -1).tolist()
    sums = [program.combine([(1, Entry(a)) for a in group], operations=max(1, len(group) - 1)) for group in groups]
    shape = [1 if axis in gone else x.shape[axis] for axis in range(rank) if keepdim or axis in kept]
    return Forms(torch.tensor(sums, dtype=torch.int64).reshape(shape))


@rule(aten._to_copy.default)
def _to_copy(program: Program, x: Forms, **keywords: Any) -> Forms:
    return x


@rule(ROUNDED)
def _rounded(program: Program, y: Any, at: Forms, *limits: float) -> Forms:
    return each(lambda x: program.rounded(x, *limits), as_forms(program, y))


# Functions of one number


def function_of(name: str, *parameters: float) -> Callable[[Program, Forms], Forms]:
    """The rule of a function of one number."""
    return lambda program, x: each(lambda a: program.function(name, a, *parameters), x)


NO_THRESHOLD = (math.inf, 0.0)  # parameters of functions that torch computes by one formula; see _threshold_parameters
reciprocal = rule(aten.reciprocal.default)(function_of("reciprocal"))
sigmoid = rule(aten.sigmoid.default)(function_of("sigmoid", *NO_THRESHOLD))
for _name in ("exp", "log", "log1p", "sqrt", "sin", "cos", "tan"):
    rule(getattr(aten, _name).default)(function_of(_name))


@rule(aten.tanh.default)
def _tanh(program: Program, x: Forms) -> Forms:
    double = each(lambda a: program.combine([(2, a)], operations=0), x)
    return each(lambda s: program.combine([(2, s)], -1.0), sigmoid(program, double))


def _threshold_parameters(threshold: float) -> tuple[float, float]:
    """(the argument above which torch replaces softplus by the identity, the largest error of doing so)."""
    return threshold, 1.001 * math.exp(-threshold) + TINY


@rule(aten.softplus.default)
def _softplus(program: Program, x: Forms, beta: float = 1, threshold: float = 20) -> Forms:
    y = x if beta == 1 else multiply(program, x, beta)
    softplus = function_of("softplus", *_threshold_parameters(threshold))(program, y)
    return softplus if beta == 1 else _divide(program, softplus, beta)


@rule(aten.softplus_backward.default)
def _softplus_backward(program: Program, gradient: Any, x: Forms, beta: float, threshold: float) -> Forms:
    y = x if beta == 1 else multiply(program, x, beta)
    return multiply(program, gradient, function_of("sigmoid", *_threshold_parameters(threshold))(program, y))


# Additions to entries


@rule(aten.index_add.default)
def _index_add(program: Program, x: Any, dim: int, index: Tensor, source: Any) -> Forms:
    return _add_at(program, x, source, lambda base, y: base.index_add(dim, index, y))


@rule(aten.index_put.default)
def _index_put(program: Program, x: Any, indices: list[Any], values: Any, accumulate: bool = False) -> Forms:
    return _add_at(program, x, values, lambda base, y: aten.index_put.default(base, indices, y, True))


def _add_at(program: Program, x: Any, source: Any, put: Callable[[Tensor, Tensor], Tensor]) -> Forms:
    """x with a source added to some of its entries, at most one number to each."""
    x, source = as_forms(program, x), as_forms(program, source)
    nothing = torch.zeros_like(x.entries)
    if bool((put(nothing, torch.ones_like(source.entries)) > 1).any()):
        raise NotImplementedError("several numbers are added to one")
    return add(program, x, Forms(put(nothing, source.entries)))


RULES.update({operation: for_programs(composed, RULES) for operation, composed in COMPOSED.items()})

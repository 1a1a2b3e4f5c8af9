"""Rules that write programs of bounds: those of lyapnet.graphs.bound_rules and branches, number by number.

What has no rule here is bounded by the interpreter of lyapnet.graphs.bounds.
"""

import math
import operator
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.fx import Graph
from torch.fx.node import map_arg
from torch.utils._pytree import tree_map_only

from lyapnet.graphs.bound_kernel.program import Entry, Forms, Program
from lyapnet.graphs.bound_rules import ARRANGEMENTS, OF_SHAPE

aten = torch.ops.aten

Rule = Callable[..., Any]
RULES: dict[Any, Rule] = {}
"""Operator ↦ its rule: a program and the operator's arguments, some of them forms, ↦ forms."""


def rule(*operators: Any) -> Callable[[Rule], Rule]:
    """Register a rule for operators."""

    def register(function: Rule) -> Rule:
        RULES.update(dict.fromkeys(operators, function))
        return function

    return register


def written(program: Program, nodes: Sequence[Any], constants: dict[Any, Any]) -> list[Forms]:
    """The results of a graph at (t, x), whose operations are written into a program.

    Raises:
        NotImplementedError: an operation has no rule, or arguments that its rule does not cover.
    """
    inputs = iter([Forms(torch.tensor(program.inputs[0])), Forms(torch.tensor(program.inputs[1:]))])
    values = dict(constants)
    for node in nodes:
        if node.op == "placeholder":
            values[node] = next(inputs)
        elif node.op == "output":
            return [_forms(program, y) for y in map_arg(node.args[0], values.__getitem__)]
        elif node not in values:
            arguments, keywords = map_arg((node.args, node.kwargs), values.__getitem__)
            values[node] = _result(program, node, values, arguments, keywords)
    raise AssertionError("a graph ends with its output")


def _result(program: Program, node: Any, values: dict[Any, Any], arguments: Any, keywords: Any) -> Any:
    if not any(isinstance(values[source], Forms | list) for source in node.all_input_nodes):
        return node.target(*arguments, **keywords)
    if node.target in OF_SHAPE:
        x, *others = arguments
        return node.target(torch.zeros(x.shape, dtype=torch.float64), *others, **keywords).to(node.meta["val"].dtype)
    if node.target in RULES:
        return RULES[node.target](program, *arguments, **keywords)
    if node.target in ARRANGEMENTS:
        return _arranged(program, node.target, *arguments, **keywords)
    raise NotImplementedError(node.target)


def _arranged(program: Program, target: Any, *arguments: Any, **keywords: Any) -> Any:
    """The operator on the places of forms, beside which constants become forms."""
    if target is operator.getitem:
        return target(*arguments)
    if target in (aten.cat.default, aten.stack.default):
        arguments = ([_forms(program, item) for item in arguments[0]], *arguments[1:])
    target = {aten.view.default: aten.reshape.default, aten._unsafe_view.default: aten.reshape.default}.get(
        target, target
    )
    arguments, keywords = tree_map_only(Forms, lambda y: y.entries, (arguments, keywords))
    return tree_map_only(Tensor, Forms, target(*arguments, **keywords))


def _forms(program: Program, value: Any) -> Forms:
    """A value as forms."""
    if isinstance(value, Forms):
        return value
    numbers = _tensor(value)
    entries = [program.constant(number) for number in numbers.flatten().tolist()]
    return Forms(torch.tensor(entries, dtype=torch.int64).reshape(numbers.shape))


def _tensor(number: Any) -> Tensor:
    return torch.as_tensor(number, dtype=torch.float64)


def _each(function: Callable[..., Entry], *values: Any) -> Forms:
    """A function of single numbers, entries or plain ones, on values that are broadcast."""
    tensors = torch.broadcast_tensors(*(y.entries if isinstance(y, Forms) else _tensor(y) for y in values))
    columns = [
        map(Entry, tensor.flatten().tolist()) if isinstance(y, Forms) else tensor.flatten().tolist()
        for y, tensor in zip(values, tensors, strict=True)
    ]
    entries = [function(*numbers) for numbers in zip(*columns, strict=True)]
    return Forms(torch.tensor(entries, dtype=torch.int64).reshape(tensors[0].shape))


# Sums and products


@rule(aten.add.Tensor, aten.add.Scalar)
def _add(program: Program, x: Any, y: Any, alpha: float = 1) -> Forms:
    if abs(alpha) != 1:
        y, alpha = (_multiply(program, y, alpha) if isinstance(y, Forms) else _tensor(y) * alpha), 1

    def add(a: Any, b: Any) -> Entry:
        if isinstance(a, Entry):
            return program.combine([(1, a), (alpha, b)] if isinstance(b, Entry) else [(1, a)], _plain(b) * alpha)
        return program.combine([(alpha, b)], a)

    return _each(add, x, y)


def _plain(number: Any) -> float:
    return 0.0 if isinstance(number, Entry) else number


@rule(aten.sub.Tensor, aten.sub.Scalar)
def _subtract(program: Program, x: Any, y: Any, alpha: float = 1) -> Forms:
    return _add(program, x, y, -alpha)


@rule(aten.rsub.Scalar, aten.rsub.Tensor)
def _subtract_from(program: Program, x: Any, y: Any, alpha: float = 1) -> Forms:
    return _subtract(program, y, x, alpha)


@rule(aten.mul.Tensor, aten.mul.Scalar)
def _multiply(program: Program, x: Any, y: Any) -> Forms:
    def multiply(a: Any, b: Any) -> Entry:
        if isinstance(a, Entry) and isinstance(b, Entry):
            return program.multiply(a, b)
        return program.scale(a, b) if isinstance(a, Entry) else program.scale(b, a)

    return _each(multiply, x, y)


@rule(aten.div.Tensor, aten.div.Scalar)
def _divide(program: Program, x: Any, y: Any) -> Forms:
    if isinstance(y, Forms):
        return _multiply(program, x, _reciprocal(program, y))
    return _each(lambda a, factor: program.combine([(factor, a)], operations=2), x, 1 / _tensor(y))


@rule(aten.pow.Tensor_Scalar)
def _power(program: Program, x: Forms, exponent: float) -> Any:
    if exponent == 0:
        return torch.ones(x.shape, dtype=torch.float64)
    if exponent < 0:
        return _reciprocal(program, _power(program, x, -exponent))
    if exponent == 0.5:
        return _function("sqrt")(program, x)
    if exponent == 1:
        return x
    half = _power(program, x, exponent // 2)
    square = _multiply(program, half, half)
    return square if exponent % 2 == 0 else _multiply(program, square, x)


@rule(aten.mm.default, aten.bmm.default)
def _matrix_product(program: Program, x: Any, y: Any) -> Forms:
    if not isinstance(x, Forms):
        return Forms(_matrix_product(program, Forms(y.entries.mT), x.mT).entries.mT)
    if not isinstance(y, Forms) and y.ndim == 2:
        rows = [program.matrix_product([Entry(k) for k in row], y.double()) for row in x.entries.tolist()]
        return Forms(torch.tensor(rows, dtype=torch.int64).reshape(len(rows), y.shape[1]))
    right = Forms(y.entries.unsqueeze(-3)) if isinstance(y, Forms) else y.unsqueeze(-3)
    return _sum(program, _multiply(program, Forms(x.entries.unsqueeze(-1)), right), [-2])


@rule(aten.mv.default)
def _matrix_vector_product(program: Program, x: Any, y: Any) -> Forms:
    column = Forms(y.entries.unsqueeze(-1)) if isinstance(y, Forms) else y.unsqueeze(-1)
    return Forms(_matrix_product(program, x, column).entries.squeeze(-1))


@rule(aten.dot.default)
def _dot(program: Program, x: Any, y: Any) -> Forms:
    return _sum(program, _multiply(program, x, y))


@rule(aten.addmm.default)
def _add_matrix_product(program: Program, offset: Any, x: Any, y: Any, beta: float = 1, alpha: float = 1) -> Forms:
    product = _matrix_product(program, x, y)
    return _add(program, product if alpha == 1 else _multiply(program, product, alpha), offset, beta)


@rule(aten.neg.default)
def _negate(program: Program, x: Forms) -> Forms:
    return _each(lambda a: program.combine([(-1, a)], operations=0), x)


@rule(aten.sum.default, aten.sum.dim_IntList)
def _sum(
    program: Program, x: Forms, dim: Sequence[int] | None = None, keepdim: bool = False, dtype: Any = None
) -> Forms:
    rank = len(x.shape)
    gone = sorted(axis % rank for axis in (dim or range(rank)))
    kept = [axis for axis in range(rank) if axis not in gone]
    groups = x.entries.permute([*kept, *gone]).reshape(math.prod(x.shape[axis] for axis in kept), -1).tolist()
    sums = [program.combine([(1, Entry(a)) for a in group], operations=max(1, len(group) - 1)) for group in groups]
    shape = [1 if axis in gone else x.shape[axis] for axis in range(rank) if keepdim or axis in kept]
    return Forms(torch.tensor(sums, dtype=torch.int64).reshape(shape))


@rule(aten.mean.default, aten.mean.dim)
def _mean(
    program: Program, x: Forms, dim: Sequence[int] | None = None, keepdim: bool = False, dtype: Any = None
) -> Forms:
    total = _sum(program, x, dim, keepdim)
    return _multiply(program, total, total.shape.numel() / x.shape.numel())


@rule(aten._to_copy.default)
def _to_copy(program: Program, x: Forms, **keywords: Any) -> Forms:
    return x


# Functions of one number


def _function(name: str, *parameters: float) -> Callable[[Program, Forms], Forms]:
    return lambda program, x: _each(lambda a: program.function(name, a, *parameters), x)


NOWHERE = (math.inf, 0.0)  # that torch's function would be another one
_reciprocal = rule(aten.reciprocal.default)(_function("reciprocal"))
_sigmoid = rule(aten.sigmoid.default)(_function("sigmoid", *NOWHERE))
for _name in ("exp", "log", "log1p", "sqrt", "sin", "cos", "tan"):
    rule(getattr(aten, _name).default)(_function(_name))


@rule(aten.rsqrt.default)
def _rsqrt(program: Program, x: Forms) -> Forms:
    return _reciprocal(program, _function("sqrt")(program, x))


@rule(aten.tanh.default)
def _tanh(program: Program, x: Forms) -> Forms:
    double = _each(lambda a: program.combine([(2, a)], operations=0), x)
    return _each(lambda s: program.combine([(2, s)], -1.0), _sigmoid(program, double))


def _threshold(threshold: float) -> tuple[float, float]:
    """(where torch's softplus is the identity, by how much it is off at most)."""
    return threshold, 1.001 * math.exp(-threshold)


@rule(aten.softplus.default)
def _softplus(program: Program, x: Forms, beta: float = 1, threshold: float = 20) -> Forms:
    y = x if beta == 1 else _multiply(program, x, beta)
    softplus = _function("softplus", *_threshold(threshold))(program, y)
    return softplus if beta == 1 else _divide(program, softplus, beta)


@rule(aten.softplus_backward.default)
def _softplus_backward(program: Program, gradient: Any, x: Forms, beta: float, threshold: float) -> Forms:
    y = x if beta == 1 else _multiply(program, x, beta)
    return _multiply(program, gradient, _function("sigmoid", *_threshold(threshold))(program, y))


@rule(aten.silu.default)
def _silu(program: Program, x: Forms) -> Forms:
    return _multiply(program, x, _sigmoid(program, x))


@rule(aten.silu_backward.default)
def _silu_backward(program: Program, gradient: Any, x: Forms) -> Forms:
    s = _sigmoid(program, x)
    inner = _add(program, _multiply(program, x, _subtract(program, 1.0, s)), 1.0)
    return _multiply(program, gradient, _multiply(program, s, inner))


@rule(aten.sigmoid_backward.default)
def _sigmoid_backward(program: Program, gradient: Any, s: Forms) -> Forms:
    return _multiply(program, gradient, _subtract(program, s, _multiply(program, s, s)))


@rule(aten.tanh_backward.default)
def _tanh_backward(program: Program, gradient: Any, y: Forms) -> Forms:
    return _multiply(program, gradient, _subtract(program, 1.0, _multiply(program, y, y)))


# Entries that are added to


@rule(aten.index_add.default)
def _index_add(program: Program, x: Any, dim: int, index: Tensor, source: Any) -> Forms:
    return _added(program, x, source, lambda base, y: base.index_add(dim, index, y))


@rule(aten.index_put.default)
def _index_put(program: Program, x: Any, indices: list[Any], values: Any, accumulate: bool = False) -> Forms:
    return _added(program, x, values, lambda base, y: base.index_put(indices, y, accumulate=True))


def _added(program: Program, x: Any, source: Any, put: Callable[[Tensor, Tensor], Tensor]) -> Forms:
    """x with a source added at places that are all different."""
    x, source = _forms(program, x), _forms(program, source)
    nothing = torch.zeros_like(x.entries)
    if bool((put(nothing, torch.ones_like(source.entries)) > 1).any()):
        raise NotImplementedError("several numbers are added to one")
    return _add(program, x, Forms(put(nothing, source.entries)))


# Kinks, truths and choices


@rule(aten.relu.default)
def _relu(program: Program, x: Forms) -> Forms:
    return _function("leaky", 0.0)(program, x)


@rule(aten.leaky_relu.default)
def _leaky_relu(program: Program, x: Forms, negative_slope: float = 0.01) -> Forms:
    return _function("leaky", negative_slope)(program, x)


@rule(aten.abs.default)
def _absolute(program: Program, x: Forms) -> Forms:
    return _function("leaky", -1.0)(program, x)


@rule(aten.clamp.default, aten.clamp_min.default)
def _clamp(program: Program, x: Forms, low: float | None = None, high: float | None = None) -> Forms:
    return _function("clamp", -math.inf if low is None else low, math.inf if high is None else high)(program, x)


@rule(aten.clamp_max.default)
def _clamp_max(program: Program, x: Forms, high: float) -> Forms:
    return _clamp(program, x, None, high)


@rule(aten.maximum.default, aten.clamp_min.Tensor)
def _maximum(program: Program, x: Any, y: Any) -> Forms:
    return _add(program, y, _relu(program, _subtract(program, x, y)))


@rule(aten.minimum.default, aten.clamp_max.Tensor)
def _minimum(program: Program, x: Any, y: Any) -> Forms:
    return _subtract(program, x, _relu(program, _subtract(program, x, y)))


@rule(aten.clamp.Tensor)
def _clamp_between(program: Program, x: Any, low: Any = None, high: Any = None) -> Forms:
    y = x if low is None or _is_constant(low, -math.inf) else _maximum(program, x, low)
    y = y if high is None or _is_constant(high, math.inf) else _minimum(program, y, high)
    if isinstance(low, Tensor) and isinstance(high, Tensor) and bool((low.isfinite() & high.isfinite()).all()):
        return _each(program.no_wider, y, torch.minimum(low, high), high)
    return y


def _is_constant(y: Any, value: float) -> bool:
    return isinstance(y, Tensor) and bool((y == value).all())


def _truth(program: Program, name: str, *values: Any) -> Forms:
    return _each(lambda *operands: program.truth(name, *operands), *(_forms(program, y) for y in values))


def _greater(program: Program, x: Any, y: Any) -> Forms:
    return _truth(program, "positive", _subtract(program, x, y))


def _negation(program: Program, x: Any) -> Forms:
    return _truth(program, "negation", x)


def _at_least(program: Program, x: Any, y: Any) -> Forms:
    return _negation(program, _greater(program, y, x))


def _conjunction(program: Program, x: Any, y: Any) -> Forms:
    return _truth(program, "conjunction", x, y)


def _disjunction(program: Program, x: Any, y: Any) -> Forms:
    return _negation(program, _conjunction(program, _negation(program, x), _negation(program, y)))


def _equal(program: Program, x: Any, y: Any) -> Forms:
    return _conjunction(program, _at_least(program, x, y), _at_least(program, y, x))


@rule(aten.where.self)
def _where(program: Program, truth: Any, x: Any, y: Any) -> Forms:
    return _each(program.where, *(_forms(program, value) for value in (truth, x, y)))


@rule(aten.threshold_backward.default)
def _threshold_backward(program: Program, gradient: Any, x: Any, threshold: float) -> Forms:
    return _where(program, _greater(program, x, threshold), gradient, 0.0)


@rule(aten.leaky_relu_backward.default)
def _leaky_relu_backward(program: Program, gradient: Any, x: Any, negative_slope: float, self_is_result: bool) -> Forms:
    return _where(program, _greater(program, x, 0.0), gradient, _multiply(program, gradient, negative_slope))


rule(aten.sign.default, aten.sgn.default)(lambda program, x: _truth(program, "sign", x))
rule(aten.gt.Scalar, aten.gt.Tensor)(_greater)
rule(aten.ge.Scalar, aten.ge.Tensor)(_at_least)
rule(aten.lt.Scalar, aten.lt.Tensor)(lambda program, x, y: _greater(program, y, x))
rule(aten.le.Scalar, aten.le.Tensor)(lambda program, x, y: _at_least(program, y, x))
rule(aten.eq.Scalar, aten.eq.Tensor)(_equal)
rule(aten.ne.Scalar, aten.ne.Tensor)(lambda program, x, y: _negation(program, _equal(program, x, y)))
rule(aten.bitwise_and.Tensor, aten.logical_and.default)(_conjunction)
rule(aten.bitwise_or.Tensor, aten.logical_or.default)(_disjunction)
rule(aten.bitwise_not.default, aten.logical_not.default)(_negation)
rule(aten.masked_fill.Scalar, aten.masked_fill.Tensor)(
    lambda program, x, mask, value: _where(program, mask, value, x)
)

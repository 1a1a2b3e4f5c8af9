"""The rule of each operator of graphs: Taylor forms of its arguments ↦ a form that encloses its result."""

import math
import operator
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.func import vmap
from torch.utils._pytree import tree_flatten, tree_unflatten

from lyapnet.base.errors import UsageError
from lyapnet.prover import elementary_functions as functions
from lyapnet.prover import taylor
from lyapnet.prover.branches import CHOICES, JUMPS, KINKS
from lyapnet.prover.composed_rules import COMPOSED, for_forms
from lyapnet.prover.linear_systems import LINEAR_SYSTEMS
from lyapnet.prover.minima import MINIMA
from lyapnet.prover.rounding import ROUNDED
from lyapnet.prover.taylor import TaylorForm

aten = torch.ops.aten

Rule = Callable[..., Any]
RULES: dict[Any, Rule] = {**KINKS, **JUMPS, **CHOICES, **LINEAR_SYSTEMS, **MINIMA}
"""Operator ↦ its rule: a function of its arguments, some of them Taylor forms, that returns a form or a tensor."""


def rule(*operators: Any) -> Callable[[Rule], Rule]:
    """Register a rule for operators."""

    def register(function: Rule) -> Rule:
        RULES.update(dict.fromkeys(operators, function))
        return function

    return register


# Sums and products


@rule(aten.add.Tensor, aten.add.Scalar)
def _add(x: Any, y: Any, alpha: float = 1) -> TaylorForm:
    """x + αy."""
    if alpha != 1:
        y = _multiply(y, alpha) if isinstance(y, TaylorForm) else _tensor(y) * alpha
    if isinstance(x, TaylorForm) and isinstance(y, TaylorForm):
        return taylor.add(x, y)
    return taylor.shift(x, _tensor(y)) if isinstance(x, TaylorForm) else taylor.shift(y, _tensor(x))


@rule(aten.sub.Tensor, aten.sub.Scalar)
def _subtract(x: Any, y: Any, alpha: float = 1) -> TaylorForm:
    """x − αy."""
    return _add(x, taylor.negate(y) if isinstance(y, TaylorForm) else -_tensor(y), alpha)


@rule(aten.mul.Tensor, aten.mul.Scalar)
def _multiply(x: Any, y: Any) -> TaylorForm:
    """x · y; x² if both are the same form."""
    if x is y:
        return functions.square(x)
    if isinstance(x, TaylorForm) and isinstance(y, TaylorForm):
        return taylor.multiply(x, y)
    return taylor.scale(x, _tensor(y)) if isinstance(x, TaylorForm) else taylor.scale(y, _tensor(x))


@rule(aten.div.Tensor, aten.div.Scalar)
def _divide(x: Any, y: Any) -> TaylorForm:
    """x · (1/y)."""
    if isinstance(y, TaylorForm):
        return _multiply(x, functions.reciprocal(y))
    return taylor.scale(x, 1 / _tensor(y)).with_rounding()


@rule(aten.mm.default, aten.bmm.default)
def _matrix_product(x: Any, y: Any) -> TaylorForm:
    """xy of matrices: a linear map if one is constant, else Σ_j x_ij y_jk, entry by entry."""
    if not isinstance(x, TaylorForm):
        return _transposed(_matrix_product(_transposed(y), x.mT))
    if not isinstance(y, TaylorForm) and y.ndim == 2:
        return taylor.matrix_product(x, y)
    left, right = ARRANGEMENTS[aten.unsqueeze.default](x, -1), _unsqueezed(y, -3)
    return _sum(_multiply(left, right), [-2])


@rule(aten.mv.default)
def _matrix_vector_product(x: Any, y: Any) -> TaylorForm:
    """xy of a matrix and a vector."""
    return ARRANGEMENTS[aten.squeeze.dim](_matrix_product(x, _unsqueezed(y, -1)), -1)


@rule(aten._to_copy.default)
def _to_copy(x: TaylorForm, **keywords: Any) -> TaylorForm:
    """x, since truth values are numbers already; lyapnet.prover.bounds refuses all dtypes but float64."""
    return x


@rule(aten.neg.default)
def _negate(x: TaylorForm) -> TaylorForm:
    """−x."""
    return taylor.negate(x)


@rule(aten.sum.default, aten.sum.dim_IntList)
def _sum(x: TaylorForm, dim: Sequence[int] | None = None, keepdim: bool = False, dtype: Any = None) -> TaylorForm:
    """Σ x over some axes: the sums of the terms, and of the remainders, since |Σ η_i| ≤ Σ r_i."""
    x, rank = x.with_rounding(x.shape.numel()), len(x.shape)
    if not rank:
        return x
    axes = [axis % rank for axis in dim or range(rank)]
    radius = x.radius.sum([axis + 1 for axis in axes], keepdim)
    return x.with_parts(x.terms.sum([axis + 2 for axis in axes], keepdim), radius)


# Rounding in another arithmetic


@rule(ROUNDED)
def _rounded(y: Any, at: Any, relative: float, absolute: float, largest: float) -> TaylorForm:
    """y (1 + θ) + η with |θ| ≤ relative, |η| ≤ absolute: r grows by relative · |y| + absolute.

    r is infinite where |y| may exceed `largest`, the largest number of the other arithmetic.
    """
    y = y if isinstance(y, TaylorForm) else taylor.constant_form(_tensor(y), at)
    size = y.magnitude * (1 + 1e-9)  # the factor covers the rounding of this line and the next
    radius = y.radius + (relative * size + absolute) * (1 + 1e-9)
    return y.with_parts(y.terms, torch.where(size <= largest, radius, torch.inf)).with_rounding()


# Functions of one number

RULES.update({getattr(aten, name).default: function for name, function in functions.ELEMENTARY.items()})


@rule(aten.tanh.default)
def _tanh(x: TaylorForm) -> TaylorForm:
    """tanh x = 2σ(2x) − 1; the product 2x is exact."""
    double = x.with_parts(2 * x.terms, 2 * x.radius)
    return _subtract(_multiply(functions.sigmoid(double), 2.0), 1.0)


@rule(aten.softplus.default)
def _softplus(x: TaylorForm, beta: float = 1, threshold: float = 20) -> TaylorForm:
    """log(1 + e^{βx})/β. Where βx exceeds the threshold, torch returns x, off by at most e^{−threshold}/|β|."""
    y = _multiply(x, beta) if beta != 1 else x
    return _widened_above(_divide(functions.softplus(y), beta), y, threshold, 1 / abs(beta))


@rule(aten.softplus_backward.default)
def _softplus_backward(gradient: Any, x: TaylorForm, beta: float, threshold: float) -> TaylorForm:
    """gradient · σ(βx). Where βx exceeds the threshold, torch uses 1 for σ, which differs by at most e^{−threshold}."""
    y = _multiply(x, beta) if beta != 1 else x
    return _multiply(gradient, _widened_above(functions.sigmoid(y), y, threshold, 1.0))


def _widened_above(smooth: TaylorForm, y: TaylorForm, threshold: float, factor: float) -> TaylorForm:
    """The form with r + factor · e^{−threshold}, rounded upwards, on boxes where y may exceed the threshold."""
    room = factor * (1.001 * torch.exp(-_tensor(threshold)) + taylor.TINY)
    return smooth.with_parts(smooth.terms, smooth.radius + torch.where(y.interval()[1] > threshold, room, 0.0))


# Arrangements: operators that copy, move or drop entries, without arithmetic


def _arranging(function: Callable[..., Any]) -> Rule:
    """The rule of an operator that only arranges entries: it arranges each term and r like the value."""
    return lambda *arguments, **keywords: _rearranged(function, *arguments, **keywords)


def _rearranged(function: Callable[..., Any], *arguments: Any, **keywords: Any) -> Any:
    """Apply the operator to all terms of the forms among its arguments, and to their r."""
    leaves, structure = tree_flatten((arguments, keywords), is_leaf=lambda leaf: isinstance(leaf, TaylorForm))
    forms = [leaf for leaf in leaves if isinstance(leaf, TaylorForm)]

    def call(*tensors: Tensor) -> Any:
        filled = iter(tensors)
        arguments, keywords = tree_unflatten(
            [next(filled) if isinstance(leaf, TaylorForm) else leaf for leaf in leaves], structure
        )
        return function(*arguments, **keywords)

    counts = forms[0].terms.shape[:2]
    terms = vmap(call)(*(form.terms.flatten(0, 1) for form in forms))
    radius = vmap(call)(*(form.radius for form in forms))
    if isinstance(terms, Tensor):
        return forms[0].with_parts(terms.unflatten(0, counts), radius)
    return [forms[0].with_parts(y.unflatten(0, counts), r) for y, r in zip(terms, radius, strict=True)]


def _along(function: Callable[..., Any], new: int = 0) -> Rule:
    """Like _arranging, but faster: for an operator along one axis that adds `new` axes."""

    def arrange(x: TaylorForm, dim: int = 0, *rest: Any) -> TaylorForm:
        axis = dim % (len(x.shape) + new)
        return x.with_parts(function(x.terms, axis + 2, *rest), function(x.radius, axis + 1, *rest))

    return arrange


def _expand(x: TaylorForm, size: Sequence[int]) -> TaylorForm:
    x = x.as_rank(len(size))
    return x.with_parts(x.terms.expand(-1, -1, *size), x.radius.expand(-1, *size))


def _view(x: TaylorForm, size: Sequence[int]) -> TaylorForm:
    if -1 in size:  # torch cannot infer this length for 0 boxes
        others = -math.prod(size)
        size = [x.shape.numel() // others if length == -1 else length for length in size]
    counts = x.terms.shape[:2]
    return x.with_parts(x.terms.reshape(*counts, *size), x.radius.reshape(*counts[1:], *size))


def _joining(function: Callable[..., Any]) -> Rule:
    """Like _arranging, for an operator of a list of forms and constants."""

    def join(items: Sequence[Any], dim: int = 0) -> TaylorForm:
        like = next(item for item in items if isinstance(item, TaylorForm))
        forms = [item if isinstance(item, TaylorForm) else taylor.constant_form(item, like) for item in items]
        return _rearranged(function, forms, dim)

    return join


ARRANGEMENTS: dict[Any, Rule] = {
    **{
        operation: _arranging(operation)
        for operation in (
            aten.permute.default, aten.t.default, aten.transpose.int, aten.squeeze.default, aten.squeeze.dim,
            aten.squeeze.dims, aten.index.Tensor, aten.select_backward.default, aten.unbind.int,
            aten.slice_backward.default, aten.split.Tensor, aten.flip.default,
            aten.diagonal.default, aten.diag_embed.default,
        )
    },
    **{operation: _along(operation) for operation in (aten.select.int, aten.slice.Tensor)},
    aten.unsqueeze.default: _along(aten.unsqueeze.default, new=1),
    **dict.fromkeys((aten.view.default, aten._unsafe_view.default), _view),
    aten.expand.default: _expand,
    aten.cat.default: _joining(aten.cat.default),
    aten.stack.default: _joining(aten.stack.default),
    operator.getitem: operator.getitem,
}  # fmt: skip


@rule(aten.index_add.default)
def _index_add(x: Any, dim: int, index: Tensor, source: Any) -> TaylorForm:
    """x with source_i added to its entry index_i: x plus a rearranged source."""
    like = x if isinstance(x, TaylorForm) else source
    x, source = (y if isinstance(y, TaylorForm) else taylor.constant_form(y, like) for y in (x, source))
    moved = _rearranged(
        lambda base, y: torch.zeros_like(base).index_add(dim, index, y), x, source.with_rounding(len(index))
    )
    return taylor.add(x, moved)


@rule(aten.index_put.default)
def _index_put(x: Any, indices: list[Any], values: Any, accumulate: bool = False) -> TaylorForm:
    """x with the values added to its entries at some indices; autograd uses it for the derivative of x[indices]."""
    if not accumulate:
        raise UsageError(
            "Expected index_put to add to entries (accumulate=True), got one that replaces them; use torch.where."
        )
    like = x if isinstance(x, TaylorForm) else values
    x, values = (y if isinstance(y, TaylorForm) else taylor.constant_form(y, like) for y in (x, values))
    values = values.with_rounding(values.shape.numel())
    moved = _rearranged(lambda base, y: aten.index_put.default(torch.zeros_like(base), indices, y, True), x, values)
    return taylor.add(x, moved)


BOOLEAN_OPERATORS = {*JUMPS, *CHOICES, *ARRANGEMENTS, aten.mul.Tensor}
"""Operators whose rules are correct for truth values too: xy is the conjunction of x and y, but 1 + 1 is none."""


def _shape_rule(operation: Any) -> Rule:
    """The rule of an operator that uses only the shape of its argument: the result is a constant tensor."""
    return lambda x, *arguments, **keywords: operation(torch.zeros_like(x.radius[0]), *arguments, **keywords)


OF_SHAPE = {
    aten.zeros_like.default, aten.ones_like.default, aten.full_like.default, aten.empty_like.default,
    aten.new_zeros.default, aten.new_ones.default, aten.new_full.default, aten.fill.Scalar,
}  # fmt: skip
for _operation in OF_SHAPE:
    rule(_operation)(_shape_rule(_operation))


RULES.update({operation: for_forms(composed, RULES) for operation, composed in COMPOSED.items()})


def _transposed(x: TaylorForm) -> TaylorForm:
    return x.with_parts(x.terms.mT, x.radius.mT)


def _unsqueezed(x: Any, axis: int) -> Any:
    return ARRANGEMENTS[aten.unsqueeze.default](x, axis) if isinstance(x, TaylorForm) else x.unsqueeze(axis)


def _tensor(number: Any) -> Tensor:
    return torch.as_tensor(number, dtype=torch.float64)

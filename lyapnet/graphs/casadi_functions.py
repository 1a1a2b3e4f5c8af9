"""Translates traced functions of tensors to CasADi expressions, operation by operation.

torch computes operations on constants. Operations that only move entries need no rules, as torch applies them to the
indices of the entries: views, slices, concatenations, indexing. RULES has the arithmetic.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import casadi
import numpy as np
import torch
from torch import Tensor
from torch.fx import GraphModule, Interpreter
from torch.utils._pytree import tree_leaves, tree_map

from lyapnet.base.errors import OracleError
from lyapnet.graphs.operators import Operator, Rules
from lyapnet.graphs.tracing import SHAPED, Tensors, core_trace, is_view, name_of

Symbols = np.ndarray  # dtype object: its entries are scalar casadi.SX


def trace_for_casadi(function: Callable[..., Tensors], arguments: Sequence[Tensor]) -> GraphModule:
    """The trace of a function in torch's core operators.

    Raises:
        OracleError: the function reads the values of tensors.
    """
    return core_trace(function, arguments, "dynamics and cost", OracleError)


def casadi_function(graph: GraphModule, arguments: Sequence[Tensor]) -> casadi.Function:
    """A CasADi function for a trace; each argument and each result is a column vector.

    Args:
        graph: a trace by `trace_for_casadi`.
        arguments: tensors of the shapes for which it was traced.

    Raises:
        OracleError: an operator has no rule.
    """
    inputs = [casadi.SX.sym(f"argument_{i}", argument.numel()) for i, argument in enumerate(arguments)]
    entries = [_symbol_array(casadi.vertsplit(x), a.shape) for x, a in zip(inputs, arguments, strict=True)]
    results = _Translator(graph).run(*entries)
    return casadi.Function("function", inputs, [casadi.vertcat(*_symbols(result).flat) for result in results])


def require_equal(
    translated: casadi.Function, function: Callable[..., Tensors], arguments: Sequence[Tensor], points: int = 8
) -> None:
    """Compare a translation with the function at random points.

    Raises:
        OracleError: they differ, because a rule is wrong, or because the function took values out of its arguments.
    """
    generator = torch.Generator().manual_seed(0)
    for _ in range(points):
        point = [torch.randn(a.shape, generator=generator, dtype=a.dtype) for a in arguments]
        with torch.no_grad():
            expected = function(*point)
        got = translated.call([argument.flatten().numpy() for argument in point])
        for ours, theirs in zip(got, expected, strict=True):
            difference = np.abs(np.asarray(ours).ravel() - theirs.flatten().numpy())
            # a nan of the function is not compared
            if not np.all(np.nan_to_num(difference) <= 1e-9 * (1 + np.nan_to_num(np.abs(theirs.flatten().numpy())))):
                raise OracleError(
                    f"Expected dynamics and cost in torch operations alone, got a trace with an error of "
                    f"{np.nanmax(difference):.3g} at a random state; do not take numbers out of tensors."
                )


class _Translator(Interpreter):
    """Runs a trace with tensors for constants and Symbols for all other values."""

    def __init__(self, graph: GraphModule):
        super().__init__(graph)
        self.extra_traceback = False  # error messages below are for users

    def call_function(self, target: Any, args: tuple, kwargs: dict[str, Any]) -> Any:
        if not any(isinstance(leaf, Symbols) for leaf in tree_leaves((args, kwargs))):
            return target(*args, **kwargs)
        name = name_of(target)
        if name in SHAPED:
            return target(*tree_map(_zeros_of_shape, args), **kwargs)
        if is_view(target) or name in MOVES:
            return _rearrange(target, args, kwargs)
        try:
            return RULES[name](*args, **kwargs)
        except (KeyError, TypeError, NotImplementedError) as error:  # no rule, or no rule for these options
            raise OracleError(
                f"Expected operations that CasADi has, got {target}; write it in other operations, or add it to the "
                "table of operators (docs/operators.md)."
            ) from error


def _symbol_array(entries: Sequence[Any], shape: Sequence[int]) -> Symbols:
    array = np.empty(len(entries), dtype=object)
    for i, entry in enumerate(entries):  # one by one, since NumPy would treat an SX as a matrix
        array[i] = entry
    return array.reshape(tuple(shape))


def _symbols(value: Any) -> Symbols:
    """A number, tensor or array of symbols, as an array of symbols."""
    if isinstance(value, Symbols):
        return value
    tensor = torch.as_tensor(value, dtype=torch.float64)
    return _symbol_array([casadi.SX(number) for number in tensor.flatten().tolist()], tensor.shape)


def _as_array(result: Any) -> Symbols:
    """An array of symbols; NumPy returns a single entry without its array."""
    return result if isinstance(result, np.ndarray) else _symbol_array([result], ())


def _rearrange(target: Any, args: tuple, kwargs: dict[str, Any]) -> Any:
    """Apply an operation that only moves entries, by applying it to the indices of the entries."""
    pool: list[Any] = []

    def to_indices(leaf: Any) -> Any:
        if not (isinstance(leaf, Symbols) or (isinstance(leaf, Tensor) and leaf.is_floating_point())):
            return leaf  # an option, or indices
        entries, first = _symbols(leaf), len(pool)
        pool.extend(entries.flat)
        return torch.arange(first, len(pool)).reshape(entries.shape)

    args, kwargs = tree_map(to_indices, (args, kwargs))
    return tree_map(lambda indices: _symbol_array([pool[i] for i in indices.flatten().tolist()], indices.shape),
                    target(*args, **kwargs))  # fmt: skip


def _zeros_of_shape(leaf: Any) -> Any:
    return torch.zeros(leaf.shape, dtype=torch.float64) if isinstance(leaf, Symbols) else leaf


# operators that only move entries and are not views
MOVES = {
    "_unsafe_view", "cat", "clone", "copy", "diagonal_scatter", "flip", "gather", "index", "index_put", "index_select",
    "lift_fresh_copy", "repeat", "roll", "scatter", "select_scatter", "slice_scatter", "stack",
}  # fmt: skip


def _elementwise(rule: Callable[..., Any], operands: int) -> Callable[..., Symbols]:
    function = np.frompyfunc(rule, operands, 1)
    return lambda *args: _as_array(function(*map(_symbols, args)))


def _rule_of_row(row: Operator) -> Callable[..., Symbols] | None:
    if row.casadi is None:
        return None
    rule = getattr(casadi, row.casadi) if isinstance(row.casadi, str) else functools.partial(row.casadi, casadi)
    return _elementwise(rule, row.operands)


def _sum(sign: int) -> Callable[..., Symbols]:
    """a ± alpha · b."""
    return lambda a, b, *, alpha=1: _elementwise(lambda a, b: a + sign * alpha * b, 2)(a, b)


def _reduction(rule: Callable[..., Any]) -> Callable[..., Symbols]:
    function = np.frompyfunc(rule, 2, 1)

    def reduce(x: Symbols, dim: Any = None, keepdim: bool = False, *, dtype: Any = None) -> Symbols:
        axes = range(x.ndim) if dim is None or dim == [] else [dim] if isinstance(dim, int) else dim
        for axis in sorted((axis % x.ndim for axis in axes), reverse=True):
            x = _as_array(function.reduce(x, axis=axis, keepdims=keepdim))
        return x

    return reduce


def _mean(x: Symbols, dim: Any = None, keepdim: bool = False, *, dtype: Any = None) -> Symbols:
    total = RULES["sum"](x, dim, keepdim)
    return RULES["div"](total, x.size // total.size)


def _cumulative_sum(x: Symbols, dim: int, *, dtype: Any = None) -> Symbols:
    return np.add.accumulate(x, axis=dim)


def _product(A: Any, B: Any) -> Symbols:
    return _as_array(np.matmul(_symbols(A), _symbols(B)))


def _clamp(x: Symbols, min: Any = None, max: Any = None) -> Symbols:
    x = x if min is None else RULES["maximum"](x, min)
    return x if max is None else RULES["minimum"](x, max)


def _convert(x: Symbols, *, dtype: torch.dtype | None = None, **options: Any) -> Symbols:
    if dtype is not None and not dtype.is_floating_point:
        raise NotImplementedError
    return x


def _norm(x: Symbols, ord: float = 2, dim: Any = None, keepdim: bool = False, *, dtype: Any = None) -> Symbols:
    if ord != 2:
        raise NotImplementedError
    return RULES["sqrt"](RULES["sum"](x * x, dim, keepdim))


NO_ERROR = torch.zeros((), dtype=torch.int32)  # torch's linear algebra also returns an error code


def _matrix(rows: Symbols) -> casadi.SX:
    return casadi.vertcat(*(casadi.horzcat(*row) for row in rows))


def _map_matrices(rule: Callable[..., casadi.SX], *batches: Symbols) -> Symbols:
    """Apply a function of matrices to each of a batch, (*batch, k, l)."""
    shape = np.broadcast_shapes(*(batch.shape[:-2] for batch in batches))
    stacks = [np.broadcast_to(b, (*shape, *b.shape[-2:])).reshape(-1, *b.shape[-2:]) for b in batches]
    results = [rule(*map(_matrix, matrices)) for matrices in zip(*stacks, strict=True)]
    entries = [result[i, j] for result in results for i in range(result.rows()) for j in range(result.columns())]
    return _symbol_array(entries, (*shape, *results[0].shape))


def _solution(A: Any, B: Any, *, left: bool = True, check_errors: bool = False) -> list[Any]:
    """A⁻¹B or BA⁻¹; B may be a batch of vectors."""
    A, B = _symbols(A), _symbols(B)
    vectors = B.ndim == 1 or B.shape == A.shape[:-1]
    B = B[..., None] if vectors else B
    x = _map_matrices(casadi.solve if left else lambda A, B: casadi.solve(A.T, B.T).T, A, B)
    return [x[..., 0] if vectors else x, None, None, NO_ERROR]


def _inverse(A: Symbols, *, check_errors: bool = False) -> list[Any]:
    return [_map_matrices(casadi.inv, A), NO_ERROR]


def _determinant(A: Symbols) -> list[Symbols]:
    return [_map_matrices(casadi.det, A)[..., 0, 0]]


RULES = Rules("CasADi", _rule_of_row, {
    "add": _sum(1),
    "sub": _sum(-1),
    "clamp": _clamp,
    "sum": _reduction(lambda a, b: a + b),
    "prod": _reduction(lambda a, b: a * b),
    "amax": _reduction(casadi.fmax),
    "amin": _reduction(casadi.fmin),
    "mean": _mean,
    "cumsum": _cumulative_sum,
    "linalg_vector_norm": _norm,
    **dict.fromkeys(("mm", "bmm", "mv", "dot"), _product),
    "_linalg_solve_ex": _solution,
    "linalg_inv_ex": _inverse,
    "_linalg_det": _determinant,
    "_to_copy": _convert,
    "getitem": lambda results, index: results[index],
})  # fmt: skip

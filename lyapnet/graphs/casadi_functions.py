"""Functions of tensors as CasADi expressions: their traces read again on symbols, operation by operation.

An operation on constants alone is torch's own. One that only moves entries is done on their numbers, again by torch;
hence no rule for views, slices, concatenations or indices. What is left is arithmetic, which RULES has.
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


def traced(function: Callable[..., Tensors], arguments: Sequence[Tensor]) -> GraphModule:
    """The trace of a function in few operators.

    Raises:
        OracleError: the function reads the values of tensors.
    """
    return core_trace(function, arguments, "dynamics and cost", OracleError)


def symbolic(graph: GraphModule, arguments: Sequence[Tensor]) -> casadi.Function:
    """The function of a trace on CasADi's symbols: column vectors in, one for each argument; out, one for each result.

    Args:
        graph: of `traced`.
        arguments: tensors of the shapes that it was traced with.

    Raises:
        OracleError: an operator has no rule; names it.
    """
    inputs = [casadi.SX.sym(f"argument_{i}", argument.numel()) for i, argument in enumerate(arguments)]
    entries = [_filled(casadi.vertsplit(x), a.shape) for x, a in zip(inputs, arguments, strict=True)]
    results = _Reader(graph).run(*entries)
    return casadi.Function("function", inputs, [casadi.vertcat(*_symbols(result).flat) for result in results])


def require_equal(
    translated: casadi.Function, function: Callable[..., Tensors], arguments: Sequence[Tensor], points: int = 8
) -> None:
    """Hold a translation against the function itself at random points.

    Raises:
        OracleError: they differ: a rule is wrong, or the function read its arguments past torch and was frozen.
    """
    generator = torch.Generator().manual_seed(0)
    for _ in range(points):
        point = [torch.randn(a.shape, generator=generator, dtype=a.dtype) for a in arguments]
        with torch.no_grad():
            expected = function(*point)
        got = translated.call([argument.flatten().numpy() for argument in point])
        for ours, theirs in zip(got, expected, strict=True):
            difference = np.abs(np.asarray(ours).ravel() - theirs.flatten().numpy())
            # where the function itself has no number, there is nothing to compare
            if not np.all(np.nan_to_num(difference) <= 1e-9 * (1 + np.nan_to_num(np.abs(theirs.flatten().numpy())))):
                raise OracleError(
                    f"Expected dynamics and cost in torch operations alone, got a trace that is off by "
                    f"{np.nanmax(difference):.3g} at a random state; use torch, not numbers taken out of it."
                )


class _Reader(Interpreter):
    """Runs a trace on values that are tensors where they are constant, else Symbols."""

    def __init__(self, graph: GraphModule):
        super().__init__(graph)
        self.extra_traceback = False  # the messages below are for users

    def call_function(self, target: Any, args: tuple, kwargs: dict[str, Any]) -> Any:
        if not any(isinstance(leaf, Symbols) for leaf in tree_leaves((args, kwargs))):
            return target(*args, **kwargs)
        name = name_of(target)
        if name in SHAPED:
            return target(*tree_map(_of_shape, args), **kwargs)
        if is_view(target) or name in MOVES:
            return _moved(target, args, kwargs)
        try:
            return RULES[name](*args, **kwargs)
        except (KeyError, TypeError, NotImplementedError) as error:  # no rule, or not for these options
            raise OracleError(
                f"Expected operations that can be handed to CasADi, got {target}; write it in others, or add it to the "
                "table of operators (docs/operators.md)."
            ) from error


def _filled(entries: Sequence[Any], shape: Sequence[int]) -> Symbols:
    array = np.empty(len(entries), dtype=object)
    for i, entry in enumerate(entries):  # one by one: NumPy would take an SX for a matrix
        array[i] = entry
    return array.reshape(tuple(shape))


def _symbols(value: Any) -> Symbols:
    """Anything that stands for numbers, as an array of symbols."""
    if isinstance(value, Symbols):
        return value
    tensor = torch.as_tensor(value, dtype=torch.float64)
    return _filled([casadi.SX(number) for number in tensor.flatten().tolist()], tensor.shape)


def _boxed(result: Any) -> Symbols:
    """NumPy takes the last entry out of its array; this puts it back."""
    return result if isinstance(result, np.ndarray) else _filled([result], ())


def _moved(target: Any, args: tuple, kwargs: dict[str, Any]) -> Any:
    """An operation that only moves entries, done on their numbers."""
    pool: list[Any] = []

    def numbered(leaf: Any) -> Any:
        if not (isinstance(leaf, Symbols) or (isinstance(leaf, Tensor) and leaf.is_floating_point())):
            return leaf  # an option, or indices
        entries, first = _symbols(leaf), len(pool)
        pool.extend(entries.flat)
        return torch.arange(first, len(pool)).reshape(entries.shape)

    args, kwargs = tree_map(numbered, (args, kwargs))
    return tree_map(lambda numbers: _filled([pool[i] for i in numbers.flatten().tolist()], numbers.shape),
                    target(*args, **kwargs))  # fmt: skip


def _of_shape(leaf: Any) -> Any:
    return torch.zeros(leaf.shape, dtype=torch.float64) if isinstance(leaf, Symbols) else leaf


# what moves entries and is no view
MOVES = {
    "_unsafe_view", "cat", "clone", "copy", "diagonal_scatter", "flip", "gather", "index", "index_put", "index_select",
    "lift_fresh_copy", "repeat", "roll", "scatter", "select_scatter", "slice_scatter", "stack",
}  # fmt: skip


def _elementwise(rule: Callable[..., Any], operands: int) -> Callable[..., Symbols]:
    function = np.frompyfunc(rule, operands, 1)
    return lambda *args: _boxed(function(*map(_symbols, args)))


def _of_row(row: Operator) -> Callable[..., Symbols] | None:
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
            x = _boxed(function.reduce(x, axis=axis, keepdims=keepdim))
        return x

    return reduce


def _mean(x: Symbols, dim: Any = None, keepdim: bool = False, *, dtype: Any = None) -> Symbols:
    total = RULES["sum"](x, dim, keepdim)
    return RULES["div"](total, x.size // total.size)


def _cumulative_sum(x: Symbols, dim: int, *, dtype: Any = None) -> Symbols:
    return np.add.accumulate(x, axis=dim)


def _product(A: Any, B: Any) -> Symbols:
    return _boxed(np.matmul(_symbols(A), _symbols(B)))


def _clamp(x: Symbols, min: Any = None, max: Any = None) -> Symbols:
    x = x if min is None else RULES["maximum"](x, min)
    return x if max is None else RULES["minimum"](x, max)


def _converted(x: Symbols, *, dtype: torch.dtype | None = None, **options: Any) -> Symbols:
    if dtype is not None and not dtype.is_floating_point:
        raise NotImplementedError
    return x


def _norm(x: Symbols, ord: float = 2, dim: Any = None, keepdim: bool = False, *, dtype: Any = None) -> Symbols:
    if ord != 2:
        raise NotImplementedError
    return RULES["sqrt"](RULES["sum"](x * x, dim, keepdim))


NO_ERROR = torch.zeros((), dtype=torch.int32)  # what torch's linear algebra returns beside its result


def _matrix(rows: Symbols) -> casadi.SX:
    return casadi.vertcat(*(casadi.horzcat(*row) for row in rows))


def _of_each(rule: Callable[..., casadi.SX], *batches: Symbols) -> Symbols:
    """A function of matrices on batches of them, (*batch, k, l) each."""
    shape = np.broadcast_shapes(*(batch.shape[:-2] for batch in batches))
    stacks = [np.broadcast_to(b, (*shape, *b.shape[-2:])).reshape(-1, *b.shape[-2:]) for b in batches]
    results = [rule(*map(_matrix, matrices)) for matrices in zip(*stacks, strict=True)]
    entries = [result[i, j] for result in results for i in range(result.rows()) for j in range(result.columns())]
    return _filled(entries, (*shape, *results[0].shape))


def _solution(A: Any, B: Any, *, left: bool = True, check_errors: bool = False) -> list[Any]:
    """A⁻¹B, or BA⁻¹; B may be a batch of vectors."""
    A, B = _symbols(A), _symbols(B)
    vectors = B.ndim == 1 or B.shape == A.shape[:-1]
    B = B[..., None] if vectors else B
    x = _of_each(casadi.solve if left else lambda A, B: casadi.solve(A.T, B.T).T, A, B)
    return [x[..., 0] if vectors else x, None, None, NO_ERROR]


def _inverse(A: Symbols, *, check_errors: bool = False) -> list[Any]:
    return [_of_each(casadi.inv, A), NO_ERROR]


def _determinant(A: Symbols) -> list[Symbols]:
    return [_of_each(casadi.det, A)[..., 0, 0]]


RULES = Rules("CasADi", _of_row, {
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
    "_to_copy": _converted,
    "getitem": lambda results, index: results[index],
})  # fmt: skip

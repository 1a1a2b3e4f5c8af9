"""Rules that write torch's core operators in C: (text, *arguments of an operator) ↦ the array of its result."""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch.utils._pytree import tree_leaves

from lyapnet.graphs.c_text import Array, Text, literal, shape_of
from lyapnet.graphs.operators import Rules

aten = torch.ops.aten


def _elementwise(expression: str) -> Callable[..., Array]:
    line = f"{{into}} = {expression};"

    def rule(text: Text, *values: Any) -> Array:
        shape = torch.broadcast_shapes(*map(shape_of, values))
        return text.each(shape, values, line, text.new(shape))

    return rule


def _sum(sign: str) -> Callable[..., Array]:
    """a ± alpha · b."""
    return lambda text, a, b, *, alpha=1: _elementwise(
        f"{{0}} {sign} {{1}}" if alpha == 1 else f"{{0}} {sign} {literal(alpha)} * {{1}}"
    )(text, a, b)


def _divide(text: Text, a: Any, b: Any, *, rounding_mode: str | None = None) -> Array:
    if rounding_mode == "floor":
        return _elementwise("({0} - remainder_of({0}, {1})) / {1}")(text, a, b)
    return _elementwise("{0} / {1}" if rounding_mode is None else "trunc({0} / {1})")(text, a, b)


def _power(text: Text, base: Any, exponent: Any) -> Array:
    short = {2: "{0} * {0}", 1: "{0}", 3: "{0} * {0} * {0}", -1: "1.0 / {0}", 0.5: "sqrt({0})"}
    if isinstance(exponent, int | float) and exponent in short:
        return _elementwise(short[exponent])(text, base)
    return _elementwise("pow({0}, {1})")(text, base, exponent)


def _clamp(text: Text, x: Array, min: Any = None, max: Any = None) -> Array:
    x = x if min is None else RULES["maximum"](text, x, min)
    return x if max is None else RULES["minimum"](text, x, max)


def _reduction(start: float, line: str) -> Callable[..., Array]:
    """A reduction along axes; the line combines the result with one entry."""

    def rule(text: Text, x: Array, dim: Any = None, keepdim: bool = False, *, dtype: Any = None) -> Array:
        every = range(len(x.shape)) if dim is None or dim == [] else [dim] if isinstance(dim, int) else dim
        reduced = {axis % max(1, len(x.shape)) for axis in every}
        total = text.new([1 if axis in reduced else size for axis, size in enumerate(x.shape)])
        text.each(total.shape, [start], "{into} = {0};", total)
        strided = Array(total.name, total.layout.expand(x.shape))
        text.each(x.shape, [x], line, strided)
        if keepdim:
            return total
        return Array(
            total.name, total.layout.reshape([size for axis, size in enumerate(x.shape) if axis not in reduced])
        )

    return rule


def _mean(text: Text, x: Array, dim: Any = None, keepdim: bool = False, *, dtype: Any = None) -> Array:
    total = RULES["sum"](text, x, dim, keepdim)
    count = x.layout.numel() // max(1, total.layout.numel())
    return _elementwise(f"{{0}} / {literal(count)}")(text, total)


def _norm(text: Text, x: Array, ord: float = 2, dim: Any = None, keepdim: bool = False, *, dtype: Any = None) -> Array:
    if ord != 2:
        raise NotImplementedError
    return _elementwise("sqrt({0})")(text, RULES["sum"](text, _power(text, x, 2), dim, keepdim))


def _product(text: Text, A: Any, B: Any) -> Array:
    """AB for matrices, vectors or batches of matrices.

    The innermost loop is along rows of B, which are contiguous. If rows of A and columns of B are contiguous instead,
    as in W'x with a table of W, long products are sums by a helper function.
    """
    a, b = (value if isinstance(value, Array) else text.tables.of(value) for value in (A, B))
    shape = (torch.empty(a.shape, device="meta") @ torch.empty(b.shape, device="meta")).shape
    left = a.layout if a.layout.ndim > 1 else a.layout[None]
    right = b.layout if b.layout.ndim > 1 else b.layout[:, None]
    k, n, columns = left.shape[-2], left.shape[-1], right.shape[-1]
    batch = torch.broadcast_shapes(left.shape[:-2], right.shape[:-2])
    result = text.new((*batch, k, columns))
    if text.rows and not batch and n >= LONG and left.stride(-1) == right.stride(-2) == 1:
        if columns == 1:  # the rows of A, one after another
            starts = Array(b.name, right[0, 0]), Array(a.name, left[0, 0]), Array(result.name, result.layout[0, 0])
            return _sums(text, k, n, left.stride(0), *starts, result, shape)
        if right.stride(1) > 1:
            starts = Array(a.name, left[:, 0]), Array(b.name, right[0, 0]), Array(result.name, result.layout[:, 0])
            return _sums(text, columns, n, right.stride(1), *starts, result, shape)
    whole = (*batch, k, n, columns)
    text.each(result.shape, [0.0], "{into} = {0};", result)
    text.each(
        whole,
        [Array(a.name, left[..., None].expand(whole)), Array(b.name, right[..., None, :, :].expand(whole))],
        "{into} += {0} * {1};",
        Array(result.name, result.layout[..., None, :].expand(whole)),
    )
    return Array(result.name, result.layout.reshape(shape))


LONG = 8  # least number of summands for which a sum of products is a call of a helper function


def _sums(text: Text, k: int, n: int, step: int, a: Array, b: Array, into: Array, whole: Array, shape: Any) -> Array:
    """A product by calls of the helper: each is k sums of n products of entries from a on, and from b + i · step on."""
    text.each(into.shape, [a, b], f"{text.rows}({k}, {n}, {step}, &{{0}}, &{{1}}, &{{into}});", into)
    return Array(whole.name, whole.layout.reshape(shape))


def _identity(text: Text, x: Any, *_: Any, dtype: torch.dtype | None = None, **options: Any) -> Any:
    """The value itself instead of a copy, since arrays are never written twice; integers are stored as double too."""
    if dtype is not None and not dtype.is_floating_point:
        raise NotImplementedError
    return x


def _cat(text: Text, parts: Sequence[Any], dim: int = 0) -> Array:
    parts = [part for part in parts if 0 not in shape_of(part)] or list(parts[:1])
    shape = torch.cat([torch.empty(shape_of(part), device="meta") for part in parts], dim).shape
    whole, start = text.new(shape), 0
    for part in parts:
        length = shape_of(part)[dim]
        text.copy(part, Array(whole.name, whole.layout.narrow(dim, start, length)))
        start += length
    return whole


def _stack(text: Text, parts: Sequence[Any], dim: int = 0) -> Array:
    shape = torch.stack([torch.empty(shape_of(part), device="meta") for part in parts], dim).shape
    whole = text.new(shape)
    for i, part in enumerate(parts):
        text.copy(part, Array(whole.name, whole.layout.select(dim, i)))
    return whole


def _scatter_into(view: Any) -> Callable[..., Array]:
    """A copy of x in which the part given by `view` is replaced by another array."""

    def rule(text: Text, x: Any, source: Any, *place: Any) -> Array:
        whole = text.copy(x, text.new(shape_of(x)))
        text.copy(source, Array(whole.name, view(whole.layout, *place)))
        return whole

    return rule


def _copy(text: Text, x: Any, source: Any, *_: Any) -> Array:
    return text.copy(source, text.new(shape_of(x)))


def _rearrangement(target: Any) -> Callable[..., Array]:
    """The rule of an operation that moves entries by constant indices: torch applies it to the positions of entries."""

    def rule(text: Text, x: Any, *args: Any, **kwargs: Any) -> Array:
        if any(isinstance(leaf, Array) for leaf in tree_leaves((args, kwargs))):
            raise NotImplementedError
        x = text.contiguous(x)
        places = target(torch.arange(x.layout.numel()).reshape(x.shape), *args, **kwargs)
        result = text.new(places.shape)
        for i, place in enumerate(places.flatten().tolist()):
            text.add(f"{result.name}[{i}] = {x.name}[{place}];")
        return result

    return rule


def _extreme(relation: str) -> Callable[..., Any]:
    """The first smallest or largest entry along an axis, and its index."""

    def rule(text: Text, x: Array, dim: int | None = None, keepdim: bool = False) -> Any:
        if dim is None or not x.shape:
            return RULES["amin" if relation == "<" else "amax"](text, x)
        value = text.copy(Array(x.name, x.layout.select(dim, 0)), text.new(x.layout.select(dim, 0).shape))
        index = text.each(value.shape, [0.0], "{into} = {0};", text.new(value.shape))
        is_better = f"{{0}} {relation} {{1}} || ({{0}} != {{0}} && {{1}} == {{1}})"  # a nan counts as the extreme
        line = f"if ({is_better}) {{{{ {{1}} = {{0}}; {{into}} = {{2}}; }}}}"
        for k in range(1, x.shape[dim]):
            text.each(value.shape, [Array(x.name, x.layout.select(dim, k)), value, float(k)], line, index)
        found = value, index
        return [Array(y.name, y.layout.unsqueeze(dim)) if keepdim else y for y in found]

    return rule


def _index_of_extreme(relation: str) -> Callable[..., Array]:
    def rule(text: Text, x: Array, dim: int | None = None, keepdim: bool = False) -> Array:
        if dim is None:
            raise NotImplementedError
        return _extreme(relation)(text, x, dim, keepdim)[1]

    return rule


def _gather(text: Text, x: Any, dim: int, index: Any, *, sparse_grad: bool = False) -> Array:
    """Entries at computed indices along an axis."""
    if not isinstance(index, Array):
        return _rearrangement(aten.gather)(text, x, dim, index)
    x = text.contiguous(x)
    first = x.layout.narrow(dim, 0, 1).as_strided(index.shape, [
        0 if axis == dim % len(x.shape) else stride for axis, stride in enumerate(x.layout.stride())
    ])  # fmt: skip
    line = f"{{into}} = {{0.name}}[{{0.index}} + {x.layout.stride(dim)} * {text.to_index}{{1}}];"
    return text.each(index.shape, [Array(x.name, first), index], line, text.new(index.shape))


def _scatter(text: Text, x: Any, dim: int, index: Any, source: Any) -> Array:
    """A copy of x in which entries at computed indices along an axis are replaced."""
    whole = text.copy(x, text.new(shape_of(x)))
    if not isinstance(index, Array):
        raise NotImplementedError
    steps = [0 if axis == dim % len(whole.shape) else step for axis, step in enumerate(whole.layout.stride())]
    first = Array(whole.name, whole.layout.as_strided(index.shape, steps))
    place = f"{{into.name}}[{{into.index}} + {whole.layout.stride(dim)} * {text.to_index}{{0}}]"
    text.each(index.shape, [index, source], f"{place} = {{1}};", first)
    return whole


def _index_put(text: Text, x: Any, indices: Sequence[Any], values: Any, accumulate: bool = False) -> Array:
    """A copy of x in which entries at constant indices along one axis are replaced, or increased (accumulate)."""
    whole = text.copy(x, text.new(shape_of(x)))
    (axis, places), *more = [(axis, index) for axis, index in enumerate(indices) if index is not None]
    if more or not isinstance(places, torch.Tensor) or places.ndim != 1 or places.dtype == torch.bool:
        raise NotImplementedError
    values = values if isinstance(values, Array) else text.tables.of(values)
    shape = (*whole.shape[:axis], len(places), *whole.shape[axis + 1 :])
    given = values.layout.expand(shape)
    for k, place in enumerate(places.tolist()):
        into, part = (Array(name, layout.select(axis, i)) for name, layout, i in
                      ((whole.name, whole.layout, place), (values.name, given, k)))  # fmt: skip
        text.each(into.shape, [into, part], "{into} = {0} + {1};" if accumulate else "{into} = {1};", into)
    return whole


def _softmax(text: Text, x: Array, dim: int, half_to_float: bool = False) -> Array:
    raised = RULES["exp"](text, RULES["sub"](text, x, RULES["amax"](text, x, [dim], True)))
    return RULES["div"](text, raised, RULES["sum"](text, raised, [dim], True))


def _pad(text: Text, x: Array, pad: Sequence[int], value: float = 0.0) -> Array:
    if min(pad) < 0:
        raise NotImplementedError
    sides = [(0, 0)] * (len(x.shape) - len(pad) // 2) + list(zip(pad[::2], pad[1::2], strict=True))[::-1]
    whole = text.new([low + size + high for size, (low, high) in zip(x.shape, sides, strict=True)])
    text.each(whole.shape, [float(value)], "{into} = {0};", whole)
    inner = whole.layout
    for axis, (low, _) in enumerate(sides):
        inner = inner.narrow(axis, low, x.shape[axis])
    text.copy(x, Array(whole.name, inner))
    return whole


def _solution(text: Text, A: Any, B: Any, *, left: bool = True, check_errors: bool = False) -> list[Any]:
    """A⁻¹B or BA⁻¹, one matrix after another; B may be a batch of vectors."""
    A, B = (value if isinstance(value, Array) else text.tables.of(value) for value in (A, B))
    vectors = len(B.shape) == 1 or B.shape == A.shape[:-1]
    right = B.layout[..., None] if vectors else B.layout
    batch = torch.broadcast_shapes(A.shape[:-2], right.shape[:-2])
    whole = text.new((*batch, *right.shape[-2:]))
    matrix, given = A.layout.expand(*batch, *A.shape[-2:]), right.expand(*batch, *right.shape[-2:])
    for place in itertools.product(*map(range, batch)):
        parts = Array(A.name, matrix[place]), Array(B.name, given[place])
        if not left:
            parts = tuple(Array(part.name, part.layout.mT) for part in parts)
        copied, answer = (text.copy(part, text.new(part.shape)) for part in parts)
        n, columns = answer.shape
        text.add(f"solve({n}, {columns}, {copied.name}, {answer.name});")
        text.copy(answer if left else Array(answer.name, answer.layout.mT), Array(whole.name, whole.layout[place]))
    return [Array(whole.name, whole.layout[..., 0]) if vectors else whole, None, None, NO_ERROR]


NO_ERROR = torch.zeros((), dtype=torch.int32)  # torch's linear algebra also returns an error code


def _inverse(text: Text, A: Array, *, check_errors: bool = False) -> list[Any]:
    solution, *_ = _solution(text, A, torch.eye(A.shape[-1], dtype=torch.float64))
    return [solution, NO_ERROR]


def _determinant(text: Text, A: Array) -> list[Array]:
    whole = text.new(A.shape[:-2])
    for k, place in enumerate(itertools.product(*map(range, A.shape[:-2]))):
        copied = text.copy(Array(A.name, A.layout[place]), text.new(A.shape[-2:]))
        text.add(f"{whole.name}[{k}] = solve({A.shape[-1]}, 0, {copied.name}, {copied.name});")
    return [whole]


def _cumulative_sum(text: Text, x: Array, dim: int, *, dtype: Any = None) -> Array:
    total = text.copy(x, text.new(x.shape))
    for k in range(1, x.shape[dim] if x.shape else 0):
        before, now = (Array(total.name, total.layout.select(dim, i)) for i in (k - 1, k))
        text.each(now.shape, [before], "{into} += {0};", now)
    return total


RULES = Rules("C", lambda row: None if row.c is None else _elementwise(row.c), {
    "add": _sum("+"),
    "sub": _sum("-"),
    "div": _divide,
    "pow": _power,
    "clamp": _clamp,
    "sum": _reduction(0.0, "{into} += {0};"),
    "prod": _reduction(1.0, "{into} *= {0};"),
    "amax": _reduction(-math.inf, "{into} = larger({into}, {0});"),
    "amin": _reduction(math.inf, "{into} = smaller({into}, {0});"),
    "any": _reduction(0.0, "{into} = {into} != 0 || {0} != 0;"),
    "all": _reduction(1.0, "{into} = {into} != 0 && {0} != 0;"),
    "mean": _mean,
    "min": _extreme("<"),
    "max": _extreme(">"),
    "argmin": _index_of_extreme("<"),
    "argmax": _index_of_extreme(">"),
    "gather": _gather,
    "scatter": _scatter,
    "index_put": _index_put,
    "_softmax": _softmax,
    "constant_pad_nd": _pad,
    "linalg_vector_norm": _norm,
    **dict.fromkeys(("mm", "bmm", "mv", "dot"), _product),
    "_linalg_solve_ex": _solution,
    "linalg_inv_ex": _inverse,
    "_linalg_det": _determinant,
    "cumsum": _cumulative_sum,
    **dict.fromkeys(("_to_copy", "clone", "alias", "lift_fresh_copy"), _identity),
    "_unsafe_view": lambda text, x, shape: text.view(aten.view.default, x, shape),
    "cat": _cat,
    "stack": _stack,
    "copy": _copy,
    "select_scatter": _scatter_into(aten.select.int),
    "slice_scatter": _scatter_into(aten.slice.Tensor),
    "diagonal_scatter": _scatter_into(aten.diagonal.default),
    **{
        name: _rearrangement(getattr(aten, name))
        for name in ("flip", "index", "index_select", "repeat", "roll")
    },
    "getitem": lambda text, results, index: results[index],
})  # fmt: skip

"""Rules that write torch's operators as instructions: (writer, result, *arguments) ↦ instructions for the result."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves

from lyapnet.graphs.number_kernel.program import Place
from lyapnet.graphs.number_kernel.writing import Number, Writer
from lyapnet.graphs.operators import Rules

OF_MEMORY = {"memory_format", "dtype", "layout", "device", "pin_memory", "non_blocking"}
"""Options of copies that do not change numbers."""
POWERS = {-1: "reciprocal", 1: "copy", 2: "square", 3: "cube", 0.5: "sqrt", -0.5: "rsqrt"}


def _elementwise(operation: str) -> Callable[..., None]:
    def write(writer: Writer, out: Tensor, *values: Number, **options: Any) -> None:
        if options:
            raise NotImplementedError(f"{operation} with {', '.join(options)}")
        writer.elementwise(operation, out, *values)

    return write


def _clone(writer: Writer, out: Tensor, x: Tensor, **options: Any) -> None:
    if options.keys() - OF_MEMORY:
        raise NotImplementedError(f"a copy with {', '.join(options)}")
    _copy(writer, out, x)


def _copy(writer: Writer, out: Tensor, x: Number) -> None:
    """Copy x, converted to the type of the result as in torch."""
    given = x.dtype if isinstance(x, Tensor) else None
    if out.dtype == torch.bool and given != torch.bool:
        writer.elementwise("truth", out, x)
    elif out.dtype == torch.int64 and given not in (torch.int64, torch.bool):
        writer.elementwise("trunc", out, x)
        writer.elementwise("add", out, out, 0)  # −0.0 becomes 0.0, since integers have one zero
    else:
        writer.elementwise("copy", out, x)


def _assign(writer: Writer, out: Tensor, x: Tensor, source: Tensor, non_blocking: bool = False) -> None:
    _copy(writer, out, source)


def _add(writer: Writer, out: Tensor, x: Number, y: Number, alpha: float = 1) -> None:
    if out.dtype == torch.bool:
        raise NotImplementedError("a sum of truths")
    if alpha == 1:
        writer.elementwise("add", out, x, y)
    else:
        writer.elementwise("product_and_sum", out, x, alpha, y)


def _subtract(writer: Writer, out: Tensor, x: Number, y: Number, alpha: float = 1) -> None:
    if alpha == 1:
        writer.elementwise("sub", out, x, y)
    else:
        writer.elementwise("product_and_sum", out, x, -alpha, y)


def _subtract_from(writer: Writer, out: Tensor, x: Number, y: Number, alpha: float = 1) -> None:
    _subtract(writer, out, y, x, alpha)


def _divide(writer: Writer, out: Tensor, x: Number, y: Number, rounding_mode: str | None = None) -> None:
    if rounding_mode == "floor":  # ⌊x/y⌋ would be wrong if x/y is rounded up to an integer
        raise NotImplementedError("a floor division")
    writer.elementwise("div", out, x, y)
    if rounding_mode is not None:
        writer.elementwise("trunc", out, out)


def _power(writer: Writer, out: Tensor, x: Number, exponent: Number) -> None:
    if not isinstance(exponent, Tensor) and exponent in POWERS:
        writer.elementwise(POWERS[exponent], out, x)
    else:
        writer.elementwise("pow", out, x, exponent)


def _clamp(writer: Writer, out: Tensor, x: Tensor, least: Number | None = None, most: Number | None = None) -> None:
    if least is not None:
        writer.elementwise("maximum", out, x, least)
        x = out
    writer.elementwise("copy", out, x) if most is None else writer.elementwise("minimum", out, x, most)


def _threshold_backward(writer: Writer, out: Tensor, costate: Tensor, x: Tensor, threshold: float) -> None:
    below = writer.new_tensor(x)
    writer.elementwise("le", below, x, threshold)
    writer.elementwise("where", out, below, 0, costate)


def _masked_fill(writer: Writer, out: Tensor, x: Tensor, mask: Tensor, value: Number) -> None:
    writer.elementwise("where", out, mask, value, x)


def _logical(operation: str) -> Callable[..., None]:
    """A rule for booleans; bits of integers are refused."""

    def write(writer: Writer, out: Tensor, x: Number, y: Number) -> None:
        if any(not isinstance(each, Tensor) or each.dtype != torch.bool for each in (out, x, y)):
            raise NotImplementedError("a logical operation on numbers")
        writer.elementwise(operation, out, x, y)

    return write


def _fill(writer: Writer, out: Tensor, x: Tensor, value: Number) -> None:
    _copy(writer, out, value)


def _reduction(operation: str, start: float) -> Callable[..., None]:
    def write(
        writer: Writer, out: Tensor, x: Tensor, dim: Any = None, keepdim: bool = False, dtype: Any = None
    ) -> None:
        every = range(x.ndim) if dim is None or dim == [] else [dim] if isinstance(dim, int) else dim
        axes = sorted(axis % max(x.ndim, 1) for axis in every)
        spread = out
        if not keepdim:
            for axis in axes:
                spread = spread.unsqueeze(axis)
        if x.ndim == 0:
            return writer.elementwise("copy", out, x)
        writer.elementwise("copy", out, start)
        place = writer.place(spread)
        strides = tuple(0 if k in axes else stride for k, stride in enumerate(place.strides))
        return writer.program.reduce(operation, x.shape, Place(place.buffer, place.offset, strides), writer.place(x))

    return write


def _index_of_extreme(operation: str) -> Callable[..., None]:
    def write(writer: Writer, out: Tensor, x: Tensor, dim: int | None = None, keepdim: bool = False) -> None:
        if dim is None or x.ndim == 0:
            raise NotImplementedError("the index of an extreme of all entries")
        place, axis = writer.place(out if keepdim else out.unsqueeze(dim)), dim % x.ndim
        strides = tuple(0 if k == axis else stride for k, stride in enumerate(place.strides))
        writer.program.find_extreme(operation, x.shape, axis, place._replace(strides=strides), writer.place(x))

    return write


def _extreme(reduced: str, start: float, index: str) -> Callable[..., None]:
    """A rule for max or min: of all entries, or along an axis with the index."""

    def write(writer: Writer, out: Any, x: Tensor, dim: int | None = None, keepdim: bool = False) -> None:
        if dim is None:
            return _reduction(reduced, start)(writer, out, x)
        _reduction(reduced, start)(writer, out[0], x, dim, keepdim)
        return _index_of_extreme(index)(writer, out[1], x, dim, keepdim)

    return write


def _gather(writer: Writer, out: Tensor, x: Tensor, dim: int, index: Tensor, sparse_grad: bool = False) -> None:
    axis = dim % x.ndim
    given, at = writer.place(x), writer.place(index)
    writer.program.index(index.shape, axis, x.shape[axis], writer.place(out), given, at)


def _scatter(writer: Writer, out: Tensor, x: Tensor, dim: int, index: Tensor, values: Number) -> None:
    axis = dim % x.ndim
    writer.elementwise("copy", out, x)
    if isinstance(values, Tensor):
        values = values[tuple(slice(size) for size in index.shape)]
    given, at = writer.place(values, index.shape), writer.place(index)
    writer.program.index(index.shape, axis, x.shape[axis], writer.place(out), given, at, into=True)


def _reduction_of_booleans(extreme: str) -> Callable[..., None]:
    """A rule for any or all: the largest or least of booleans."""

    def write(writer: Writer, out: Tensor, x: Tensor, dim: Any = None, keepdim: bool = False) -> None:
        truths = x if x.dtype == torch.bool else writer.new_tensor(x)
        if truths is not x:
            writer.elementwise("truth", truths, x)
        RULES[extreme](writer, out, truths, dim, keepdim)

    return write


def _mean(writer: Writer, out: Tensor, x: Tensor, dim: Any = None, keepdim: bool = False, dtype: Any = None) -> None:
    RULES["sum"](writer, out, x, dim, keepdim)
    writer.elementwise("mul", out, out, out.numel() / x.numel())


def _matrix_product(writer: Writer, out: Tensor, A: Tensor, B: Tensor, add: bool = False) -> None:
    shape = (A.shape[-2], B.shape[-1], A.shape[-1])
    places = [writer.place(each) for each in (out, A, B)]
    if out.ndim == 2:
        writer.program.multiply(shape, places, add, writer.width)
    elif len(out):
        writer.program.multiply_batch(len(out), shape, places, add)


def _matrix_and_vector(writer: Writer, out: Tensor, A: Tensor, x: Tensor) -> None:
    _matrix_product(writer, out.unsqueeze(-1), A, x.unsqueeze(-1))


def _add_matrix_product(
    writer: Writer, out: Tensor, x: Tensor, A: Tensor, B: Tensor, beta: float = 1, alpha: float = 1
) -> None:
    if (beta, alpha) != (1, 1):
        raise NotImplementedError("weights in a matrix product")
    writer.elementwise("copy", out, x)
    _matrix_product(writer, out, A, B, add=True)


def _symmetric_inverse(writer: Writer, out: Tensor, A: Tensor) -> None:
    writer.program.small_matrices("symmetric_inverse", A.shape, [writer.place(out), writer.place(A)])


def _active_set(writer: Writer, out: Tensor, b: Tensor, R: Tensor, low: Tensor, high: Tensor) -> None:
    shape = *b.shape, b.shape[-1]
    vectors = [writer.place(each.unsqueeze(-1), shape) for each in (out, b, low, high)]
    writer.program.small_matrices("active_set", shape, [*vectors, writer.place(R, shape)])


def _concatenate(writer: Writer, out: Tensor, parts: Sequence[Tensor], dim: int = 0) -> None:
    first = 0
    for part in parts:
        if part.ndim == out.ndim:  # torch also accepts empty vectors, which are skipped
            writer.elementwise("copy", out.narrow(dim, first, part.shape[dim]), part)
            first += part.shape[dim]


def _stack(writer: Writer, out: Tensor, parts: Sequence[Tensor], dim: int = 0) -> None:
    for k, part in enumerate(parts):
        writer.elementwise("copy", out.select(dim, k), part)


def _select_scatter(writer: Writer, out: Tensor, x: Number, part: Tensor, dim: int, index: int) -> None:
    writer.elementwise("copy", out, x)
    _copy(writer, out.select(dim, index), part)


def _slice_scatter(
    writer: Writer,
    out: Tensor,
    x: Number,
    part: Tensor,
    dim: int = 0,
    start: Any = None,
    end: Any = None,
    step: int = 1,
) -> None:
    writer.elementwise("copy", out, x)
    _copy(writer, torch.ops.aten.slice.Tensor(out, dim, start, end, step), part)


def _backward_of(scatter: Callable[..., None]) -> Callable[..., None]:
    """A rule for the backward operator of a selection: the costate at the selected entries, and zeros elsewhere."""
    return lambda writer, out, costate, sizes, *places: scatter(writer, out, 0, costate, *places)


def _positions(x: Tensor) -> Tensor:
    """The position of each entry of a tensor in memory, counted in numbers from the first."""
    positions = torch.zeros((), dtype=torch.int64)
    for axis, (size, stride) in enumerate(zip(x.shape, x.stride(), strict=True)):
        shape = [1] * x.ndim
        shape[axis] = size
        positions = positions + (torch.arange(size) * stride).reshape(shape)
    return positions


def _require_constant(writer: Writer, *given: Any) -> None:
    for each in tree_leaves(given):
        if isinstance(each, Tensor) and writer.is_written(each):
            raise NotImplementedError("indices that depend on arguments")


def _rearrangement(target: Any) -> Callable[..., None]:
    """A rule for an operator that moves entries of its first argument, and puts zeros elsewhere."""

    def write(writer: Writer, out: Tensor, x: Tensor, *options: Any, **named: Any) -> None:
        _require_constant(writer, options, named)
        source = target(_positions(x).reshape(x.shape) + 1, *options, **named).flatten()
        to, there = _positions(out).flatten(), source > 0
        if not there.all():
            writer.elementwise("copy", out, 0)
        writer.program.move(writer.place(out), to[there], writer.place(x), source[there] - 1)

    return write


def _index_put(
    writer: Writer, out: Tensor, x: Tensor, indices: Sequence[Tensor | None], values: Tensor, accumulate: bool = False
) -> None:
    _require_constant(writer, indices)
    _put(writer, out, x, torch.ops.aten.index.Tensor(_positions(out).reshape(out.shape), indices), values, accumulate)


def _index_add(writer: Writer, out: Tensor, x: Tensor, dim: int, index: Tensor, source: Tensor, alpha: Any = 1) -> None:
    _require_constant(writer, index)
    if alpha != 1:
        raise NotImplementedError("index_add with a weight")
    _put(writer, out, x, _positions(out).reshape(out.shape).index_select(dim, index), source, add=True)


def _put(writer: Writer, out: Tensor, x: Tensor, to: Tensor, values: Tensor, add: bool) -> None:
    if add and out.dtype == torch.bool:
        raise NotImplementedError("a sum of truths")
    writer.elementwise("copy", out, x)
    values = values.expand(to.shape)
    place = writer.place(values)
    source = _positions(values).expand(to.shape)
    writer.program.move(writer.place(out), to.flatten(), place, source.flatten(), add)


REARRANGEMENTS = {
    "index": torch.ops.aten.index.Tensor, "index_select": torch.ops.aten.index_select.default,
    "flip": torch.ops.aten.flip.default, "roll": torch.ops.aten.roll.default,
    "repeat": torch.ops.aten.repeat.default, "tril": torch.ops.aten.tril.default, "triu": torch.ops.aten.triu.default,
}  # fmt: skip

RULES = Rules("numbers", lambda row: None if row.instruction is None else _elementwise(row.name), {
    **{name: _rearrangement(target) for name, target in REARRANGEMENTS.items()},
    **dict.fromkeys(("_to_copy", "clone", "contiguous", "lift_fresh_copy"), _clone),
    "add": _add,
    "sub": _subtract,
    "rsub": _subtract_from,
    "div": _divide,
    "pow": _power,
    "clamp": _clamp,
    "clamp_min": _clamp,
    "clamp_max": lambda writer, out, x, most: _clamp(writer, out, x, None, most),
    "threshold_backward": _threshold_backward,
    "masked_fill": _masked_fill,
    "copy": _assign,
    "bitwise_and": _logical("mul"),
    "bitwise_or": _logical("maximum"),
    "bitwise_xor": _logical("ne"),
    "bitwise_not": lambda writer, out, x: _logical("ne")(writer, out, x, torch.ones_like(x)),
    "logical_and": _logical("mul"),
    "logical_or": _logical("maximum"),
    "logical_xor": _logical("ne"),
    "fill": _fill,
    "sum": _reduction("reduce_sum", 0.0),
    "amax": _reduction("reduce_maximum", -torch.inf),
    "amin": _reduction("reduce_minimum", torch.inf),
    "max": _extreme("reduce_maximum", -torch.inf, "index_of_largest"),
    "min": _extreme("reduce_minimum", torch.inf, "index_of_least"),
    "argmax": _index_of_extreme("index_of_largest"),
    "argmin": _index_of_extreme("index_of_least"),
    "gather": _gather,
    "scatter": _scatter,
    "any": _reduction_of_booleans("amax"),
    "all": _reduction_of_booleans("amin"),
    "mean": _mean,
    "mm": _matrix_product,
    "bmm": _matrix_product,
    "mv": _matrix_and_vector,
    "addmm": _add_matrix_product,
    "baddbmm": _add_matrix_product,
    "symmetric_inverse": _symmetric_inverse,
    "active_set": _active_set,
    "cat": _concatenate,
    "stack": _stack,
    "select_backward": _backward_of(_select_scatter),
    "slice_backward": _backward_of(_slice_scatter),
    "select_scatter": _select_scatter,
    "slice_scatter": _slice_scatter,
    "index_put": _index_put,
    "index_add": _index_add,
})  # fmt: skip

"""ONNX operators as torch functions of float64 numbers, with the semantics of opset 18 and later.

Each takes the inputs of a node, and its attributes by their names in ONNX. Shapes, axes and exponents are plain Python
numbers, since they are constants of the graph. An operator that rounds takes the arithmetic of its type (Numbers) as
first argument.
"""

import math
from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from lyapnet.exchange.importing.arithmetic import LARGEST_ANGLE, REPRESENTED, Numbers

SLOPE = 0.009999999776482582  # default slope of LeakyRelu, 0.01 in float32


class OnnxOperator(NamedTuple):
    """An ONNX operator as a torch function."""

    function: Callable[..., Any]
    plain: tuple[int, ...] = ()  # indices of the inputs that the function takes as plain numbers, not as tensors
    rounds: bool = True  # whether it rounds floating-point numbers; the function then takes Numbers first
    whole: bool = False  # whether it takes whole numbers


def _basic(function: Callable[..., Tensor], whole: bool = False) -> OnnxOperator:
    """An operation whose result is rounded correctly."""
    return OnnxOperator(lambda numbers, *tensors: numbers.rounded(function(*tensors)), whole=whole)


def _elementary(name: str, function: Callable[[Tensor], Tensor]) -> OnnxOperator:
    """A function of one number."""
    return OnnxOperator(lambda numbers, x: numbers.function(name, function(x)))


def _wave(name: str, function: Callable[[Tensor], Tensor]) -> OnnxOperator:
    """A function of an angle."""

    def computed(numbers: Numbers, x: Tensor) -> Tensor:
        return numbers.function(name, function(numbers.limited(x, LARGEST_ANGLE)))

    return OnnxOperator(computed)


def _exact(function: Callable[..., Any], *plain: int, whole: bool = True) -> OnnxOperator:
    """An operation that does not round."""
    return OnnxOperator(function, plain, rounds=False, whole=whole)


def _clip(x: Tensor, low: float | None = None, high: float | None = None) -> Tensor:
    return x if low is None and high is None else x.clamp(low, high)


def _gemm(
    numbers: Numbers, a: Tensor, b: Tensor, c: Tensor | None = None, alpha: float = 1.0, beta: float = 1.0,
    transA: int = 0, transB: int = 0,
) -> Tensor:  # fmt: skip
    """α · ab + β · c."""
    a, b = (a.mT if transA else a), (b.mT if transB else b)
    y = numbers.product(a, b, alpha)
    y = y if alpha == 1 else alpha * y
    if c is not None:
        c = numbers.summands(c, 1, max(1.0, abs(beta)))
        y = y + (c if beta == 1 else beta * c)
    return numbers.rounded(y, 0, lost=1 + abs(alpha) + abs(beta))


def _power(numbers: Numbers, x: Tensor, exponent: Any) -> Tensor:
    """xᵖ of one number p."""
    (p,) = exponent if isinstance(exponent, list) else (exponent,)
    return numbers.function("Pow", x**p)


def _softplus(x: Tensor) -> Tensor:
    """log(1 + eˣ); for x > 40 this is x in float64."""
    return functional.softplus(x, threshold=40)


def _elu(numbers: Numbers, x: Tensor, alpha: float = 1.0) -> Tensor:
    below = numbers.rounded(numbers.function("Exp", torch.exp(x.clamp(max=0))) - 1)
    return x.relu() + numbers.rounded(alpha * below)


def _divide(x: Tensor, y: Tensor) -> Tensor:
    whole = not x.is_floating_point() and not y.is_floating_point()
    return torch.div(x, y, rounding_mode="trunc") if whole else x / y


def _cast(numbers: Numbers, x: Tensor, to: int, saturate: int = 1) -> Tensor:
    """x in another number type."""
    if REPRESENTED[to] == torch.bool:
        return x if x.dtype == torch.bool else x != 0
    y = x.to(REPRESENTED[to])
    return numbers.rounded(y) if x.is_floating_point() and y.is_floating_point() else y


def _constant_of_shape(shape: list[int], value: Tensor | None = None) -> Tensor:
    value = torch.zeros(1, dtype=torch.float64) if value is None else value
    return value.reshape(()).expand(shape)


def _reshape(x: Tensor, shape: list[int], allowzero: int = 0) -> Tensor:
    return x.reshape([x.shape[k] if size == 0 and not allowzero else size for k, size in enumerate(shape)])


def _flatten(x: Tensor, axis: int = 1) -> Tensor:
    axis = axis + x.ndim if axis < 0 else axis
    return x.reshape(math.prod(x.shape[:axis]), math.prod(x.shape[axis:]))


def _squeeze(x: Tensor, axes: list[int] | None = None) -> Tensor:
    return x.squeeze() if axes is None else x.squeeze(axes)


def _unsqueeze(x: Tensor, axes: list[int]) -> Tensor:
    for axis in sorted(axis % (x.ndim + len(axes)) for axis in axes):
        x = x.unsqueeze(axis)
    return x


def _transpose(x: Tensor, perm: list[int] | None = None) -> Tensor:
    return x.permute(perm if perm is not None else [*reversed(range(x.ndim))])


def _expand(x: Tensor, shape: list[int]) -> Tensor:
    return x.expand(torch.broadcast_shapes(x.shape, shape))


def _slice(
    x: Tensor, starts: list[int], ends: list[int], axes: list[int] | None = None, steps: list[int] | None = None
) -> Tensor:
    axes, steps = axes or [*range(len(starts))], steps or [1] * len(starts)
    for start, end, axis, step in zip(starts, ends, axes, steps, strict=True):
        size = x.shape[axis]
        last = None if step < 0 and end < -size else end  # a slice that goes down then includes the first
        chosen = range(size)[start:last:step]
        x = x.narrow(axis, chosen.start, len(chosen)) if step == 1 else _gather(x, [*chosen], axis)
    return x


def _gather(x: Tensor, indices: Any, axis: int = 0) -> Tensor:
    """x at indices along an axis; nested lists give as many axes."""
    if isinstance(indices, int):
        return x.select(axis, indices)
    if not indices:
        return x.narrow(axis, 0, 0)
    if isinstance(indices[0], int) and indices[0] >= 0 and indices == [*range(indices[0], indices[0] + len(indices))]:
        return x.narrow(axis, indices[0], len(indices))
    return torch.stack([_gather(x, each, axis) for each in indices], axis)


def _split(
    x: Tensor, split: list[int] | None = None, axis: int = 0, num_outputs: int | None = None
) -> Sequence[Tensor]:
    size = x.shape[axis]
    if split is None:
        part = math.ceil(size / (num_outputs or 1))
        split = [min(part, size - start) for start in range(0, size, part)]
    return [x.narrow(axis, sum(split[:k]), each) for k, each in enumerate(split)]


def _reducing(of_sum: Callable[[Numbers, Tensor, int], Tensor], each: Callable[[Tensor], Tensor]) -> OnnxOperator:
    """The operator of_sum(Σ each(x), number of summands), with sums over some axes."""

    def reduced(
        numbers: Numbers, x: Tensor, axes: list[int] | None = None, keepdims: int = 1, noop_with_empty_axes: int = 0
    ) -> Tensor:
        if not axes and noop_with_empty_axes:
            return of_sum(numbers, each(x), 1)
        axes = axes or list(range(x.ndim))
        terms = math.prod(x.shape[axis] for axis in axes)
        total = numbers.summands(each(x), terms).sum(axes, bool(keepdims)) if axes else each(x)
        return of_sum(numbers, numbers.rounded(total, 0), terms)

    return OnnxOperator(reduced, (1,))


def _each(function: Callable[[Tensor, Tensor], Tensor]) -> Callable[..., Tensor]:
    """A function of two tensors, extended to any number of them."""
    return lambda *tensors: reduce(function, tensors)


def _total(numbers: Numbers, *tensors: Tensor) -> Tensor:
    return reduce(lambda x, y: numbers.rounded(x + y), tensors)


def _constant(**value: Any) -> Tensor:
    """The value of the only attribute as a tensor."""
    (found,) = value.values()
    return found if isinstance(found, Tensor) else torch.as_tensor(
        found, dtype=torch.float64 if "float" in next(iter(value)) else torch.int64
    )  # fmt: skip


OPERATORS: dict[str, OnnxOperator] = {
    # arithmetic
    "Add": _basic(torch.add, whole=True),
    "Sub": _basic(torch.sub, whole=True),
    "Mul": _basic(torch.mul, whole=True),
    "Div": _basic(_divide, whole=True),
    "Sqrt": _elementary("Sqrt", torch.sqrt),
    "Reciprocal": _elementary("Reciprocal", torch.reciprocal),
    "Pow": OnnxOperator(_power, (1,)),
    "LeakyRelu": OnnxOperator(lambda numbers, x, alpha=SLOPE: numbers.rounded(functional.leaky_relu(x, alpha))),
    "Sum": OnnxOperator(_total),
    "Mean": OnnxOperator(lambda numbers, *tensors: numbers.rounded(_total(numbers, *tensors) / len(tensors), 2)),
    "MatMul": OnnxOperator(lambda numbers, a, b: numbers.rounded(numbers.product(a, b), 0)),
    "Gemm": OnnxOperator(_gemm),
    "ReduceSum": _reducing(lambda numbers, total, terms: total, lambda x: x),
    "ReduceMean": _reducing(lambda numbers, total, terms: numbers.rounded(total / terms, 2), lambda x: x),
    "ReduceSumSquare": _reducing(lambda numbers, total, terms: total, lambda x: x**2),
    "ReduceL2": _reducing(lambda numbers, total, terms: numbers.function("Sqrt", total.sqrt()), lambda x: x**2),
    # functions
    "Exp": _elementary("Exp", torch.exp),
    "Log": _elementary("Log", torch.log),
    "Tanh": _elementary("Tanh", torch.tanh),
    "Sigmoid": _elementary("Sigmoid", torch.sigmoid),
    "Softplus": _elementary("Softplus", _softplus),
    "Elu": OnnxOperator(_elu),
    "Sin": _wave("Sin", torch.sin),
    "Cos": _wave("Cos", torch.cos),
    "Tan": _wave("Tan", torch.tan),
    # operators without rounding
    "Cast": OnnxOperator(_cast, whole=True),
    "Neg": _exact(torch.neg),
    "Abs": _exact(torch.abs),
    "Relu": _exact(torch.relu, whole=False),
    "Clip": _exact(_clip, 1, 2, whole=False),
    "Sign": _exact(torch.sign, whole=False),
    "Floor": _exact(torch.floor, whole=False),
    "Ceil": _exact(torch.ceil, whole=False),
    "Max": _exact(_each(torch.maximum)),
    "Min": _exact(_each(torch.minimum)),
    "Less": _exact(torch.lt),
    "LessOrEqual": _exact(torch.le),
    "Greater": _exact(torch.gt),
    "GreaterOrEqual": _exact(torch.ge),
    "Equal": _exact(torch.eq),
    "Not": _exact(torch.logical_not),
    "And": _exact(torch.logical_and),
    "Or": _exact(torch.logical_or),
    "Where": _exact(torch.where),
    # arrangements
    "Identity": _exact(lambda x: x),
    "Constant": _exact(_constant),
    "ConstantOfShape": _exact(_constant_of_shape, 0),
    "Shape": _exact(lambda x, start=0, end=None: torch.tensor(x.shape[start:end])),
    "Concat": _exact(lambda *tensors, axis: torch.cat(tensors, axis)),
    "Flatten": _exact(_flatten),
    "Transpose": _exact(_transpose),
    "Reshape": _exact(_reshape, 1),
    "Squeeze": _exact(_squeeze, 1),
    "Unsqueeze": _exact(_unsqueeze, 1),
    "Expand": _exact(_expand, 1),
    "Slice": _exact(_slice, 1, 2, 3, 4),
    "Gather": _exact(_gather, 1),
    "Split": _exact(_split, 1),
}

"""ONNX operators as torch functions of float64 numbers, with the semantics of opset 18 and later.

Each takes the node's inputs and its attributes by their names in ONNX. Shapes, axes and exponents are plain Python
numbers: they are constants of the graph.
"""

import math
from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

KINDS = {  # onnx.TensorProto: float and double, which are real numbers here; truths; integers
    **dict.fromkeys((1, 11), torch.float64),
    9: torch.bool,
    **dict.fromkeys((2, 3, 4, 5, 6, 7, 12, 13), torch.int64),
}


class Operator(NamedTuple):
    """What an ONNX operator does."""

    function: Callable[..., Any]
    plain: tuple[int, ...] = ()  # the inputs that are handed over as plain numbers, not as tensors


def _clip(x: Tensor, low: float | None = None, high: float | None = None) -> Tensor:
    return x if low is None and high is None else x.clamp(low, high)


def _gemm(
    a: Tensor, b: Tensor, c: Tensor | None = None, alpha: float = 1.0, beta: float = 1.0, transA: int = 0,
    transB: int = 0,
) -> Tensor:  # fmt: skip
    """α · ab + β · c."""
    product = (a.mT if transA else a) @ (b.mT if transB else b)
    product = product if alpha == 1 else alpha * product
    return product if c is None else product + (c if beta == 1 else beta * c)


def _power(x: Tensor, exponent: Any) -> Tensor:
    """xᵖ of one number p."""
    (p,) = exponent if isinstance(exponent, list) else (exponent,)
    return x**p


def _softplus(x: Tensor) -> Tensor:
    """log(1 + eˣ); beyond 40 that is x, in float64."""
    return functional.softplus(x, threshold=40)


def _divide(x: Tensor, y: Tensor) -> Tensor:
    whole = not x.is_floating_point() and not y.is_floating_point()
    return torch.div(x, y, rounding_mode="trunc") if whole else x / y


def _cast(x: Tensor, to: int, saturate: int = 1) -> Tensor:
    """x as another kind of number; less than float32 is none, as that would round."""
    if to not in KINDS:
        raise ValueError(f"type {to} of onnx.TensorProto in the place of float or double")
    return x.to(KINDS[to])


def _constant_of_shape(shape: list[int], value: Tensor | None = None) -> Tensor:
    value = torch.zeros(1, dtype=torch.float64) if value is None else value
    return value.reshape(()).expand(shape).clone()


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
        x = _gather(x, [*range(size)][start:last:step], axis)
    return x


def _gather(x: Tensor, indices: Any, axis: int = 0) -> Tensor:
    """x at indices along an axis; nested lists give as many axes."""
    if isinstance(indices, int):
        return x.select(axis, indices)
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


def _reducing(function: Callable[..., Tensor]) -> Operator:
    """A sum over some axes, of a function of the numbers."""

    def reduced(x: Tensor, axes: list[int] | None = None, keepdims: int = 1, noop_with_empty_axes: int = 0) -> Tensor:
        if not axes and noop_with_empty_axes:
            return x
        return function(x, axes or list(range(x.ndim)), bool(keepdims))

    return Operator(reduced, (1,))


def _each(function: Callable[[Tensor, Tensor], Tensor]) -> Operator:
    """A function of two, of any number."""
    return Operator(lambda *tensors: reduce(function, tensors))


def _constant(**value: Any) -> Tensor:
    """The one attribute that there is; numbers as tensors."""
    (found,) = value.values()
    return found if isinstance(found, Tensor) else torch.as_tensor(
        found, dtype=torch.float64 if "float" in next(iter(value)) else torch.int64
    )  # fmt: skip


OPERATORS: dict[str, Operator] = {
    **{
        name: Operator(function)
        for name, function in {
            "Identity": lambda x: x, "Neg": torch.neg, "Abs": torch.abs, "Reciprocal": torch.reciprocal,
            "Exp": torch.exp, "Log": torch.log, "Sqrt": torch.sqrt, "Sin": torch.sin, "Cos": torch.cos,
            "Tan": torch.tan, "Tanh": torch.tanh, "Sigmoid": torch.sigmoid, "Relu": torch.relu,
            "Softplus": _softplus, "Sign": torch.sign, "Floor": torch.floor, "Ceil": torch.ceil,
            "Not": torch.logical_not,
            "Add": torch.add, "Sub": torch.sub, "Mul": torch.mul, "Div": _divide, "MatMul": torch.matmul, "Gemm": _gemm,
            "Less": torch.lt, "LessOrEqual": torch.le, "Greater": torch.gt, "GreaterOrEqual": torch.ge,
            "Equal": torch.eq, "And": torch.logical_and, "Or": torch.logical_or, "Where": torch.where,
            "Flatten": _flatten, "Transpose": _transpose, "Cast": _cast, "Constant": _constant,
            "Concat": lambda *tensors, axis: torch.cat(tensors, axis),
            "LeakyRelu": lambda x, alpha=0.01: functional.leaky_relu(x, alpha),
            "Elu": lambda x, alpha=1.0: x.relu() + alpha * (torch.exp(x.clamp(max=0)) - 1),
            "Shape": lambda x, start=0, end=None: torch.tensor(x.shape[start:end]),
        }.items()
    },
    "Pow": Operator(_power, (1,)),
    "Clip": Operator(_clip, (1, 2)),
    "Max": _each(torch.maximum),
    "Min": _each(torch.minimum),
    "Sum": _each(torch.add),
    "Mean": Operator(lambda *tensors: reduce(torch.add, tensors) / len(tensors)),
    "ReduceSum": _reducing(lambda x, axes, keep: x.sum(axes, keep)),
    "ReduceMean": _reducing(lambda x, axes, keep: x.mean(axes, keep)),
    "ReduceSumSquare": _reducing(lambda x, axes, keep: (x**2).sum(axes, keep)),
    "ReduceL2": _reducing(lambda x, axes, keep: (x**2).sum(axes, keep).sqrt()),
    "ConstantOfShape": Operator(_constant_of_shape, (0,)),
    "Reshape": Operator(_reshape, (1,)),
    "Squeeze": Operator(_squeeze, (1,)),
    "Unsqueeze": Operator(_unsqueeze, (1,)),
    "Expand": Operator(_expand, (1,)),
    "Slice": Operator(_slice, (1, 2, 3, 4)),
    "Gather": Operator(_gather, (1,)),
    "Split": Operator(_split, (1,)),
}  # fmt: skip

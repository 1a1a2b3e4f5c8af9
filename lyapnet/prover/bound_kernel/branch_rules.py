"""The rules of lyapnet.prover.branches (kinks, truth values, choices) for machine code."""

import math
from typing import Any

import torch
from torch import Tensor

from lyapnet.prover.bound_kernel.program import Forms, Program
from lyapnet.prover.bound_kernel.rules import Rule, add, as_forms, each, function_of, multiply, registering, subtract

aten = torch.ops.aten
RULES: dict[Any, Rule] = {}
rule = registering(RULES)


@rule(aten.relu.default)
def _relu(program: Program, x: Forms) -> Forms:
    return function_of("leaky", 0.0)(program, x)


@rule(aten.leaky_relu.default)
def _leaky_relu(program: Program, x: Forms, negative_slope: float = 0.01) -> Forms:
    return function_of("leaky", negative_slope)(program, x)


@rule(aten.abs.default)
def _absolute(program: Program, x: Forms) -> Forms:
    return function_of("absolute")(program, x)


@rule(aten.clamp.default, aten.clamp_min.default)
def _clamp(program: Program, x: Forms, low: float | None = None, high: float | None = None) -> Forms:
    return function_of("clamp", -math.inf if low is None else low, math.inf if high is None else high)(program, x)


@rule(aten.clamp_max.default)
def _clamp_max(program: Program, x: Forms, high: float) -> Forms:
    return _clamp(program, x, None, high)


@rule(aten.maximum.default, aten.clamp_min.Tensor)
def _maximum(program: Program, x: Any, y: Any) -> Forms:
    return add(program, y, _relu(program, subtract(program, x, y)))


@rule(aten.minimum.default, aten.clamp_max.Tensor)
def _minimum(program: Program, x: Any, y: Any) -> Forms:
    return subtract(program, x, _relu(program, subtract(program, x, y)))


@rule(aten.clamp.Tensor)
def _clamp_between(program: Program, x: Any, low: Any = None, high: Any = None) -> Forms:
    y = x if low is None or _is_constant(low, -math.inf) else _maximum(program, x, low)
    y = y if high is None or _is_constant(high, math.inf) else _minimum(program, y, high)
    if isinstance(low, Tensor) and isinstance(high, Tensor) and bool((low.isfinite() & high.isfinite()).all()):
        return each(program.within_limits, y, torch.minimum(low, high), high)
    return y


def _is_constant(y: Any, value: float) -> bool:
    return isinstance(y, Tensor) and bool((y == value).all())


def _truth(program: Program, name: str, *values: Any) -> Forms:
    return each(lambda *operands: program.truth(name, *operands), *(as_forms(program, y) for y in values))


def _greater(program: Program, x: Any, y: Any) -> Forms:
    return _truth(program, "positive", subtract(program, x, y))


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
    return each(program.where, *(as_forms(program, value) for value in (truth, x, y)))


@rule(aten.threshold_backward.default)
def _threshold_backward(program: Program, gradient: Any, x: Any, threshold: float) -> Forms:
    return _where(program, _greater(program, x, threshold), gradient, 0.0)


@rule(aten.leaky_relu_backward.default)
def _leaky_relu_backward(program: Program, gradient: Any, x: Any, negative_slope: float, self_is_result: bool) -> Forms:
    return _where(program, _greater(program, x, 0.0), gradient, multiply(program, gradient, negative_slope))


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
rule(aten.masked_fill.Scalar, aten.masked_fill.Tensor)(lambda program, x, mask, value: _where(program, mask, value, x))

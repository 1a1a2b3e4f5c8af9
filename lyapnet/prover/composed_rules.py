"""Bounds of operators that are compositions of others: one rule each, for the interpreter and for machine code."""

from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from typing import Any

import torch

from lyapnet.base.errors import UsageError

aten = torch.ops.aten

Rule = Callable[..., Any]


class Operators:
    """The rules for bounds as methods with the names of torch's operators, as in `operators.mul(x, y)`.

    Args:
        rules: operator ↦ rule. If several overloads have a rule, the default overload is used, else that of tensors.
        first: arguments of all rules before those of the operator: the program for machine code; none for Taylor forms.
    """

    def __init__(self, rules: Mapping[Any, Rule], *first: Any):
        self._rules, self._first = rules, first

    def __getattr__(self, name: str) -> Rule:
        packet = getattr(aten, name)
        overloads = (getattr(packet, each) for each in ("default", "Tensor", "self") if each in packet.overloads())
        for rule in (self._rules[each] for each in overloads if each in self._rules):
            return lambda *arguments: rule(*self._first, *arguments)
        raise NotImplementedError(f"no rule for bounds of {name}")


def for_forms(rule: Rule, rules: Mapping[Any, Rule]) -> Rule:
    """A composed rule for Taylor forms, as the interpreter of graphs uses it."""
    return wraps(rule)(lambda *arguments, **keywords: rule(Operators(rules), *arguments, **keywords))


def for_programs(rule: Rule, rules: Mapping[Any, Rule]) -> Rule:
    """A composed rule for machine code; its first argument is the program."""
    return wraps(rule)(lambda program, *arguments, **keywords: rule(Operators(rules, program), *arguments, **keywords))


def _subtract_from(operators: Operators, x: Any, y: Any, alpha: float = 1) -> Any:
    """y − αx."""
    return operators.sub(y, x, alpha)


def _power(operators: Operators, x: Any, exponent: float) -> Any:
    """xᵖ for p = ±½ and whole p: (x^⌊p/2⌋)² for even p, (x^⌊p/2⌋)² x for odd p, 1/x⁻ᵖ for negative p, and x⁰ = 1."""
    if exponent == 0:
        return torch.ones(x.shape, dtype=torch.float64)
    if exponent < 0:
        return operators.reciprocal(_power(operators, x, -exponent))
    if exponent == 0.5:
        return operators.sqrt(x)
    if not float(exponent).is_integer():
        raise UsageError(f"Expected a whole exponent or ±½ in a power, got {exponent}; write it with exp or sqrt.")
    if exponent == 1:
        return x
    half = _power(operators, x, exponent // 2)
    even = operators.mul(half, half)
    return even if exponent % 2 == 0 else operators.mul(even, x)


def _dot(operators: Operators, x: Any, y: Any) -> Any:
    """Σ_i x_i y_i."""
    return operators.sum(operators.mul(x, y))


def _add_matrix_product(operators: Operators, offset: Any, x: Any, y: Any, beta: float = 1, alpha: float = 1) -> Any:
    """β · offset + α · xy."""
    product = operators.mm(x, y)
    return operators.add(product if alpha == 1 else operators.mul(product, alpha), offset, beta)


def _mean(
    operators: Operators, x: Any, dim: Sequence[int] | None = None, keepdim: bool = False, dtype: Any = None
) -> Any:
    """Σ x over some axes, divided by their length."""
    total = operators.sum(x, dim, keepdim)
    return operators.mul(total, total.shape.numel() / x.shape.numel())


def _rsqrt(operators: Operators, x: Any) -> Any:
    """1/√x."""
    return operators.reciprocal(operators.sqrt(x))


def _silu(operators: Operators, x: Any) -> Any:
    """x σ(x)."""
    return operators.mul(x, operators.sigmoid(x))


def _silu_backward(operators: Operators, gradient: Any, x: Any) -> Any:
    """gradient · σ(x)(1 + x(1 − σ(x)))."""
    s = operators.sigmoid(x)
    inner = operators.add(operators.mul(x, operators.sub(1.0, s)), 1.0)
    return operators.mul(gradient, operators.mul(s, inner))


def _sigmoid_backward(operators: Operators, gradient: Any, s: Any) -> Any:
    """gradient · s(1 − s), where s = σ(x) is the result."""
    return operators.mul(gradient, operators.sub(s, operators.mul(s, s)))


def _tanh_backward(operators: Operators, gradient: Any, y: Any) -> Any:
    """gradient · (1 − y²), where y = tanh x is the result."""
    return operators.mul(gradient, operators.sub(1.0, operators.mul(y, y)))


COMPOSED: dict[Any, Rule] = {
    **dict.fromkeys((aten.rsub.Scalar, aten.rsub.Tensor), _subtract_from),
    aten.pow.Tensor_Scalar: _power,
    aten.dot.default: _dot,
    aten.addmm.default: _add_matrix_product,
    **dict.fromkeys((aten.mean.default, aten.mean.dim), _mean),
    aten.rsqrt.default: _rsqrt,
    aten.silu.default: _silu,
    aten.silu_backward.default: _silu_backward,
    aten.sigmoid_backward.default: _sigmoid_backward,
    aten.tanh_backward.default: _tanh_backward,
}
"""Operator ↦ its rule, a function of `Operators` and the arguments of the operator."""

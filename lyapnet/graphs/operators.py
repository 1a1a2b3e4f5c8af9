"""The table of elementwise operators: each row is an operator in C, in CasADi and in the kernel for numbers.

A reader translates traces with rules from these rows. It has further rules only for what rows cannot express: options,
such as alpha in a sum, and operators that move entries, add them up or solve equations. The column of bounds is in
lyapnet.prover.operators, since a proof depends on that folder alone; `register` there takes a whole row with bounds.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from lyapnet.base.errors import UsageError

# domains of operands for the tests against torch
ANY = (-3.0, 3.0)
POSITIVE = (0.1, 9.0)
UNIT = (-0.99, 0.99)
TRUTH = None  # a boolean


@dataclass(frozen=True)
class Operator:
    """An elementwise operator of torch and its expression for each reader; None if a reader does not support it.

    Args:
        name: the name in torch without the overload, such as `sin` for torch.ops.aten.sin.
        c: an expression in C99 and JavaScript with operands {0}, {1}, …
        casadi: the name of a function of CasADi, or (casadi, *operands) ↦ an expression.
        numbers: an expression in C++ of vectors x, y, z (see program.cpp); None to compute `c` for each number.
        domain: the intervals of the operands, or TRUTH, on which the columns are tested against torch.
        namespace: in torch.ops.
    """

    name: str
    c: str | None = None
    casadi: str | Callable[..., Any] | None = None
    numbers: str | None = None
    domain: tuple[tuple[float, float] | None, ...] = (ANY,)
    namespace: str = "aten"

    @property
    def operands(self) -> int:
        """The number of operands."""
        return len(self.domain)

    @property
    def instruction(self) -> str | None:
        """The expression for the kernel for numbers."""
        if self.numbers is not None or self.c is None:
            return self.numbers
        names = "xyz"[: self.operands]
        declared = ", ".join(f"double {name}" for name in names)
        return f"each<T>([]({declared}) -> double {{ return {self.c.format(*names)}; }}, {', '.join(names)})"

    @property
    def overloads(self) -> list[Any]:
        """torch's overloads that return a new tensor; those that take only tensors come first."""
        packet = getattr(getattr(torch.ops, self.namespace), self.name)
        overloads = [getattr(packet, name) for name in packet.overloads()]
        return sorted((each for each in overloads if not each._schema.is_mutable), key=_takes_numbers)

    def __call__(self, *operands: Tensor) -> Tensor:
        """The result of torch."""
        return self.overloads[0](*operands)

    def at(self, unit: Tensor) -> list[Tensor]:
        """Operands in the domain, from points of the unit cube, (*, operands)."""
        pairs = zip(unit.unbind(-1), self.domain, strict=True)
        return [u > 0.5 if sides is None else sides[0] + (sides[1] - sides[0]) * u for u, sides in pairs]


def _takes_numbers(overload: Any) -> bool:
    """Whether an overload has required arguments that are not tensors."""
    return any(str(each.type) != "Tensor" for each in overload._schema.arguments if not each.has_default_value())


def _of_library(name: str, domain: tuple[float, float] = ANY, casadi: Any = "", numbers: str | None = None) -> Operator:
    """An operator that is a function of the C library, with the same name in CasADi unless given."""
    return Operator(name, f"{name}({{0}})", casadi or name, numbers, (domain,))


def _comparison(name: str, sign: str, casadi: Callable[..., Any]) -> Operator:
    return Operator(name, f"{{0}} {sign} {{1}} ? 1.0 : 0.0", casadi, f"x {sign} y ? ONE : ZERO", (ANY, ANY))


def _logical(name: str, sign: str, casadi: str) -> list[Operator]:
    """Logical and bitwise operators of booleans; the kernel for numbers has its own rules, which refuse other types."""
    c = f"{{0}} != 0 {sign} {{1}} != 0"
    return [Operator(f"{kind}_{name}", c, casadi, domain=(TRUTH, TRUTH)) for kind in ("logical", "bitwise")]


def _remainder(casadi: Any, a: Any, b: Any) -> Any:
    """The remainder with the sign of b; a − b⌊a/b⌋ would be wrong by b where a/b is rounded up to an integer."""
    r = casadi.fmod(a, b)
    return casadi.if_else(casadi.logic_and(r != 0, (r < 0) != (b < 0)), r + b, r)


_SIGN = "{0} > 0 ? 1.0 : {0} < 0 ? -1.0 : 0.0", "sign", "x > 0 ? ONE : (x < 0 ? -ONE : ZERO)"

_ROWS = [
    Operator("abs", "fabs({0})", "fabs", "(absolute<T, V>(x))"),
    _of_library("acos", UNIT),
    _of_library("acosh", (1.01, 9.0)),
    _of_library("asin", UNIT),
    _of_library("asinh"),
    _of_library("atan"),
    _of_library("atanh", UNIT),
    _of_library("ceil"),
    _of_library("cos"),
    _of_library("cosh"),
    _of_library("erf"),
    _of_library("erfc", casadi=lambda casadi, a: 1 - casadi.erf(a)),
    _of_library("exp", numbers="exponential(x)"),
    _of_library("exp2", casadi=lambda casadi, a: 2**a),
    _of_library("expm1"),
    _of_library("floor"),
    _of_library("log", POSITIVE),
    _of_library("log10", POSITIVE),
    _of_library("log1p", (-0.9, 9.0)),
    _of_library("log2", POSITIVE, lambda casadi, a: casadi.log(a) / math.log(2)),
    _of_library("sin"),
    _of_library("sinh"),
    _of_library("sqrt", POSITIVE),
    _of_library("tan", (-1.5, 1.5)),
    _of_library("tanh", numbers="(hyperbolic_tangent<T, V>(x))"),
    _of_library("trunc", casadi=lambda casadi, a: casadi.sign(a) * casadi.floor(casadi.fabs(a))),
    Operator("round", numbers="each<T>([](double x) { return std::nearbyint(x); }, x)"),
    Operator("isnan", "{0} != {0}", numbers="x != x ? ONE : ZERO"),
    Operator("neg", "-{0}", lambda casadi, a: -a, "-x"),
    Operator("sign", *_SIGN),
    Operator("sgn", None, *_SIGN[1:]),
    Operator("reciprocal", "1.0 / {0}", lambda casadi, a: 1 / a, "1 / x", (POSITIVE,)),
    Operator("rsqrt", "1.0 / sqrt({0})", lambda casadi, a: 1 / casadi.sqrt(a), "1 / root<T, V>(x)", (POSITIVE,)),
    Operator("square", None, lambda casadi, a: a * a, "x * x"),
    Operator("relu", "larger({0}, 0.0)", lambda casadi, a: casadi.fmax(a, 0), "x > 0 ? x : (x != x ? x : ZERO)"),
    Operator(
        "sigmoid", "1.0 / (1.0 + exp(-{0}))", lambda casadi, a: (1 + casadi.tanh(a / 2)) / 2, "(logistic<T, V>(x))"
    ),
    Operator("sigmoid_backward", numbers="x * (y * (1 - y))", domain=(ANY, ANY)),  # operands: a costate and σ
    Operator("tanh_backward", numbers="x * (1 - y * y)", domain=(ANY, ANY)),  # operands: a costate and tanh
    Operator("add", "{0} + {1}", lambda casadi, a, b: a + b, "x + y", (ANY, ANY)),
    Operator("sub", "{0} - {1}", lambda casadi, a, b: a - b, "x - y", (ANY, ANY)),
    Operator("mul", "{0} * {1}", lambda casadi, a, b: a * b, "x * y", (ANY, ANY)),
    Operator("div", "{0} / {1}", lambda casadi, a, b: a / b, "x / y", (ANY, POSITIVE)),
    Operator(
        "pow", "pow({0}, {1})", lambda casadi, a, b: a**b,
        "each<T>([](T x, T y) { return std::pow(x, y); }, x, y)", (POSITIVE, ANY),
    ),
    Operator("hypot", "hypot({0}, {1})", "hypot", domain=(ANY, ANY)),
    Operator(
        "atan2", "atan2({0}, {1})", "atan2", "each<T>([](T x, T y) { return std::atan2(x, y); }, x, y)", (ANY, ANY)
    ),
    Operator("fmod", "fmod({0}, {1})", "fmod", domain=(ANY, POSITIVE)),
    Operator(
        "remainder", "remainder_of({0}, {1})", _remainder,
        "each<T>(remainder_like<T>, x, y)", (ANY, POSITIVE),
    ),
    Operator("maximum", "larger({0}, {1})", "fmax", "x != x ? x : (y != y ? y : (x > y ? x : y))", (ANY, ANY)),
    Operator("minimum", "smaller({0}, {1})", "fmin", "x != x ? x : (y != y ? y : (x < y ? x : y))", (ANY, ANY)),
    _comparison("eq", "==", lambda casadi, a, b: a == b),
    _comparison("ne", "!=", lambda casadi, a, b: a != b),
    _comparison("lt", "<", lambda casadi, a, b: a < b),
    _comparison("le", "<=", lambda casadi, a, b: a <= b),
    _comparison("gt", ">", lambda casadi, a, b: a > b),
    _comparison("ge", ">=", lambda casadi, a, b: a >= b),
    *_logical("and", "&&", "logic_and"),
    *_logical("or", "||", "logic_or"),
    Operator("logical_not", "{0} == 0", "logic_not", "x == 0 ? ONE : ZERO", (TRUTH,)),
    Operator("bitwise_not", "{0} == 0", "logic_not", domain=(TRUTH,)),
    Operator("where", "{0} != 0 ? {1} : {2}", "if_else", "x != 0 ? y : z", (TRUTH, ANY, ANY)),
]  # fmt: skip
OPERATORS = {row.name: row for row in _ROWS}

Rule = Callable[..., Any]


class Rules(dict[str, Rule]):
    """The rules of a reader: operator name ↦ rule, from the table or written for this reader.

    Args:
        reader: its name, as a key of READERS.
        of_row: row ↦ rule; None if the reader's column is empty.
        own: further rules by operator name; they replace those from the table.
    """

    def __init__(self, reader: str, of_row: Callable[[Operator], Rule | None], own: Mapping[str, Rule]):
        super().__init__()
        self._of_row = of_row
        for row in OPERATORS.values():
            self.add(row)
        self.update(own)
        READERS[reader] = self

    def add(self, row: Operator) -> None:
        """Add the rule of a row, if there is one."""
        rule = self._of_row(row)
        if rule is not None:
            self[row.name] = rule


READERS: dict[str, Rules] = {}
"""Name of each loaded reader ↦ its rules."""


def add(row: Operator) -> None:
    """Add a row to the table, for all readers; see lyapnet.prover.operators.register.

    Raises:
        UsageError: the operator is in the table or in a reader's own rules, or torch does not have it.
    """
    if row.name in OPERATORS or any(row.name in rules for rules in READERS.values()):
        raise UsageError(
            f"Expected an operator that lyapnet lacks, got {row.name}; use the row that is in the table of operators."
        )
    if not hasattr(getattr(torch.ops, row.namespace), row.name):
        raise UsageError(
            f"Expected an operator of torch.ops.{row.namespace}, got {row.name!r}; print the graph of "
            "lyapnet.graphs.tracing.trace to see the names of operators."
        )
    OPERATORS[row.name] = row
    for rules in READERS.values():
        rules.add(row)


def remove(row: Operator) -> None:
    """Remove a row from the table and from all readers."""
    del OPERATORS[row.name]
    for rules in READERS.values():
        rules.pop(row.name, None)

"""Right-hand sides in SymPy, such as those of sympy.physics.mechanics, as equations."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from lyapnet.base.errors import UsageError
from lyapnet.task.systems.equations import EquationSystem, defined


def sympy_system(
    rates: Any, states: Mapping[Any, str] | Sequence[Any], controls: Mapping[Any, str] | Sequence[Any],
    parameters: Mapping[Any, float] | None = None, angles: Sequence[Any] = (), title: str = "SymPy",
) -> EquationSystem:  # fmt: skip
    """The system ẋ = rates of SymPy expressions, such as `KanesMethod.rhs()` of sympy.physics.mechanics.

    The name of a symbol, or of a function of time such as dynamicsymbols("q"), is its text without "(t)".

    Args:
        rates: ẋ, a column or list with an expression for each state.
        states, controls: the symbols, or symbol ↦ unit.
        parameters: symbol ↦ value of all other symbols, in SI units.
        angles: the states that are angles in rad.
        title: the name of the system in tables.

    Raises:
        UsageError: a symbol is neither state, control nor parameter, or an operation has no expression.
    """
    values = {_name_of(symbol): float(value) for symbol, value in (parameters or {}).items()}
    x, u = (_units_by_name(given) for given in (states, controls))
    rates = list(rates)
    if len(rates) != len(x):
        raise UsageError(f"Expected a rate for each of {len(x)} states, got {len(rates)}; give ẋ in x's order.")
    text = "\n".join(_lines(rates, [*states, *controls, *(parameters or {})], list(x)))
    return defined(text, x, u, list(values), [_name_of(each) for each in angles], title)(**values)


def _units_by_name(given: Mapping[Any, str] | Sequence[Any]) -> dict[str, str]:
    return {_name_of(each): given[each] if isinstance(given, Mapping) else "" for each in given}


def _lines(rates: Sequence[Any], given: Sequence[Any], states: Sequence[str]) -> Iterator[str]:
    """The expressions as assignments, with a line for each repeated part."""
    import sympy
    from sympy.printing.pycode import PythonCodePrinter

    plain = {each: sympy.Symbol(_name_of(each), real=True) for each in given}
    parts, results = sympy.cse([sympy.sympify(each).subs(plain) for each in rates], sympy.numbered_symbols("part_"))
    known = {*plain.values(), *(name for name, _ in parts)}
    for expression in [*(part for _, part in parts), *results]:
        if unknown := sorted(map(str, expression.free_symbols - known)):
            raise UsageError(
                f"Expected states, controls and parameters alone in the rates, got {', '.join(unknown)}; give its "
                "value in parameters."
            )
        if functions := sorted(map(str, expression.atoms(sympy.core.function.AppliedUndef, sympy.Derivative))):
            raise UsageError(
                f"Expected no unknown functions in the rates, got {functions[0]}; make it a state or control."
            )
    printer = PythonCodePrinter({"fully_qualified_modules": False, "strict": True})
    try:
        for name, part in parts:
            yield f"{name} = {printer.doprint(part)}"
        for state, result in zip(states, results, strict=True):
            yield f"der({state}) = {printer.doprint(result)}"
    except NotImplementedError as error:
        raise UsageError(f"Expected operations with an expression, got {error}; write them in others.") from error


def _name_of(symbol: Any) -> str:
    """The text of a symbol or function of time, without "(t)"."""
    return str(symbol).removesuffix("(t)")

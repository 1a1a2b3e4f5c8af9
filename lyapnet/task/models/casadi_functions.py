"""CasADi functions (x, u, p…) ↦ ẋ as equations, operation by operation.

It imports neither torch nor other modules of lyapnet that do, because a process without access to files runs it; see
lyapnet.task.models.reading.
"""

import keyword
import math
import random
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from lyapnet.base.errors import UsageError, one_line
from lyapnet.base.names import with_underscores

POINTS = 8  # random points at which equations are compared with the function

# CasADi's operation ↦ its expression; booleans are 1 and 0 in both
EXPRESSIONS = {
    "ASSIGN": "{0}", "ADD": "{0} + {1}", "SUB": "{0} - {1}", "MUL": "{0} * {1}", "DIV": "{0} / {1}", "NEG": "-{0}",
    "SQ": "{0} ** 2", "TWICE": "2 * {0}", "INV": "1 / {0}", "POW": "{0} ** {1}", "CONSTPOW": "{0} ** {1}",
    "LT": "{0} < {1}", "LE": "{0} <= {1}", "EQ": "{0} == {1}", "NE": "{0} != {1}", "NOT": "not {0}",
    "AND": "{0} and {1}", "OR": "{0} or {1}", "IF_ELSE_ZERO": "where({0}, {1}, 0)", "FABS": "abs({0})",
    "FMIN": "min({0}, {1})", "FMAX": "max({0}, {1})", "LIFT": "{0}",
    "REMAINDER": "{0} - {1} * round({0} / {1})",
    **{
        name.upper(): f"{name}({{0}})"
        for name in (
            "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "exp",
            "expm1", "log", "log1p", "sqrt", "sign", "floor", "ceil", "erf",
        )
    },
    **{name.upper(): f"{name}({{0}}, {{1}})" for name in ("atan2", "hypot", "fmod", "copysign")},
}  # fmt: skip
RESULTS = ("xdot", "ode", "rhs", "f", "f_expl", "dx")  # names by which ẋ is found among several results


class Model(NamedTuple):
    """The equations of a model, the names in them, and values of the model for a comparison.

    Args:
        equations: lines in the syntax of lyapnet.task.systems.formulas.
        states, controls, parameters: names, in their order.
        points: for each point of the comparison the values of states, controls, parameters and ẋ.
        units: units of states, then of controls; empty if unknown.
        angles: names of the states that are angles in rad.
        limits: least and greatest controls; None if unknown.
        drawing: lines in the syntax of lyapnet.task.systems.drawing; empty if unknown.
    """

    equations: str
    states: list[str]
    controls: list[str]
    parameters: list[str]
    points: list[list[float]]
    units: Sequence[str] = ()
    angles: Sequence[str] = ()
    limits: list[list[float]] | None = None
    drawing: str = ""


def model_of_function(function: Any, states: Sequence[str] = (), controls: Sequence[str] = ()) -> Model:
    """The equations of a CasADi function (x, u, p…) ↦ ẋ.

    x and u are the inputs with these names, or else the first two; all others are parameters.

    Args:
        states, controls: names that replace those of the function's symbols.

    Raises:
        UsageError: an operation has no expression, or the function has other inputs or results.
    """
    import casadi

    try:
        expanded = function if function.is_a("SXFunction") else _expanded(casadi, function)
    except RuntimeError as error:
        raise UsageError(
            f"Expected a CasADi function of elementary operations, got {function.name()}, which CasADi cannot expand "
            f"({one_line(error)[-150:]}); leave out solvers, interpolants and external functions."
        ) from error
    inputs, result = _inputs_of(expanded), _result_of(expanded)
    given = {inputs[0]: states, inputs[1]: controls}
    names = {i: _names_of(expanded, i, given.get(i, ())) for i in inputs}
    n = len(names[inputs[0]])
    if expanded.size_out(result) != (n, 1):
        raise UsageError(
            f"Expected ẋ of shape ({n}, 1) from {function.name()}, as x has {n} entries, got "
            f"{expanded.size_out(result)}; return a column of derivatives."
        )
    taken = [name for each in names.values() for name in each]
    if twice := [name for k, name in enumerate(taken) if name in taken[:k]]:
        raise UsageError(f"Expected different names of x, u and p, got {twice[0]} twice; name states and controls.")
    lines, texts = assignments(expanded, names, taken)
    x, u, *p = (names[i] for i in inputs)
    rates = [f"der({state}) = {texts[result].get(i, '0')}" for i, state in enumerate(x)]
    return Model(
        "\n".join([*lines, *rates]),
        x,
        u,
        [name for each in p for name in each],
        list(_values(function, inputs, result)),
    )


def _expanded(casadi: Any, function: Any) -> Any:
    """An MX function as elementary operations, also for linear solves, which CasADi does not expand by itself."""
    inputs = function.mx_in()
    results = function.call(inputs, True, False)  # inlines the functions that it calls
    inlined = casadi.Function(function.name(), inputs, results)
    operations = [k for k in range(inlined.n_instructions()) if inlined.instruction_id(k) == casadi.OP_SOLVE]
    if not operations:
        return function.expand()
    solves = [inlined.instruction_MX(k) for k in operations]
    symbols = [casadi.MX.sym(f"solution_{k}", each.sparsity()) for k, each in enumerate(solves)]
    systems = [each.dep(i) for each in solves for i in (1, 0)]  # A and B of each A Y = B
    parts = casadi.Function(
        function.name(), [*inputs, *symbols], casadi.graph_substitute([*systems, *results], solves, symbols)
    ).expand()
    given = function.sx_in()
    solutions = [casadi.SX.zeros(each.sparsity()) for each in symbols]
    for k, each in enumerate(solves):  # in the order of the function, so that each needs only those before it
        A, B = parts.call([*given, *solutions])[2 * k : 2 * k + 2]
        solutions[k] = casadi.solve(A.T if each.info()["tr"] else A, B)
    written = [casadi.cse(each) for each in parts.call([*given, *solutions])[len(systems) :]]
    return casadi.Function(function.name(), given, written, function.name_in(), function.name_out())


def function_of_text(casadi: Any, text: str) -> Any:
    """The function in the text of Function.save or Function.serialize.

    This may run code that the text names: call it in a process that cannot open files, or with your own text.
    """
    try:
        found = casadi.StringDeserializer(text).unpack()  # of save
    except RuntimeError:
        found = casadi.Function.deserialize(text)  # of serialize
        if found.is_null():
            raise
    if not isinstance(found, casadi.Function):
        raise UsageError(
            f"Expected a CasADi Function, got a saved {type(found).__name__}; save the function (x, u, p) ↦ ẋ."
        )
    return found


def _inputs_of(function: Any) -> list[int]:
    """The indices of x, u and the parameters."""
    names = [name.lower().strip("_") for name in function.name_in()]  # do-mpc has _x, _u, _z, _tvp, _p, _w
    used = [i for i in range(function.n_in()) if function.numel_in(i)]
    first = [names.index("x"), names.index("u")] if {"x", "u"} <= {*names} else used[:2]
    if len(first) < 2 or not all(i in used for i in first):
        raise UsageError(
            "Expected a CasADi function (x, u, p…) with states and controls, got inputs "
            f"{', '.join(function.name_in())}; call them x and u, or put them first."
        )
    others = [i for i in used if i not in first]
    for i in [*first, *others]:
        if function.size2_in(i) != 1 or not function.sparsity_in(i).is_dense():
            raise UsageError(
                f"Expected inputs that are dense columns, got {function.name_in(i)} of shape {function.size_in(i)}; "
                "pass columns."
            )
    if any(names[i] == "z" for i in others):
        raise UsageError(
            f"Expected ẋ as a function of x, u and p in {function.name()}, got algebraic states z; solve for them, by "
            "casadi.solve where their equations are linear."
        )
    time = [i for i in others if names[i] in ("t", "time") and function.numel_in(i) == 1]
    depends = [i for i in time if any(function.jac_sparsity(k, i).nnz() for k in range(function.n_out()))]
    if depends:
        raise UsageError("Expected dynamics that do not depend on time, got an input t that counts; make it a state.")
    return [*first, *(i for i in others if i not in time)]


def _result_of(function: Any) -> int:
    """The index of ẋ among the results."""
    names = [name.lower() for name in function.name_out()]
    found = [names.index(name) for name in RESULTS if name in names]
    if function.n_out() > 1 and not found:
        raise UsageError(
            f"Expected one result, or one called {', '.join(RESULTS)}, from {function.name()}, got "
            f"{', '.join(function.name_out())}; return the derivative alone."
        )
    return found[0] if found else 0


def _names_of(function: Any, i: int, given: Sequence[str]) -> list[str]:
    """The names of the entries of an input."""
    count, name = function.numel_in(i), function.name_in(i)
    if given:
        if len(given) != count:
            raise UsageError(
                f"Expected {count} names for {name} of {function.name()}, got {len(given)} ({', '.join(given)}); name "
                "each in its order."
            )
        return [with_underscores(each) for each in given]
    symbols = [str(each) for each in function.sx_in(i).elements()]
    usable = all(_is_name(each) for each in symbols) and len(set(symbols)) == count
    if usable and not all(each.startswith(f"i{i}") for each in symbols):  # the names that expand() gives
        return symbols
    return [name] if count == 1 else [f"{name}_{k}" for k in range(count)]


def _is_name(text: str) -> bool:
    return text.isidentifier() and not keyword.iskeyword(text)


def _prefix(taken: Sequence[str]) -> str:
    """A prefix for names of intermediate results that no taken name has."""
    prefix = "v"
    while any(name.startswith(prefix) and name[len(prefix) :].isdigit() for name in taken):
        prefix += "_"
    return prefix


def assignments(
    function: Any, names: Mapping[int, Sequence[str]], taken: Sequence[str]
) -> tuple[list[str], list[dict[int, str]]]:
    """(the operations of an SX function as assignments, in their order; for each result, its entries as text).

    Args:
        names: index of an input ↦ names of its entries; inputs without names are 0.
        taken: names that intermediate results must not have.
    """
    import casadi

    prefix = _prefix(taken)

    known = {getattr(casadi, f"OP_{name}"): form for name, form in EXPRESSIONS.items()}
    held, lines = dict[int, str](), list[str]()  # held: the entries of the work vector
    rows = [function.sparsity_out(i).row() for i in range(function.n_out())]
    results: list[dict[int, str]] = [{} for _ in rows]
    for k in range(function.n_instructions()):
        operation, given, places = (
            function.instruction_id(k), function.instruction_input(k), function.instruction_output(k)
        )  # fmt: skip
        if operation == casadi.OP_OUTPUT:
            results[places[0]][rows[places[0]][places[1]]] = held[given[0]]
        elif operation == casadi.OP_INPUT:
            held[places[0]] = names[given[0]][int(given[1])] if given[0] in names else "0"
        elif operation == casadi.OP_CONST:
            held[places[0]] = _number(function.instruction_constant(k))
        elif operation in known:
            name = f"{prefix}{len(lines)}"
            lines.append(f"{name} = {known[operation].format(*(held[i] for i in given))}")
            held[places[0]] = name
        else:
            name = next((n for n in dir(casadi) if n.startswith("OP_") and getattr(casadi, n) == operation), operation)
            what = "OP_CALL of a solver, table or external function" if operation == casadi.OP_CALL else name
            raise UsageError(
                f"Expected operations with an expression in {function.name()}, got CasADi's {what}; write it in others."
            )
    return lines, results


def _number(value: float) -> str:
    if not math.isfinite(value):
        raise UsageError(f"Expected finite numbers in the CasADi function, got {value}; leave it out.")
    return repr(value) if value >= 0 else f"({value!r})"


def _values(function: Any, inputs: Sequence[int], result: int) -> Iterator[list[float]]:
    """Values of x, u, p and ẋ at random points, evaluated by CasADi; x and u are positive at half of the points."""
    draw = random.Random(0)
    for k in range(POINTS):
        given = [[0.0] * function.numel_in(i) for i in range(function.n_in())]
        for i in inputs:
            positive = i in inputs[2:] or k % 2  # parameters, levels and concentrations are positive
            given[i] = [draw.uniform(0.5, 1.5) if positive else draw.gauss(0, 1) for _ in given[i]]
        value = function.call(given)[result]
        flat = [float(value[k]) for k in range(value.numel())]
        yield [*(number for i in inputs for number in given[i]), *flat]

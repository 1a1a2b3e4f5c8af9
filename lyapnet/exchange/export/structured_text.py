"""The law as a function block in structured text of IEC 61131-3, the language of programmable logic controllers."""

import textwrap
from collections.abc import Callable, Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lyapnet.base.errors import ExportError
from lyapnet.controller.controller import Controller
from lyapnet.exchange.export.c import Bits, Style, has_limits, limits_of, tested_boxes
from lyapnet.exchange.export.law import Law
from lyapnet.exchange.export.verification import Evaluate, Points
from lyapnet.graphs.c_functions import c_function
from lyapnet.graphs.structured_text_functions import (
    LARGEST,
    ArrayTables,
    Block,
    StructuredText,
    declarations,
    in_single_precision,
    real,
    translate,
)
from lyapnet.graphs.structured_text_in_python import in_python, standard_functions
from lyapnet.graphs.structured_text_library import further_functions

NOT_FINITE, OUTSIDE, OUTSIDE_X0, OUTSIDE_DOMAIN = (
    meaning[0] for meaning in (Bits.NOT_FINITE, Bits.OUTSIDE, Bits.OUTSIDE_X0, Bits.OUTSIDE_DOMAIN)
)
CODES = {
    NOT_FINITE: "t or a number of x or u is not finite",
    OUTSIDE: "x is outside of the states on which u was compared, closed loops from X0 and 20 % around",
    OUTSIDE_X0: "x is outside of X0 at t <= 0",
    OUTSIDE_DOMAIN: "x is where f, g or the cost are not defined",
}
WIDTH = 110  # of the comment at the top


def structured_text(controller: Controller, law: Law, style: Style, tried: Points) -> str:
    """The text of a function block for u(t, x), a return code and, if asked for, V(t, x).

    Args:
        style: the first part of all names; float64 is LREAL, float32 is REAL.
        tried: the points of the comparison; the code tells of states outside of their box.

    Raises:
        ExportError: pycparser is missing; or an operation cannot be written.
    """
    block, tables, bodies = Block(depth=1), ArrayTables(), dict[str, list[str]]()
    for result, graph in (("u", law.control), ("V", law.value)):
        code, _ = c_function(f"static void {result}_of(void)", graph, law.arguments, [result], tables, StructuredText)
        block.depth, block.lines = (1 if result == "u" else 2), []
        translate(code, block, ("t", "V"), style.name)
        bodies[result] = block.lines
    n, m = len(law.arguments["x"]), controller.system.m
    inputs = {"x": n, "p": len(law.arguments.get("p", ()))}
    codes, constants = _code(controller, style, tested_boxes(controller, law, tried), inputs)
    sizes = {"states": n, "controls": m, "parameters": inputs["p"]}
    types = [f"    {style.name}_{what} : ARRAY [0..{size - 1}] OF LREAL;" for what, size in sizes.items() if size]
    parameters = [f"    p : {style.name}_parameters;"] if inputs["p"] else []
    block.counters.add("j0")
    declared = [
        *(f"{array} : ARRAY [0..{size - 1}] OF LREAL;" for array, size in sorted(block.arrays.items())),
        *declarations(block.numbers, "LREAL"),
        *declarations(block.counters | {"flag"}, "DINT"),
    ]
    meanings = "; ".join(f"{number}: {meaning}" for number, meaning in CODES.items())
    lines = [
        "TYPE", *types, "END_TYPE\n",
        *further_functions(block.functions, style.name),
        f"(* u(t, x), to be called every {controller.horizon.dt:g} s; code is 0, or a sum of:",
        textwrap.fill(meanings, WIDTH, initial_indent="   ", subsequent_indent="   ") + " *)",
        f"FUNCTION_BLOCK {style.name}_law",
        "VAR_INPUT",
        *("    t : LREAL;", f"    x : {style.name}_states;", *parameters, "    with_value : BOOL;"),
        "END_VAR",
        "VAR_OUTPUT", f"    u : {style.name}_controls;", "    V : LREAL;", "    code : DINT;", "END_VAR",
        "VAR", *(f"    {each}" for each in declared), "END_VAR",
        "VAR CONSTANT", *tables.text, *constants, "END_VAR",
        *bodies["u"],
        "    V := 0.0;", "    IF with_value THEN", *bodies["V"], "    END_IF;",
        *codes,
        "END_FUNCTION_BLOCK\n",
    ]  # fmt: skip
    text = "\n".join(lines)
    return in_single_precision(text) if style.single else text


def comment(facts: Mapping[str, str]) -> str:
    """Facts as a comment, in ASCII, which all editors of controllers read."""
    known = {"₀": "0", "Δ": "d", "≤": "<=", "≥": ">=", "−": "-", "’": "'", "ᵀ": "'", "²": "^2", "±": "+-"}
    text = "\n   ".join(f"{key}: {value}" for key, value in facts.items())
    for letter, written in known.items():
        text = text.replace(letter, written)
    text = text.encode("ascii", "replace").decode().replace("(*", "( *").replace("*)", "* )")
    return f"(* {text} *)\n"


def _code(
    controller: Controller, style: Style, boxes: Mapping[str, tuple[Tensor, Tensor]], inputs: Mapping[str, int]
) -> tuple[list[str], list[str]]:
    """(the statements that limit u in single precision and compute the return code, the tables that they need)."""
    n, block, tables = inputs["x"], Block(depth=1), list[str]()

    def add_box(name: str, lower: Tensor, upper: Tensor) -> None:
        for side, numbers in (("lower", lower), ("upper", upper)):
            entries = ", ".join(map(real, numbers.tolist()))
            tables.append(f"{name}_{side} : ARRAY [0..{len(numbers) - 1}] OF LREAL := [{entries}];")

    def each_of(size: int, write: Callable[[], None]) -> None:
        block.within(f"FOR j0 := 0 TO {size - 1} DO", "END_FOR;", write)

    def add_flag(number: int, *tests: tuple[int, str]) -> None:
        """Add a number to the code unless tests hold, each of them for every j0 below a number."""
        block.add("flag := 0;")
        for size, test in tests:
            each_of(size, lambda test=test: block.choose(f"NOT ({test})", lambda: block.add(f"flag := {number};")))
        block.add("code := code + flag;")

    limits, m = limits_of(controller, style), controller.system.m
    block.add("code := 0;")
    finite = "ABS({0}) < " + real(LARGEST)  # before limits are applied: MAX and MIN may drop what is not finite
    add_flag(NOT_FINITE, (n, finite.format("x[j0]")), (m, finite.format("u[j0]")), (1, finite.format("t")))
    if limits is not None and has_limits(controller.controls, style):
        add_box("limit", *limits)
        clamped = "u[j0] := MIN(MAX(u[j0], limit_lower[j0]), limit_upper[j0]);"
        each_of(m, lambda: block.add(clamped))
    for name, sides in boxes.items():
        add_box(name, *sides)
    within = "({0} >= {1}_lower[{2}]) AND ({0} <= {1}_upper[{2}])"
    parameters = [(inputs["p"], within.format("p[j0]", "known", f"{n} + j0"))] if inputs["p"] else []
    add_flag(OUTSIDE, (n, within.format("x[j0]", "known", "j0")), *parameters)
    at_start = n, within.format("x[j0]", "start", "j0")
    block.within("IF t <= 0.0 THEN", "END_IF;", lambda: add_flag(OUTSIDE_X0, at_start))
    if "defined" in boxes:
        add_flag(OUTSIDE_DOMAIN, (n, within.format("x[j0]", "defined", "j0")))
    return block.lines, tables


class BlockInPython:
    """The function block of a text, computed in Python statement by statement; for one state at a time.

    A division by zero, an overflow, or a function where it is not defined may stop a programmable controller; here it
    raises.

    Args:
        text: what `structured_text` has written.
        law: the law of the text.
        dtype: the type of its numbers.
    """

    def __init__(self, text: str, law: Law, dtype: torch.dtype):
        self._law, self._number = law, float if dtype == torch.float64 else np.float32
        self._names = standard_functions(self._number)
        exec(in_python(text), self._names)  # the text is our own
        (self._block,) = (value for name, value in self._names.items() if name.endswith("_law"))

    def __call__(self, t: float, state: NDArray, with_value: bool = True) -> tuple[list[float], float, int]:
        """(u, V, code) at a time and a state, with the parameters of a family.

        Raises:
            ExportError: an operation that may stop a controller.
        """
        _, *arrays = self._law.given(t, state)
        numbers = ([self._number(entry) for entry in array] for array in arrays)
        try:
            with np.errstate(divide="raise", over="raise", invalid="raise"):
                u, V, code = self._block(self._number(t), *numbers, with_value)
        except (ArithmeticError, ValueError) as error:  # ValueError: a root, a logarithm
            raise ExportError(
                "Expected a law without division by zero, overflow and undefined functions, at which a programmable "
                f"controller may stop, got {error} at t = {t:g}, x = {np.round(state, 6).tolist()}; export it to c."
            ) from error
        return [float(number) for number in u], float(V), code


def run(text: str, law: Law, dtype: torch.dtype) -> Evaluate:
    """The results of a text for many states."""
    block = BlockInPython(text, law, dtype)

    def evaluate(t: NDArray, x: NDArray) -> tuple[NDArray, NDArray]:
        u, V, _ = zip(*map(block, t.tolist(), x), strict=True)
        return np.array(u), np.array(V)

    return evaluate

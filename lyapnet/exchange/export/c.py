"""C99 without a library: a header, a source, an example and a CMake file."""

import ctypes
import shutil
import subprocess
import tempfile
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from lyapnet.base.errors import ExportError
from lyapnet.controller.controller import Controller
from lyapnet.exchange.export.law import Law
from lyapnet.exchange.export.verification import Points
from lyapnet.graphs.c_functions import c_function, helpers
from lyapnet.graphs.c_text import Tables, in_single_precision, literal
from lyapnet.task.domain import SLACK
from lyapnet.task.sets import ControlBox, ControlSet

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Wpedantic", "-Werror")
FLAGS = (*STRICT, "-O2")
FAST = ("-std=c99", "-O3")
NAME = "lyapnet"  # default of the first part of all names


@dataclass(frozen=True)
class Style:
    """Names and precision of the C.

    Args:
        name: the first part of the names of functions, types and macros, an identifier of C.
        dtype: the type of all numbers, float64 or float32.
    """

    name: str = NAME
    dtype: torch.dtype = torch.float64

    @property
    def macro(self) -> str:
        """The first part of the names of macros."""
        return self.name.upper()

    @property
    def real(self) -> str:
        """The name of the type of numbers in the header."""
        return f"{self.name}_real"

    @property
    def single(self) -> bool:
        """Whether the numbers have single precision."""
        return self.dtype == torch.float32

    @property
    def size(self) -> int:
        """Bytes of a number."""
        return self.dtype.itemsize

    @property
    def numpy(self) -> Any:
        """NumPy's type of the numbers."""
        return np.float32 if self.single else np.float64

    def code(self, text: str) -> str:
        """Code in double precision, converted to this style; WIDE becomes double in both precisions."""
        return (in_single_precision(text) if self.single else text).replace("WIDE", "double")


class Bits:
    """The return codes of the functions, as macros: each is (number, meaning); functions return a sum of them, or 0."""

    NOT_FINITE = 1, "u is not finite; a loop holds the control before it and its last finite estimate"
    OUTSIDE = 2, "x is outside of the states that it was compared on: closed loops from X0, and 20 % around"
    OUTSIDE_X0 = 4, "x is outside of X0 at t <= 0; of a loop by more than three standard deviations"
    OUTSIDE_DOMAIN = 8, "x is where f, g or the cost are not defined"
    MISSING = 16, "a reading is not finite, and was left out"
    AT_RANGE_END = 32, "the estimate of a parameter is at an end of its range: the plant may be beyond, with an offset"


LOOPS = ("MISSING", "AT_RANGE_END")  # codes that only a loop with an estimator returns


def file_comment(facts: Mapping[str, str]) -> str:
    """Facts as the comment at the top of a file."""
    lines = "\n   ".join(f"{key}: {value}" for key, value in facts.items())
    return "/* " + lines.replace("*/", "* /").replace("/*", "/ *") + " */\n"


def sources(
    controller: Controller,
    law: Law,
    facts: Mapping[str, str],
    style: Style,
    tried: Points,
    loop: Any = None,
    claim: str = "",
) -> dict[str, str]:
    """File name ↦ text.

    Args:
        facts: lines for the comment at the top.
        style: names and precision.
        tried: the points of the comparison; the functions return a code for states outside of their box.
        loop: the loop with an estimator, as `LoopTraces`; None: only the law.
        claim: a claim about the files, for the comment of the header.

    Raises:
        ExportError: an operation has no rule in C; or the law is too large for a stack.
    """
    tables, arrays = Tables(), "".join(f"const double *{argument}, " for argument in law.arguments)
    bodies, sizes = list[str](), dict[str, int]()
    for result, graph in (("control", law.control), ("value", law.value)):
        signature = f"static void {result}_of({arrays}double *y)"
        body, sizes[result] = c_function(signature, graph, law.arguments, ["y"], tables)
        bodies.append(body)
    entries, stack = _entries(controller, law, style, tried), max(sizes.values())
    if loop is not None:
        further, size = loop.functions(tables)
        bodies.append(further)
        entries, stack = entries + loop.entries(style, tried, law), max(stack, size + sizes["control"])
    made = "\n".join([*bodies, entries])
    code = "\n".join(['#include "policy.h"\n\n#include <math.h>\n', *helpers(made), *tables.text, made])
    sized = {
        **facts,
        "tables": f"{style.size * tables.count} bytes",
        "stack": f"{style.size * stack} bytes of arrays; a compiler's frames add to that",
    }
    claimed = {"certified": textwrap.fill(claim, 114, subsequent_indent="   ")} if claim else {}
    return {
        "policy.h": file_comment({**sized, **claimed}) + style.code(_header(controller, law, style, loop)),
        "policy.c": file_comment(sized) + style.code(code),
        "main.c": style.code(_example(law, style) if loop is None else loop.example(style)),
        "CMakeLists.txt": CMAKE.replace("@", "policy" if style.name == NAME else f"{style.name}_policy"),
    }


def signatures(law: Law, style: Style) -> tuple[str, str]:
    """The heads of the functions for u and for V."""
    name, macro, real = style.name, style.macro, style.real
    parameter = f", const {real} p[{macro}_PARAMETERS]" if "p" in law.arguments else ""
    state = f"{real} t, const {real} x[{macro}_STATES]{parameter}"
    return f"int {name}_control({state}, {real} u[{macro}_CONTROLS])", f"{real} {name}_value({state})"


def numbers_of(values: Any) -> str:
    """Numbers as an initialiser."""
    return "{" + ", ".join(literal(float(value)) for value in values) + "}"


def box_table(name: str, lower: Tensor, upper: Tensor) -> str:
    """A box as a table of pairs."""
    pairs = ", ".join(
        f"{{{literal(low)}, {literal(high)}}}" for low, high in zip(lower.tolist(), upper.tolist(), strict=True)
    )
    return f"static const double {name}[{len(lower)}][2] = {{{pairs}}};\n"


def limits_of(controller: Controller, style: Style) -> tuple[Tensor, Tensor] | None:
    """The limits (m,) of the controls in the precision of a style, rounded inwards; None if there are none."""
    controls = controller.controls
    if not isinstance(controls, ControlBox) or controls.fixed_limits is None:
        return None
    rounded = ControlBox(controls.lower.double().cpu(), controls.upper.double().cpu()).to(style.dtype)
    m = controller.system.m
    return rounded.lower.double().expand(m), rounded.upper.double().expand(m)


def has_limits(controls: ControlSet, style: Style) -> bool:
    """Whether the C clamps u once more: in single precision, u may exceed a limit by rounding."""
    return style.single and isinstance(controls, ControlBox) and controls.fixed_limits is not None


def tested_boxes(controller: Controller, law: Law, tried: Points) -> dict[str, tuple[Tensor, Tensor]]:
    """Name ↦ (lower, upper) of the boxes outside of which the return code is not 0.

    known: states, and parameters, of the comparison; start: X₀; defined: where f, g and the cost are defined, if that
    is not everywhere.
    """
    n, box, domain = len(law.arguments["x"]), controller.initial_states, controller.problem.domain
    boxes = {"known": (tried.lower, tried.upper), "start": (box.lower[:n], box.upper[:n])}
    if domain is not None:
        low, high = domain.narrowed(-SLACK)
        boxes["defined"] = low[:n], high[:n]
    return boxes


INSIDE = """static int is_inside(int n, const double *x, const double (*box)[2])
{
    for (int i = 0; i < n; i++)
        if (!(x[i] >= box[i][0] && x[i] <= box[i][1])) return 0;
    return 1;
}
"""
LIMIT = """
static void limit(double *u)
{
    for (int i = 0; i < @M; i++) u[i] = u[i] < limits[i][0] ? limits[i][0] : u[i] > limits[i][1] ? limits[i][1] : u[i];
}
"""
FINITE = """static int is_finite(int n, const double *x)
{
    for (int i = 0; i < n; i++)
        if (!isfinite(x[i])) return 0;
    return 1;
}
"""


def _entries(controller: Controller, law: Law, style: Style, tried: Points) -> str:
    """The functions of the header, with the tables of the boxes that they test."""
    n, boxes = len(law.arguments["x"]), tested_boxes(controller, law, tried)
    tables = [box_table(name, *box) for name, box in boxes.items()]
    given = ", ".join("&t" if argument == "t" else argument for argument in law.arguments)
    lines = [f"control_of({given}, u);"]
    limits = limits_of(controller, style)
    if limits is not None and has_limits(controller.controls, style):
        tables.append(box_table("limits", *limits) + LIMIT.replace("@M", str(controller.system.m)))
        lines.append("limit(u);")
    lines.append(f"int code = is_finite({controller.system.m}, u) ? 0 : {style.macro}_NOT_FINITE;")
    parameters = f" || !is_inside({len(tried.lower) - n}, p, known + {n})" if "p" in law.arguments else ""
    lines.append(f"if (!is_inside({n}, x, known){parameters}) code |= {style.macro}_OUTSIDE;")
    lines.append(f"if (t <= 0 && !is_inside({n}, x, start)) code |= {style.macro}_OUTSIDE_X0;")
    if "defined" in boxes:
        lines.append(f"if (!is_inside({n}, x, defined)) code |= {style.macro}_OUTSIDE_DOMAIN;")
    control, value = signatures(law, style)
    return "\n".join([
        *tables, INSIDE, FINITE,
        f"{control}\n{{\n    " + "\n    ".join([*lines, "return code;"]) + "\n}\n",
        f"{value}\n{{\n    double V[1];\n    value_of({given}, V);\n    return V[0];\n}}\n",
    ])  # fmt: skip


def _header(controller: Controller, law: Law, style: Style, loop: Any) -> str:
    macro, n, box = style.macro, len(law.arguments["x"]), controller.initial_states
    sizes = {"STATES": n, "CONTROLS": controller.system.m}
    if "p" in law.arguments:
        sizes["PARAMETERS"] = len(law.arguments["p"])
    if loop is not None:
        sizes |= {"READINGS": loop.readings, "ESTIMATED": loop.estimated}
        sizes |= {"SETTINGS": loop.settings} if loop.settings else {}
    numbers = {"DT": literal(controller.horizon.dt), "T": literal(controller.horizon.duration)}
    numbers |= {"X0_LOWER": numbers_of(box.lower[:n]), "X0_UPPER": numbers_of(box.upper[:n])}
    if (limits := limits_of(controller, style)) is not None and all(bool(side.isfinite().all()) for side in limits):
        numbers |= {"U_LOWER": numbers_of(limits[0]), "U_UPPER": numbers_of(limits[1])}
    defines = "".join(f"#define {macro}_{key} {text}\n" for key, text in (sizes | numbers).items())
    bits = {key: entry for key, entry in vars(Bits).items() if key.isupper() and (loop is not None or key not in LOOPS)}
    codes = "".join(f"#define {macro}_{key} {number}  /* {what} */\n" for key, (number, what) in bits.items())
    control, value = signatures(law, style)
    return (
        f"#ifndef {macro}_POLICY_H\n#define {macro}_POLICY_H\n\n{defines}\ntypedef double {style.real};\n\n"
        f"/* What functions return: 0, or the sum of */\n{codes}\n"
        f'#ifdef __cplusplus\nextern "C" {{\n#endif\n\n/* u(t, x) */\n{control};\n\n/* V(t, x) */\n{value};\n\n'
        f"{'' if loop is None else loop.declarations(style)}"
        "#ifdef __cplusplus\n}\n#endif\n\n#endif\n"
    )


YOURS = ("main.c", "CMakeLists.txt")  # files of the user, which are not replaced
CMAKE = """cmake_minimum_required(VERSION 3.10)
project(@ C)
set(CMAKE_C_STANDARD 99)
if(NOT CMAKE_BUILD_TYPE)
  set(CMAKE_BUILD_TYPE Release)
endif()
add_library(@ policy.c)
target_include_directories(@ PUBLIC ${CMAKE_CURRENT_SOURCE_DIR} ${CMAKE_CURRENT_SOURCE_DIR}/..)
target_link_libraries(@ PUBLIC m)
if(CMAKE_SOURCE_DIR STREQUAL CMAKE_CURRENT_SOURCE_DIR)
  add_executable(main main.c)
  target_link_libraries(main @)
endif()
"""  # @ is the name of the library; as part of another project this adds only the library


def _example(law: Law, style: Style) -> str:
    """A program that prints u and V at a state of X₀."""
    name, macro, real = style.name, style.macro, style.real
    lists = {one: ", ".join(map(literal, law.arguments[one].tolist())) for one in law.arguments if one != "t"}
    arrays = "".join(f"    const {real} {one}[] = {{{numbers}}};\n" for one, numbers in lists.items())
    given, controls = ", ".join(lists), f"{macro}_CONTROLS"
    return (
        '#include <stdio.h>\n#include "policy.h"\n\nint main(void)\n{\n'
        f"{arrays}    {real} u[{controls}];\n    {name}_control(0, {given}, u);\n"
        f'    for (int i = 0; i < {controls}; i++) printf("u[%d] = %g\\n", i, u[i]);\n'
        f'    printf("V = %g\\n", {name}_value(0, {given}));\n    return 0;\n}}\n'
    )


def compile_c(source: Sequence[Path], result: Path, options: Sequence[str]) -> None:
    """Compile C files to a program or a library.

    Raises:
        ExportError: there is no C compiler, or it complains.
    """
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        raise ExportError("Expected a C compiler (cc, gcc or clang) to run what is written with, got none.")
    command = [compiler, *options, "-o", str(result), *map(str, source), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise ExportError(f"Expected C that {' '.join(options)} takes, got: {done.stderr.strip()[:300]}")


def library_of(sources: Sequence[Path], options: Sequence[str]) -> ctypes.CDLL:
    """C files as machine code of this process.

    Raises:
        ExportError: as compile_c.
    """
    with tempfile.TemporaryDirectory() as place:
        library = Path(place) / "policy.so"
        compile_c(sources, library, [*options, "-shared", "-fPIC"])
        return ctypes.CDLL(str(library))


class CompiledLaw:
    """A controller's law as machine code of this process, for one state at a time, within microseconds.

    Args:
        folder: the folder of policy.c.
        law: the law that policy.c computes.
        controls: m.
        options: options of the compiler.
        style: the names and the precision of policy.c.
        functions: the compiled policy.c, if it exists already.

    Raises:
        ExportError: as compile_c.
    """

    def __init__(
        self,
        folder: Path,
        law: Law,
        controls: int,
        options: Sequence[str],
        style: Style = Style(),
        functions: ctypes.CDLL | None = None,
    ):
        functions = library_of([folder / "policy.c"], options) if functions is None else functions
        self.parameters = len(law.arguments.get("p", ()))
        self.states, self.controls, self._style = len(law.arguments["x"]), controls, style
        number = ctypes.c_float if style.single else ctypes.c_double
        arrays = [ctypes.c_void_p] * (len(law.arguments) - 1)
        self._control, self._value = functions[f"{style.name}_control"], functions[f"{style.name}_value"]
        self._control.argtypes, self._control.restype = [number, *arrays, ctypes.c_void_p], ctypes.c_int
        self._value.argtypes, self._value.restype = [number, *arrays], number

    def policy(self, t: float, x: ArrayLike) -> NDArray:
        """u(t, x): x (n,), or (x, p) of a family; returns (m,). t below 0 counts as 0.

        Raises:
            ValueError: another shape.
        """
        return self.policy_and_code(t, x)[0]

    def policy_and_code(self, t: float, x: ArrayLike) -> tuple[NDArray, int]:
        """(u(t, x), the return code of the function, 0 or a sum of numbers of Bits); raises as `policy` does."""
        state, u = self._state(x), np.empty(self.controls, self._style.numpy)
        code = self._control(t, *self._places(state), u.ctypes.data)
        return u, code

    def value(self, t: float, x: ArrayLike) -> float:
        """V(t, x); raises as `policy` does."""
        state = self._state(x)
        return self._value(t, *self._places(state))

    def _state(self, x: ArrayLike) -> NDArray:
        state, size = np.ascontiguousarray(x, dtype=self._style.numpy), self.states + self.parameters
        if state.shape != (size,):
            raise ValueError(f"Expected x of shape ({size},), one state, got {state.shape}; ask for one after another.")
        return state

    def _places(self, state: NDArray) -> tuple[int, ...]:
        """The addresses of x and, for a family, of p."""
        start = state.ctypes.data
        return (start, start + state.itemsize * self.states) if self.parameters else (start,)

    def of_many(self, t: NDArray, x: NDArray) -> tuple[NDArray, NDArray]:
        """u (k, m) and V (k,) at t (k,) and x (k, n)."""
        u, V = zip(*((self.policy(*one), self.value(*one)) for one in zip(t.tolist(), x, strict=True)), strict=True)
        return np.stack(u), np.array(V)

"""C99 without a library: a header, a source, an example and a CMake file."""

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lyapnet.base.errors import ExportError
from lyapnet.controller.controller import Controller
from lyapnet.exchange.export.law import Law
from lyapnet.graphs.c_functions import c_function, helpers
from lyapnet.graphs.c_text import Tables, literal

FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Wconversion", "-Wpedantic", "-Werror")
FAST = ("-std=c99", "-O3")
NAME = "lyapnet"  # what names begin with, unless told otherwise


def sources(controller: Controller, law: Law, about: Mapping[str, str], name: str = NAME) -> dict[str, str]:
    """File name ↦ text.

    Args:
        about: what is exported, for the comment at the top.
        name: what the names of its functions and macros begin with: an identifier of C.

    Raises:
        ExportError: an operation has no rule in C; or the law is too large for a stack.
    """
    tables, arrays = Tables(), "".join(f"const double *{argument}, " for argument in law.arguments)
    functions, stack = zip(
        *(
            c_function(f"static void {result}_of({arrays}double *y)", graph, law.arguments, ["y"], tables)
            for result, graph in (("control", law.control), ("value", law.value))
        ),
        strict=True,
    )
    lines = "\n   ".join(f"{key}: {value}" for key, value in {**about, "stack": f"{8 * max(stack)} bytes"}.items())
    comment = "/* " + lines.replace("*/", "* /").replace("/*", "/ *") + " */\n"
    macro = name.upper()
    parameter = f", const double p[{macro}_PARAMETERS]" if "p" in law.arguments else ""
    control = f"void {name}_control(double t, const double x[{macro}_STATES]{parameter}, double u[{macro}_CONTROLS])"
    value = f"double {name}_value(double t, const double x[{macro}_STATES]{parameter})"
    given = ", ".join("&t" if argument == "t" else argument for argument in law.arguments)
    entries = (
        f"{control}\n{{\n    control_of({given}, u);\n}}\n\n"
        f"{value}\n{{\n    double V[1];\n    value_of({given}, V);\n    return V[0];\n}}\n"
    )
    code, includes = "\n".join(functions), '#include "policy.h"\n\n#include <math.h>\n'
    return {
        "policy.h": comment + _header(controller, law, macro, control, value),
        "policy.c": "\n".join([comment + includes, *helpers(code), *tables.text, code, entries]),
        "main.c": _example(law, name),
        "CMakeLists.txt": CMAKE.replace("@", "policy" if name == NAME else f"{name}_policy"),
    }


def _header(controller: Controller, law: Law, macro: str, control: str, value: str) -> str:
    sizes = {"STATES": len(law.arguments["x"]), "CONTROLS": controller.system.m}
    if "p" in law.arguments:
        sizes["PARAMETERS"] = len(law.arguments["p"])
    defines = "".join(f"#define {macro}_{name} {size}\n" for name, size in sizes.items())
    return (
        f"#ifndef {macro}_POLICY_H\n#define {macro}_POLICY_H\n\n{defines}\n"
        f'#ifdef __cplusplus\nextern "C" {{\n#endif\n\n/* u(t, x) */\n{control};\n\n/* V(t, x) */\n{value};\n\n'
        "#ifdef __cplusplus\n}\n#endif\n\n#endif\n"
    )


YOURS = ("main.c", "CMakeLists.txt")  # which are left as they are where they exist
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
"""  # @: the library; as a part of another project it is that alone


def _example(law: Law, name: str) -> str:
    """A program that asks for u and V at a state of X₀."""
    lists = {one: ", ".join(map(literal, law.arguments[one].tolist())) for one in law.arguments if one != "t"}
    arrays = "".join(f"    const double {one}[] = {{{numbers}}};\n" for one, numbers in lists.items())
    given, controls = ", ".join(lists), f"{name.upper()}_CONTROLS"
    return (
        '#include <stdio.h>\n#include "policy.h"\n\nint main(void)\n{\n'
        f"{arrays}    double u[{controls}];\n    {name}_control(0.0, {given}, u);\n"
        f'    for (int i = 0; i < {controls}; i++) printf("u[%d] = %g\\n", i, u[i]);\n'
        f'    printf("V = %g\\n", {name}_value(0.0, {given}));\n    return 0;\n}}\n'
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


class CompiledLaw:
    """A controller's law as machine code of this process, for one state at a time: microseconds, not milliseconds.

    Args:
        folder: with the source.
        law: of which it is.
        controls: m.
        options: for the compiler.
        name: as in `sources`.

    Raises:
        ExportError: as compile_c.
    """

    def __init__(self, folder: Path, law: Law, controls: int, options: Sequence[str], name: str = NAME):
        with tempfile.TemporaryDirectory() as place:
            library = Path(place) / "policy.so"
            compile_c([folder / "policy.c"], library, [*options, "-shared", "-fPIC"])
            functions = ctypes.CDLL(str(library))
        self.parameters = len(law.arguments.get("p", ()))
        self.states, self.controls = len(law.arguments["x"]), controls
        arrays = [ctypes.c_void_p] * (len(law.arguments) - 1)
        self._control, self._value = functions[f"{name}_control"], functions[f"{name}_value"]
        self._control.argtypes, self._control.restype = [ctypes.c_double, *arrays, ctypes.c_void_p], None
        self._value.argtypes, self._value.restype = [ctypes.c_double, *arrays], ctypes.c_double

    def policy(self, t: float, x: ArrayLike) -> NDArray:
        """u(t, x): x (n,), or (x, p) of a family; returns (m,). t below 0 counts as 0.

        Raises:
            ValueError: another shape.
        """
        state, u = self._state(x), np.empty(self.controls)
        self._control(t, *self._places(state), u.ctypes.data)
        return u

    def value(self, t: float, x: ArrayLike) -> float:
        """V(t, x) likewise."""
        state = self._state(x)
        return self._value(t, *self._places(state))

    def _state(self, x: ArrayLike) -> NDArray:
        state, size = np.ascontiguousarray(x, dtype=np.float64), self.states + self.parameters
        if state.shape != (size,):
            raise ValueError(f"Expected x of shape ({size},), one state, got {state.shape}; ask for one after another.")
        return state

    def _places(self, state: NDArray) -> tuple[int, ...]:
        """Where x, and p, begin; a double has 8 bytes."""
        start = state.ctypes.data
        return (start, start + 8 * self.states) if self.parameters else (start,)

    def of_many(self, t: NDArray, x: NDArray) -> tuple[NDArray, NDArray]:
        """u (k, m) and V (k,) at t (k,) and x (k, n)."""
        u, V = zip(*((self.policy(*one), self.value(*one)) for one in zip(t.tolist(), x, strict=True)), strict=True)
        return np.stack(u), np.array(V)

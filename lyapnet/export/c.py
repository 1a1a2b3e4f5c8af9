"""C99 without a library: a header, a source, an example and a CMake file."""

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lyapnet.controller import Controller
from lyapnet.errors import ExportError
from lyapnet.export.law import Law
from lyapnet.export.verification import Evaluate
from lyapnet.graphs.c_functions import c_function, helpers
from lyapnet.graphs.c_text import Tables, literal

FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Werror")


def sources(controller: Controller, law: Law, about: Mapping[str, str]) -> dict[str, str]:
    """File name ↦ text.

    Args:
        about: what is exported, for the comment at the top.

    Raises:
        ExportError: an operation has no rule in C; or the law is too large for a stack.
    """
    tables, arrays = Tables(), "".join(f"const double *{name}, " for name in law.arguments)
    functions, stack = zip(
        *(
            c_function(f"static void {name}_of({arrays}double *y)", graph, law.arguments, ["y"], tables)
            for name, graph in (("control", law.control), ("value", law.value))
        ),
        strict=True,
    )
    lines = "\n   ".join(f"{key}: {value}" for key, value in {**about, "stack": f"{max(stack)} bytes"}.items())
    comment = "/* " + lines.replace("*/", "* /").replace("/*", "/ *") + " */\n"
    parameter = ", const double p[LYAPNET_PARAMETERS]" if "p" in law.arguments else ""
    control = f"void lyapnet_control(double t, const double x[LYAPNET_STATES]{parameter}, double u[LYAPNET_CONTROLS])"
    value = f"double lyapnet_value(double t, const double x[LYAPNET_STATES]{parameter})"
    given = ", ".join("&t" if name == "t" else name for name in law.arguments)
    entries = (
        f"{control}\n{{\n    control_of({given}, u);\n}}\n\n"
        f"{value}\n{{\n    double V[1];\n    value_of({given}, V);\n    return V[0];\n}}\n"
    )
    code, includes = "\n".join(functions), '#include "policy.h"\n\n#include <math.h>\n'
    return {
        "policy.h": comment + _header(controller, law, control, value),
        "policy.c": "\n".join([comment + includes, *helpers(code), *tables.text, code, entries]),
        "main.c": _example(law),
        "CMakeLists.txt": CMAKE,
    }


def _header(controller: Controller, law: Law, control: str, value: str) -> str:
    sizes = {"STATES": len(law.arguments["x"]), "CONTROLS": controller.system.m}
    if "p" in law.arguments:
        sizes["PARAMETERS"] = len(law.arguments["p"])
    defines = "".join(f"#define LYAPNET_{name} {size}\n" for name, size in sizes.items())
    return (
        f"#ifndef LYAPNET_POLICY_H\n#define LYAPNET_POLICY_H\n\n{defines}\n"
        f'#ifdef __cplusplus\nextern "C" {{\n#endif\n\n/* u(t, x) */\n{control};\n\n/* V(t, x) */\n{value};\n\n'
        "#ifdef __cplusplus\n}\n#endif\n\n#endif\n"
    )


YOURS = ("main.c", "CMakeLists.txt")  # which are left as they are where they exist
CMAKE = """cmake_minimum_required(VERSION 3.10)
project(policy C)
set(CMAKE_C_STANDARD 99)
if(NOT CMAKE_BUILD_TYPE)
  set(CMAKE_BUILD_TYPE Release)
endif()
add_library(policy policy.c)
target_include_directories(policy PUBLIC ${CMAKE_CURRENT_SOURCE_DIR})
target_link_libraries(policy PUBLIC m)
add_executable(main main.c)
target_link_libraries(main policy)
"""


def _example(law: Law) -> str:
    """A program that asks for u and V at a state of X₀."""
    lists = {name: ", ".join(map(literal, law.arguments[name].tolist())) for name in law.arguments if name != "t"}
    arrays = "".join(f"    const double {name}[] = {{{numbers}}};\n" for name, numbers in lists.items())
    given = ", ".join(lists)
    return (
        '#include <stdio.h>\n#include "policy.h"\n\nint main(void)\n{\n'
        f"{arrays}    double u[LYAPNET_CONTROLS];\n    lyapnet_control(0.0, {given}, u);\n"
        f'    for (int i = 0; i < LYAPNET_CONTROLS; i++) printf("u[%d] = %g\\n", i, u[i]);\n'
        f'    printf("V = %g\\n", lyapnet_value(0.0, {given}));\n    return 0;\n}}\n'
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


def compiled(folder: Path, law: Law, controls: int) -> Evaluate:
    """The functions of a folder's source as machine code of this process.

    Raises:
        ExportError: as compile_c.
    """
    with tempfile.TemporaryDirectory() as place:
        library = Path(place) / "policy.so"
        compile_c([folder / "policy.c"], library, [*FLAGS, "-shared", "-fPIC"])
        functions = ctypes.CDLL(str(library))
    return _calling(functions, law, controls)


def _calling(functions: ctypes.CDLL, law: Law, controls: int) -> Evaluate:
    """u and V at many states, one call for each."""
    doubles = ctypes.POINTER(ctypes.c_double)
    functions.lyapnet_value.restype = ctypes.c_double
    states = [doubles] * (len(law.arguments) - 1)
    functions.lyapnet_value.argtypes = [ctypes.c_double, *states]
    functions.lyapnet_control.argtypes = [ctypes.c_double, *states, doubles]

    def evaluate(t: NDArray, x: NDArray) -> tuple[NDArray, NDArray]:
        u, V = np.empty((len(t), controls)), np.empty(len(t))
        for k, (time, row) in enumerate(zip(t.tolist(), np.ascontiguousarray(x), strict=True)):
            _, *parts = law.given(time, row)
            pointers = [part.ctypes.data_as(doubles) for part in parts]
            functions.lyapnet_control(time, *pointers, u[k].ctypes.data_as(doubles))
            V[k] = functions.lyapnet_value(time, *pointers)
        return u, V

    return evaluate

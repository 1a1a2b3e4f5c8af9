"""Compile exported function blocks by MATIEC and compare them with their controllers on all states of a comparison.

python -m tests.exchange.export.by_matiec FOLDER zoo:cartpole_swingup …, where FOLDER has MATIEC's iec2c and lib/.
MATIEC translates structured text to C, and is not part of lyapnet's tests.
"""

import ctypes
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch

import lyapnet
from lyapnet.controller.controller import Controller
from lyapnet.exchange.export import export
from lyapnet.exchange.export.verification import Agreement, verify

PROGRAM = """
PROGRAM main
VAR
    law : lyapnet_law;
END_VAR
    law(t := 0.0);
END_PROGRAM

CONFIGURATION config
    RESOURCE resource1 ON PLC
        TASK cycle(INTERVAL := T#10ms, PRIORITY := 0);
        PROGRAM instance1 WITH cycle : main;
    END_RESOURCE
END_CONFIGURATION
"""
CALL = """#include "iec_std_lib.h"
#include "accessor.h"
#include "POUS.h"
#include "POUS.c"
TIME __CURRENT_TIME;
BOOL __DEBUG;
int call(@REAL t, const @REAL *x, @REAL *u)
{
    static LYAPNET_LAW law;
    static int begun = 0;
    if (!begun++) LYAPNET_LAW_init__(&law, 0);
    law.T.value = t;
    law.WITH_VALUE.value = 1;
    @INPUTS
    LYAPNET_LAW_body__(&law);
    for (int i = 0; i < @CONTROLS; i++) u[i] = law.U.value.table[i];
    u[@CONTROLS] = law.V.value;
    return law.CODE.value;
}
"""


def compare(controller: Controller, matiec: Path, dtype: str) -> Agreement:
    """The differences of a compiled block from its controller."""
    real, number = {"float64": ("double", np.float64), "float32": ("float", np.float32)}[dtype]
    n, m = controller.system.n - len(controller.system.constants), controller.system.m
    places = [f"law.X.value.table[{i}]" for i in range(n)]
    places += [f"law.P.value.table[{i}]" for i in range(controller.system.n - n)]
    inputs = " ".join(f"{place} = x[{i}];" for i, place in enumerate(places))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (path,), _ = export(controller, folder / "law.st", "st", dtype=dtype)
        path.write_text(path.read_text(encoding="ascii") + PROGRAM, encoding="ascii")
        call = CALL.replace("@INPUTS", inputs).replace("@CONTROLS", str(m)).replace("@REAL", real)
        (folder / "call.c").write_text(call, encoding="ascii")
        _run([str(matiec / "iec2c"), "-I", str(matiec / "lib"), "-T", ".", "law.st"], folder)
        headers = ["-I", str(matiec / "lib" / "C"), "-I", "."]
        _run(["cc", "-O1", "-w", "-shared", "-fPIC", *headers, "call.c", "-o", "law.so", "-lm"], folder)
        library = ctypes.CDLL(str(folder / "law.so"))
    library.call.argtypes = [
        ctypes.c_double if dtype == "float64" else ctypes.c_float,
        ctypes.c_void_p,
        ctypes.c_void_p,
    ]

    def evaluate(t: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        results = np.empty((len(t), m + 1), number)
        for time, state, result in zip(t, np.ascontiguousarray(x, number), results, strict=True):
            code = library.call(time, state.ctypes.data, result.ctypes.data)
            assert code == 0, f"code {code} at t = {time}, x = {state}"
        return results[:, :m], results[:, m]

    return verify(controller, evaluate, dtype=getattr(torch, dtype))


def _run(command: list[str], folder: Path) -> None:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"Expected {command[0]} to take the block, got: {done.stdout}{done.stderr}")


if __name__ == "__main__":
    for checkpoint in sys.argv[2:]:
        for dtype in ("float64", "float32"):
            print(checkpoint, dtype, compare(lyapnet.load(checkpoint), Path(sys.argv[1]), dtype), flush=True)

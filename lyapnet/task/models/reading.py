"""Reads a model's file in a separate process that cannot open files, so that the file can do no harm.

A CasADi file may name libraries to load and compilers to call, and a robot's description may name other files. The
process first gives up opening files and starting programs, and limits its time and memory. Then it reads the content
from its standard input, and prints equations as JSON.
"""

import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lyapnet.base.errors import UsageError, one_line
from lyapnet.base.files import LARGEST_TEXT, read_file

EXTRAS = {"casadi": "oracle", "urdf": "robots", "mjcf": "robots,mujoco"}  # kind of model ↦ extras of lyapnet to install
KINDS = tuple(EXTRAS)
SECONDS = 60  # limit of the CPU time; the limit of real time is twice as long
LINEAR_SOLVERS = ("qr", "ldl", "symbolicqr", "csparse", "lsqr")  # those of CasADi, each in a library
MEMORY = 8 * 2**30  # limit of the address space in bytes; CasADi's libraries take about 2**30

_CHILD = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); from lyapnet.task.models.reading import child; child()"
)


def read_model(path: Path, kind: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of the Model in a file, by name.

    Args:
        kind: one of KINDS.
        options: names of states and controls that replace those of the model.

    Raises:
        UsageError: there is no such file, a library is missing, or the file is no such model.
    """
    try:
        content = read_file(path, LARGEST_TEXT)
    except OSError as error:
        raise UsageError(
            f"Expected a file for system.file, got {str(path)!r} ({error.strerror or error}); correct the name."
        ) from error
    request = json.dumps({"kind": kind, "name": path.name, "options": dict(options)}).encode()
    command = [sys.executable, "-c", _CHILD, json.dumps(sys.path)]
    try:
        done = subprocess.run(
            command, input=request + b"\n" + content, capture_output=True, timeout=2 * SECONDS, check=False
        )
        answer = json.loads(done.stdout)
    except subprocess.TimeoutExpired as error:
        raise UsageError(f"Expected {path.name} to be read within {2 * SECONDS} s, got no end; simplify it.") from error
    except ValueError as error:
        reason = done.stderr.decode(errors="replace").strip().splitlines()[-1:] or [f"exit status {done.returncode}"]
        raise UsageError(
            f"Expected a {kind} model in {path.name}, got a file that stopped its reader ({reason[0][:150]}); write it "
            "again, with the model alone."
        ) from error
    if "error" in answer:
        raise UsageError(answer["error"])
    return answer


def child() -> None:
    """The main function of the process: reads a request and a file from standard input, and prints JSON."""
    request, content = sys.stdin.buffer.read().split(b"\n", 1)
    asked = json.loads(request)
    try:
        reader = _reader(asked["kind"])
        _give_up_files()
        answer = reader(content, **asked["options"])
    except UsageError as error:
        answer = {"error": str(error)}
    except Exception as error:  # the file may be of unknown origin, and fail in any way
        answer = {
            "error": f"Expected a {asked['kind']} model in {asked['name']}, got {one_line(error)[:200]}; write it "
            "again, with the model alone."
        }
    sys.stdout.write(json.dumps(answer))


def _reader(kind: str) -> Any:
    """The function that reads a kind of model, after all imports that it needs."""
    try:
        if kind == "casadi":
            import casadi

            from lyapnet.task.models.casadi_functions import function_of_text, model_of_function

            for name in LINEAR_SOLVERS:
                casadi.has_linsol(name)  # loads its library
            return lambda content, **options: model_of_function(
                function_of_text(casadi, content.decode("ascii")), **options
            )._asdict()
        from lyapnet.task.models import robots

        read = robots.model_of_urdf if kind == "urdf" else robots.model_of_mjcf
        read(robots.SMALLEST_URDF if kind == "urdf" else robots.SMALLEST_MJCF)  # makes all imports at first use
        return lambda content, **options: read(content, **options)._asdict()
    except ImportError as error:
        raise UsageError(
            f"Expected {error.name} for a {kind} model, got none; install it by pip install 'lyapnet[{EXTRAS[kind]}]'."
        ) from error


def _give_up_files() -> None:
    """Give up opening files and starting programs, and limit time and memory."""
    try:
        import resource
    except ImportError as error:
        raise UsageError(
            "Expected a system where a process can give up opening files, got one without limits of resources; read "
            "the model on Linux or macOS, or pass the function to lyapnet.casadi_system in Python."
        ) from error
    for kind in (resource.RLIMIT_NOFILE, resource.RLIMIT_NPROC, resource.RLIMIT_FSIZE, resource.RLIMIT_CORE):
        resource.setrlimit(kind, (0, 0))
    resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))

"""lyapnet's own C++, compiled once for a machine and kept on disk."""

import ctypes
import hashlib
import logging
import platform
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

import torch

from lyapnet.errors import CompilationError, one_line
from lyapnet.files import digest_of_file, write_atomically
from lyapnet.graphs.compilation import cache_folder, has_compiler, require_own

FLAGS = ("-std=c++17", "-O3", "-march=native", "-ffp-contract=fast", "-fno-math-errno", "-fPIC", "-shared", "-w")


def library_of(name: str, sources: tuple[Path, ...], *definitions: str) -> ctypes.CDLL:
    """Compiled C++, from disk, or compiled now: one file for each machine.

    Args:
        name: the file's name begins with.
        sources: the last one includes the others.
        definitions: of macros, as "NAME=value".

    Raises:
        CompilationError: there is no compiler, or it fails; or the cache is not the user's own.
    """
    path, folder = file_of_library(name, sources, *definitions), cache_folder()
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    require_own(folder)
    digest = path.with_suffix(".sha256")
    if path.is_file():
        require_own(path)
        if digest.is_file() and digest.read_text(encoding="ascii") == digest_of_file(path):
            return ctypes.CDLL(str(path))
        logging.getLogger(__name__).warning("note: compiling again what is in %s: got another digest.", path)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".new_") as draft:
        file = Path(draft) / path.name
        _compile(sources[-1], file, definitions)
        write_atomically(digest, digest_of_file(file).encode())
        file.replace(path)
    return ctypes.CDLL(str(path))


def _compile(source: Path, file: Path, definitions: Sequence[str]) -> None:
    from torch._inductor.cpp_builder import get_cpp_compiler

    if not has_compiler():
        raise CompilationError("Expected a C++ compiler ($CXX, g++ or clang++), got none")
    command = [get_cpp_compiler(), *FLAGS, *(f"-D{each}" for each in definitions), str(source), "-o", str(file)]
    try:
        subprocess.run(command, check=True, capture_output=True, text=True)
    except (OSError, subprocess.CalledProcessError) as error:
        said = getattr(error, "stderr", None) or str(error)
        reason = one_line(RuntimeError(said))[:200]
        raise CompilationError(f"Expected {source.name} to compile, got {reason}") from error
    file.chmod(0o600)


def file_of_library(name: str, sources: Sequence[Path], *definitions: str) -> Path:
    """Where machine code is kept: by its source, how it is compiled, and the instructions of the CPU."""
    capabilities = sorted(torch.cpu.get_capabilities().items())
    parts = [platform.machine(), capabilities, FLAGS, definitions, *(source.read_bytes() for source in sources)]
    return cache_folder() / f"{name}_{hashlib.sha256(repr(parts).encode()).hexdigest()[:32]}.so"

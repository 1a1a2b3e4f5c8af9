"""Compiles lyapnet's C++ once for each machine, and keeps the libraries in a cache folder."""

import ctypes
import hashlib
import logging
import os
import platform
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.fx import GraphModule

from lyapnet.base.errors import CompilationError, LyapnetError, one_line
from lyapnet.base.files import digest_of_file, write_atomically

FLAGS = ("-std=c++17", "-O3", "-march=native", "-ffp-contract=fast", "-fno-math-errno", "-fPIC", "-shared", "-w")


def library_of(name: str, sources: tuple[Path, ...], *options: str) -> ctypes.CDLL:
    """Load a compiled library from the cache, or compile it now.

    Args:
        name: the first part of the file name.
        sources: source files; the last one includes the others.
        options: further options of the compiler, as "-DNAME=value" for a macro; the last one of a kind counts.

    Raises:
        CompilationError: there is no compiler, it fails, or another user can write to the cache.
    """
    path, folder = file_of_library(name, sources, *options), cache_folder()
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    require_own(folder)
    digest = path.with_suffix(".sha256")
    if path.is_file():
        require_own(path)
        if digest.is_file() and digest.read_text(encoding="ascii") == digest_of_file(path):
            return ctypes.CDLL(str(path))
        logging.getLogger(__name__).warning("note: compiling %s again: its digest does not match.", path)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".new_") as draft:
        file = Path(draft) / path.name
        _compile(sources[-1], file, options)
        write_atomically(digest, digest_of_file(file).encode())
        file.replace(path)
    return ctypes.CDLL(str(path))


def _compile(source: Path, file: Path, options: Sequence[str]) -> None:
    from torch._inductor.cpp_builder import get_cpp_compiler

    if not has_compiler():
        raise CompilationError("Expected a C++ compiler ($CXX, g++ or clang++), got none")
    command = [get_cpp_compiler(), *FLAGS, *options, str(source), "-o", str(file)]
    try:
        subprocess.run(command, check=True, capture_output=True, text=True)
    except (OSError, subprocess.CalledProcessError) as error:
        message = getattr(error, "stderr", None) or str(error)
        reason = one_line(RuntimeError(message))[:200]
        raise CompilationError(f"Expected {source.name} to compile, got {reason}") from error
    file.chmod(0o600)


def file_of_library(name: str, sources: Sequence[Path], *options: str) -> Path:
    """The file of a library; its name has a hash of the source, the compiler flags and the features of the CPU."""
    capabilities = sorted(torch.cpu.get_capabilities().items())
    parts = [platform.machine(), capabilities, FLAGS, options, *(source.read_bytes() for source in sources)]
    return cache_folder() / f"{name}_{hashlib.sha256(repr(parts).encode()).hexdigest()[:32]}.so"


def require_own(path: Path) -> None:
    """Refuse a folder or file of machine code that another user owns or can write."""
    if sys.platform == "win32":  # Windows has no such permission bits
        return
    facts = path.stat()
    if facts.st_uid != os.getuid() or facts.st_mode & 0o022:
        raise CompilationError(
            f"Expected machine code that only you can write, got {str(path)!r} with {stat.filemode(facts.st_mode)} of "
            f"user {facts.st_uid}; run chmod go-w on it, or choose another folder with LYAPNET_CACHE"
        )


@contextmanager
def compilation_errors() -> Iterator[None]:
    """Convert exceptions of compilation to CompilationError; errors of lyapnet are raised as they are."""
    try:
        yield
    except LyapnetError:
        raise
    except Exception as error:
        line = one_line(error)[:200]
        raise CompilationError(f"Expected a closed loop to compile, got {type(error).__name__}: {line}") from error


def has_compiler() -> bool:
    """Whether a C++ compiler is found: $CXX, g++ or clang++."""
    from torch._inductor.cpp_builder import get_cpp_compiler
    from torch._inductor.exc import InvalidCxxCompiler

    try:
        get_cpp_compiler()
    except (InvalidCxxCompiler, OSError):
        return False
    return True


def cache_folder() -> Path:
    """The folder of compiled functions: $LYAPNET_CACHE, else lyapnet in the user's cache folder."""
    chosen = os.environ.get("LYAPNET_CACHE")
    return Path(chosen) if chosen else Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "lyapnet"


def constants_of(graph: GraphModule) -> list[tuple[str, Any]]:
    """(name, entries) of every tensor that a graph holds."""
    constants = {**vars(graph), **dict(graph.named_buffers())}
    return [(key, value.tolist()) for key, value in sorted(constants.items()) if isinstance(value, Tensor)]

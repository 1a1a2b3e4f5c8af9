"""Safe reading and atomic writing of files, digests, and JSON.

All files from outside are read by `read_file`. It refuses fifos, sockets and devices, on which reading could wait for
ever, and files that are larger than the memory.
"""

import contextlib
import errno
import hashlib
import io
import json
import math
import os
import secrets
import socket
import stat
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import psutil

from lyapnet.base import sizes
from lyapnet.base.errors import LyapnetError

LARGEST_TEXT = 2**24  # largest config or record in bytes: 16 MiB, which are read in seconds
NO_FILES = {
    stat.S_IFIFO: "a fifo", stat.S_IFSOCK: "a socket", stat.S_IFCHR: "a device", stat.S_IFBLK: "a device",
}  # fmt: skip


def require_file(path: Path, most: int | None = None) -> None:
    """Check that a path is a regular file of limited size, without opening it.

    Args:
        most: largest size in bytes; None: half of the free memory.

    Raises:
        OSError: it does not exist, is no regular file, or is too large; strerror says which.
    """
    status = path.stat()
    kind, most = stat.S_IFMT(status.st_mode), sizes.free_memory() // 2 if most is None else most
    if kind == stat.S_IFDIR:
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if kind != stat.S_IFREG:
        raise OSError(errno.EINVAL, f"it is {NO_FILES.get(kind, 'something else')}, not a file", str(path))
    if status.st_size > most:
        raise OSError(errno.EFBIG, f"it has {status.st_size:.3g} bytes, more than {most:.3g}", str(path))


def read_file(path: Path, most: int | None = None) -> bytes:
    """The content of a file.

    Raises:
        OSError: as require_file, or it cannot be read.
    """
    require_file(path, most)
    return path.read_bytes()


@contextlib.contextmanager
def open_for_appending(path: Path) -> Iterator[io.TextIOWrapper]:
    """Open a text file for appending, creating it if necessary; links are not followed.

    Raises:
        OSError: it is a link, no regular file, or cannot be written.
    """
    # without O_NONBLOCK, which regular files ignore, opening a fifo would wait
    flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    with os.fdopen(os.open(path, flags, 0o644), "a", newline="", encoding="utf-8") as file:
        require_file(path)
        yield file


def write_atomically(path: Path, content: bytes | memoryview) -> None:
    """Write to a temporary file beside the target, synchronise, then rename it over the target.

    If this is interrupted, the target has either its old or its new content. The temporary name contains the process
    id, so that the next write removes files that killed processes left behind.

    Raises:
        OSError: the file cannot be written; the temporary file is removed.
    """
    prefix = f".{path.name[:60]}.{socket.gethostname()[:60]}."
    temporary = path.with_name(f"{prefix}{os.getpid()}.{secrets.token_hex(4)}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise
    for other in [other for other in path.parent.iterdir() if other.name.startswith(prefix)]:
        try:
            alive = psutil.pid_exists(int(other.name.split(".")[-3]))
        except (IndexError, ValueError, OverflowError):  # another file
            continue
        if not alive:
            other.unlink(missing_ok=True)


def digest_of_file(path: Path) -> str:
    """The SHA-256 of a file.

    Raises:
        OSError: as require_file.
    """
    require_file(path, 2**63)  # it is read in parts
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_json(path: Path, remedy: str) -> dict[str, Any]:
    """The object in a JSON file.

    Raises:
        LyapnetError: it cannot be read, or is no object; the message ends with the remedy.
    """
    try:
        content = json.loads(read_file(path))
        if isinstance(content, dict):
            return content
        reason = f"holds {type(content).__name__}"
    except OSError as error:
        reason = f"cannot be read ({error.strerror})"
    except (ValueError, RecursionError) as error:
        reason = f"is none ({' '.join(str(error).split())})"
    raise LyapnetError(f"Expected a JSON object, got {str(path)!r}, which {reason}; {remedy}.")


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write an object as JSON, atomically."""
    write_atomically(path, (json.dumps(content, indent=2) + "\n").encode())


def plain(value: Any) -> Any:
    """Replace every number that JSON lacks, NaN and the infinities, by None."""
    if isinstance(value, Mapping):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value

"""Files that are written whole or not at all, digests by which a change is noticed, and numbers as JSON has them."""

import contextlib
import hashlib
import json
import math
import os
import secrets
import socket
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lyapnet.errors import LyapnetError


def write_atomically(path: Path, content: bytes | memoryview) -> None:
    """Write to a temporary file beside the target, synchronise, then rename it over the target.

    Whatever stops this, a full disk or a lost process, the target holds its old content or the new one. The temporary
    name is this call's own and names the process: what a killed one left behind, the next write replaces.

    Raises:
        OSError: the disk is full, the folder cannot be written; the temporary file is gone.
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
            os.kill(int(other.name.split(".")[-3]), 0)
        except ProcessLookupError:
            other.unlink(missing_ok=True)
        except (IndexError, ValueError, OverflowError, PermissionError):  # no such name, or another user's process
            pass


def digest_of_file(path: Path) -> str:
    """The SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_json(path: Path, remedy: str) -> dict[str, Any]:
    """The object in a JSON file.

    Raises:
        LyapnetError: it cannot be read, or holds something else; ends with the remedy.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if isinstance(content, dict):
            return content
        reason = f"holds {type(content).__name__}"
    except OSError as error:
        reason = f"cannot be read ({error.strerror})"
    except (ValueError, RecursionError) as error:
        reason = f"is none ({' '.join(str(error).split())})"
    raise LyapnetError(f"Expected a JSON object, got {str(path)!r}, which {reason}; {remedy}.")


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write an object as JSON, all or nothing."""
    write_atomically(path, (json.dumps(content, indent=2) + "\n").encode())


def plain(value: Any) -> Any:
    """The value with None for every number that JSON does not have: NaN and the infinities."""
    if isinstance(value, Mapping):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value

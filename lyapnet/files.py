"""Files that are written whole or not at all, and numbers as JSON has them."""

import contextlib
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def write_atomically(path: Path, content: bytes | memoryview) -> None:
    """Write to a temporary file beside the target, synchronise, then rename it over the target.

    Whatever stops this, a full disk or a lost process, the target holds its old content or the new one. The temporary
    name is always the same: what a killed write left behind, the next one replaces.

    Raises:
        OSError: the disk is full, the folder cannot be written; the temporary file is gone.
    """
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise


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

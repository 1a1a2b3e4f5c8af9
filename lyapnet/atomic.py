"""Files that are written whole or not at all."""

import contextlib
import os
from pathlib import Path


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

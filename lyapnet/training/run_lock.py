"""The lock in a run's folder: one process trains a run at a time."""

import fcntl
import os
import socket
from pathlib import Path

from lyapnet.errors import LyapnetError, UsageError

LOCK = ".lock"


class RunLock:
    """Held from its making to the end of its `with`. The kernel releases that of a dead process: none is ever stale.

    Args:
        folder: of the run.

    Raises:
        UsageError: another process holds it; names that process.
        LyapnetError: the folder cannot be written.
    """

    def __init__(self, folder: Path):
        try:
            opened = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
            self._file = os.fdopen(opened, "r+", encoding="utf-8", errors="replace")
        except OSError as error:
            raise LyapnetError(
                f"Expected a writable folder of a run, got {str(folder)!r} ({error.strerror}); check its permissions."
            ) from error
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder = " ".join(self._file.read(200).split()) or "another process"
            self._file.close()
            raise UsageError(
                f"Expected a run that nobody trains, got {str(folder)!r}, which {holder} is training; wait for it, or "
                "stop it with Ctrl-C, which saves."
            ) from error
        except OSError:  # a file system without locks
            pass
        self._file.truncate(0)
        self._file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
        self._file.flush()

    def __enter__(self) -> "RunLock":
        return self

    def __exit__(self, *exception: object) -> None:
        self._file.close()

"""The lock in a run's folder: one process trains a run at a time."""

import fcntl
import os
import socket
from pathlib import Path

from lyapnet.errors import LyapnetError, UsageError

LOCK = ".lock"


class RunLock:
    """Held from its making to the end of its `with`. The kernel releases that of a dead process: none is ever stale.

    Raises:
        UsageError: another process holds it; names that process.
        LyapnetError: the folder cannot be written.
    """

    def __init__(self, folder: Path):
        try:
            self._file = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
        except OSError as error:
            raise LyapnetError(
                f"Expected a writable folder of a run, got {str(folder)!r} ({error.strerror}); check its permissions."
            ) from error
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder = " ".join(os.read(self._file, 200).decode(errors="replace").split()) or "another process"
            raise UsageError(
                f"Expected a run that nobody trains, got {str(folder)!r}, which {holder} is training; wait for it, or "
                "stop it with Ctrl-C, which saves."
            ) from error
        except OSError:  # a file system without locks
            pass
        os.ftruncate(self._file, 0)
        os.write(self._file, f"process {os.getpid()} on {socket.gethostname()}\n".encode())

    def __enter__(self) -> "RunLock":
        return self

    def __exit__(self, *exception: object) -> None:
        if (held := self.__dict__.pop("_file", None)) is not None:
            os.close(held)

    def __del__(self) -> None:
        self.__exit__()

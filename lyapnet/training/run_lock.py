"""The lock of a run's folder: only one process at a time trains a run."""

import errno
import os
import socket
from pathlib import Path

from filelock import FileLock, Timeout

from lyapnet.base.errors import LyapnetError, UsageError

LOCK = ".lock"
NO_LOCKS = {errno.ENOSYS, errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP}  # errors of a file system without locks


class RunLock:
    """Acquires the lock on construction, releases it at the end of `with`. The kernel releases locks of dead processes.

    Raises:
        UsageError: another process holds the lock; the message names it.
        LyapnetError: the folder cannot be written.
    """

    def __init__(self, folder: Path):
        self._lock = FileLock(
            folder / LOCK, blocking=False, thread_local=False, fallback_to_soft=False, preserve_lock_file=True,
            on_acquired=_write_holder,
        )  # fmt: skip
        try:
            self._lock.acquire()
        except Timeout as error:
            raise UsageError(
                f"Expected a run that nobody trains, got {str(folder)!r}, which {_read_holder(folder / LOCK)} is "
                "training; wait for it, or stop it with Ctrl-C, which saves."
            ) from error
        except OSError as error:
            if error.errno not in NO_LOCKS:
                raise LyapnetError(
                    f"Expected a writable folder of a run, got {str(folder)!r} ({error.strerror}); check its "
                    "permissions."
                ) from error

    def __enter__(self) -> "RunLock":
        return self

    def __exit__(self, *exception: object) -> None:
        self._lock.release()


def _write_holder(file: int) -> None:
    """Write into the lock file which process holds it, from the second byte on because Windows locks the first."""
    os.ftruncate(file, 0)
    os.write(file, f"\nprocess {os.getpid()} on {socket.gethostname()}\n".encode())


def _read_holder(path: Path) -> str:
    """Read which process holds the lock."""
    try:
        with path.open("rb", buffering=0) as file:
            file.seek(1)
            return " ".join(file.read(200).decode(errors="replace").split()) or "another process"
    except OSError:
        return "another process"

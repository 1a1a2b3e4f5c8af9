"""Errors for users: one line that says what was expected, what was got, and what to do."""

import difflib
import re
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

_INSTALLED = (str(Path(__file__).parents[1]), "site-packages", "/lib/python")
_REQUEST = re.compile(
    r"[^.;:]*(please|feel free to)[^.;]*(file|open|report|submit)[^.;]*(issue|bug|ticket).*", re.I | re.S
)
LONGEST = 400  # largest number of characters of another library's message that is quoted


def did_you_mean(name: str, known: Iterable[str], otherwise: str, prefix: str = "") -> str:
    """The end of a message about an unknown name: the nearest known name with a prefix, or else another advice."""
    near = difflib.get_close_matches(name, list(known), n=1)
    return f"did you mean {prefix}{near[0]}?" if near else otherwise


def one_line(error: BaseException | str) -> str:
    """The message of another library's error on one line, without its requests to report an issue."""
    text = " ".join(_REQUEST.sub("", str(error)).split())
    return text if len(text) <= LONGEST else f"{text[:LONGEST]} …"


def describe_error(error: BaseException) -> str:
    """Describe an error of a user's code with its line: "ValueError: no such mass (drone.py:12)"."""
    line = own_line(error)
    place = None if line is None else (line.filename, line.lineno)
    if isinstance(error, SyntaxError) and error.filename:
        place = (error.filename, error.lineno)
    what = f"{type(error).__name__}: {one_line(error)}"
    return what if place is None else f"{what} ({Path(place[0]).name}:{place[1]})"


def own_line(error: BaseException) -> traceback.FrameSummary | None:
    """The innermost line of the user's code in an error's traceback; None if there is none."""
    own = [frame for frame in traceback.extract_tb(error.__traceback__) if is_own_file(frame.filename)]
    return own[-1] if own else None


def running_line(frame: FrameType | None = None) -> traceback.FrameSummary | None:
    """The innermost line of the user's code that is running now, or in a frame; None if there is none."""
    frame = sys._getframe(1) if frame is None else frame
    while frame is not None and not is_own_file(frame.f_code.co_filename):
        frame = frame.f_back
    if frame is None:
        return None
    return traceback.FrameSummary(frame.f_code.co_filename, frame.f_lineno, frame.f_code.co_name)


def place_of(line: traceback.FrameSummary | None) -> str:
    """Format a line as " at file:line (its text)"; empty if there is none."""
    return "" if line is None else f" at {Path(line.filename).name}:{line.lineno} ({line.line})"


def is_own_file(name: str) -> bool:
    """Whether a file is the user's own, and not part of lyapnet, of an installed library, or of Python."""
    written = not name.startswith("<") or name.startswith(("<stdin>", "<ipython"))  # not generated code
    return written and not any(part in name for part in _INSTALLED)


class LyapnetError(Exception):
    """A failure with a message meant for the user; the command line prints it and exits with `exit_status`."""

    exit_status = 1
    section = ""  # of docs/troubleshooting.md, which the command line names


class UsageError(LyapnetError, ValueError):
    """An invalid request: a misspelt key, a missing file, an impossible combination."""

    exit_status = 2


class CheckpointError(LyapnetError):
    """A checkpoint cannot be read, written, or used for the request."""

    section = "a-checkpoint-is-refused"


class DivergenceError(LyapnetError):
    """A rollout, a loss term or a gradient is not finite."""

    section = "training-diverges"


class CompilationError(LyapnetError):
    """A closed loop cannot be compiled; it runs uncompiled."""


class UntraceableError(CompilationError):
    """A function depends on the values of tensors, for example in its control flow; a closed loop then runs eagerly."""


class ExportError(LyapnetError):
    """A control law cannot be exported, or the exported law differs from it."""

    section = "an-export-is-refused"


class OracleError(LyapnetError):
    """There is no optimum for a task; measures without the optimum can still be reported."""

    section = "no-optimum"


class Interrupted(BaseException):
    """Ctrl-C or SIGTERM: status 0 if the run was saved, 130 if it was stopped at once.

    Like KeyboardInterrupt it is no Exception, so that handlers in a compiler or a user's function do not catch it.
    """

    def __init__(self, message: str, exit_status: int = 0):
        super().__init__(message)
        self.exit_status = exit_status


@contextmanager
def signals_taken(handler: Callable[..., None]) -> Iterator[None]:
    """Install a handler for Ctrl-C and SIGTERM in the main thread, and restore the previous ones afterwards."""
    main = threading.current_thread() is threading.main_thread()
    previous = {number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM) if main}
    try:
        yield
    finally:
        for number, before in previous.items():
            signal.signal(number, before)

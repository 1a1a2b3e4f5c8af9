"""What lyapnet raises for its users: one line that says what was expected, what came, what to do."""

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
LONGEST = 400  # characters of a foreign message that a line repeats


def did_you_mean(name: str, known: Iterable[str], otherwise: str, prefix: str = "") -> str:
    """How a message about an unknown name ends: with the nearest known one after its prefix, or with another advice."""
    near = difflib.get_close_matches(name, list(known), n=1)
    return f"did you mean {prefix}{near[0]}?" if near else otherwise


def one_line(error: BaseException | str) -> str:
    """The message of an error that another library raised: its words alone, and not its requests to report it."""
    text = " ".join(_REQUEST.sub("", str(error)).split())
    return text if len(text) <= LONGEST else f"{text[:LONGEST]} …"


def raised(error: BaseException) -> str:
    """What code of the user's own raised, and in which line of it: "ValueError: no such mass (drone.py:12)"."""
    line = own_line(error)
    place = None if line is None else (line.filename, line.lineno)
    if isinstance(error, SyntaxError) and error.filename:
        place = (error.filename, error.lineno)
    what = f"{type(error).__name__}: {one_line(error)}"
    return what if place is None else f"{what} ({Path(place[0]).name}:{place[1]})"


def own_line(error: BaseException) -> traceback.FrameSummary | None:
    """The innermost line of the user's own code that an error came through; None if it came through none."""
    own = [frame for frame in traceback.extract_tb(error.__traceback__) if is_own_file(frame.filename)]
    return own[-1] if own else None


def running_line(frame: FrameType | None = None) -> traceback.FrameSummary | None:
    """The innermost line of the user's own code that runs now, or ran in a frame; None where there is none."""
    frame = sys._getframe(1) if frame is None else frame
    while frame is not None and not is_own_file(frame.f_code.co_filename):
        frame = frame.f_back
    if frame is None:
        return None
    return traceback.FrameSummary(frame.f_code.co_filename, frame.f_lineno, frame.f_code.co_name)


def place_of(line: traceback.FrameSummary | None) -> str:
    """ " at file:line (its text)"; nothing where there is no line."""
    return "" if line is None else f" at {Path(line.filename).name}:{line.lineno} ({line.line})"


def is_own_file(name: str) -> bool:
    """Whether code of this file is the user's own: neither lyapnet's, nor of an installed library, nor Python's."""
    written = not name.startswith("<") or name.startswith(("<stdin>", "<ipython"))  # and not made by a program
    return written and not any(part in name for part in _INSTALLED)


class LyapnetError(Exception):
    """A failure with a message meant for the user; the command line prints it and exits with `exit_status`."""

    exit_status = 1


class UsageError(LyapnetError, ValueError):
    """The request itself cannot be met: a misspelt key, a missing file, an impossible combination."""

    exit_status = 2


class CheckpointError(LyapnetError):
    """A checkpoint cannot be read, written, or used for what was asked."""


class DivergenceError(LyapnetError):
    """A rollout, a loss term or a gradient left the finite numbers."""


class CompilationError(LyapnetError):
    """A closed loop cannot be compiled; it runs without."""


class UntraceableError(CompilationError):
    """A function reads the values of tensors, for its control flow say; a closed loop then runs eagerly."""


class ExportError(LyapnetError):
    """A control law cannot be written in another language, or what was written is not that law."""


class OracleError(LyapnetError):
    """There is no ground truth for a task; what is measured without it can still be reported."""


class Interrupted(BaseException):
    """Ctrl-C or SIGTERM: status 0 where the run was saved, 130 where it was stopped at once.

    No Exception, as KeyboardInterrupt is none: what stops in the midst of a compiler or a user's function gets through.
    """

    def __init__(self, message: str, exit_status: int = 0):
        super().__init__(message)
        self.exit_status = exit_status


@contextmanager
def signals_taken(handler: Callable[..., None]) -> Iterator[None]:
    """Have a handler take Ctrl-C and SIGTERM, where this is the main thread; who took them before does afterwards."""
    main = threading.current_thread() is threading.main_thread()
    previous = {number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM) if main}
    try:
        yield
    finally:
        for number, before in previous.items():
            signal.signal(number, before)

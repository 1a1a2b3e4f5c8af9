"""What lyapnet raises for its users: one line that says what was expected, what came, what to do."""

import difflib
from collections.abc import Iterable


def did_you_mean(name: str, known: Iterable[str], otherwise: str, prefix: str = "") -> str:
    """How a message about an unknown name ends: with the nearest known one after its prefix, or with another advice."""
    near = difflib.get_close_matches(name, list(known), n=1)
    return f"did you mean {prefix}{near[0]}?" if near else otherwise


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


class OracleError(LyapnetError):
    """There is no ground truth for a task; what is measured without it can still be reported."""


class Interrupted(LyapnetError):
    """Ctrl-C or SIGTERM: status 0 where the run was saved, 130 where it was stopped at once."""

    def __init__(self, message: str, exit_status: int = 0):
        super().__init__(message)
        self.exit_status = exit_status

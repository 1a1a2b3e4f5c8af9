"""The command line: lyapnet check | trim | identify | train | evaluate | animate | view | export | sweep | tune | …

Commands import what they need when they run, so that help and misspelt options are answered at once.
"""

import atexit
import gc
import os
import re
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Annotated, Any

import typer

from lyapnet.base.errors import Interrupted, LyapnetError, describe_error, one_line, signals_taken
from lyapnet.cli import bench, certify
from lyapnet.cli.animate import animate
from lyapnet.cli.check import check
from lyapnet.cli.compare import compare
from lyapnet.cli.evaluate import evaluate
from lyapnet.cli.export import export
from lyapnet.cli.identify import identify
from lyapnet.cli.sweep import sweep
from lyapnet.cli.systems import systems
from lyapnet.cli.train import train
from lyapnet.cli.trim import trim
from lyapnet.cli.tune import tune
from lyapnet.cli.view import view
from lyapnet.cli.zoo import demo, zoo

# Allocations between two searches for garbage; with Python's 700 these take a seventh of a short training.
ALLOCATIONS = 10_000
CLOSED_OUTPUT = 141  # exit status of a process that the signal SIGPIPE ended; not every system has this signal

atexit.register(gc.freeze)  # Python's last search for garbage takes a second, after which memory is free anyway

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.callback(invoke_without_command=True)
def lyapnet(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    """Learn value functions and Lyapunov functions, and measure how good they are."""
    if version:
        from lyapnet import __version__

        print(__version__)


for command in (
    check,
    trim,
    identify,
    train,
    evaluate,
    animate,
    view,
    export,
    sweep,
    tune,
    compare,
    systems,
    zoo,
    demo,
):
    app.command()(command)
for group in (certify, bench):
    app.add_typer(group.app, name=group.__name__.rpartition(".")[2])


def main(arguments: list[str] | None = None) -> int:
    """Run a command; return 0 if done or interrupted, 1 if failed, 2 if misused, 141 if its output is closed."""
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        with signals_taken(_stop), _collect_garbage_rarely():
            status = app(arguments or ["--help"], prog_name="lyapnet", standalone_mode=False) or 0
            sys.stdout.flush()
            return status
    except (Exception, SystemExit) as error:  # the outermost frame: one line for the user, whatever happened
        if _is_closed_output(error):
            return CLOSED_OUTPUT
        if "--debug" in arguments:
            raise
        line, status = _explain(error)
        print(line, file=sys.stderr)
        return status
    except Interrupted as stop:
        print(stop, file=sys.stderr)
        return stop.exit_status


@contextmanager
def _collect_garbage_rarely() -> Iterator[None]:
    """Search for garbage only after ALLOCATIONS, because there are very many objects and little garbage."""
    before = gc.get_threshold()
    gc.set_threshold(max(before[0], ALLOCATIONS), *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)


def _stop(number: int, frame: Any) -> None:
    raise Interrupted(f"{signal.Signals(number).name}: stopped at once.", 130)


def _is_closed_output(error: BaseException) -> bool:
    """Whether the output is closed, as after `| head -1`; the rest of the output is then discarded.

    Rich and Typer raise SystemExit in this case.
    """
    if not isinstance(error.__context__ if isinstance(error, SystemExit) else error, BrokenPipeError):
        return False
    with suppress(OSError):  # a stream without a descriptor, as in tests
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return True


def _explain(error: Any) -> tuple[str, int]:
    """One line for the user, and the exit status, for an exception."""
    if isinstance(error, LyapnetError):
        more = f" More: docs/troubleshooting.md#{error.section}." if error.section else ""
        return f"error: {' '.join(str(error).split())}{more}", error.exit_status
    if isinstance(error, typer.TyperException):
        context = getattr(error, "ctx", None)
        command, got = getattr(context, "command_path", "lyapnet"), " ".join(error.format_message().split())
        if unknown := re.fullmatch(r"No such command ('.*?')\.(?: Did you mean (.*)\?)?", got):
            hint = f"did you mean {unknown[2]}?" if unknown[2] else f"see {command} --help."
            return f"error: Expected a command of {command}, got {unknown[1]}; {hint}", error.exit_code
        return f"error: Expected options of {command}, got: {got.rstrip('.')}; see {command} --help.", error.exit_code
    if isinstance(error, SystemExit):
        return f"error: Expected code of your own that returns, got {describe_error(error)}; take that out.", 1
    if isinstance(error, OSError):
        return (
            f"error: {error.strerror or error}: {error.filename or 'a file of the run'}; check space and permissions.",
            1,
        )
    return f"error: {type(error).__name__}: {one_line(error)}; run again with --debug for the traceback.", 1

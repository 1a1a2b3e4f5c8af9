"""The command line: lyapnet train | evaluate | sweep | certify | compare | bench | systems.

A command imports what it needs when it runs: help and misspelt options are answered at once.
"""

import sys
from typing import Annotated

import typer

from lyapnet.cli import bench, certify
from lyapnet.cli.compare import compare
from lyapnet.cli.evaluate import evaluate
from lyapnet.cli.sweep import sweep
from lyapnet.cli.systems import systems
from lyapnet.cli.train import train
from lyapnet.errors import LyapnetError

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.callback(invoke_without_command=True)
def lyapnet(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    """Learn time-varying value functions and Lyapunov functions, and measure what they are worth."""
    if version:
        from lyapnet import __version__

        print(__version__)


for command in (train, evaluate, sweep, compare, systems):
    app.command()(command)
for group in (certify, bench):
    app.add_typer(group.app, name=group.__name__.rpartition(".")[2])


def main(arguments: list[str] | None = None) -> int:
    """Run a command; the exit status: 0 done or cleanly interrupted, 1 failed, 2 asked wrongly."""
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        return app(arguments or ["--help"], prog_name="lyapnet", standalone_mode=False) or 0
    except Exception as error:  # the outermost frame: one line for the user, whatever happened
        if "--debug" in arguments:
            raise
        line, status = _explain(error)
        print(line, file=sys.stderr)
        return status
    except KeyboardInterrupt:
        print("Interrupted; whatever was saved is kept.", file=sys.stderr)
        return 130


def _explain(error: Exception) -> tuple[str, int]:
    """One line and the exit status for an exception that reached the user."""
    if isinstance(error, LyapnetError):
        status = error.exit_status
        return (f"error: {error}" if status else str(error)), status
    if isinstance(error, typer.TyperException):
        return f"error: {error.format_message().rstrip('.')}. See lyapnet --help.", error.exit_code
    if isinstance(error, OSError):
        return (
            f"error: {error.strerror or error}: {error.filename or 'a file of the run'}; check space and permissions.",
            1,
        )
    message = " ".join(str(error).split())
    return f"error: {type(error).__name__}: {message}; run again with --debug for the traceback.", 1

"""Progress messages: the current stage of a command, how much of it is done, and its seconds."""

import threading
import time
from typing import Protocol, runtime_checkable

from rich.console import Console
from rich.text import Text

LOG_INTERVAL = 8.0  # seconds between two lines in a log without a terminal
PATIENCE = 4.0  # seconds after which a stage gets its first line
POLL_INTERVAL = 0.25  # seconds between two checks of the clock


@runtime_checkable
class StageReport(Protocol):
    """A function that is called with the current stage and, if it is countable, how much of it is done."""

    def __call__(self, stage: str, done: int = 0, total: int = 0) -> None: ...


def silent(stage: str, done: int = 0, total: int = 0) -> None:
    """A report that shows nothing."""


class StageMessages:
    """A report that shows a line with a spinner in a terminal; elsewhere it prints lines.

    It prints one line for each stage that lasts longer than `patience`, and one every LOG_INTERVAL seconds.

    with StageMessages(console, "start") as report:
        report("optima from 96 states of X₀", 3, 96)

    Args:
        console: the console.
        subject: the first word of each line, such as the command.
        patience: seconds after which a stage gets its line.
        first: seconds after which the first line of all is printed; `patience` if None.
    """

    def __init__(self, console: Console, subject: str, patience: float = 0.0, first: float | None = None):
        self.console, self.subject, self.patience = console, subject, patience
        self.first = patience if first is None else first
        self.stage, self.done, self.total, self.detail = "", 0, 0, ""
        self._began = self._printed = time.monotonic()
        self._printed_stage = ""  # the last stage that was printed
        self._ended, self._printing = threading.Event(), threading.Lock()
        self._status = console.status(self) if console.is_terminal else None  # is rendered again by __rich__
        self._clock = threading.Thread(target=self._print_periodically, daemon=True)

    def __call__(self, stage: str, done: int = 0, total: int = 0, detail: str = "") -> None:
        is_new = stage != self.stage
        if is_new:
            self._began = time.monotonic()
        self.stage, self.done, self.total, self.detail = stage, done, total, detail
        if self._status is not None:
            self._status.start()
        elif is_new and not self.patience:
            self._print()

    def rest(self) -> None:
        """Show nothing until the next stage, while something else is printed."""
        with self._printing:
            self.stage, self._printed = "", time.monotonic()
        if self._status is not None:
            self._status.stop()

    def __enter__(self) -> "StageMessages":
        self._printed = time.monotonic()
        if self._status is None:
            self._clock.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        if self._status is not None:
            self._status.stop()

    def __rich__(self) -> Text:
        return Text(f"{self.subject}: {self.now}", no_wrap=True, overflow="ellipsis")

    @property
    def now(self) -> str:
        """The current line, such as "optima from 96 states of X₀, 3 of 96, 12 s"; a detail precedes the seconds."""
        seconds = int(time.monotonic() - self._began)
        counted = f", {self.done} of {self.total}" if self.total else ""
        detail = f", {self.detail}" if self.detail else ""
        return f"{self.stage}{counted}{detail}{f', {seconds} s' if seconds else ' …'}"

    def _print(self) -> None:
        with self._printing:
            self._printed, self._printed_stage = time.monotonic(), self.stage
            if self.stage:
                self.console.print(f"{self.subject}: {self.now}", soft_wrap=True, markup=False, highlight=False)

    def _print_periodically(self) -> None:
        while not self._ended.wait(POLL_INTERVAL):
            due = self._printed + (LOG_INTERVAL if self._printed_stage or not self.first else self.first)
            if self.patience and self._printed_stage not in ("", self.stage):
                due = min(due, self._began + self.patience)
            if self.stage and time.monotonic() >= due:
                self._print()

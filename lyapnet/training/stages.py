"""What a command is doing, how much of it is done, and for how many seconds."""

import threading
import time
from typing import Protocol, runtime_checkable

from rich.console import Console
from rich.text import Text

QUIET = 8.0  # seconds after which a log without a terminal has another line
PATIENCE = 4.0  # seconds after which a stage of a command has its first one
TICK = 0.25  # seconds between two looks at the clock


@runtime_checkable
class Report(Protocol):
    """Is told what is being done, and how many of how many are done where that is counted."""

    def __call__(self, stage: str, done: int = 0, total: int = 0) -> None: ...


def silent(stage: str, done: int = 0, total: int = 0) -> None:
    """Tell nobody."""


class Stages:
    """A report as a line with a spinner in a terminal; elsewhere as lines: one for each stage, and one every QUIET s.

    with Stages(console, "start") as report:
        report("optima from 96 states of X₀", 3, 96)

    Args:
        console: where it is shown.
        subject: what the stages belong to.
        patience: seconds after which a stage has its line.
        first: seconds after which the very first line comes; `patience` if None.
    """

    def __init__(self, console: Console, subject: str, patience: float = 0.0, first: float | None = None):
        self.console, self.subject, self.patience = console, subject, patience
        self.first = patience if first is None else first
        self.stage, self.done, self.total, self.detail = "", 0, 0, ""
        self._began = self._printed = time.monotonic()
        self._said = ""  # the last stage that has its line
        self._ended, self._printing = threading.Event(), threading.Lock()
        self._status = console.status(self) if console.is_terminal else None  # renders itself anew each time
        self._clock = threading.Thread(target=self._print_now_and_then, daemon=True)

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
        """Show nothing until the next stage: something else is printed."""
        with self._printing:
            self.stage, self._printed = "", time.monotonic()
        if self._status is not None:
            self._status.stop()

    def __enter__(self) -> "Stages":
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
        """As "optima from 96 states of X₀, 3 of 96, 12 s"; a detail stands before the seconds."""
        seconds = int(time.monotonic() - self._began)
        counted = f", {self.done} of {self.total}" if self.total else ""
        detail = f", {self.detail}" if self.detail else ""
        return f"{self.stage}{counted}{detail}{f', {seconds} s' if seconds else ' …'}"

    def _print(self) -> None:
        with self._printing:
            self._printed, self._said = time.monotonic(), self.stage
            if self.stage:
                self.console.print(f"{self.subject}: {self.now}", soft_wrap=True, markup=False, highlight=False)

    def _print_now_and_then(self) -> None:
        while not self._ended.wait(TICK):
            due = self._printed + (QUIET if self._said or not self.first else self.first)
            if self.patience and self._said not in ("", self.stage):
                due = min(due, self._began + self.patience)
            if self.stage and time.monotonic() >= due:
                self._print()

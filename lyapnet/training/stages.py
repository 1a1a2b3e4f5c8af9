"""What is being done before the first training step, how much of it is done, and for how many seconds."""

import threading
import time
from typing import Protocol, runtime_checkable

from rich.console import Console
from rich.text import Text

QUIET = 8.0  # seconds after which a log without a terminal has another line


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
    """

    def __init__(self, console: Console, subject: str):
        self.console, self.subject = console, subject
        self.stage, self.done, self.total = "", 0, 0
        self._began = self._printed = time.monotonic()
        self._ended, self._printing = threading.Event(), threading.Lock()
        self._status = console.status(self) if console.is_terminal else None  # renders itself anew each time
        self._clock = threading.Thread(target=self._print_now_and_then, daemon=True)

    def __call__(self, stage: str, done: int = 0, total: int = 0) -> None:
        is_new = stage != self.stage
        self.stage, self.done, self.total = stage, done, total
        if is_new:
            self._began = time.monotonic()
            if self._status is None:
                self._print()

    def __enter__(self) -> "Stages":
        if self._status is None:
            self._clock.start()
        else:
            self._status.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        if self._status is not None:
            self._status.stop()

    def __rich__(self) -> Text:
        return Text(f"{self.subject}: {self.now}", no_wrap=True, overflow="ellipsis")

    @property
    def now(self) -> str:
        """As "optima from 96 states of X₀, 3 of 96, 12 s"."""
        seconds = int(time.monotonic() - self._began)
        counted = f", {self.done} of {self.total}" if self.total else ""
        return f"{self.stage}{counted}{f', {seconds} s' if seconds else ' …'}"

    def _print(self) -> None:
        with self._printing:
            self._printed = time.monotonic()
            self.console.print(f"{self.subject}: {self.now}", soft_wrap=True, markup=False, highlight=False)

    def _print_now_and_then(self) -> None:
        while not self._ended.wait(max(0.1, self._printed + QUIET - time.monotonic())):
            if self.stage and time.monotonic() - self._printed >= QUIET:
                self._print()

"""Ctrl-C and SIGTERM in the midst of a search: it ends after its round, so that what it has can be kept."""

from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from lyapnet.errors import Interrupted, signals_taken


class Stop:
    """Whether the user has asked a search to stop; asked before it began, or once more, it stops at once."""

    def __init__(self) -> None:
        self.asked = self.searching = False

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Take Ctrl-C and SIGTERM."""
        with signals_taken(self._ask):
            yield

    def _ask(self, number: int, frame: FrameType | None) -> None:
        if self.asked or not self.searching:
            raise Interrupted("Stopped while certifying, at once: nothing new is kept.", 130)
        self.asked = True

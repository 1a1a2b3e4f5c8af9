"""Ctrl-C and SIGTERM in the midst of a search: it ends after its round, so that what it has can be kept."""

import signal
import threading
from types import FrameType


class Stop:
    """Whether the user has asked a search to stop; asked before it began, or once more, it stops at once.

    Within `with`, it takes the signals of the main thread.
    """

    def __init__(self) -> None:
        self.asked = self.searching = False

    def __enter__(self) -> "Stop":
        main = threading.current_thread() is threading.main_thread()
        numbers = (signal.SIGINT, signal.SIGTERM) if main else ()
        self._previous = {number: signal.signal(number, self._ask) for number in numbers}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        if self.asked or not self.searching:
            raise KeyboardInterrupt
        self.asked = True

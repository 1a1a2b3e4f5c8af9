"""Ctrl-C and SIGTERM during a search: the search ends after the current round, and its result is kept."""

from lyapnet.base.errors import Interrupted


class Stop:
    """Whether the user has asked a search to stop. A signal before the search, or a second one, ends the program."""

    asked: bool = False  # a signal has arrived during the search
    searching: bool = False  # the search has begun

    def ask(self, *_: object) -> None:
        """Ask the search to stop; the handler of both signals.

        Raises:
            Interrupted: the search has not begun, or was already asked to stop.
        """
        if self.asked or not self.searching:
            raise Interrupted("Stopped while certifying, at once: nothing new is kept.", 130)
        self.asked = True

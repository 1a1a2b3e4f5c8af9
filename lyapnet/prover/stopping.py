"""Ctrl-C and SIGTERM during a search: it ends after the current round, so that its result can be kept."""

from lyapnet.base.errors import Interrupted


class Stop:
    """Whether the user has asked a search to stop. A signal before the search, or a second one, stops at once."""

    asked: bool = False
    searching: bool = False

    def ask(self, *_: object) -> None:
        """Ask the search to stop; a handler of signals.

        Raises:
            Interrupted: the search has not begun, or was asked before.
        """
        if self.asked or not self.searching:
            raise Interrupted("Stopped while certifying, at once: nothing new is kept.", 130)
        self.asked = True

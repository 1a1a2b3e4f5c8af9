"""Ctrl-C and SIGTERM in the midst of a search: it ends after its round, so that what it has can be kept."""

from lyapnet.base.errors import Interrupted


class Stop:
    """Whether the user has asked a search to stop; asked before it began, or once more, it stops at once."""

    asked: bool = False
    searching: bool = False

    def ask(self, *_: object) -> None:
        """Take a signal."""
        if self.asked or not self.searching:
            raise Interrupted("Stopped while certifying, at once: nothing new is kept.", 130)
        self.asked = True

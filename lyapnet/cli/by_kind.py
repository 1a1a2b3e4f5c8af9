"""Which kind of claim a command line of lyapnet certify is about."""

import re
from pathlib import Path
from typing import Any

from typer.core import TyperGroup

from lyapnet.base.errors import UsageError, did_you_mean

DEFAULT = "statistical"


class ByKind(TyperGroup):
    """A group of commands, one for each kind of claim; without a kind, the default one runs."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args[:1] == ["--help"]:
            return super().parse_args(ctx, args)
        if any(argument.partition("=")[0] == "--kind" for argument in args):
            raise UsageError("Expected the kind of claim as a word, got --kind; as in lyapnet certify sound CKPT.")
        if args and re.fullmatch(r"\w+", args[0]) and args[0] not in self.commands and not Path(args[0]).exists():
            hint = did_you_mean(args[0], self.commands, "choose one, or name a file.")
            raise UsageError(f"Expected {', '.join(self.commands)} or a checkpoint, got {args[0]!r}; {hint}")
        # options may stand before the kind, because the group itself has no options
        named = next((argument for argument in args if argument in self.commands), DEFAULT)
        return super().parse_args(ctx, [named, *(argument for argument in args if argument != named)])

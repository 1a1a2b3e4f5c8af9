"""Which kind of claim a command line of lyapnet certify is about."""

import re
import shlex
import sys
from pathlib import Path
from typing import Any

from typer.core import TyperGroup

from lyapnet.base.errors import UsageError, did_you_mean

DEFAULT = "statistical"


class ByKind(TyperGroup):
    """A group of commands, one for each kind of claim; what names none of them is for the default one.

    For one version `certify CKPT --kind KIND` is read as `certify KIND CKPT`, with a note.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args[:1] != ["--help"]:
            args = self._with_kind(args)
        return super().parse_args(ctx, args)

    def _with_kind(self, args: list[str]) -> list[str]:
        kind, others = _without_option("--kind", args)
        if kind is None:  # options may stand before the kind, or none: those of the group itself are none
            if args and re.fullmatch(r"\w+", args[0]) and args[0] not in self.commands and not Path(args[0]).exists():
                hint = did_you_mean(args[0], self.commands, "choose one, or name a file.")
                raise UsageError(f"Expected {', '.join(self.commands)} or a checkpoint, got {args[0]!r}; {hint}")
            named = next((argument for argument in args if argument in self.commands), DEFAULT)
            return [named, *(argument for argument in args if argument != named)]
        kinds = [name for name in self.commands if name != "check"]
        if kind not in kinds:
            raise UsageError(f"Expected --kind as one of {', '.join(kinds)}, got {kind!r}; choose one.")
        command = shlex.join(["lyapnet", "certify", kind, *others])
        print(f"note: --kind will be removed in the next version; from now on: {command}", file=sys.stderr)
        return [kind, *others]


def _without_option(name: str, args: list[str]) -> tuple[str | None, list[str]]:
    """(the last value of an option, the arguments without it)."""
    value, others, rest = None, [], iter(args)
    for argument in rest:
        if argument == name:
            value = next(rest, "")
        elif argument.startswith(f"{name}="):
            value = argument.partition("=")[2]
        else:
            others.append(argument)
    return value, others

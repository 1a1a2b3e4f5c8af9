"""What several commands share: options, and the controller that a command is given."""

import functools
import inspect
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from lyapnet.training.stages import PATIENCE, Stages

FIRST = 1.0  # seconds after which a command says what it is doing

Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]


Checkpoint = Annotated[Path, typer.Argument(help="A checkpoint of a run, or zoo:NAME.", metavar="CKPT")]
At = Annotated[
    list[str] | None,
    typer.Option(help="Of a family, one member: NAME=VALUE for each parameter.", metavar="NAME=VALUE"),
]
Parameter = Annotated[
    list[str] | None,
    typer.Option(
        help="A parameter of the plant that may lie anywhere between; u and V stay. May be given again.",
        metavar="NAME=LOWER:UPPER",
    ),
]
OWN = {
    "system": "a system", "network": "a network", "cost": "a cost", "controls": "a control set",
    "constraints": "constraints", "program": "a program",
}  # fmt: skip


@dataclass(frozen=True)
class Given:
    """The controller that a command is given: its checkpoint, the user's own parts, and of a family one member."""

    checkpoint: Path
    own: dict[str, str | None]  # the user's own parts, as module:Class, each by its option's name
    at: list[str] | None
    report: Stages  # is told what is being done
    functions: tuple[Path, Path] | None = None  # ONNX files of V and u made elsewhere; the checkpoint is a config then

    @property
    def title(self) -> str:
        """What a table calls the controller."""
        from lyapnet.experiment.checkpoint import ZOO

        name = f"zoo:{self.checkpoint.stem}" if self.checkpoint.parent == ZOO else str(self.checkpoint)
        return ", ".join([name, *(self.at or []), *(path.name for path in self.functions or ())])

    @property
    def named(self) -> dict[str, str]:
        """The user's own parts that the command names."""
        return {part: name for part, name in self.own.items() if name is not None}

    @property
    def again(self) -> dict[str, str | None]:
        """The options that give the same controller again, but for --at."""
        return {**self.own, **dict(zip(("value", "law"), map(str, self.functions or ()), strict=False))}

    def with_functions(self, value: Path | None, law: Path | None) -> "Given":
        """The same with V and u of their own files, where there are both; a config in the place of a checkpoint."""
        from lyapnet.base.errors import UsageError

        if value is None and law is None:
            return self
        if value is None or law is None or self.at:
            got = "--at" if self.at else "one"
            raise UsageError(f"Expected --value and --law, both and without --at, got {got}; a proof is about V and u.")
        return replace(self, functions=(value, law))

    def of(self, checkpoint: Path) -> "Given":
        """The same of another checkpoint."""
        return replace(self, checkpoint=checkpoint)

    def parts(self) -> Any:
        """The user's own parts, made with the config of the checkpoint."""
        from lyapnet.controller.loading import config_of
        from lyapnet.experiment.assembly import Parts, parts_named
        from lyapnet.experiment.checkpoint import read_checkpoint

        if not self.named:
            return Parts()
        return parts_named(config_of(read_checkpoint(self.checkpoint), self.checkpoint), self.named)

    def load(self) -> Any:
        """The controller."""
        import torch

        from lyapnet.controller.loading import load
        from lyapnet.experiment.assembly import DTYPES

        self.report(f"loading {self.title}")
        if self.functions is None:
            controller = load(self.checkpoint, **vars(self.parts()))
        else:
            from lyapnet.exchange.importing import imported_controller

            controller = imported_controller(self.checkpoint, *self.functions, self.named)
        torch.set_num_threads(controller.config.training.threads)
        torch.set_default_dtype(DTYPES[controller.config.training.precision])  # until the command ends
        return member_of(controller, self.at) if self.at else controller


def stages_of(name: str) -> Stages:
    """What tells on stderr what a command is doing, from before torch is imported; what is quickly done is not told.

    It keeps to the stderr of the command, which an oracle hides from others while it searches.
    """
    return Stages(Console(file=sys.stderr, highlight=False, markup=False), name, PATIENCE, FIRST)


def of_a_controller(command: Callable[..., None]) -> Callable[..., None]:
    """A command with a Given among its parameters, as one with CKPT in its place, --system and its like, and --at."""
    parameters = inspect.signature(command).parameters.values()
    (given,) = (parameter.name for parameter in parameters if parameter.annotation is Given)

    @functools.wraps(command)
    def run(**options: Any) -> None:
        own, checkpoint = {name: options.pop(name) for name in OWN}, options.pop("checkpoint")
        with stages_of(command.__name__) as report:
            report(f"importing torch for {checkpoint}")
            import torch

            from lyapnet.experiment.checkpoint import located  # takes seconds

            before = torch.get_default_dtype()
            try:
                command(**{given: Given(located(checkpoint), own, options.pop("at"), report)}, **options)
            finally:
                torch.set_default_dtype(before)

    def keyword(name: str, annotation: Any, **more: Any) -> inspect.Parameter:
        return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, annotation=annotation, **more)

    checkpoint = keyword("checkpoint", Checkpoint)
    *own_options, debug = (
        checkpoint if parameter.name == given else parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY)
        for parameter in parameters
    )
    named = (
        keyword(name, Annotated[str | None, typer.Option(help=f"module:Class of {what} of your own.")], default=None)
        for name, what in OWN.items()
    )
    taken = [*own_options, *named, keyword("at", At, default=None), debug]
    vars(run)["__signature__"] = inspect.Signature(taken)
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in taken}
    return run


def member_of(controller: Any, at: list[str]) -> Any:
    """The controller of one member of a family, from NAME=VALUE of its parameters."""
    from lyapnet.base.errors import UsageError

    try:
        parameters = {name: float(value) for name, _, value in (each.partition("=") for each in at)}
    except ValueError as error:
        raise UsageError(f"Expected --at NAME=VALUE with a number, got {' '.join(at)}; as in --at mass=0.9.") from error
    if len(parameters) < len(at):
        raise UsageError(f"Expected --at once for each parameter, got {' '.join(at)}; leave one of them out.")
    return controller.with_(**parameters)

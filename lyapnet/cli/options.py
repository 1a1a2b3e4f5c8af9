"""What several commands share: options, and the controller of a checkpoint."""

from pathlib import Path
from typing import Annotated, Any

import typer

Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]


def _located(path: Path) -> Path:
    from lyapnet.checkpoint import located  # torch takes seconds: only where a checkpoint is named

    return located(path)


Checkpoint = Annotated[
    Path, typer.Argument(help="A checkpoint of a run, or zoo:NAME.", metavar="CKPT", callback=_located)
]
System = Annotated[str | None, typer.Option(help="module:Class of a system of your own.")]
Network = Annotated[str | None, typer.Option(help="module:Class of a network of your own.")]
Cost = Annotated[str | None, typer.Option(help="module:Class of a cost of your own.")]
Controls = Annotated[str | None, typer.Option(help="module:Class of a control set of your own.")]
Constraints = Annotated[str | None, typer.Option(help="module:Class of constraints of your own.")]
At = Annotated[
    list[str] | None,
    typer.Option(help="Of a family, one member: NAME=VALUE for each parameter.", metavar="NAME=VALUE"),
]
Program = Annotated[str | None, typer.Option(help="module:Class of a program of your own.")]


def parts_given(checkpoint: Path, **own: str | None) -> Any:
    """The user's own parts, each by its option's name, where one is given; made with the config of a checkpoint."""
    from lyapnet.build import Parts, parts_named
    from lyapnet.checkpoint import read_checkpoint
    from lyapnet.loading import config_of

    named = {part: name for part, name in own.items() if name is not None}
    return parts_named(config_of(read_checkpoint(checkpoint), checkpoint), named) if named else Parts()


def load_controller(checkpoint: Path, at: list[str] | None = None, **own: str | None) -> Any:
    """The controller of a checkpoint, with the user's own parts; of a family, that of one member if `at` names it."""
    import torch

    from lyapnet.loading import load

    controller = load(checkpoint, **vars(parts_given(checkpoint, **own)))
    torch.set_num_threads(controller.config.training.threads)
    return member_of(controller, at) if at else controller


def titled(checkpoint: Path, at: list[str] | None) -> str:
    """What a table calls a controller."""
    return f"{checkpoint}, {', '.join(at)}" if at else str(checkpoint)


def member_of(controller: Any, at: list[str]) -> Any:
    """The controller of one member of a family, from NAME=VALUE of its parameters."""
    from lyapnet.errors import UsageError

    try:
        parameters = {name: float(value) for name, _, value in (each.partition("=") for each in at)}
    except ValueError as error:
        raise UsageError(f"Expected --at NAME=VALUE with a number, got {' '.join(at)}; as in --at mass=0.9.") from error
    if len(parameters) < len(at):
        raise UsageError(f"Expected --at once for each parameter, got {' '.join(at)}; leave one of them out.")
    return controller.with_(**parameters)

"""What several commands share: options, and the controller of a checkpoint."""

from pathlib import Path
from typing import Annotated, Any

import typer

Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]
Checkpoint = Annotated[Path, typer.Argument(help="A checkpoint of a run.", metavar="CKPT")]
System = Annotated[str | None, typer.Option(help="module:Class of a system of your own.")]
Network = Annotated[str | None, typer.Option(help="module:Class of a network of your own.")]
Cost = Annotated[str | None, typer.Option(help="module:Class of a cost of your own.")]
Controls = Annotated[str | None, typer.Option(help="module:Class of a control set of your own.")]
Program = Annotated[str | None, typer.Option(help="module:Class of a program of your own.")]


def load_controller(checkpoint: Path, **own: str | None) -> Any:
    """The controller of a checkpoint, with the user's own parts, each by its option's name, where one is given."""
    import torch

    from lyapnet.build import parts_named
    from lyapnet.checkpoint import read_checkpoint
    from lyapnet.controller import config_of, load

    named = {part: name for part, name in own.items() if name is not None}
    parts = parts_named(config_of(read_checkpoint(checkpoint), checkpoint), named) if named else None
    controller = load(checkpoint, **(vars(parts) if parts else {}))
    torch.set_num_threads(controller.config.training.threads)
    return controller

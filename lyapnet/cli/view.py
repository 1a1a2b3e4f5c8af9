"""lyapnet view."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from lyapnet.cli.options import (
    At,
    Checkpoint,
    Constraints,
    Controls,
    Cost,
    Debug,
    Network,
    Program,
    System,
    load_controller,
    titled,
)


def view(
    checkpoint: Checkpoint,
    out: Annotated[Path, typer.Option(help="The file: a .html.")],
    proof: Annotated[
        Path | None, typer.Option(help="Draw the funnel that certify sound --keep FILE proved.", metavar="FILE")
    ] = None,
    system: System = None,
    network: Network = None,
    cost: Cost = None,
    controls: Controls = None,
    constraints: Constraints = None,
    program: Program = None,
    at: At = None,
    debug: Debug = False,
) -> None:
    """Write an interactive page: V and u on slices through time, the funnel, and closed loops from where you click.

    The page is one file that needs no server and no network.
    """
    from lyapnet.certification.checking import kept_funnel
    from lyapnet.checkpoint import ZOO
    from lyapnet.view import write_page

    controller = load_controller(
        checkpoint,
        at,
        system=system,
        network=network,
        cost=cost,
        controls=controls,
        constraints=constraints,
        program=program,
    )
    notes = Console(highlight=False, markup=False)
    with notes.status("writing …"):
        funnel = None if proof is None else kept_funnel(controller, proof)
        name = Path(f"zoo:{checkpoint.stem}") if checkpoint.parent == ZOO else checkpoint
        write_page(controller, out, titled(name, at), funnel)
    notes.print(f"wrote {out}", soft_wrap=True)

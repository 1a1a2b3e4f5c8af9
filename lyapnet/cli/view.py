"""lyapnet view."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from lyapnet.cli.options import Debug, Given, with_controller_options


@with_controller_options
def view(
    given: Given,
    out: Annotated[Path, typer.Option(help="The file: a .html.")],
    proof: Annotated[
        Path | None, typer.Option(help="Draw the funnel of this proof by certify sound --keep FILE.", metavar="FILE")
    ] = None,
    debug: Debug = False,
) -> None:
    """Write an interactive page: V and u on slices through time, the funnel, and closed loops from any state.

    The page is one file and needs no server and no network.
    """
    from lyapnet.claims.checking import kept_funnel
    from lyapnet.exchange.view import write_page

    controller = given.load()
    given.report("writing the page")
    funnel = None if proof is None else kept_funnel(controller, proof)
    write_page(controller, out, given.title, funnel)
    given.report.rest()
    Console(highlight=False, markup=False).print(f"wrote {out}", soft_wrap=True)

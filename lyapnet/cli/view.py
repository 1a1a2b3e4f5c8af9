"""lyapnet view."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from lyapnet.cli.options import Debug, Given, of_a_controller


@of_a_controller
def view(
    given: Given,
    out: Annotated[Path, typer.Option(help="The file: a .html.")],
    proof: Annotated[
        Path | None, typer.Option(help="Draw the funnel that certify sound --keep FILE proved.", metavar="FILE")
    ] = None,
    debug: Debug = False,
) -> None:
    """Write an interactive page: V and u on slices through time, the funnel, and closed loops from where you click.

    The page is one file that needs no server and no network.
    """
    from lyapnet.claims.checking import kept_funnel
    from lyapnet.exchange.view import write_page

    controller = given.load()
    given.report("writing the page")
    funnel = None if proof is None else kept_funnel(controller, proof)
    write_page(controller, out, given.title, funnel)
    given.report.rest()
    Console(highlight=False, markup=False).print(f"wrote {out}", soft_wrap=True)

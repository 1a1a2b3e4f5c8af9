"""lyapnet animate."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from lyapnet.base.errors import UsageError
from lyapnet.cli.options import Debug, Given, with_controller_options


@with_controller_options
def animate(
    given: Given,
    out: Annotated[Path, typer.Option(help="The file: a .gif, or an .mp4 where ffmpeg is installed.")],
    start: Annotated[
        str | None, typer.Option("--from", help="The initial state, as x_1,x_2,…", metavar="STATE")
    ] = None,
    samples: Annotated[int, typer.Option(min=1, max=16, help="Closed loops from X₀, without --from.")] = 5,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the draw.")] = 0,
    rate: Annotated[float, typer.Option("--frames-per-second", help="Of the animation.")] = 20.0,
    speed: Annotated[
        float | None,
        typer.Option(help="1 is real time; by default that, or the speed with which the film takes 3 to 10 s."),
    ] = None,
    debug: Debug = False,
) -> None:
    """Animate closed loops, with their controls, cost and V.

    The system is drawn by its method `draw`; without one, the film shows the plane of two states with level sets of
    V(t, ·).
    """
    from lyapnet.base.random_streams import FIGURES, stream
    from lyapnet.evaluation.animation import Film

    controller = given.load()
    if start is None:
        x0 = controller.initial_states.sample(samples, stream(seed, FIGURES))
    else:
        try:
            x0 = controller.initial_states.lower.new_tensor([[float(entry) for entry in start.split(",")]])
        except ValueError as error:
            raise UsageError(f"Expected --from as numbers, got {start!r}; as in --from 0.5,-0.2.") from error
    given.report("animating")
    noise = None if controller.problem.noise is None else seed
    film = Film(controller.rollout(x0, noise=noise), controller.problem, controller.value, rate, speed)
    film.write(out)
    given.report.rest()
    Console(highlight=False, markup=False).print(f"wrote {out}", soft_wrap=True)

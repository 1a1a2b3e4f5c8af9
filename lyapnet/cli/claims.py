"""Options of the commands that certify."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperOption

from lyapnet.base.errors import UsageError
from lyapnet.base.sizes import THREADS


def number(holds: Callable[[float], bool], expected: str, remedy: str, help: str) -> Any:
    """A number of which more than its type is expected."""

    def checked(parameter: TyperOption, value: float | None) -> float | None:
        if value is not None and not holds(value):
            raise UsageError(f"Expected {parameter.opts[0]} {expected}, got {value:g}; {remedy}.")
        return value

    return typer.Option(help=help, callback=checked)


Radius = Annotated[
    float | None,
    number(
        lambda r: 0 <= r < math.inf, "≥ 0", "give it in the norm of x",
        "Success at T needs ‖x(T) − goal‖ within it; not asked for if none.",
    ),
]  # fmt: skip
States = Annotated[str | None, typer.Option("--set", help="The set D, as lower:upper,…; found if none.", metavar="BOX")]
Seconds = Annotated[
    float, number(lambda s: 0 < s < math.inf, "> 0", "a proof needs some", "When to stop undecided.")
]  # fmt: skip
Delta = Annotated[
    float | None,
    number(
        lambda d: 0 <= d < math.inf, "≥ 0", "give it in cost per second",
        "Slack in cost per second; 0.5 % of the mean ℓ on X₀ if none.",
    ),
]  # fmt: skip
TwoSided = Annotated[bool, typer.Option("--two-sided", help="Bound the optimum from below, too.")]
Device = Annotated[str, typer.Option(help="Where boxes are bounded: cpu, or cuda for a GPU.")]
Workers = Annotated[int, typer.Option(min=1, max=THREADS, help="Processes that bound boxes side by side.")]
Ray = Annotated[
    str | None,
    typer.Option(
        help="Bound boxes by --workers cores of a Ray cluster: auto, local or ray://host:port.", metavar="ADDRESS"
    ),
]
Disturbance = Annotated[
    list[str] | None,
    typer.Option(help="The largest push on the derivative of a state; may be given again.", metavar="STATE=W"),
]
Value = Annotated[
    Path | None,
    typer.Option(help="ONNX file of a V(x) made elsewhere; CKPT is then a config: its task.", metavar="FILE"),
]
Law = Annotated[Path | None, typer.Option(help="ONNX file of its u(x).", metavar="FILE")]
Overrides = Annotated[list[str] | None, typer.Argument(help="With --refine: changes to the config, as key.sub=value.")]
Refine = Annotated[int, typer.Option(min=0, help="Train on with what failed, so many times at most.", metavar="ROUNDS")]
Seed = Annotated[int, typer.Option(min=0, help="Seed of the draw.")]
Keep = Annotated[str | None, typer.Option(help="Keep the proof there, and go on from it.", metavar="FILE")]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
FigureFile = Annotated[Path | None, typer.Option(help="Draw the claim.", metavar="FILE")]
ReportFolder = Annotated[
    Path | None, typer.Option(help="Write report.md, report.json and the figure there.", metavar="FOLDER")
]

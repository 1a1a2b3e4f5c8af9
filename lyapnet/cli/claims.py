"""Options that several commands that certify share, beside those of each claim."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from lyapnet.base.errors import UsageError
from lyapnet.base.sizes import THREADS
from lyapnet.claims.claim import option
from lyapnet.cli.options import Given, read_pushes

TwoSided = Annotated[bool, typer.Option("--two-sided", help="Bound the optimum from below, too.")]
Value = Annotated[
    Path | None,
    typer.Option(help="ONNX file of a V(x) made elsewhere; CKPT is then a config: its task.", metavar="FILE"),
]
Law = Annotated[Path | None, typer.Option(help="ONNX file of its u(x).", metavar="FILE")]
Keep = Annotated[str | None, typer.Option(help="Keep the proof there, and go on from it.", metavar="FILE")]
Workers = Annotated[int, typer.Option(min=1, max=THREADS, help="Processes that bound boxes side by side.")]


@dataclass(frozen=True, kw_only=True)
class Search:
    """How long a proof is sought, and by how many."""

    seconds: float = option(60.0, "When to stop undecided.", above=0, remedy="a proof needs some")
    workers: Workers = 1

    def budget(self, started: float) -> Any:
        """The same for a claim; its seconds count from when the command began."""
        from lyapnet.prover.branch_and_bound import Budget

        return Budget(**vars(self), started=started)


@dataclass(frozen=True, kw_only=True)
class SearchAnywhere(Search):
    """And where."""

    ray: Annotated[
        str | None,
        typer.Option(
            help="Bound boxes by --workers cores of a Ray cluster: auto, local or ray://host:port.", metavar="ADDRESS"
        ),
    ] = None
    device: Annotated[str, typer.Option(help="Where boxes are bounded: cpu, or cuda for a GPU.")] = "cpu"


@dataclass(frozen=True, kw_only=True)
class Refining:
    """Whether a proof is kept, or what failed is trained on with: not both."""

    overrides: Annotated[
        list[str] | None, typer.Argument(help="With --refine: changes to the config, as key.sub=value.")
    ] = None
    keep: Keep = None
    refine: Annotated[
        int, typer.Option(min=0, help="Train on with what failed, so many times at most.", metavar="ROUNDS")
    ] = 0

    def require_fitting(self, given: Given) -> None:
        """Refuse what does not go with --refine, and overrides without it."""
        if self.refine and self.keep is not None:
            raise UsageError("Expected --keep or --refine, got both; each round proves something about another V.")
        if self.refine and given.at:
            raise UsageError("Expected --at or --refine, got both; training goes on with the whole family.")
        if self.overrides and not self.refine:
            raise UsageError(f"Expected overrides with --refine ROUNDS, got {' '.join(self.overrides)!r}; add it.")


@dataclass(frozen=True, kw_only=True)
class Output:
    """The draw, and how its certificate is shown."""

    seed: Annotated[int, typer.Option(min=0, help="Seed of the draw.")] = 0
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False
    figure: Annotated[Path | None, typer.Option(help="Draw the claim.", metavar="FILE")] = None
    report: Annotated[
        Path | None, typer.Option(help="Write report.md, report.json and the figure there.", metavar="FOLDER")
    ] = None

    def require_writable(self, keep: str | None = None) -> None:
        """Refuse at once what could not be written after the work."""
        from lyapnet.claims.report import require_writable

        require_writable(self.figure, self.report, keep)

    def show(self, certificate: Any, given: Given) -> None:
        """The certificate as a table, unless JSON is asked for."""
        given.report("comparing with the optimum")
        certificate.result  # noqa: B018  # computed now, where it is told
        given.report.rest()
        if not self.as_json:
            Console(highlight=False, markup=False).print(certificate.table(given.title))

    def write(self, certificate: Any, given: Given) -> None:
        """The certificate as JSON, and its figure and report, where they are asked for."""
        from lyapnet.claims.report import write_outputs

        if self.as_json:
            print(json.dumps(certificate.result, allow_nan=False))
        command = certificate.command(str(given.checkpoint), given.at or [], **given.again)
        if self.figure is not None or self.report is not None:
            given.report("drawing and writing")
        for path in write_outputs(certificate, given.checkpoint, command, self.figure, self.report):
            given.report.rest()
            note_written(path)


def law_of(controller: Any, folder: Path, given: Given) -> Any:
    """The law that an export in C computes, for claims about it; the export has to be that of the controller."""
    from lyapnet.exchange.export.certified import CertifiedFiles

    given.report("comparing the C with the checkpoint")
    return CertifiedFiles(controller, folder, given.checkpoint).law()


def note_written(path: Path) -> None:
    """Say on stderr that a file was written."""
    Console(stderr=True, highlight=False, markup=False).print(f"wrote {path}", soft_wrap=True)


def pushes_of_one_state(named: list[str]) -> tuple[str, list[float]]:
    """The state and the pushes that ["velocity=0,0.05,0.1"] names, in increasing order, each once.

    Raises:
        UsageError: more than one state is pushed, or what is named is no number ≥ 0.
    """
    if len(named) != 1:
        raise UsageError(
            f"Expected one --disturbance STATE=W,W,… where it has several values, got {len(named)} of them; push one "
            "state."
        )
    state, _, values = named[0].partition("=")
    pushes = {read_pushes([f"{state}={value}"])[state] for value in values.split(",")}
    wrong = [w for w in pushes if not 0 <= w < math.inf]
    if wrong:
        raise UsageError(f"Expected disturbances ≥ 0, got {wrong[0]:g}; give the largest |w| in units of ẋ.")
    return state, sorted(pushes)

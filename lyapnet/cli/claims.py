"""Options that several kinds of `lyapnet certify` share."""

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
from lyapnet.cli.options import Given, read_numbers

TwoSided = Annotated[bool, typer.Option("--two-sided", help="Bound the optimum from below, too.")]
Value = Annotated[
    Path | None,
    typer.Option(help="ONNX file of another program's V(x); CKPT is then a config with its task.", metavar="FILE"),
]
Law = Annotated[Path | None, typer.Option(help="ONNX file of its u(x).", metavar="FILE")]
Keep = Annotated[str | None, typer.Option(help="Keep the proof in this file, and continue from it.", metavar="FILE")]
Workers = Annotated[int, typer.Option(min=1, max=THREADS, help="Number of processes that bound boxes.")]


@dataclass(frozen=True, kw_only=True)
class Search:
    """The time limit of a proof, and its number of processes."""

    seconds: float = option(60.0, "Time limit of the search.", above=0, remedy="a proof needs some")
    workers: Workers = 1

    def budget(self, started: float) -> Any:
        """The budget of a claim; its seconds count from the start of the command."""
        from lyapnet.prover.branch_and_bound import Budget

        return Budget(**vars(self), started=started)


@dataclass(frozen=True, kw_only=True)
class SearchAnywhere(Search):
    """Also the device and the cluster of the search."""

    ray: Annotated[
        str | None,
        typer.Option(
            help="Bound boxes by --workers cores of a Ray cluster: auto, local or ray://host:port.", metavar="ADDRESS"
        ),
    ] = None
    device: Annotated[str, typer.Option(help="Where boxes are bounded: cpu, or cuda for a GPU.")] = "cpu"


@dataclass(frozen=True, kw_only=True)
class Refining:
    """Whether a proof is kept, or training continues with counterexamples; one of the two."""

    overrides: Annotated[
        list[str] | None, typer.Argument(help="With --refine: changes to the config, as key.sub=value.")
    ] = None
    keep: Keep = None
    refine: Annotated[
        int, typer.Option(min=0, help="Largest number of rounds of training with counterexamples.", metavar="ROUNDS")
    ] = 0

    def require_fitting(self, given: Given) -> None:
        """Refuse options that exclude --refine, and overrides without it."""
        if self.refine and self.keep is not None:
            raise UsageError("Expected --keep or --refine, got both; each round proves something about another V.")
        if self.refine and given.at:
            raise UsageError("Expected --at or --refine, got both; training goes on with the whole family.")
        if self.overrides and not self.refine:
            raise UsageError(f"Expected overrides with --refine ROUNDS, got {' '.join(self.overrides)!r}; add it.")


@dataclass(frozen=True, kw_only=True)
class Output:
    """The seed, and the outputs of a certificate."""

    seed: Annotated[int, typer.Option(min=0, help="Seed of the draw.")] = 0
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False
    figure: Annotated[Path | None, typer.Option(help="Draw the claim.", metavar="FILE")] = None
    report: Annotated[
        Path | None, typer.Option(help="Write report.md, report.json and the figure there.", metavar="FOLDER")
    ] = None

    def require_writable(self, keep: str | None = None) -> None:
        """Refuse files that could not be written, before the work."""
        from lyapnet.claims.report import require_writable

        require_writable(self.figure, self.report, keep)

    def show(self, certificate: Any, given: Given) -> None:
        """Print the certificate as a table, unless --json is given."""
        given.report("comparing with the optimum")
        certificate.result  # noqa: B018  # computed here, under this message
        given.report.rest()
        if not self.as_json:
            Console(highlight=False, markup=False).print(certificate.table(given.title))

    def write(self, certificate: Any, given: Given) -> None:
        """Print the certificate as JSON, and write its figure and report, as far as options ask for them."""
        from lyapnet.claims.report import write_outputs

        if self.as_json:
            print(json.dumps(certificate.result, allow_nan=False))
        command = certificate.command(str(given.checkpoint), given.at or [], **given.again)
        if self.figure is not None or self.report is not None:
            given.report("drawing and writing")
        for path in write_outputs(certificate, given.checkpoint, command, self.figure, self.report):
            given.report.rest()
            print_written(path)


def load_exported_law(controller: Any, folder: Path, given: Given) -> Any:
    """The law that an export in C computes, for claims about it; it has to be an export of the controller."""
    from lyapnet.exchange.export.certified import CertifiedFiles

    given.report("comparing the C with the checkpoint")
    return CertifiedFiles(controller, folder, given.checkpoint).law()


def print_written(path: Path) -> None:
    """Print on stderr that a file was written."""
    Console(stderr=True, highlight=False, markup=False).print(f"wrote {path}", soft_wrap=True)


def read_disturbances_of_one_state(named: list[str]) -> tuple[str, list[float]]:
    """Read ["velocity=0,0.05,0.1"]: the state, and the largest disturbances in increasing order, without repetition.

    Raises:
        UsageError: more than one state, or something else than numbers ≥ 0.
    """
    if len(named) != 1:
        raise UsageError(
            f"Expected a single --disturbance if it has several values, as STATE=W,W,…, got {len(named)}; name one "
            "state."
        )
    state, _, values = named[0].partition("=")
    pushes = {read_numbers([f"{state}={value}"])[state] for value in values.split(",")}
    wrong = [w for w in pushes if not 0 <= w < math.inf]
    if wrong:
        raise UsageError(f"Expected disturbances ≥ 0, got {wrong[0]:g}; give the largest |w| in units of ẋ.")
    return state, sorted(pushes)

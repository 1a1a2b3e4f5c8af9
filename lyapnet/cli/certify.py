"""lyapnet certify sampled | statistical | sound | noisy | reach | region | tube | check."""

import dataclasses
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from lyapnet.base.errors import UsageError
from lyapnet.claims.claim import Claim, flag_of
from lyapnet.claims.kinds import Funnel, LowerBound, NoisyFunnel, Reach, Region, Sampled, Statistical, Tube
from lyapnet.cli.by_kind import ByKind
from lyapnet.cli.claims import (
    Keep,
    Law,
    Output,
    Refining,
    Search,
    SearchAnywhere,
    TwoSided,
    Value,
    Workers,
    load_exported_law,
    print_written,
    read_disturbances_of_one_state,
)
from lyapnet.cli.options import Debug, Given, read_numbers, with_controller_options

app = typer.Typer(cls=ByKind)


@app.callback()
def certify() -> None:
    """Certify a controller: the share of X₀ on which a claim holds, and how sure that is.

    Verdicts: certified, falsified (with a state), unknown. Without the name of a kind, statistical.
    """


@app.command()
@with_controller_options
def sampled(given: Given, claim: Sampled, output: Output, debug: Debug = False) -> None:
    """The share of sampled states whose closed loop succeeds; no statement about other states."""
    _draw(given, claim, output)


@app.command()
@with_controller_options
def statistical(given: Given, claim: Statistical, output: Output, debug: Debug = False) -> None:
    """A share of X₀ that succeeds, with a confidence."""
    _draw(given, claim, output)


@app.command()
@with_controller_options
def sound(
    given: Given, claim: Funnel, search: SearchAnywhere, refining: Refining, output: Output,
    two_sided: TwoSided = False, debug: Debug = False,
) -> None:  # fmt: skip
    """A funnel that no closed loop leaves, and its cost: proved."""
    if two_sided and (refining.refine or claim.disturbance):
        raise UsageError("Expected --two-sided alone, got --refine or --disturbance; these are about one side.")
    _prove(given, [claim, *([LowerBound()] if two_sided else [])], search, refining, output)


@app.command()
@with_controller_options
def noisy(
    given: Given,
    claim: NoisyFunnel,
    search: SearchAnywhere,
    output: Output,
    keep: Keep = None,
    debug: Debug = False,
) -> None:
    """A funnel that noise leaves with a small probability, and the expected cost: proved."""
    _prove(given, [claim], search, Refining(keep=keep), output)


@app.command()
@with_controller_options
def reach(
    given: Given,
    claim: Reach,
    search: SearchAnywhere,
    output: Output,
    keep: Keep = None,
    debug: Debug = False,
) -> None:
    """Closed loops under noise reach a target and avoid other sets, with a probability: proved."""
    _prove(given, [claim], search, Refining(keep=keep), output)


@app.command()
@with_controller_options
def region(
    given: Given,
    claim: Region,
    search: SearchAnywhere,
    refining: Refining,
    output: Output,
    disturbance: Annotated[
        list[str] | None,
        typer.Option(
            help="The largest disturbance of the rate of a state; may be repeated. STATE=W,W: one claim for each.",
            metavar="STATE=W",
        ),
    ] = None,
    value: Value = None,
    law: Law = None,
    debug: Debug = False,
) -> None:
    """A region of attraction of the receding law u(0, x), for all times: proved."""
    several = any("," in each for each in disturbance or ())
    if refining.refine and (several or value or law or claim.parameters):
        got = "--parameter" if claim.parameters else "several or --value"
        raise UsageError(f"Expected --refine with one checkpoint and one disturbance, got {got}; drop it.")
    if several and (refining.keep is not None or output.report is not None or search.ray is not None):
        raise UsageError("Expected one disturbance with --keep, --report or --ray, got several; name one for each.")
    given = given.with_functions(value, law)
    if several:
        return _prove_for_each(given, claim, *read_disturbances_of_one_state(disturbance or []), search, output)
    return _prove(given, [replace(claim, disturbance=read_numbers(disturbance or []))], search, refining, output)


@app.command()
@with_controller_options
def tube(
    given: Given, claim: Tube, below: LowerBound, search: Search, output: Output, two_sided: TwoSided = False,
    debug: Debug = False,
) -> None:  # fmt: skip
    """A tube that holds all closed loops from X₀ up to T, and bounds of their cost: proved."""
    alone = [flag_of(f) for f in dataclasses.fields(below) if getattr(below, f.name) is not None]
    if alone and not two_sided:
        raise UsageError(f"Expected --{alone[0]} with --two-sided, got it alone; add --two-sided, or leave it out.")
    _prove(given, [claim, *([below] if two_sided else [])], search, Refining(), output)


@app.command()
@with_controller_options
def check(
    proof: Annotated[Path, typer.Argument(help="The file of --keep.", metavar="PROOF")],
    given: Given,
    value: Value = None,
    law: Law = None,
    file: Annotated[
        Path | None, typer.Option(help="The folder of the export in C that the proof is about.", metavar="FOLDER")
    ] = None,
    workers: Workers = 1,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    debug: Debug = False,
) -> None:
    """Check a kept proof: its boxes are bounded anew, without a search."""
    from lyapnet.claims.checking import check as checked
    from lyapnet.claims.checking import labels_of
    from lyapnet.claims.tables import progress_reporter, rows_of, table_of

    given = given.with_functions(value, law)
    controller = given.load()
    computed = None if file is None else load_exported_law(controller, file, given)
    result = checked(controller, proof, workers, progress_reporter(given.report, "check"), computed)
    given.report.rest()
    if as_json:
        print(json.dumps(result, allow_nan=False))
    else:
        title = f"{proof}, {given.title}\n{result['kind']}: {result['verdict']}"
        Console(highlight=False, markup=False).print(table_of(title, rows_of(result, labels_of(result))))
    raise typer.Exit(result["verdict"] != "certified")


def _draw(given: Given, claim: Sampled | Statistical, output: Output) -> None:
    """Establish a claim from sampled states, and record the draw, or say why that is not possible."""
    from lyapnet.claims.certify import certify
    from lyapnet.claims.draws import draws_of

    output.require_writable()
    controller = given.load()
    draws = draws_of(given.checkpoint, given.at, **given.own, radius=claim.radius)
    if isinstance(claim, Statistical):
        claim = replace(claim, draws=1 + draws.others(output.seed, claim.samples))
    given.report(f"closed loops from {claim.samples:,} states of X₀")
    certificate: Any = certify(controller, claim, seed=output.seed)
    certificate.caveat = draws.record(claim.kind, output.seed, claim.samples, certificate.verdict)
    output.show(certificate, given)
    output.write(certificate, given)


def _prove(given: Given, claims: Sequence[Claim], search: Search, refining: Refining, output: Output) -> None:
    """Prove a claim, or both sides of one; with --refine after rounds of training."""
    begun = time.monotonic()
    from lyapnet.claims.certify import certify

    refining.require_fitting(given)
    output.require_writable(refining.keep)
    progress = _progress(given, claims)

    def prove(checkpoint: Path, started: float | None = None) -> Any:
        started, found = started or time.monotonic(), given.of(checkpoint)
        controller = found.load()
        made = [_with_law(each, controller, found) for each in claims]
        certificate = certify(
            controller, *made, budget=search.budget(started), seed=output.seed, keep=refining.keep, report=progress
        )
        output.show(certificate, found)
        return certificate

    if not refining.refine:
        return output.write(prove(given.checkpoint, begun), given)
    from lyapnet.training.refinement import refine

    notes = Console(stderr=True, highlight=False, markup=False)
    checkpoint, certificate = refine(
        given.checkpoint, prove, refining.refine, refining.overrides or [], notes, given.parts()
    )
    return output.write(certificate, given.of(checkpoint))


def _with_law(claim: Claim, controller: Any, given: Given) -> Claim:
    """The claim with the law that its file computes instead of the file."""
    file = getattr(claim, "file", None)
    return claim if file is None else replace(claim, file=load_exported_law(controller, file, given))  # pyright: ignore


def _prove_for_each(
    given: Given, claim: Region, state: str, pushes: Sequence[float], search: Search, output: Output
) -> None:
    """Prove a region for each disturbance of one state, each within --seconds; print a table or JSON, and draw them."""
    from lyapnet.claims.certify import certify
    from lyapnet.claims.disturbances.regions import DisturbedRegions
    from lyapnet.claims.disturbances.tables import table
    from lyapnet.claims.report import write_figure

    output.require_writable()
    controller, progress = given.load(), _progress(given, [claim])
    claims = [replace(claim, disturbance={state: w}) for w in pushes]
    made: list[Any] = [
        certify(controller, each, budget=search.budget(time.monotonic()), seed=output.seed, report=progress)
        for each in claims
    ]
    regions = DisturbedRegions(controller, state, list(pushes), made)
    given.report.rest()
    if output.as_json:
        print(json.dumps(regions.result, allow_nan=False))
    else:
        Console(highlight=False, markup=False).print(table(given.title, regions))
    if output.figure is not None:
        write_figure(regions.figure(), output.figure)
        print_written(output.figure)


def _progress(given: Given, claims: Sequence[Claim]) -> Callable[[Any], None]:
    """A function that reports the progress of a proof."""
    from lyapnet.claims.tables import progress_reporter

    return progress_reporter(given.report, ("two-sided " if len(claims) > 1 else "") + claims[0].kind)

"""lyapnet certify sampled | statistical | sound | region | tube | check."""

import json
import math
import time
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from lyapnet.base.errors import UsageError
from lyapnet.cli.by_kind import ByKind
from lyapnet.cli.claims import (
    AsJson,
    Delta,
    Device,
    Disturbance,
    FigureFile,
    Keep,
    Law,
    Overrides,
    Radius,
    Ray,
    Refine,
    ReportFolder,
    Seconds,
    Seed,
    States,
    TwoSided,
    Value,
    Workers,
    number,
)
from lyapnet.cli.options import Debug, Given, Parameter, of_a_controller
from lyapnet.cli.refining import refined, require_refinable

app = typer.Typer(cls=ByKind)


@app.callback()
def certify() -> None:
    """Certify a controller: on how much of X₀ it keeps its promises, and how sure that is.

    Verdicts: certified, falsified (with a state), unknown. Without the name of a kind, statistical.
    """


@app.command()
@of_a_controller
def sampled(
    given: Given,
    samples: Annotated[int, typer.Option(min=1, help="Initial states to draw.")] = 100,
    radius: Radius = None,
    seed: Seed = 0,
    as_json: AsJson = False,
    figure: FigureFile = None,
    report: ReportFolder = None,
    debug: Debug = False,
) -> None:
    """The share of some states whose closed loop succeeds. It proves no more."""
    from lyapnet.claims.draws import draws_of
    from lyapnet.claims.report import require_writable
    from lyapnet.claims.sampling_certificates import sampled_certificate

    require_writable(figure, report)
    controller = given.load()
    given.report(f"closed loops from {samples:,} states of X₀")
    certificate = sampled_certificate(controller, samples, radius, seed)
    _record(certificate, draws_of(given.checkpoint, given.at, **given.own, radius=radius))
    _show(certificate, given, as_json)
    _write(certificate, given, as_json, figure, report)


@app.command()
@of_a_controller
def statistical(
    given: Given,
    samples: Annotated[int, typer.Option(min=1, help="Initial states to draw.")] = 10_000,
    confidence: Annotated[
        float,
        number(lambda c: 0 < c < 1, "strictly between 0 and 1", "for example 0.999999", "Confidence of the bound."),
    ] = 1 - 1e-6,
    share: Annotated[
        float,
        number(lambda p: 0 < p <= 1, "in (0, 1]", "for example 0.99", "Share of X₀ that the verdict is about."),
    ] = 0.99,
    radius: Radius = None,
    seed: Seed = 0,
    as_json: AsJson = False,
    figure: FigureFile = None,
    report: ReportFolder = None,
    debug: Debug = False,
) -> None:
    """A share of X₀ that succeeds, with a confidence."""
    from lyapnet.claims.draws import draws_of
    from lyapnet.claims.report import require_writable
    from lyapnet.claims.sampling_certificates import statistical_certificate

    require_writable(figure, report)
    controller = given.load()
    draws = draws_of(given.checkpoint, given.at, **given.own, radius=radius)
    made = 1 + draws.others(seed, samples)
    given.report(f"closed loops from {samples:,} states of X₀")
    certificate = statistical_certificate(controller, samples, confidence, share, radius, seed, draws=made)
    _record(certificate, draws)
    _show(certificate, given, as_json)
    _write(certificate, given, as_json, figure, report)


@app.command()
@of_a_controller
def sound(
    given: Given,
    overrides: Overrides = None,
    alpha: Annotated[
        float,
        number(
            lambda a: 0 < a <= 1, "in (0, 1]", "V can pay for no more than the whole running cost",
            "Share of ℓ that V pays for.",
        ),
    ] = 0.95,
    delta: Delta = None,
    states: States = None,
    seconds: Seconds = 60.0,
    workers: Workers = 1,
    ray: Ray = None,
    device: Device = "cpu",
    disturbance: Disturbance = None,
    keep: Keep = None,
    refine: Refine = 0,
    two_sided: TwoSided = False,
    seed: Seed = 0,
    as_json: AsJson = False,
    figure: FigureFile = None,
    report: ReportFolder = None,
    debug: Debug = False,
) -> None:  # fmt: skip
    """A funnel that no closed loop leaves, and its cost: proved."""
    begun = time.monotonic()
    require_refinable(refine, overrides, keep, given)
    if two_sided and (refine or disturbance):
        raise UsageError("Expected --two-sided alone, got --refine or --disturbance; these are about one side.")
    from lyapnet.claims.report import require_writable
    from lyapnet.claims.sound_certificate import parse_set, sound_certificate
    from lyapnet.claims.tables import progress_told_to
    from lyapnet.claims.two_sided_certificate import two_sided_certificate

    if states is not None:
        parse_set(states)
    require_writable(figure, report, keep)
    progress = progress_told_to(given.report, "sound")

    def certified(path: Path, started: float | None = None) -> Any:
        started = started or time.monotonic()
        found = given.of(path)
        controller = found.load()
        made = two_sided_certificate if two_sided else partial(sound_certificate, disturbance=disturbance)
        certificate = made(
            controller, alpha, delta, states, seconds, workers, device,
            keep=keep, seed=seed, report=progress, ray=ray, started=started,
        )  # fmt: skip
        _show(certificate, found, as_json)
        return certificate

    given, certificate = refined(given, certified, refine, overrides, begun)
    _write(certificate, given, as_json, figure, report)


@app.command()
@of_a_controller
def region(
    given: Given,
    overrides: Overrides = None,
    decay: Annotated[
        float | None,
        number(
            lambda d: 0 < d < math.inf, "> 0", "give it in 1/s",
            "λ, at which V(0, ·) has to fall, in 1/s; 1 % of 1/T if none.",
        ),
    ] = None,
    value: Value = None,
    law: Law = None,
    states: States = None,
    seconds: Seconds = 60.0,
    workers: Workers = 1,
    ray: Ray = None,
    device: Device = "cpu",
    disturbance: Annotated[
        list[str] | None,
        typer.Option(
            help="The largest push on the derivative of a state; may be given again. STATE=W,W claims for each W.",
            metavar="STATE=W",
        ),
    ] = None,
    parameter: Parameter = None,
    keep: Keep = None,
    refine: Refine = 0,
    seed: Seed = 0,
    as_json: AsJson = False,
    figure: FigureFile = None,
    report: ReportFolder = None,
    debug: Debug = False,
) -> None:  # fmt: skip
    """A region of attraction of the receding law u(0, x), for ever: proved."""
    begun = time.monotonic()
    require_refinable(refine, overrides, keep, given)
    several = any("," in each for each in disturbance or ())
    if refine and (several or value or law or parameter):
        got = "--parameter" if parameter else "several or --value"
        raise UsageError(f"Expected --refine with one checkpoint and one disturbance, got {got}; drop it.")
    if several and (keep is not None or report is not None or ray is not None):
        raise UsageError("Expected one disturbance with --keep, --report or --ray, got several; name one for each.")
    from lyapnet.claims.disturbances.regions import regions_under_pushes
    from lyapnet.claims.region_certificate import region_certificate
    from lyapnet.claims.report import require_writable
    from lyapnet.claims.sound_certificate import parse_set
    from lyapnet.claims.tables import progress_told_to

    if states is not None:
        parse_set(states)
    require_writable(figure, report, keep)
    given = given.with_functions(value, law)
    options, progress = (decay, states, seconds, workers, device), progress_told_to(given.report, "region")
    if several:
        controller = given.load()
        regions = regions_under_pushes(controller, disturbance or (), *options, seed, progress, parameter)
        return _show_several(regions, given, as_json, figure)

    def certified(path: Path, started: float | None = None) -> Any:
        started, found = started or time.monotonic(), given.of(path)
        controller = found.load()
        made = region_certificate(
            controller, *options, disturbance, keep, seed, progress, parameter, ray=ray, started=started
        )
        _show(made, found, as_json)
        return made

    given, certificate = refined(given, certified, refine, overrides, begun)
    return _write(certificate, given, as_json, figure, report)


@app.command()
@of_a_controller
def tube(
    given: Given,
    radius: Radius = None,
    two_sided: TwoSided = False,
    beta: Annotated[
        float | None,
        number(
            lambda b: 0 < b <= 1, "in (0, 1]", "more than V is no bound from below",
            "With --two-sided: the share of V that bounds the optimum from below; 0.95 if none.",
        ),
    ] = None,
    delta: Delta = None,
    states: States = None,
    seconds: Seconds = 60.0,
    workers: Workers = 1,
    seed: Seed = 0,
    as_json: AsJson = False,
    figure: FigureFile = None,
    report: ReportFolder = None,
    debug: Debug = False,
) -> None:  # fmt: skip
    """Where all closed loops from X₀ go up to T, and what they cost: proved."""
    begun = time.monotonic()
    from lyapnet.claims.report import require_writable
    from lyapnet.claims.sound_certificate import parse_set
    from lyapnet.claims.tables import progress_told_to
    from lyapnet.claims.tubes.certificate import tube_certificate
    from lyapnet.claims.tubes.two_sided import two_sided_tube

    alone = [name for name, value in (("--beta", beta), ("--delta", delta), ("--set", states)) if value is not None]
    if alone and not two_sided:
        raise UsageError(f"Expected {alone[0]} with --two-sided, got it alone; add --two-sided, or leave it out.")
    if states is not None:
        parse_set(states)
    require_writable(figure, report)
    controller = given.load()
    made = partial(tube_certificate, controller)
    if two_sided:
        made = partial(two_sided_tube, controller, 0.95 if beta is None else beta, delta, states)
    progress = progress_told_to(given.report, "two-sided tube" if two_sided else "tube")
    certificate = made(radius, seconds, workers, seed, progress, started=begun)
    _show(certificate, given, as_json)
    _write(certificate, given, as_json, figure, report)


@app.command()
@of_a_controller
def check(
    proof: Annotated[Path, typer.Argument(help="The file of --keep.", metavar="PROOF")],
    given: Given,
    value: Value = None,
    law: Law = None,
    workers: Workers = 1,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Whether a kept proof proves its claim: its leaves are bounded anew, without a search."""
    from lyapnet.claims.checking import check as checked
    from lyapnet.claims.checking import labels_of
    from lyapnet.claims.tables import certificate_table, progress_told_to

    given = given.with_functions(value, law)
    controller = given.load()
    result = checked(controller, proof, workers, progress_told_to(given.report, "check"))
    given.report.rest()
    if as_json:
        print(json.dumps(result, allow_nan=False))
    else:
        table = certificate_table(f"{proof}, {given.title}", result, labels_of(result))
        Console(highlight=False, markup=False).print(table)
    raise typer.Exit(result["verdict"] != "certified")


def _record(certificate: Any, draws: Any) -> None:
    """Take down the draw of a certificate, or have it say why that is not possible."""
    options = certificate.options
    certificate.caveat = draws.record(certificate.kind, options["seed"], options["samples"], certificate.verdict)


def _show(certificate: Any, given: Given, as_json: bool) -> None:
    """The certificate as a table, unless JSON is asked for."""
    from lyapnet.claims.tables import certificate_table

    given.report("comparing with the optimum")
    certificate.result  # noqa: B018  # computed now, where it is told
    given.report.rest()
    if not as_json:
        table = certificate_table(given.title, certificate.result, certificate.labels)
        Console(highlight=False, markup=False).print(table)


def _show_several(regions: Any, given: Given, as_json: bool, figure: Path | None) -> None:
    """Regions under pushes of several sizes as a table or JSON, and their figure."""
    from lyapnet.claims.disturbances.tables import table
    from lyapnet.claims.report import write_figure

    given.report.rest()
    if as_json:
        print(json.dumps(regions.result, allow_nan=False))
    else:
        Console(highlight=False, markup=False).print(table(given.title, regions))
    if figure is not None:
        write_figure(regions.figure(), figure)
        Console(stderr=True, highlight=False, markup=False).print(f"wrote {figure}", soft_wrap=True)


def _write(certificate: Any, given: Given, as_json: bool, figure: Path | None, report: Path | None) -> None:
    """The certificate as JSON, and its figure and report, where they are asked for."""
    from lyapnet.claims.report import write_outputs

    if as_json:
        print(json.dumps(certificate.result, allow_nan=False))
    command = certificate.command(str(given.checkpoint), given.at or [], **given.again)
    if figure is not None or report is not None:
        given.report("drawing and writing")
    for path in write_outputs(certificate, given.checkpoint, command, figure, report):
        given.report.rest()
        Console(stderr=True, highlight=False, markup=False).print(f"wrote {path}", soft_wrap=True)

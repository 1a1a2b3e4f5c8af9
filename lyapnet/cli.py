"""The command line: lyapnet train | evaluate | sweep | certify | compare | bench | systems."""

import json
import sys
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Column, Table

from lyapnet.bench import commands
from lyapnet.comparison.command import compare
from lyapnet.errors import LyapnetError, UsageError
from lyapnet.tables import (
    certificate_table,
    evaluation_table,
    proof_progress,
    robustness_table,
    sweep_table,
    table_over_seeds,
)

app = typer.Typer(
    add_completion=False,
    pretty_exceptions_enable=False,
)
Debug = commands.Debug
Checkpoint = Annotated[Path, typer.Argument(help="A checkpoint of a run.", metavar="CKPT")]


@app.callback(invoke_without_command=True)
def lyapnet(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    """Learn time-varying value functions and Lyapunov functions, and measure what they are worth."""
    if version:
        from lyapnet import __version__

        print(__version__)


@app.command()
def train(
    overrides: Annotated[list[str] | None, typer.Argument(help="Changes to the config, as key.sub=value.")] = None,
    config: Annotated[Path | None, typer.Option(help="The experiment, a YAML file.")] = None,
    resume: Annotated[
        str | None, typer.Option(help="Continue a run: last, or a checkpoint.", metavar="last|PATH")
    ] = None,
    finetune: Annotated[Path | None, typer.Option(help="Start a new run from the weights of a checkpoint.")] = None,
    debug: Debug = False,
) -> None:
    """Train one experiment; python train.py is the same command."""
    from lyapnet.experiment import fit, plan_run  # Lightning takes seconds to import: only where it is needed

    console = Console(highlight=False)
    plan = plan_run(config, overrides or [], resume, finetune)
    if plan.resume_from and plan.run.finished and _reached_end(plan):
        console.print(f"{plan.run.folder} is finished: nothing to resume. Raise training.iterations to train longer.")
        return
    result = fit(plan, console)
    if result:
        _print_result(console, plan, result)


@app.command()
def evaluate(
    checkpoint: Checkpoint,
    samples: Annotated[int, typer.Option(min=1, help="Initial states to draw.")] = 256,
    seed: Annotated[int, typer.Option(min=0, help="Of the draw.")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    optimum: Annotated[bool, typer.Option(help="Compare with the optimum, where there is an oracle.")] = True,
    table: Annotated[Path | None, typer.Option(help="Write a row for each state.", metavar="FILE.csv")] = None,
    figures: Annotated[Path | None, typer.Option(help="Write figures into this folder.", metavar="FOLDER")] = None,
    disturbed: Annotated[
        bool, typer.Option("--robustness", help="Also outside X₀, on other plants, under noise, with half the Δt.")
    ] = False,
    system: Annotated[str | None, typer.Option(help="module:Class of a system of your own.")] = None,
    network: Annotated[str | None, typer.Option(help="module:Class of a network of your own.")] = None,
    debug: Debug = False,
) -> None:
    """Measure a controller on fresh initial states of X₀.

    The optimum of a linear task is Riccati's; that of any other takes the extra lyapnet[oracle], and is computed
    once for each state: the next evaluation of any controller of the task reads it.
    """
    from lyapnet.evaluation import evaluation
    from lyapnet.robustness import robustness

    controller = _load(checkpoint, system, network)
    notes = Console(stderr=True, highlight=False)
    with notes.status("measuring …") as status:
        measured = evaluation(
            controller, samples, seed, optimum, lambda done, total: status.update(f"optimum: {done} of {total} states")
        )
        result = measured.result()
        if disturbed:
            count = min(samples, 64)
            rows = robustness(controller, count, seed, optimum, lambda name: status.update(f"disturbance: {name}"))
            result["robustness"] = [row._asdict() for row in rows]
    if as_json:
        print(json.dumps(result))
    else:
        Console(highlight=False).print(evaluation_table(str(checkpoint), result))
        if disturbed:
            Console(highlight=False).print(robustness_table(result["robustness"], min(samples, 64)))
    if table is not None:
        measured.write(table)
        notes.print(f"wrote {table}", soft_wrap=True)
    if figures is not None:
        notes.print(_write_optimality(figures, measured), soft_wrap=True)


@app.command()
def sweep(
    overrides: Annotated[list[str] | None, typer.Argument(help="Changes to every config, as key.sub=value.")] = None,
    config: Annotated[list[Path] | None, typer.Option(help="An experiment, a YAML file; once or more.")] = None,
    vary: Annotated[str | None, typer.Option(help="A key and its values.", metavar="KEY=VALUE,VALUE,…")] = None,
    workers: Annotated[int, typer.Option(min=1, help="Trainings at a time.")] = 1,
    out: Annotated[
        Path | None, typer.Option(help="Write sweep.csv, and sweep.png with --vary, there.", metavar="FOLDER")
    ] = None,
    debug: Debug = False,
) -> None:
    """Train several configs, or one with several values of a key, and compare.

    What is trained already is taken as it is, and what was stopped goes on:
    the same command again only fills in what is missing.

    lyapnet sweep --config conf/double_integrator.yaml --vary horizon.steps=100,200,300,400
    lyapnet sweep --config conf/reacher.yaml --config conf/cartpole_swingup.yaml seeds=5
    """
    from lyapnet.sweep import points_of, write_csv
    from lyapnet.sweep import sweep as run

    console, notes = Console(highlight=False), Console(stderr=True, highlight=False)
    points = points_of(config or [], vary, overrides or [])
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    with notes.status(f"training {len(points)} runs, {workers} at a time"):
        rows = run(points, workers, partial(notes.print, soft_wrap=True))
    failed = len(points) - len({(row.config, row.value) for row in rows})
    for name in dict.fromkeys(row.config for row in rows):
        console.print(sweep_table(name, [row for row in rows if row.config == name]))
    for name in dict.fromkeys(row.config for row in rows):
        known = [row for row in rows if row.config == name and row.measures["cost_ratio"] is not None]
        if vary and known:
            best = min(known, key=lambda row: row.measures["cost_ratio"] or 0)
            console.print(f"closest to the optimum: {best.key}={best.value}, {best.checkpoint}", soft_wrap=True)
    if out is not None and rows:
        write_csv(rows, out / "sweep.csv")
        if vary:
            from lyapnet import figures

            figures.swept(rows).savefig(out / "sweep.png", dpi=150)
    if failed:
        raise LyapnetError(f"Expected {len(points)} runs, {failed} failed; the same command tries them again.")


@app.command()
def certify(
    checkpoint: Checkpoint,
    overrides: Annotated[
        list[str] | None, typer.Argument(help="With --refine: changes to the config, as key.sub=value.")
    ] = None,
    kind: Annotated[str, typer.Option(help="sampled, statistical or sound.")] = "statistical",
    samples: Annotated[
        int | None, typer.Option(min=1, help="Initial states to draw; 100 for sampled, 10000 for statistical.")
    ] = None,
    confidence: Annotated[float | None, typer.Option(help="Statistical: of the bound; 1 − 1e-6 if none.")] = None,
    share: Annotated[
        float | None, typer.Option(help="Statistical: of X₀, about which the verdict is; 0.99 if none.")
    ] = None,
    radius: Annotated[
        float | None, typer.Option(help="Of success at T, in the norm of x; not asked for if none.")
    ] = None,
    alpha: Annotated[float | None, typer.Option(help="Sound: the share of ℓ that V pays for; 0.95 if none.")] = None,
    delta: Annotated[
        float | None, typer.Option(help="Sound: slack in cost per second; 0.5 % of the mean ℓ on X₀ if none.")
    ] = None,
    states: Annotated[
        str | None, typer.Option("--set", help="Sound: the set D, as lower:upper,…; found if none.")
    ] = None,
    seconds: Annotated[float | None, typer.Option(help="Sound: when to stop undecided; 60 if none.")] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Sound: threads; 1 if none.")] = None,
    keep: Annotated[
        str | None, typer.Option(help="Sound: keep an unfinished proof there, and go on from it.", metavar="FILE")
    ] = None,
    refine: Annotated[
        int, typer.Option(min=0, help="Sound: train on with what failed, so many times at most.", metavar="ROUNDS")
    ] = 0,
    seed: Annotated[int | None, typer.Option(min=0, help="Of the draw; 0 if none.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    figure: Annotated[Path | None, typer.Option(help="Draw the claim.", metavar="FILE")] = None,
    report: Annotated[
        Path | None, typer.Option(help="Write report.md, report.json and the figure there.", metavar="FOLDER")
    ] = None,
    system: Annotated[str | None, typer.Option(help="module:Class of a system of your own.")] = None,
    network: Annotated[str | None, typer.Option(help="module:Class of a network of your own.")] = None,
    debug: Debug = False,
) -> None:
    """Certify a controller: on how much of X₀ it keeps its promises, and how sure that is.

    sampled      the share of some states whose closed loop succeeds
    statistical  a share of X₀ that succeeds, with a confidence
    sound        a funnel that no closed loop leaves, and its cost: proved

    Verdicts: certified, falsified (with a state), unknown.
    """
    from lyapnet import certificates
    from lyapnet.report import require_writable, write_outputs

    options = certificates.options_of(
        kind,
        {
            "samples": samples, "confidence": confidence, "share": share, "radius": radius, "alpha": alpha,
            "delta": delta, "set": states, "seconds": seconds, "workers": workers, "keep": keep, "seed": seed,
        },
    )  # fmt: skip
    if refine and kind != "sound":
        raise UsageError(f"Expected --refine with --kind sound, got --kind {kind}; leave it out.")
    if refine and keep is not None:
        raise UsageError("Expected --keep or --refine, got both; each round proves something about another V.")
    if overrides and not refine:
        raise UsageError(f"Expected overrides with --refine ROUNDS, got {' '.join(overrides)!r}; add it.")
    require_writable(figure, report, keep)
    notes = Console(stderr=True, highlight=False)

    def certified(path: Path) -> certificates.Certificate:
        controller = _load(path, system, network)
        with proof_progress(notes, kind) as progress:
            certificate = certificates.certify(controller, kind, options, progress)
        if not as_json:
            Console(highlight=False).print(certificate_table(str(path), certificate.result))
        return certificate

    if refine:
        from lyapnet.refinement import refine as train_on

        checkpoint, certificate = train_on(checkpoint, certified, refine, overrides or [], notes)
    else:
        certificate = certified(checkpoint)
    if as_json:
        print(json.dumps(certificate.result, allow_nan=False))
    command = certificates.command(str(checkpoint), kind, options, system=system, network=network)
    for path in write_outputs(certificate, checkpoint, command, figure, report):
        notes.print(f"wrote {path}", soft_wrap=True)


app.command()(compare)
app.add_typer(commands.app, name="bench")


@app.command()
def systems(debug: Debug = False) -> None:
    """List the registered systems with their states, controls and parameters."""
    import inspect

    from lyapnet.systems import SYSTEMS

    parameters_column = Column("parameters (default)", overflow="fold")
    table = Table("system", "states", "controls", parameters_column, title="system.name in a config")
    for name, cls in SYSTEMS.items():
        parameters = inspect.signature(cls).parameters.values()
        shown = [p.name if p.default is p.empty else f"{p.name}={p.default}" for p in parameters]
        required = any(p.default is p.empty for p in parameters)
        instance = None if required else cls()
        table.add_row(
            name,
            "any number" if instance is None else ", ".join(instance.state_labels),
            "any number" if instance is None else ", ".join(instance.control_labels),
            ", ".join(shown),
        )
    console = Console(highlight=False)
    console.print(table)
    console.print("A system of your own: system.name=module:Class; see the README.")


def _load(checkpoint: Path, system: str | None, network: str | None) -> Any:
    """The controller of a checkpoint, with a system or network of the user's own where one is named."""
    import torch
    from torch import nn

    from lyapnet.build import build_system, resolve
    from lyapnet.checkpoint import read_checkpoint
    from lyapnet.config import SystemConfig
    from lyapnet.controller import config_of, load
    from lyapnet.networks import NETWORKS

    own = None
    if system is not None:
        parameters = config_of(read_checkpoint(checkpoint), checkpoint).system.parameters
        own = build_system(SystemConfig(name=system, parameters=parameters))
    own_network = None if network is None else resolve(network, NETWORKS, "--network", nn.Module)
    controller = load(checkpoint, system=own, network=own_network)
    torch.set_num_threads(controller.config.training.threads)
    return controller


def _write_optimality(folder: Path, measured: Any) -> str:
    """Draw cost and V(0, x₀) against the optimum; what there is to say about it."""
    from lyapnet import figures

    if measured.result()["cost_ratio"] is None:
        return "No figure optimality.png: there is no optimum to draw against."
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "optimality.png"
    figures.optimality(measured.table).savefig(path, dpi=150)
    return f"wrote {path}"


def main(arguments: list[str] | None = None) -> int:
    """Run a command; the exit status: 0 done or cleanly interrupted, 1 failed, 2 asked wrongly."""
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        return app(arguments or ["--help"], prog_name="lyapnet", standalone_mode=False) or 0
    except Exception as error:  # the outermost frame: one line for the user, whatever happened
        if "--debug" in arguments:
            raise
        line, status = _explain(error)
        print(line, file=sys.stderr)
        return status
    except KeyboardInterrupt:
        print("Interrupted; whatever was saved is kept.", file=sys.stderr)
        return 130


def _explain(error: Exception) -> tuple[str, int]:
    """One line and the exit status for an exception that reached the user."""
    if isinstance(error, LyapnetError):
        status = error.exit_status
        return (f"error: {error}" if status else str(error)), status
    if isinstance(error, typer.TyperException):
        return f"error: {error.format_message().rstrip('.')}. See lyapnet --help.", error.exit_code
    if isinstance(error, OSError):
        return (
            f"error: {error.strerror or error}: {error.filename or 'a file of the run'}; check space and permissions.",
            1,
        )
    message = " ".join(str(error).split())
    return f"error: {type(error).__name__}: {message}; run again with --debug for the traceback.", 1


def _reached_end(plan: Any) -> bool:
    from lyapnet.checkpoint import read_checkpoint

    return read_checkpoint(plan.resume_from)["global_step"] >= plan.config.training.iterations


def _print_result(console: Console, plan: Any, result: dict[str, Any]) -> None:
    title, members = f"{plan.config.experiment}, best checkpoint", plan.run.members(plan.config)
    console.print(
        evaluation_table(title, result) if len(members) == 1 else table_over_seeds(f"{title} of each seed", result)
    )
    best = members[0].best
    for what, command in (
        ("run", plan.run.folder),
        ("watch", f"tensorboard --logdir {plan.config.logs}"),
        ("measure", f"lyapnet evaluate {best}"),
        ("certify", f"lyapnet certify {best}"),
        ("fine-tune", f"{plan.command} --finetune {best}"),
        ("use", f'lyapnet.load("{best}")'),
    ):
        console.print(f"{what:<10}{command}", soft_wrap=True, markup=False)

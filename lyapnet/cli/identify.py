"""lyapnet identify."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from lyapnet.base.errors import UsageError
from lyapnet.cli.options import Debug, make_stages


def identify(
    config: Annotated[Path, typer.Argument(help="The experiment, a YAML file.", metavar="CONFIG")],
    data: Annotated[
        list[str],
        typer.Argument(help="CSV files with t, controls and readings; and changes to the config.", metavar="DATA.csv…"),
    ],
    parameters: Annotated[
        list[str] | None,
        typer.Option(help="Parameters to estimate; else those in system.parameters.", metavar="NAME,NAME,…"),
    ] = None,
    test: Annotated[
        list[Path] | None, typer.Option(help="A file to hold out; may be repeated.", metavar="FILE.csv")
    ] = None,
    held_out: Annotated[
        float | None,
        typer.Option(min=0, max=0.9, help="Share of each file to hold out, at its end; 0.25, or 0 with --test."),
    ] = None,
    family: Annotated[bool, typer.Option("--family", help="Write the ranges as family instead of randomise.")] = False,
    with_residual: Annotated[
        bool,
        typer.Option("--residual", help="Also fit r(x), the effects that the equations lack; it is added if it helps."),
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            help="The YAML file, and the figure beside it; CONFIG_identified.yaml if none.", metavar="FILE.yaml"
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    debug: Debug = False,
) -> None:
    """Estimate parameters of a system from measurements, with confidence intervals, and write a config with them.

    Columns are named like states, outputs and controls; a unit such as [deg] after a name is converted.

    lyapnet identify conf/pendulum_limited.yaml swing.csv --parameters mass,length,damping
    lyapnet identify conf/cartpole_outputs.yaml first.csv second.csv --test third.csv
    """
    overrides = [each for each in data if "=" in each and not Path(each).is_file()]
    files = [Path(each) for each in data if each not in overrides]
    target = config.with_name(f"{config.stem}_identified.yaml") if out is None else out
    if not files:
        raise UsageError("Expected CSV files of measurements after the config, got none; name one or more.")
    if target.suffix not in (".yaml", ".yml") or not target.parent.is_dir() or target.resolve() == config.resolve():
        raise UsageError(
            f"Expected --out as another YAML file in a folder that exists, got {str(target)!r}; choose such a name."
        )
    with make_stages("identify") as report:
        report("importing torch")
        from lyapnet.base.files import write_atomically
        from lyapnet.base.threads import use_threads
        from lyapnet.experiment.config import load_config
        from lyapnet.lab.identification import identify as find
        from lyapnet.lab.identification import read_measurements, system_of
        from lyapnet.lab.identification.figure import measured_and_fitted
        from lyapnet.lab.identification.report import identified_yaml, residual_sentences
        from lyapnet.lab.identification.residual_network import identify_residual, require_equations

        resolved = load_config(config, overrides)
        use_threads(resolved.training.threads)
        system, _ = system_of(resolved)
        if with_residual:
            require_equations(system)
        report("reading data")
        given, held = ([read_measurements(path, system) for path in many] for many in (files, test or []))
        names = [name.strip() for each in parameters or [] for name in each.split(",") if name.strip()]
        found = find(resolved, given, names, held, held_out, report)
        residual = identify_residual(resolved, given, found, held, held_out, report=report) if with_residual else None
        report("writing")
        key = "family" if family else "randomise"
        sources = [path.name for path in files]
        text, note = identified_yaml(config, overrides, resolved, found, target, key, sources, residual)
        write_atomically(target, text.encode())
        picture = target.with_suffix(".png")
        measured_and_fitted(found).savefig(picture, dpi=150)
        report.rest()
    unread = [
        f"{each.name}: columns that are not read: {', '.join(map(repr, each.unread))}" for each in given if each.unread
    ]
    told = [*unread, note, *([] if residual is None else residual_sentences(residual))]
    _tell(found, f"{config.name}, from {', '.join(sources)}", told, as_json, files, residual)
    notes = Console(stderr=as_json, highlight=False, markup=False)
    notes.print(f"wrote {target} and {picture}", soft_wrap=True)


def _tell(found: Any, title: str, notes: list[str], as_json: bool, files: list[Path], residual: Any) -> None:
    """Print tables and sentences, or one JSON object."""
    from lyapnet.lab.identification import report

    if as_json:
        print(json.dumps(report.as_json(found, list(map(str, files)), residual), ensure_ascii=False))
        return
    console = Console(highlight=False, markup=False)
    console.print(report.parameter_table(found, title))
    console.print(report.reading_table(found))
    for line in filter(None, [*notes, *report.sentences(found)]):
        console.print(line, soft_wrap=True)

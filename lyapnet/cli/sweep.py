"""lyapnet sweep."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from lyapnet.base.errors import LyapnetError
from lyapnet.base.sizes import THREADS
from lyapnet.cli.options import Debug, make_stages


def sweep(
    overrides: Annotated[list[str] | None, typer.Argument(help="Changes to every config, as key.sub=value.")] = None,
    config: Annotated[list[Path] | None, typer.Option(help="An experiment, a YAML file; once or more.")] = None,
    vary: Annotated[str | None, typer.Option(help="A key and its values.", metavar="KEY=VALUE,VALUE,…")] = None,
    workers: Annotated[int, typer.Option(min=1, max=THREADS, help="Trainings at a time.")] = 1,
    ray: Annotated[
        str | None, typer.Option(help="Train on the Ray cluster there: auto, local, ray://…", metavar="ADDRESS")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Write sweep.csv, and sweep.png with --vary, there.", metavar="FOLDER")
    ] = None,
    debug: Debug = False,
) -> None:
    """Train several configs, or one with several values of a key, and compare.

    The same command again runs only the trainings that are missing, and continues
    those that were stopped.

    lyapnet sweep --config conf/double_integrator.yaml --vary horizon.steps=100,200,300,400
    lyapnet sweep --config conf/reacher.yaml --config conf/cartpole_swingup.yaml seeds=5
    """
    console = Console(highlight=False, markup=False)
    with make_stages("sweep") as report:
        report("importing torch and Lightning")
        from lyapnet.lab.sweep.points import points_of
        from lyapnet.lab.sweep.runs import sweep as run
        from lyapnet.lab.sweep.runs import sweep_csv
        from lyapnet.lab.sweep.tables import sweep_table

        points = points_of(config or [], vary, overrides or [])
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
        where = f"{workers} at a time" if ray is None else f"on the Ray cluster {ray}"
        report(f"training {len(points)} runs, {where}")
        rows = run(points, workers, partial(report.console.print, soft_wrap=True), ray)
    failed = len(points) - len({(row.config, row.value) for row in rows})
    for name in dict.fromkeys(row.config for row in rows):
        console.print(sweep_table(name, [row for row in rows if row.config == name]))
    for name in dict.fromkeys(row.config for row in rows):
        known = [row for row in rows if row.config == name and row.measures["cost_ratio"] is not None]
        if vary and known:
            best = min(known, key=lambda row: row.measures["cost_ratio"] or 0)
            console.print(f"closest to the optimum: {best.key}={best.value}, {best.checkpoint}", soft_wrap=True)
    if out is not None and rows:
        (out / "sweep.csv").write_text(sweep_csv(rows), encoding="utf-8")
        if vary:
            from lyapnet.lab.sweep.figures import swept

            swept(rows).savefig(out / "sweep.png", dpi=150)
    if failed:
        raise LyapnetError(f"Expected {len(points)} runs, {failed} failed; the same command tries them again.")

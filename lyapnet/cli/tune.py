"""lyapnet tune."""

import importlib.util
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from lyapnet.base.errors import Interrupted, LyapnetError, UsageError
from lyapnet.base.sizes import THREADS
from lyapnet.cli.options import Debug, make_stages


def tune(
    config: Annotated[Path, typer.Argument(help="The experiment, a YAML file.", metavar="CONFIG")],
    overrides: Annotated[list[str] | None, typer.Argument(help="Changes to the config, as key.sub=value.")] = None,
    trials: Annotated[int, typer.Option(min=1, help="Trainings in all.")] = 30,
    vary: Annotated[
        list[str] | None,
        typer.Option(
            help="A key with its range or its values; may be repeated. Standard keys if none.",
            metavar="KEY=LOW..HIGH[:log]|VALUE,VALUE,…",
        ),
    ] = None,
    workers: Annotated[int, typer.Option(min=1, max=THREADS, help="Trainings at a time.")] = 1,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the search; LOGS/EXPERIMENT/tune if none.", metavar="FOLDER")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the proposals.")] = 0,
    final: Annotated[bool, typer.Option(help="Train the best once more, with another seed, and evaluate it.")] = True,
    debug: Debug = False,
) -> None:
    """Search settings with which a config reaches a lower cost, by Optuna.

    The same command continues a search that was stopped; a larger --trials extends it.

    lyapnet tune conf/pendulum_limited.yaml --trials 30 --workers 2
    lyapnet tune conf/reacher.yaml --vary training.learning_rate=1e-4..1e-2:log --vary training.batch_size=16,32,64
    """
    if importlib.util.find_spec("optuna") is None:
        raise UsageError('Expected Optuna for a search, got none; pip install "lyapnet[tune]".')
    with make_stages("tune") as report:
        report(f"importing torch and Lightning for {config}")
        from lyapnet.lab.tuning.search import best_of, open_study, search, task_of, train_anew
        from lyapnet.lab.tuning.tables import final_line
        from lyapnet.training.run_lock import RunLock

        say = partial(report.console.print, soft_wrap=True)
        task = task_of(config, overrides or [], vary or [], out, seed, say)
        task.folder.mkdir(parents=True, exist_ok=True)
        with RunLock(task.folder):
            study = open_study(task, say)
            try:
                report(f"{trials} trials, {workers} at a time")
                search(task, study, trials, workers, say)
            except Interrupted as stop:
                report.rest()
                _show(task, study)
                raise Interrupted(f"{stop} The same command goes on.", stop.exit_status) from None
            report.rest()
            _show(task, study)
            if (best := best_of(study)) is None:
                raise LyapnetError(f"Expected a trial that finishes, got {trials} that did not; see {task.folder}.")
            if final:
                report("final training")
                training = train_anew(task, best, say)
                report.rest()
                Console(highlight=False, markup=False).print(final_line(task, training), soft_wrap=True)


def _show(task: Any, study: Any) -> None:
    """Print the trials, and write them to files."""
    from lyapnet.lab.tuning.search import write_best
    from lyapnet.lab.tuning.tables import search_csv, search_rows, search_table, summary

    console = Console(highlight=False, markup=False)
    if not search_rows(task, study):
        return
    console.print(search_table(task, study))
    (task.folder / "trials.csv").write_text(search_csv(task, study), encoding="utf-8")
    wrote = write_best(task, study)
    for line in summary(task, study):
        console.print(line, soft_wrap=True)
    console.print(f"wrote {task.folder / 'trials.csv'}{f' and {wrote}' if wrote else ''}", soft_wrap=True)

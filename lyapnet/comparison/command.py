"""lyapnet compare: the jobs of a comparison, and its report."""

import importlib.util
import os
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, TextColumn
from rich.text import Text

from lyapnet.errors import LyapnetError, UsageError


def compare(
    overrides: Annotated[list[str] | None, typer.Argument(help="Changes to the config, as key.sub=value.")] = None,
    config: Annotated[Path | None, typer.Option(help="The comparison, a YAML file.")] = None,
    tasks: Annotated[str | None, typer.Option(help="Only these.", metavar="NAME,NAME,…")] = None,
    methods: Annotated[str | None, typer.Option(help="Only these.", metavar="NAME,NAME,…")] = None,
    seeds: Annotated[int | None, typer.Option(min=1, help="Seeds of every method; the config's if none.")] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Jobs at a time; one for each core if none.")] = None,
    ray: Annotated[
        str | None, typer.Option(help="Run the jobs on the Ray cluster there: auto, local, ray://…", metavar="ADDRESS")
    ] = None,
    report: Annotated[bool, typer.Option("--report", help="Only report what is finished.")] = False,
    job: Annotated[
        str | None, typer.Option(help="Run this one job here, and nothing else.", metavar="TASK/METHOD/seed_K")
    ] = None,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Compare lyapnet with PPO and SAC: same tasks, states and evaluator.

    What is finished is taken as it is, and what was stopped goes on: the same
    command again only fills in what is missing, and writes the report anew.

    lyapnet compare --config conf/compare.yaml --workers 2
    lyapnet compare --config conf/compare.yaml --tasks reacher --methods lyapnet,ppo_tuned --seeds 1
    """
    _require_extra()
    from lyapnet.comparison.plan import begun_jobs, job_named, jobs_of, load_comparison
    from lyapnet.comparison.training import require_same, run_job

    if config is None:
        raise UsageError("Expected --config PATH, got none; for example --config conf/compare.yaml.")
    comparison = load_comparison(config, overrides or [])
    console = Console(highlight=False)
    if job is not None:
        run_job(job_named(comparison, job), console)
        return
    jobs = jobs_of(comparison, _names(tasks), _names(methods), seeds)
    for one in begun_jobs(comparison):
        require_same(one)
    missing = [] if report else [one for one in jobs if one.result is None]
    _tell_of_optima(missing, console)
    command = ["compare", "--config", str(config), *(overrides or [])]
    worker = [sys.executable, "-m", "lyapnet", *command, "--job"]
    failed = _run(missing, len(jobs), worker, workers or os.cpu_count() or 1, ray, console)
    _report(comparison, jobs, command, console)
    if failed:
        raise LyapnetError(f"Expected {len(jobs)} jobs, {failed} failed; the same command tries them again.")


def _require_extra() -> None:
    for module in ("gymnasium", "stable_baselines3"):
        if importlib.util.find_spec(module) is None:
            raise UsageError(f"Expected {module} for a comparison, got none; pip install 'lyapnet[baselines]'.")


def _names(listed: str | None) -> list[str] | None:
    return None if listed is None else [name.strip() for name in listed.split(",") if name.strip()]


def _tell_of_optima(jobs: Sequence[Any], console: Console) -> None:
    """A line for each task whose costs will stand alone, before hours are spent on it."""
    from lyapnet.baselines.rl import why_no_optimum

    for job in {job.task: job for job in jobs}.values():
        if (reason := why_no_optimum(job.bounded)) is not None:
            console.print(f"{job.task}: cost without its optimum. {reason}", soft_wrap=True, markup=False)


def _run(
    jobs: Sequence[Any], total: int, command: Sequence[str], workers: int, ray: str | None, console: Console
) -> int:
    """Run the jobs, with a line for each that ends; how many failed."""
    from lyapnet.comparison.workers import run_locally, run_on_ray

    if not jobs:
        return 0
    failed = 0
    with _progress(jobs, total, workers, console) as (begun, ended):
        outcomes = run_locally(jobs, command, workers, begun) if ray is None else run_on_ray(jobs, command, ray, begun)
        for outcome in outcomes:
            failed += bool(outcome.failure)
            ended(outcome)
    return failed


@contextmanager
def _progress(
    jobs: Sequence[Any], total: int, workers: int, console: Console
) -> Iterator[tuple[Callable[[Any], None], Callable[[Any], None]]]:
    """A line for each job that ends, and in a terminal a bar with what runs and the time left."""
    from lyapnet.comparison.workers import seconds_left

    starts: dict[Any, float] = {}
    took: dict[Any, float] = {}
    finished = total - len(jobs)

    def left() -> str:
        now = time.monotonic()
        running = {one: now - start for one, start in list(starts.items())}  # jobs begin while the bar is drawn
        seconds = seconds_left(jobs, running, dict(took), workers)
        return "time left unknown" if seconds is None else f"{_duration(seconds)} left"

    columns = (MofNCompleteColumn(), BarColumn(), TextColumn("{task.description}"), TimeLeft(left))
    bar = Progress(*columns, console=console, disable=not console.is_terminal)
    task = bar.add_task("starting", total=total, completed=finished)

    def begun(job: Any) -> None:
        starts[job] = time.monotonic()
        bar.update(task, description=job.name)

    def ended(outcome: Any) -> None:
        took[outcome.job] = outcome.seconds
        said = f"failed: {outcome.failure}" if outcome.failure else f"done in {_duration(outcome.seconds)}"
        count = finished + len(took)
        console.print(f"{count}/{total}  {outcome.job.name}  {said}; {left()}", soft_wrap=True, markup=False)
        bar.update(task, completed=count)

    console.print(f"{total} jobs, {finished} of them finished", soft_wrap=True)
    with bar:
        yield begun, ended


class TimeLeft(ProgressColumn):
    """What a function says of the time left, each time that the bar is drawn."""

    def __init__(self, left: Callable[[], str]):
        super().__init__()
        self.left = left

    def render(self, task: Any) -> Text:
        return Text(self.left())


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s" if minutes else f"{rest} s"


def _report(comparison: Any, chosen: Sequence[Any], command: Sequence[str], console: Console) -> None:
    """Write and show what all finished jobs say, those beyond the config's number of seeds included."""
    from lyapnet.comparison import layout, tables
    from lyapnet.comparison.plan import begun_jobs, jobs_of
    from lyapnet.comparison.report import write_report
    from lyapnet.comparison.results import with_cold_compilation, with_common_optima
    from lyapnet.comparison.statistics import compared
    from lyapnet.comparison.training import controllers_of

    jobs = list({job.name: job for job in (*jobs_of(comparison), *chosen, *begun_jobs(comparison))}.values())
    finished = [result for job in jobs if (result := job.result) is not None]
    results = with_cold_compilation(with_common_optima(finished))
    if not results:
        console.print("no job is finished: nothing to report", soft_wrap=True)
        return
    planned = [(job.task, job.method, job.seed) for job in jobs]
    wrote = write_report(
        results, comparison.folder / "report", command=shlex.join(["lyapnet", *command]), planned=planned,
        controllers=controllers_of(jobs),
    )  # fmt: skip
    summary = compared(results)
    console.print(layout.terminal(tables.summary(summary)))
    if lacking := len(planned) - len(results):
        console.print(f"{lacking} of {len(planned)} jobs are missing; the same command goes on", soft_wrap=True)
    console.print(f"wrote {wrote[0]} and {len(wrote) - 1} files beside it", soft_wrap=True)

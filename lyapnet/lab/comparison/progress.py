"""The progress of the jobs of a comparison, and an estimate of the time left."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from statistics import fmean
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, TextColumn
from rich.text import Text

from lyapnet.lab.comparison.plan import Job
from lyapnet.lab.comparison.workers import Outcome
from lyapnet.training.stage_messages import StageReport, silent


@contextmanager
def progress(
    jobs: Sequence[Job], total: int, workers: int, console: Console, report: StageReport = silent
) -> Iterator[tuple[Callable[[Job], None], Callable[[Outcome[Job]], None]]]:
    """Prints a line for each job that ends, and in a terminal a bar with the running jobs and the time left.

    Args:
        report: is told what runs.
    """
    starts: dict[Job, float] = {}
    took: dict[Job, float] = {}
    finished = total - len(jobs)

    def left() -> str:
        now = time.monotonic()
        running = {one: now - start for one, start in list(starts.items())}  # a copy, as jobs start in other threads
        seconds = seconds_left(jobs, running, dict(took), workers)
        return "time left unknown" if seconds is None else f"{duration(seconds)} left"

    columns = (MofNCompleteColumn(), BarColumn(), TextColumn("{task.description}", markup=False), TimeLeft(left))
    bar = Progress(*columns, console=console, disable=not console.is_terminal)
    task = bar.add_task("starting", total=total, completed=finished)

    def tell() -> None:
        running = [one.name for one in list(starts) if one not in took]
        report(", ".join(running) or "no job", finished + len(took), total)

    def begun(job: Job) -> None:
        starts[job] = time.monotonic()
        bar.update(task, description=job.name)
        tell()

    def ended(outcome: Outcome[Job]) -> None:
        took[outcome.job] = outcome.seconds
        said = f"failed: {outcome.failure}" if outcome.failure else f"done in {duration(outcome.seconds)}"
        count = finished + len(took)
        console.print(f"{count}/{total}  {outcome.job.name}  {said}; {left()}", soft_wrap=True, markup=False)
        bar.update(task, completed=count)
        tell()

    console.print(f"{total} jobs, {finished} of them finished", soft_wrap=True)
    with bar:
        yield begun, ended


class TimeLeft(ProgressColumn):
    """A column of the bar with the time left, from a function."""

    def __init__(self, left: Callable[[], str]):
        super().__init__()
        self.left = left

    def render(self, task: Any) -> Text:
        return Text(self.left())


def seconds_left(
    jobs: Sequence[Job], begun: Mapping[Job, float], took: Mapping[Job, float], workers: int
) -> float | None:
    """Estimated seconds until all jobs are finished, from those that are; None if this is not possible yet.

    A job takes as long as others of its task and method did, or else of its method, or else of any.

    Args:
        begun: job ↦ how long ago it started.
        took: finished job ↦ seconds.
    """
    if not took:
        return None
    left = 0.0
    for job in jobs:
        if job not in took:
            alike = [s for j, s in took.items() if (j.task, j.method) == (job.task, job.method)]
            alike = alike or [s for j, s in took.items() if j.method == job.method] or list(took.values())
            left += max(0.0, fmean(alike) - begun.get(job, 0.0))
    return left / workers


def duration(seconds: float) -> str:
    """Seconds as text: 2 h 5 min, 3 min 4 s, 7 s."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s" if minutes else f"{rest} s"

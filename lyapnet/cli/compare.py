"""lyapnet compare: the jobs of a comparison, and its report."""

import importlib.util
import os
import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from lyapnet.base.errors import LyapnetError, UsageError
from lyapnet.base.sizes import THREADS
from lyapnet.cli.options import Debug, make_stages
from lyapnet.training.stage_messages import StageMessages, silent


def compare(
    overrides: Annotated[list[str] | None, typer.Argument(help="Changes to the config, as key.sub=value.")] = None,
    config: Annotated[Path | None, typer.Option(help="The comparison, a YAML file.")] = None,
    tasks: Annotated[str | None, typer.Option(help="Only these.", metavar="NAME,NAME,…")] = None,
    methods: Annotated[str | None, typer.Option(help="Only these.", metavar="NAME,NAME,…")] = None,
    seeds: Annotated[int | None, typer.Option(min=1, help="Seeds of every method; the config's if none.")] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, max=THREADS, help="Jobs at a time; one for each core if none.")
    ] = None,
    ray: Annotated[
        str | None, typer.Option(help="Run the jobs on the Ray cluster there: auto, local, ray://…", metavar="ADDRESS")
    ] = None,
    report: Annotated[bool, typer.Option("--report", help="Only report what is finished.")] = False,
    job: Annotated[
        str | None, typer.Option(help="Run this one job here, and nothing else.", metavar="TASK/METHOD/seed_K")
    ] = None,
    debug: Debug = False,
) -> None:
    """Compare lyapnet with PPO, SAC, LQR, iLQR and MPC: same tasks and states.

    The same command again runs only the jobs that are missing, continues those
    that were stopped, and writes the report anew.

    lyapnet compare --config conf/compare.yaml --workers 2
    lyapnet compare --config conf/compare.yaml --tasks reacher --methods lyapnet,ppo_tuned --seeds 1
    """
    _require_extra()
    if config is None:
        raise UsageError("Expected --config PATH, got none; for example --config conf/compare.yaml.")
    console = Console(highlight=False, markup=False)
    with make_stages("compare") as stages:
        stages(f"importing torch and Lightning for {config}")
        from lyapnet.lab.comparison.execution import require_same, run_job
        from lyapnet.lab.comparison.plan import begun_jobs, job_named, jobs_of, load_comparison

        comparison = load_comparison(config, overrides or [])
    if job is not None:
        run_job(job_named(comparison, job), console)
        return
    command = ["compare", "--config", str(config), *(overrides or [])]
    jobs = [replace(one, origin=command) for one in jobs_of(comparison, _names(tasks), _names(methods), seeds)]
    for one in begun_jobs(comparison):
        require_same(one)
    missing = [] if report else [one for one in jobs if not one.finished]
    print_missing_optima(missing, console)
    with make_stages("compare") as stages:
        failed = _run(missing, len(jobs), workers or os.cpu_count() or 1, ray, console, stages)
        _report(comparison, jobs, command, console, stages)
    if failed:
        raise LyapnetError(f"Expected {len(jobs)} jobs, {failed} failed; the same command tries them again.")


def _require_extra() -> None:
    for module in ("gymnasium", "stable_baselines3"):
        if importlib.util.find_spec(module) is None:
            raise UsageError(f"Expected {module} for a comparison, got none; pip install 'lyapnet[baselines]'.")


def _names(listed: str | None) -> list[str] | None:
    return None if listed is None else [name.strip() for name in listed.split(",") if name.strip()]


def print_missing_optima(jobs: Sequence[Any], console: Console) -> None:
    """Print a line for each task without an optimum to compare with, before its jobs run for hours."""
    from lyapnet.lab.comparison.scoring import why_no_optimum

    for job in {job.task: job for job in jobs}.values():
        if (reason := why_no_optimum(job.bounded)) is not None:
            console.print(f"{job.task}: cost without its optimum. {reason}", soft_wrap=True)


def _run(
    jobs: Sequence[Any], total: int, workers: int, ray: str | None, console: Console, stages: StageMessages
) -> int:
    """Run the jobs and show their progress; return how many failed."""
    from lyapnet.lab.comparison.progress import progress
    from lyapnet.lab.comparison.workers import run_jobs

    if not jobs:
        return 0
    failed = 0
    with progress(jobs, total, workers, console, silent if console.is_terminal else stages) as (begun, ended):
        for outcome in run_jobs(jobs, workers, ray, begun):
            failed += bool(outcome.failure)
            ended(outcome)
    stages.rest()
    return failed


def _report(
    config: Any, chosen: Sequence[Any], command: Sequence[str], console: Console, stages: StageMessages
) -> None:
    """Write and print the report of all finished jobs, also of seeds beyond the number in the config."""
    from lyapnet.base.tables import terminal
    from lyapnet.lab.comparison.execution import controllers_of
    from lyapnet.lab.comparison.plan import begun_jobs, jobs_of
    from lyapnet.lab.comparison.report import brief_alternatives, mean_costs, summary, write_report
    from lyapnet.lab.comparison.results import PLANNED, with_cold_compilation, with_common_optima
    from lyapnet.lab.comparison.statistics import compared

    jobs = list({job.name: job for job in (*jobs_of(config, check=False), *chosen, *begun_jobs(config))}.values())
    finished = [result for job in jobs if (result := job.result) is not None]
    results = with_cold_compilation(with_common_optima(finished))
    if not results:
        console.print("no job is finished: nothing to report", soft_wrap=True)
        return
    stages("statistics, figures and tables")
    planned = [(job.task, job.method, job.seed) for job in jobs]
    wrote = write_report(
        results, config.folder / "report", command=shlex.join(["lyapnet", *command]), planned=planned,
        controllers=controllers_of(jobs),
    )  # fmt: skip
    comparison = compared(results)
    stages.rest()
    if (learned := comparison.without(PLANNED)).groups:
        console.print(terminal(summary(learned)))
    if set(PLANNED).intersection(comparison.methods):
        console.print(terminal(brief_alternatives(comparison)))
    if (noisy := mean_costs(comparison)) is not None:
        console.print(terminal(noisy))
    if lacking := len(planned) - len(results):
        console.print(f"{lacking} of {len(planned)} jobs are missing; the same command goes on", soft_wrap=True)
    console.print(f"wrote {wrote[0]} and {len(wrote) - 1} files beside it", soft_wrap=True)

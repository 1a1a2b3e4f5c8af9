"""Runs jobs, each a command, in parallel processes of this machine or on a Ray cluster."""

import contextlib
import os
import signal
import subprocess
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from lyapnet.base.cluster import connect_to_cluster
from lyapnet.base.errors import one_line

LOG = "job.log"
ASKED_EVERY = 1.0  # seconds between checks of whether a running job is given up


class Runnable(ABC):
    """A job: a command, the folder of its output, and whether its work is done."""

    @property
    @abstractmethod
    def name(self) -> str:
        """Its name in messages."""

    @property
    @abstractmethod
    def folder(self) -> Path:
        """The folder of job.log."""

    @property
    @abstractmethod
    def command(self) -> Sequence[str]:
        """The command that does or continues the work; computed when the job starts."""

    @property
    @abstractmethod
    def finished(self) -> bool:
        """Whether the work is done, in addition to the exit status."""

    @property
    def given_up(self) -> bool:
        """Whether to stop the job early; checked while it runs."""
        return False


J = TypeVar("J", bound=Runnable)


@dataclass(frozen=True)
class Outcome(Generic[J]):
    """The outcome of a job."""

    job: J
    seconds: float
    failure: str  # its last message; empty if it was successful


def run_jobs(
    jobs: Sequence[J], workers: int, ray: str | None = None, begun: Callable[[J], Any] = lambda job: None
) -> Iterator[Outcome[J]]:
    """Yield outcomes as jobs end, of `workers` processes at a time, or of the Ray cluster at an address.

    Args:
        begun: called with each job that starts.

    Raises:
        UsageError: Ray is not installed, or there is no cluster at the address.
    """
    return run_locally(jobs, workers, begun) if ray is None else run_on_ray(jobs, ray, begun)


def run_locally(jobs: Sequence[J], workers: int, begun: Callable[[J], Any]) -> Generator[Outcome[J], None, None]:
    """Yield outcomes as jobs end, of `workers` processes at a time; closing the generator stops them.

    Args:
        begun: called with each job that starts.
    """
    processes: list[subprocess.Popen] = []
    stopping = threading.Event()

    def started(process: subprocess.Popen) -> None:
        processes.append(process)
        if stopping.is_set():  # set while the process started
            process.terminate()

    def run(job: J) -> Outcome[J]:
        begun(job)
        return Outcome(job, *run_process(job, started))

    pool = ThreadPoolExecutor(workers)
    waiting = {pool.submit(run, job) for job in jobs}
    try:
        while waiting:
            ended, waiting = wait(waiting, return_when=FIRST_COMPLETED)
            yield from (future.result() for future in ended)
    finally:  # also if the user interrupts: no more jobs are started, and running ones are stopped
        stopping.set()
        pool.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.terminate()
        pool.shutdown()


def run_on_ray(jobs: Sequence[J], address: str, begun: Callable[[J], Any]) -> Iterator[Outcome[J]]:
    """Yield outcomes as jobs end, on a Ray cluster whose machines share this folder; a core for each job.

    Args:
        address: where the cluster is, as for lyapnet.base.cluster.connect_to_cluster.
        begun: called with each job that is handed over.

    Raises:
        UsageError: Ray is not installed, or there is no cluster at the address.
    """
    with connect_to_cluster(address) as ray:
        remote: Any = ray.remote(num_cpus=1, max_retries=0)(_run_in)
        waiting: dict[Any, J] = {}
        for job in jobs:
            begun(job)
            waiting[remote.remote(job, Path.cwd())] = job
        while waiting:
            (ended, *_), _ = ray.wait(list(waiting))
            job = waiting.pop(ended)
            try:
                yield Outcome(job, *ray.get(ended))
            except ray.exceptions.RayError as error:  # a machine was lost; the others continue
                yield Outcome(job, 0.0, one_line(error))


def _run_in(job: Runnable, place: Path) -> tuple[float, str]:
    """run_process in a working directory, in its own process."""
    with contextlib.chdir(place):
        return run_process(job)


def run_process(job: Runnable, started: Callable[[subprocess.Popen], Any] = lambda process: None) -> tuple[float, str]:
    """Run a job on one thread, appending its output to job.log; return seconds, and its last message if it failed."""
    job.folder.mkdir(parents=True, exist_ok=True)
    threads = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    begun, log = time.perf_counter(), job.folder / LOG
    with log.open("ab") as output:
        earlier = output.tell()
        process = subprocess.Popen(job.command, stdout=output, stderr=output, env={**os.environ, **threads})
        started(process)
        status = _status(process, job)
    seconds = time.perf_counter() - begun
    if job.finished:
        return seconds, ""
    words = log.read_bytes()[earlier:].decode(errors="replace").strip().splitlines()
    if status < 0:
        return seconds, f"stopped by {signal.Signals(-status).name}"
    return seconds, words[-1] if words else f"stopped with status {status}"


def _status(process: subprocess.Popen, job: Runnable) -> int:
    """The exit status of the process of a job, which is stopped if the job is given up."""
    while True:
        try:
            return process.wait(ASKED_EVERY)
        except subprocess.TimeoutExpired:
            if job.given_up:
                process.terminate()
                return process.wait()

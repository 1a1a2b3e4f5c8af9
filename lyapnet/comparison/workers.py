"""Jobs side by side: in processes of this machine, or on a Ray cluster. Each is a command of its own."""

import logging
import os
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from lyapnet.comparison.plan import RESULT, Job
from lyapnet.errors import UsageError

LOG = "job.log"


class Outcome(NamedTuple):
    """How a job ended."""

    job: Job
    seconds: float
    failure: str  # its last words; empty where it came to its end


def run_locally(
    jobs: Sequence[Job], command: Sequence[str], workers: int, begun: Callable[[Job], Any]
) -> Iterator[Outcome]:
    """The outcomes as they come, of `workers` processes at a time.

    Args:
        command: what runs a job, but for its name.
        begun: hears of each job that starts.
    """
    processes: list[subprocess.Popen] = []
    stopping = threading.Event()

    def started(process: subprocess.Popen) -> None:
        processes.append(process)
        if stopping.is_set():  # while it started
            process.terminate()

    def run(job: Job) -> Outcome:
        begun(job)
        return Outcome(job, *run_process([*command, job.name], job.folder, started=started))

    pool = ThreadPoolExecutor(workers)
    waiting = {pool.submit(run, job) for job in jobs}
    try:
        while waiting:
            ended, waiting = wait(waiting, return_when=FIRST_COMPLETED)
            yield from (future.result() for future in ended)
    finally:  # also when the user interrupts: nothing more is started, and what runs is told to leave
        stopping.set()
        pool.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.terminate()
        pool.shutdown()


def run_on_ray(
    jobs: Sequence[Job], command: Sequence[str], address: str, begun: Callable[[Job], Any]
) -> Iterator[Outcome]:
    """The outcomes as they come, of a Ray cluster whose machines share this folder; a core for each job.

    Args:
        address: of the cluster, as ray.init takes it: auto, local, or ray://host:port.

    Raises:
        UsageError: Ray is not installed, or there is no cluster at the address.
    """
    try:
        import ray
        from ray.exceptions import RayError
    except ImportError as error:
        raise UsageError("Expected Ray for --ray, got none; pip install 'lyapnet[ray]'.") from error
    _require_listening(address)
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.WARNING)
    except Exception as error:  # ConnectionError, or one of its many own
        line = " ".join(str(error).split())
        raise UsageError(f"Expected a Ray cluster at {address!r}, got {type(error).__name__}: {line}") from error
    remote: Any = ray.remote(num_cpus=1, max_retries=0)(run_process)
    waiting: dict[Any, Job] = {}
    try:
        for job in jobs:
            begun(job)
            waiting[remote.remote([*command, job.name], job.folder.absolute(), Path.cwd())] = job
        while waiting:
            (ended, *_), _ = ray.wait(list(waiting))
            job = waiting.pop(ended)
            try:
                yield Outcome(job, *ray.get(ended))
            except RayError as error:  # a machine was lost: the others go on
                yield Outcome(job, 0.0, " ".join(str(error).split()))
    finally:
        ray.shutdown()


def _require_listening(address: str) -> None:
    """Refuse host:port where nothing listens: ray.init tries for minutes."""
    place = urlsplit(address if "://" in address else f"//{address}")
    if place.hostname and place.port:
        try:
            socket.create_connection((place.hostname, place.port), timeout=5).close()
        except OSError as error:
            raise UsageError(
                f"Expected a Ray cluster at {address!r}, got {error.strerror or error}; run ray start --head there."
            ) from error


def run_process(
    command: Sequence[str],
    folder: Path,
    place: Path | None = None,
    started: Callable[[subprocess.Popen], Any] = lambda process: None,
) -> tuple[float, str]:
    """Run a job's command on one thread, its output appended to job.log; seconds, and its last words if it failed.

    Args:
        folder: of the job, which has a result when it is finished.
        place: the working directory.
    """
    folder.mkdir(parents=True, exist_ok=True)
    threads = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    begun, log = time.perf_counter(), folder / LOG
    with log.open("ab") as output:
        earlier = output.tell()
        process = subprocess.Popen(command, cwd=place, stdout=output, stderr=output, env={**os.environ, **threads})
        started(process)
        status = process.wait()
    seconds = time.perf_counter() - begun
    if (folder / RESULT).is_file():
        return seconds, ""
    words = log.read_bytes()[earlier:].decode(errors="replace").strip().splitlines()
    if status < 0:
        return seconds, f"stopped by {signal.Signals(-status).name}"
    return seconds, words[-1] if words else f"stopped with status {status}"


def seconds_left(
    jobs: Sequence[Job], begun: Mapping[Job, float], took: Mapping[Job, float], workers: int
) -> float | None:
    """How long the jobs that are not finished will take, from those that are; None while nothing tells.

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

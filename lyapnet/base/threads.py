"""Division of work over threads, and its CPU seconds."""

import functools
import os
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

Part = TypeVar("Part")
Result = TypeVar("Result")
CORES = torch.get_num_threads()  # torch's number at import: cores of the machine, or OMP_NUM_THREADS
_this = threading.local()  # for each thread: is_worker, and waited, the seconds for which it waited for its workers
_of_programs: int | None = None  # number of threads of compiled programs; None: that of torch


def use_threads(count: int | None) -> None:
    """Compute on a number of threads; None: on all CORES, but torch's own operations on one.

    In small networks several threads of torch mostly wait for each other; those of compiled programs do not.
    """
    global _of_programs
    torch.set_num_threads(count or 1)
    _of_programs = CORES if count is None else None


def in_threads(function: Callable[[Part], Result], parts: Sequence[Part]) -> list[Result]:
    """The results for several parts in their order, on the number of threads of `use_threads`.

    This is faster for compiled programs, which release Python's lock. If a function divides its own part again, it uses
    only its own thread.
    """
    count = min(_of_programs or torch.get_num_threads(), len(parts))
    if count < 2 or getattr(_this, "is_worker", False):
        return [function(part) for part in parts]

    def run(part: Part) -> tuple[Result, float]:
        began, _this.is_worker = time.thread_time(), True
        with torch.no_grad():  # each thread has its own grad mode
            return function(part), time.thread_time() - began

    done = list(_workers(count, os.getpid()).map(run, parts))
    _this.waited = getattr(_this, "waited", 0.0) + sum(seconds for _, seconds in done) / count
    return [result for result, _ in done]


def size_of_parts(rows: int, least: int) -> int:
    """The smallest size, of at least a number of rows, in which all parts of a batch are equally large."""
    return next((size for size in range(min(least, rows), rows) if not rows % size), rows)


def seconds_of_work() -> float:
    """CPU seconds of this thread, plus those of its workers divided by their number; they limit all searches.

    Seconds in which other programs use the machine do not count.
    """
    return time.thread_time() + getattr(_this, "waited", 0.0)


@functools.lru_cache(maxsize=4)
def _workers(count: int, process: int) -> ThreadPoolExecutor:
    """The threads of a process; a forked process needs its own."""
    return ThreadPoolExecutor(count, thread_name_prefix=f"lyapnet-{process}")

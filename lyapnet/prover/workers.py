"""Bounds boxes in parallel, by processes or on a cluster; Python's threads would wait for each other."""

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils._pytree import tree_map_only

from lyapnet.base.cluster import connect_to_cluster
from lyapnet.base.errors import LyapnetError, UsageError, one_line
from lyapnet.base.threads import use_threads
from lyapnet.prover.boxes import Boxes

Bounding = Callable[[Boxes], tuple[Boxes, Tensor]]

START_TIMEOUT = 120  # seconds until all workers of a cluster have started

_question: list[Any] = []  # in a worker process: its copy of the question, as the only element


@contextmanager
def _worker_pool(question: Any, workers: int) -> Iterator[ProcessPoolExecutor | None]:
    """A pool of processes with a copy of the question each; None for one worker, or if processes cannot be forked."""
    if workers == 1 or "fork" not in multiprocessing.get_all_start_methods():
        yield None
        return
    context = multiprocessing.get_context("fork")
    with ProcessPoolExecutor(workers, context, initializer=_start_worker, initargs=(question,)) as pool:
        try:
            yield pool
        except BrokenProcessPool as error:
            raise UsageError(
                "Expected all workers to finish, got one that was killed; choose fewer --workers."
            ) from error


@contextmanager
def workers_for_boxes(
    question: Any, workers: int, ray: str | None = None, make_question: Callable[[], Any] | None = None
) -> Iterator[Callable[[Bounding, Iterable[Boxes]], Iterable[Any]]]:
    """A parallel `map` of question.find_undecided over chunks of boxes.

    The workers are copies of this process, made at the beginning. They have the question as it was then, except for its
    `level`, which is sent with each chunk. A single worker is this process itself; so is it where processes cannot be
    forked.

    Args:
        ray: address of a Ray cluster whose cores bound the boxes, instead of this machine.
        make_question: makes the question on a machine of the cluster.

    Raises:
        UsageError: a worker was killed, perhaps for lack of memory, or the cluster does not answer.
    """
    if ray is not None:
        with connect_to_cluster(ray) as cluster, _cluster_map(cluster, make_question, workers) as run:
            yield partial(_find_undecided_in_parallel, run, question)
        return
    with _worker_pool(question, workers) as pool:
        yield (
            map if pool is None else partial(_find_undecided_in_parallel, partial(pool.map, _find_undecided), question)
        )


@contextmanager
def _cluster_map(cluster: Any, make_question: Any, workers: int) -> Iterator[Callable[[Iterable[Any]], Iterable[Any]]]:
    """A `map` of _find_undecided on a cluster; its machines import modules from the same paths as this one."""
    cores = int(cluster.cluster_resources().get("CPU", 0))
    if workers > cores:
        raise UsageError(f"Expected at most the {cores} cores of the cluster, got --workers {workers}; ask for fewer.")
    places = {"PYTHONPATH": os.pathsep.join([str(Path.cwd()), *filter(None, sys.path)])}
    worker = cluster.remote(num_cpus=1, runtime_env={"env_vars": places})(ClusterWorker)
    actors = [worker.remote() for _ in range(workers)]
    try:
        cluster.get(
            [each.start.remote(make_question, torch.get_default_dtype()) for each in actors], timeout=START_TIMEOUT
        )
        pool = cluster.util.ActorPool(actors)
        yield lambda arguments: map(
            _copy_arrays, pool.map(lambda each, what: each.find_undecided.remote(what), arguments)
        )
    except cluster.exceptions.GetTimeoutError as error:
        raise UsageError(
            f"Expected {workers} free cores of the cluster within {START_TIMEOUT} s, got fewer; choose fewer --workers."
        ) from error
    except cluster.exceptions.RayError as error:
        if isinstance(cause := getattr(error, "cause", None), LyapnetError):
            raise cause from None
        raise UsageError(
            f"Expected the workers of the cluster to finish, got {one_line(error)}; see its logs."
        ) from error


class ClusterWorker:
    """A worker on another machine."""

    def start(self, make_question: Callable[[], Any], default: torch.dtype) -> None:
        use_threads(1)
        torch.set_default_dtype(default)
        _question[:] = [make_question()]

    def find_undecided(self, arguments: tuple[Any, ...]) -> tuple[Any, ...]:
        return _find_undecided(_copy_arrays(arguments))


def _copy_arrays(data: Any) -> Any:
    """Copy arrays, because those that Ray passes are read-only."""
    return tree_map_only(np.ndarray, np.copy, data)


@contextmanager
def workers_for_calls(question: Any, workers: int) -> Iterator[Callable[[list[tuple[Any, ...]]], Iterable[Any]]]:
    """A parallel `map` of question.enclose over tuples of arguments, by local workers as in `workers_for_boxes`.

    Raises:
        UsageError: a worker was killed, perhaps for lack of memory.
    """
    with _worker_pool(question, workers) as pool:
        if pool is None:
            yield lambda arguments: (question.enclose(*each) for each in arguments)
        else:
            yield lambda arguments: map(_as_tensors, pool.map(_enclose, map(_as_arrays, arguments)))


def _enclose(arguments: Any) -> Any:
    """In a worker: question.enclose, from arrays to arrays."""
    (question,) = _question
    with torch.no_grad():
        return _as_arrays(question.enclose(*_as_tensors(arguments)))


def _as_arrays(data: Any) -> Any:
    return tree_map_only(Tensor, lambda part: part.numpy(), data)


def _as_tensors(data: Any) -> Any:
    return tree_map_only(np.ndarray, torch.from_numpy, data)


def _find_undecided_in_parallel(
    run: Callable[[Iterable[Any]], Iterable[Any]], question: Any, _: Bounding, chunks: Iterable[Boxes]
) -> Iterator[tuple[Boxes, Tensor]]:
    """question.find_undecided of each chunk; `run` maps _find_undecided over tuples (level, arrays of the boxes)."""
    arguments = [(question.level, *(part.numpy() for part in chunk)) for chunk in chunks]
    for *parts, axis in run(arguments):
        yield Boxes(*map(torch.from_numpy, parts)), torch.from_numpy(axis)


def _start_worker(question: Any) -> None:
    """In a worker: use one thread, leave Ctrl-C to the parent process, and end with it."""
    use_threads(1)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    _question[:] = [question]


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _find_undecided(arguments: tuple[Any, ...]) -> tuple[Any, ...]:
    """In a worker: question.find_undecided, from arrays to arrays."""
    (question,), (level, *parts) = _question, arguments
    question.level = level
    boxes, axis = question.find_undecided(Boxes(*map(torch.from_numpy, parts)))
    return (*(part.numpy() for part in boxes), axis.numpy())

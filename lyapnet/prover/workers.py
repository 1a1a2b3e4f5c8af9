"""Processes, or cores of a cluster, that bound boxes side by side: threads of one process wait for each other."""

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

from lyapnet.base.cluster import connected
from lyapnet.base.errors import LyapnetError, UsageError, one_line
from lyapnet.prover.boxes import Boxes

Bounding = Callable[[Boxes], tuple[Boxes, Tensor]]

PATIENCE = 120  # seconds, in which cores of a cluster are free and have begun

_own: list[Any] = []  # of a worker: the question that it was begun with


@contextmanager
def _copies(question: Any, workers: int) -> Iterator[ProcessPoolExecutor | None]:
    """So many copies of this process that have a question; None where there is one, or none can be made."""
    if workers == 1 or "fork" not in multiprocessing.get_all_start_methods():
        yield None
        return
    context = multiprocessing.get_context("fork")
    with ProcessPoolExecutor(workers, context, initializer=_begin, initargs=(question,)) as pool:
        try:
            yield pool
        except BrokenProcessPool as error:
            raise UsageError("Expected workers that live on, got one killed; choose fewer --workers.") from error


@contextmanager
def bounding(
    question: Any, workers: int, ray: str | None = None, make_question: Callable[[], Any] | None = None
) -> Iterator[Callable[[Bounding, Iterable[Boxes]], Iterable[Any]]]:
    """A `map` of question.undecided over chunks of boxes, by so many processes, copies of this one.

    They see the question as it was at the beginning, and its `level` as it is. One worker is this process itself, and
    so it is where processes cannot be copied.

    Args:
        ray: the address of a cluster of which so many cores bound boxes, in place of this machine.
        make_question: makes it there.

    Raises:
        UsageError: a worker was killed, of too little memory perhaps, or there is no such cluster.
    """
    if ray is not None:
        with connected(ray) as cluster, _on_cluster(cluster, make_question, workers) as ask:
            yield partial(_shared_out, ask, question)
        return
    with _copies(question, workers) as pool:
        yield map if pool is None else partial(_shared_out, partial(pool.map, _undecided), question)


@contextmanager
def _on_cluster(cluster: Any, make_question: Any, workers: int) -> Iterator[Callable[[Iterable[Any]], Iterable[Any]]]:
    """A `map` of _undecided by cores of a cluster, whose machines find modules where this one does."""
    cores = int(cluster.cluster_resources().get("CPU", 0))
    if workers > cores:
        raise UsageError(f"Expected at most the {cores} cores of the cluster, got --workers {workers}; ask for fewer.")
    places = {"PYTHONPATH": os.pathsep.join([str(Path.cwd()), *filter(None, sys.path)])}
    worker = cluster.remote(num_cpus=1, runtime_env={"env_vars": places})(ClusterWorker)
    them = [worker.remote() for _ in range(workers)]
    try:
        cluster.get([each.begin.remote(make_question, torch.get_default_dtype()) for each in them], timeout=PATIENCE)
        pool = cluster.util.ActorPool(them)
        yield lambda asked: map(_own_copy, pool.map(lambda each, what: each.undecided.remote(what), asked))
    except cluster.exceptions.GetTimeoutError as error:
        raise UsageError(
            f"Expected {workers} free cores of the cluster within {PATIENCE} s, got fewer; ask for fewer --workers."
        ) from error
    except cluster.exceptions.RayError as error:
        if isinstance(cause := getattr(error, "cause", None), LyapnetError):
            raise cause from None
        raise UsageError(f"Expected workers of the cluster that live on, got {one_line(error)}") from error


class ClusterWorker:
    """A worker on another machine."""

    def begin(self, make_question: Callable[[], Any], default: torch.dtype) -> None:
        torch.set_num_threads(1)
        torch.set_default_dtype(default)
        _own[:] = [make_question()]

    def undecided(self, asked: tuple[Any, ...]) -> tuple[Any, ...]:
        return _undecided(_own_copy(asked))


def _own_copy(data: Any) -> Any:
    """Arrays that may be written to, of those that a cluster shares."""
    return tree_map_only(np.ndarray, np.copy, data)


@contextmanager
def answering(question: Any, workers: int) -> Iterator[Callable[[list[tuple[Any, ...]]], Iterable[Any]]]:
    """question.of(*asked) for each of a list of arguments, by so many processes, copies of this one; as `bounding`.

    Raises:
        UsageError: a worker was killed, of too little memory perhaps.
    """
    with _copies(question, workers) as pool:
        if pool is None:
            yield lambda asked: (question.of(*each) for each in asked)
        else:
            yield lambda asked: map(_as_tensors, pool.map(_answer, map(_as_arrays, asked)))


def _answer(asked: Any) -> Any:
    """The answer of a worker's question, as arrays."""
    (question,) = _own
    with torch.no_grad():
        return _as_arrays(question.of(*_as_tensors(asked)))


def _as_arrays(data: Any) -> Any:
    return tree_map_only(Tensor, lambda part: part.numpy(), data)


def _as_tensors(data: Any) -> Any:
    return tree_map_only(np.ndarray, torch.from_numpy, data)


def _shared_out(
    ask: Callable[[Iterable[Any]], Iterable[Any]], question: Any, _: Bounding, chunks: Iterable[Boxes]
) -> Iterator[tuple[Boxes, Tensor]]:
    asked = [(question.level, *(part.numpy() for part in chunk)) for chunk in chunks]
    for *parts, axis in ask(asked):
        yield Boxes(*map(torch.from_numpy, parts)), torch.from_numpy(axis)


def _begin(question: Any) -> None:
    """Become a worker: one thread, and nothing to do with signals, which are for the process that asks; end with it."""
    torch.set_num_threads(1)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    _own[:] = [question]


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _undecided(asked: tuple[Any, ...]) -> tuple[Any, ...]:
    """What is undecided of boxes, as arrays."""
    (question,), (level, *parts) = _own, asked
    question.level = level
    boxes, axis = question.undecided(Boxes(*map(torch.from_numpy, parts)))
    return (*(part.numpy() for part in boxes), axis.numpy())

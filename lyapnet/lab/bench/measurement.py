"""Seconds, memory and error of the routes on one task and batch, in one run."""

import gc
import os
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

from torch import Tensor
from torch.profiler import ProfilerActivity, profile

from lyapnet.base import threads as base_threads
from lyapnet.base.types import State
from lyapnet.lab.bench.accuracy import reference_gradient, relative_error
from lyapnet.lab.bench.arithmetic import GRADIENT_FACTOR, multiply_adds, peak_rate
from lyapnet.lab.bench.cases import Case
from lyapnet.lab.bench.routes import JAX_ROUTES, entries, timed


@dataclass(frozen=True)
class BenchRow:
    """One route on one task and batch, a row of `lyapnet bench --json`."""

    task: str
    states: int  # n
    batch: int
    route: str
    compiled: bool
    dtype: str
    seconds: float  # median time of one loss with its gradient, or of the closed loop alone for route rollout
    steps_per_second: float  # environment steps: batch · N / seconds
    peak_bytes: int | None  # beyond the model; None: not torch's memory
    relative_error: float | None  # ‖gradient − reference‖ / ‖reference‖; None: no gradient
    peak_share: float  # multiply-adds per second that V and V_x need, and their gradient, relative to `peak_rate`
    compile_seconds: float | None  # to trace, and to compile or load from disk; None: nothing is compiled


def time_routes(
    case: Case, batch: int, routes: Sequence[str], repeats: int, say: Callable[[str], Any]
) -> list[BenchRow]:
    """A row for each route as written and compiled; after a first call they are timed in turns, `repeats` times each.

    Args:
        case, batch, routes, repeats: what is measured.
        say: called with the reason if compiled rows are left out.

    Raises:
        DivergenceError: the closed loop of the random V is not finite.
    """
    x0 = case.sample(batch)
    ready = list(entries(case, x0, routes, say))
    gradients = [entry.flat and entry.flat(entry.run()) for entry in ready]  # this first call also fills the caches
    errors = _errors(gradients, case, x0)
    peaks = [None if entry.route in JAX_ROUTES else peak_bytes(entry.run) for entry in ready]
    turns = [[timed(entry.run)[1] for entry in ready] for _ in range(repeats)]
    least = batch * multiply_adds(case) / peak_rate(x0.dtype)  # seconds at the machine's peak
    rows = []
    for entry, error, peak, times in zip(ready, errors, peaks, zip(*turns, strict=True), strict=True):
        seconds = statistics.median(times)
        rows.append(
            BenchRow(
                case.name, case.problem.system.n, batch, entry.route, entry.compiled, case.config.training.precision,
                seconds, batch * case.problem.horizon.steps / seconds, peak, error,
                (GRADIENT_FACTOR if entry.flat else 1) * least / seconds, entry.compile_seconds,
            )
        )  # fmt: skip
    return rows


def _errors(gradients: Sequence[Tensor | None], case: Case, x0: State) -> list[float | None]:
    if all(gradient is None for gradient in gradients):
        return [None] * len(gradients)
    reference = reference_gradient(case, x0)
    return [None if gradient is None else relative_error(gradient, reference) for gradient in gradients]


def use_threads(threads: int) -> None:
    """Set the number of CPU threads of torch, and of JAX if it has not computed yet."""
    base_threads.use_threads(threads)
    os.environ["NPROC"] = str(threads)


def peak_bytes(run: Callable[[], Any]) -> int:
    """The largest increase of torch's CPU memory during a call, in bytes.

    torch's profiler records all requests to torch's allocator, by eager code, autograd and compiled code. It does not
    see memory that kernels such as MKL allocate themselves.
    """
    os.environ.setdefault("KINETO_LOG_LEVEL", "99")  # or the profiler writes to the terminal
    gc.collect()
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as recording:
        run()
    results: Any = getattr(recording.profiler, "kineto_results", None)
    events = [event for event in results.events() if event.name() == "[memory]"]
    changes = [event.nbytes() for event in sorted(events, key=lambda event: event.start_ns())]
    return max(accumulate(changes), default=0)

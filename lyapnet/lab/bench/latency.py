"""Time for one control in a loop of 1 kHz: in exported C, and in Python."""

import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lyapnet.base.errors import ExportError
from lyapnet.base.random_streams import TEST, stream
from lyapnet.controller.controller import Controller
from lyapnet.exchange.export import export
from lyapnet.exchange.export.c import FAST, CompiledLaw, compile_c
from lyapnet.exchange.export.law import Law
from lyapnet.exchange.export.verification import points
from lyapnet.graphs.c_text import literal

RATE = 1000  # controls per second
STATES = 1000  # number of states whose controls are computed in turn
LOOPS = 64  # number of closed loops from which these states are taken
NATIVE = "-O3 -march=native"  # options that not every compiler supports
OPTIMISED = {"C, -O2": "-O2", "C, -O3": "-O3", f"C, {NATIVE}": NATIVE, "  core kept awake": f"{NATIVE} -DAWAKE"}
LOOP = """#define _POSIX_C_SOURCE 200112L
#include <stdio.h>
#include <time.h>
#include "policy.h"

static const double states[{states}][{width}] = {{{table}}};

int main(void)
{{
    double u[LYAPNET_CONTROLS];
    struct timespec next, before, after;
    clock_gettime(CLOCK_MONOTONIC, &next);
    for (long k = 0; k < {count}; k++) {{
        next.tv_nsec += {period};
        if (next.tv_nsec >= 1000000000) {{ next.tv_nsec -= 1000000000; next.tv_sec++; }}
#ifdef AWAKE
        do clock_gettime(CLOCK_MONOTONIC, &after);
        while (after.tv_sec < next.tv_sec || (after.tv_sec == next.tv_sec && after.tv_nsec < next.tv_nsec));
#else
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &next, NULL);
#endif
        const double *z = states[k % {states}];
        clock_gettime(CLOCK_MONOTONIC, &before);
        lyapnet_control(z[0], {given}, u);
        clock_gettime(CLOCK_MONOTONIC, &after);
        double seconds = (double)(after.tv_sec - before.tv_sec) + 1e-9 * (double)(after.tv_nsec - before.tv_nsec);
        printf("%.3f\\n", 1e6 * seconds);
    }}
    return 0;
}}
"""

Policy = Callable[[float, NDArray], NDArray]  # t, x (n,) ↦ u (m,)


@dataclass(frozen=True)
class Latency:
    """The time for one control in one way, in microseconds."""

    way: str
    calls: int
    median: float
    most: float  # the 99.9th percentile
    worst: float


def latencies(controller: Controller, seconds: float, others: Mapping[str, Policy] | None = None) -> list[Latency]:
    """The time for u in C, compiled in Python, and by `Controller.policy`, each measured for some seconds.

    Between two calls the process sleeps, so that caches and the core are cold at each; "core kept awake" waits by
    looking at the clock, as a loop on a core of its own would. Where the compiler has no -march=native, two rows less.

    Args:
        others: further ways, which are asked along closed loops of the controller, one after another.

    Raises:
        ExportError: the law cannot be written in C; or there is no compiler.
    """
    count = max(1, round(seconds * RATE))
    t, x = (
        column[:: max(1, len(column) // STATES)][:STATES].double().cpu().numpy() for column in points(controller)[:2]
    )
    t = np.minimum(t, controller.horizon.duration)
    found = []
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        export(controller, folder / "law", "c")
        (folder / "law" / "loop.c").write_text(_loop(controller, t, x, count))
        for way, options in OPTIMISED.items():
            try:
                found.append(_summary(way, _in_c(folder / "law", options)))
            except ExportError:
                if NATIVE not in options:
                    raise
        fast = CompiledLaw(folder / "law", Law(controller), controller.system.m, FAST)
    for way, policy in (("Python, compiled", fast.policy), ("Python", controller.policy)):
        found.append(_summary(way, _in_python(policy, t, x, count)))
    if others:
        t, x = _along_loops(controller)
        found += [_summary(way, _in_python(policy, t, x, count)) for way, policy in others.items()]
    return found


def _along_loops(controller: Controller) -> tuple[NDArray, NDArray]:
    """(t, x) of closed loops at their steps, one loop after another."""
    x0 = controller.initial_states.sample(LOOPS, stream(0, TEST, 2)).to(controller.initial_states.lower)
    loops = controller.rollout(x0)
    t, x = loops.t[:-1].double().cpu().numpy(), loops.x[:-1].double().cpu().numpy()
    return np.tile(t, x.shape[1]), x.transpose(1, 0, 2).reshape(-1, x.shape[2])


def _loop(controller: Controller, t: NDArray, x: NDArray, count: int) -> str:
    """The text of a C program that prints the microseconds of each call."""
    table = np.concatenate([t[:, None], x], 1)
    rows = ",\n    ".join("{" + ", ".join(map(literal, row)) + "}" for row in table.tolist())
    constants = len(controller.system.constants)
    given = "z + 1" if not constants else f"z + 1, z + {1 + x.shape[1] - constants}"
    return LOOP.format(
        states=len(table), width=table.shape[1], table=rows, count=count, period=10**9 // RATE, given=given
    )


def _in_c(folder: Path, options: str) -> NDArray:
    program = folder / "loop"
    compile_c([folder / "loop.c", folder / "policy.c"], program, ["-std=c99", *options.split()])
    printed = subprocess.run([str(program)], check=True, capture_output=True, text=True).stdout
    return np.array(printed.split(), dtype=np.float64)


def _in_python(policy: Policy, t: NDArray, x: NDArray, count: int) -> NDArray:
    """As many calls as fit into the time, up to a largest number."""
    taken, following = list[float](), time.perf_counter()
    end = following + count / RATE
    while len(taken) < count and following < end:
        following = max(following + 1 / RATE, time.perf_counter())
        time.sleep(max(0.0, following - time.perf_counter()))
        k, started = len(taken) % len(t), time.perf_counter()
        policy(t[k], x[k])
        taken.append(1e6 * (time.perf_counter() - started))
    return np.array(taken)


def _summary(way: str, microseconds: NDArray) -> Latency:
    median, most = np.quantile(microseconds, (0.5, 0.999)).tolist()
    return Latency(way, len(microseconds), median, most, float(microseconds.max()))

"""How long one control takes: of one state at a time, on one thread."""

import contextlib
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyapnet.comparison.environments import Episodes
from lyapnet.comparison.reference_problems import BoundedProblem
from lyapnet.comparison.results import ControlTimes
from lyapnet.controller import Controller
from lyapnet.errors import LyapnetError
from lyapnet.export import compiled
from lyapnet.types import State

CALLS = 1000


def times_of_policy(policy: Any, bounded: BoundedProblem, observe_time: bool, x0: State) -> ControlTimes:
    """Of a policy with SB3's `predict`, at t = 0 of each of x₀ in turn."""
    episodes = Episodes(bounded, observe_time)
    episodes.start(x0)
    observations = episodes.observation

    def ask(k: int) -> None:
        policy.predict(observations[k % len(observations)][None], deterministic=True)

    return _times(ask)


def times_of_controller(controller: Controller, x0: State) -> ControlTimes:
    """Of a learned law, as machine code where there is a compiler for it, else as it is in Python."""
    law: Callable[..., NDArray] = controller.policy
    with contextlib.suppress(LyapnetError):  # where there is no compiler, or the law has no C
        law = compiled(controller).policy
    states, times = x0.double().cpu().numpy(), np.linspace(0, controller.horizon.duration, CALLS, endpoint=False)
    return _times(lambda k: law(times[k], states[k % len(states)]))


def _times(ask: Callable[[int], Any]) -> ControlTimes:
    ask(0)  # what is done but once is not counted
    taken = []
    for k in range(CALLS):
        began = time.perf_counter()
        ask(k)
        taken.append(time.perf_counter() - began)
    return ControlTimes.of(taken)

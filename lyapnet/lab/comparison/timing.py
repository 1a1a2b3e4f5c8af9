"""The time for one control, for one state at a time on one thread."""

import contextlib
import importlib.util
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyapnet.base.errors import LyapnetError, UsageError
from lyapnet.base.types import State
from lyapnet.controller.controller import Controller
from lyapnet.exchange.export import compiled
from lyapnet.lab.comparison.environments import Episodes
from lyapnet.lab.comparison.planners import planner_of
from lyapnet.lab.comparison.planners.planner import LoopLaw
from lyapnet.lab.comparison.reference_problems import BoundedProblem
from lyapnet.lab.comparison.results import ControlTimes

CALLS = 1000


def times_of_policy(policy: Any, bounded: BoundedProblem, observe_time: bool, x0: State) -> ControlTimes:
    """The latency of a policy with SB3's `predict`, at t = 0 for each of x₀ in turn."""
    episodes = Episodes(bounded, observe_time)
    episodes.start(x0)
    observations = episodes.observation

    def ask(k: int) -> None:
        policy.predict(observations[k % len(observations)][None], deterministic=True)

    return _times(ask)


def times_of_controller(controller: Controller, x0: State) -> ControlTimes:
    """The latency of a learned law, as machine code if there is a compiler, else in Python."""
    law: Callable[..., NDArray] = controller.policy
    with contextlib.suppress(LyapnetError):  # if there is no compiler, or no C for the law
        law = compiled(controller).policy
    states, times = x0.double().cpu().numpy(), np.linspace(0, controller.horizon.duration, CALLS, endpoint=False)
    return _times(lambda k: law(times[k], states[k % len(states)]))


def alternatives(controller: Controller) -> dict[str, Callable[[float, NDArray], NDArray]]:
    """What else could be asked for u(t, x) along closed loops: MPC over all of T, and a policy as SB3 trains it.

    The policy is that of PPO with its two layers of 64, not trained: that takes it as long.

    Raises:
        UsageError: an extra is missing, or MPC does not know the task.
    """
    if importlib.util.find_spec("stable_baselines3") is None:
        raise UsageError("Expected stable_baselines3 for a policy to time, got none; pip install 'lyapnet[baselines]'.")
    from gymnasium.spaces import Box
    from stable_baselines3.common.policies import ActorCriticPolicy

    problem = controller.problem
    n, m = problem.system.n, problem.system.m
    learned = ActorCriticPolicy(Box(-np.inf, np.inf, (n + 1,)), Box(-1, 1, (m,)), lambda _: 0.0).float()
    planner, laws = planner_of("mpc_100", problem), dict[str, LoopLaw]()

    def plan(t: float, x: NDArray) -> NDArray:
        if (step := round(t / problem.horizon.dt)) == 0:
            laws["now"] = planner.law()
        return laws["now"](step, x)

    def predict(t: float, x: NDArray) -> NDArray:
        return learned.predict(np.append(x, t)[None], deterministic=True)[0]

    return {"MPC over T (fatrop)": plan, "SB3's predict": predict}


def _times(ask: Callable[[int], Any]) -> ControlTimes:
    ask(0)  # work of the first call is not counted
    taken = []
    for k in range(CALLS):
        began = time.perf_counter()
        ask(k)
        taken.append(time.perf_counter() - began)
    return ControlTimes.of(taken)

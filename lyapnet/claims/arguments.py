"""Converts the options of claims to the sets and tensors that proofs take."""

from collections.abc import Mapping
from typing import Any

import torch

from lyapnet.base.contracts import copied
from lyapnet.base.errors import UsageError, did_you_mean
from lyapnet.base.random_streams import CERTIFICATION, stream
from lyapnet.base.types import State
from lyapnet.claims.claim import sides_of
from lyapnet.controller.controller import Controller
from lyapnet.loop.rollout.closed_loop import ClosedLoop
from lyapnet.task.noise import StateNoise
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box

COMPARED = 1000  # number of random states of X₀ whose mean running cost sets δ and whose costs certificates compare


def box_of(states: Any) -> Box | None:
    """D in float64; None if the proof chooses D itself."""
    if states is None:
        return None
    return Box(*(torch.tensor(side, dtype=torch.float64) for side in sides_of(states)))


def disturbance_of(disturbance: Mapping[str, float] | None, controller: Controller) -> State | None:
    """w in units of ẋ, (n,), with 0 for the states that are not named; None if no state is named.

    Raises:
        UsageError: a name is not the name of a state.
    """
    w = number_of_each_state("a disturbance", disturbance or {}, controller)
    return torch.tensor(w, dtype=torch.float64) if disturbance else None


def number_of_each_state(what: str, given: Mapping[str, float], controller: Controller) -> list[float]:
    """A number for each state, 0 for those that are not named.

    Raises:
        UsageError: a name is not the name of a state.
    """
    names = controller.system.state_names
    for name, value in given.items():
        if name not in names:
            hint = did_you_mean(name, names, "name one of them.")
            raise UsageError(f"Expected {what} of {', '.join(names)}, got '{name}={value:g}'; {hint}")
    return [given.get(name, 0.0) for name in names]


def with_noise(noise: Mapping[str, float] | None, controller: Controller) -> tuple[ClosedLoop, Problem]:
    """The closed loop and the task of a controller, with noise of strength σ on the named states.

    Args:
        noise: σ by state, in its unit per √s; without it the result has the noise of the task.

    Raises:
        UsageError: a name is not the name of a state, or the task has noise already.
    """
    loop, problem = controller.closed_loop, controller.problem
    if not noise:
        return loop, problem
    if problem.noise is not None:
        raise UsageError("Expected no noise beside that of the task, got some; leave it out.")
    loop = copied(loop)
    loop.noise = StateNoise(number_of_each_state("noise", noise, controller), torch.float64)
    return loop, problem.replaced(noise=loop.noise)


def slack_of(delta: float | None, controller: Controller) -> float:
    """The given δ, else 0.5 % of the mean running cost on X₀ at t = 0; in cost per second."""
    if delta is not None:
        return delta
    x0 = controller.initial_states.sample(COMPARED, stream(0, CERTIFICATION))
    return 0.005 * float(controller.cost.running(x0, controller.policy(0.0, x0)).mean())

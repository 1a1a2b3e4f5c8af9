"""The closed loop after T, where V was not trained, under each law that can follow."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from lyapnet.base.errors import DivergenceError, UsageError
from lyapnet.base.sizes import require_memory, size_of_loops
from lyapnet.base.types import State
from lyapnet.controller.controller import Controller
from lyapnet.value.after_horizon import LAWS, LONGEST, MULTIPLE, is_held

DIVERGES = "the closed loop diverges"


class LoopsAfterHorizon(NamedTuple):
    """The closed loops under one law after T."""

    beyond: str
    distance: Float[Tensor, "nodes batch"] | None  # ‖x(t_n) − x*‖ up to the last requested time; None: see refused
    refused: str  # why this law has no closed loop; empty if it has

    def mean_at(self, node: int) -> float | None:
        """Mean ‖x(t_n) − x*‖."""
        return None if self.distance is None else float(self.distance[node].mean())


def loops_after_horizon(controller: Controller, x0: State, multiple: float) -> list[LoopsAfterHorizon]:
    """The closed loops of a batch of states up to a multiple of T, under each law that can follow T.

    Raises:
        UsageError: see check_multiple.
    """
    check_multiple(controller, multiple, len(x0))
    return [_follow(controller, beyond, x0, last_node(controller, multiple)) for beyond in LAWS]


def _follow(controller: Controller, beyond: str, x0: State, steps: int) -> LoopsAfterHorizon:
    try:
        other = controller.continued(beyond)
    except ValueError as error:  # the law cannot hold the goal
        return LoopsAfterHorizon(beyond, None, str(error))
    try:
        x = other.rollout(x0, steps).x
    except DivergenceError as error:
        return LoopsAfterHorizon(beyond, None, f"{DIVERGES}: {error}")
    distance = torch.linalg.vector_norm(controller.cost.from_goal(x), dim=-1)
    return (
        LoopsAfterHorizon(beyond, distance, "")
        if distance.isfinite().all()
        else LoopsAfterHorizon(beyond, None, DIVERGES)
    )


def share_at_goal(controller: Controller, x0: State) -> float | None:
    """The share of closed loops that the law after T keeps near the goal up to MULTIPLE T; None where it is undefined.

    It is undefined without a goal that stays, without a law after T, and beyond LONGEST steps. If a closed loop
    diverges, or f, g or the cost raise an error, the share is 0.
    """
    steps = MULTIPLE * controller.horizon.steps
    stays = controller.problem.has_goal and not controller.problem.follows_reference
    if steps > LONGEST or not stays or controller.law.beyond == "error":
        return None
    try:
        x = controller.continued(controller.law.beyond).rollout(x0, steps).x
        return float(is_held(controller.problem, x).double().mean())
    except Exception:  # f, g and the cost may be the user's
        return 0.0


def check_multiple(controller: Controller, multiple: float, states: int) -> None:
    """Check a multiple of T.

    Raises:
        UsageError: it is infinite or below 1, or the closed loops do not fit into memory.
    """
    if not 1 <= multiple < math.inf:
        raise UsageError(f"Expected a multiple of T from 1 on, got {multiple:g}; give how many T to go on for.")
    size = size_of_loops(states, last_node(controller, multiple), controller.system.n)
    require_memory("a multiple of T", multiple, len(LAWS) * size, "give a smaller one")


def last_node(controller: Controller, multiple: float) -> int:
    """The index n of the first node t_n at or after a multiple of T, at least one step after T."""
    return max(math.ceil(multiple * controller.horizon.steps), controller.horizon.steps + 1)


def shown_nodes(controller: Controller, multiple: float) -> list[int]:
    """The nodes shown in a table: T, and a tenth, a half and all of the time after T."""
    T, last = controller.horizon.steps, last_node(controller, multiple)
    return sorted({T, T + max((last - T) // 10, 1), T + max((last - T) // 2, 1), last})


def to_plain_data(found: Sequence[LoopsAfterHorizon], controller: Controller, multiple: float) -> list[dict[str, Any]]:
    """Plain data for JSON and tables: the mean distance at some times in s for each law, or why there is none."""
    nodes, dt = shown_nodes(controller, multiple), controller.horizon.dt
    return [
        {
            "beyond": one.beyond,
            "distances": [{"time": n * dt, "mean": one.mean_at(n)} for n in nodes],
            "refused": one.refused,
        }
        for one in found
    ]

"""What a controller does after T, for which V was not trained, under each law that can follow."""

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


class Afterwards(NamedTuple):
    """Where closed loops go under one law after T."""

    beyond: str
    distance: Float[Tensor, "nodes batch"] | None  # ‖x(t_n) − x*‖ up to the last time asked for; None: see refused
    refused: str  # why this law has no closed loop; empty where it has

    def mean_at(self, node: int) -> float | None:
        """Mean ‖x(t_n) − x*‖."""
        return None if self.distance is None else float(self.distance[node].mean())


def afterwards(controller: Controller, x0: State, multiple: float) -> list[Afterwards]:
    """The closed loops of a batch of states up to a multiple of T, under each law that can follow T.

    Raises:
        UsageError: see check_multiple.
    """
    check_multiple(controller, multiple, len(x0))
    return [_under(controller, beyond, x0, last_node(controller, multiple)) for beyond in LAWS]


def _under(controller: Controller, beyond: str, x0: State, steps: int) -> Afterwards:
    try:
        other = controller.continued(beyond)
    except ValueError as error:  # of a goal that the law cannot hold
        return Afterwards(beyond, None, str(error))
    try:
        x = other.rollout(x0, steps).x
    except DivergenceError as error:
        return Afterwards(beyond, None, f"{DIVERGES}: {error}")
    distance = torch.linalg.vector_norm(controller.cost.from_goal(x), dim=-1)
    return Afterwards(beyond, distance, "") if distance.isfinite().all() else Afterwards(beyond, None, DIVERGES)


def share_at_goal(controller: Controller, x0: State) -> float | None:
    """The share of closed loops that the law after T holds up to MULTIPLE T; None where that is not asked.

    It is not asked of a task without a goal, of an error, and of a time of more than LONGEST steps. Closed loops that
    cannot be followed, as one of them diverges or f, g or the cost refuse a state, are not held.
    """
    steps = MULTIPLE * controller.horizon.steps
    if steps > LONGEST or not controller.problem.has_goal or controller.law.beyond == "error":
        return None
    try:
        x = controller.continued(controller.law.beyond).rollout(x0, steps).x
        return float(is_held(controller.problem, x).double().mean())
    except Exception:  # of any kind: f, g and the cost may be the user's
        return 0.0


def check_multiple(controller: Controller, multiple: float, states: int) -> None:
    """Refuse a multiple of T that never comes, that is before T, or up to which closed loops fit into no memory.

    Raises:
        UsageError: naming it.
    """
    if not 1 <= multiple < math.inf:
        raise UsageError(f"Expected a multiple of T from 1 on, got {multiple:g}; give how many T to go on for.")
    size = size_of_loops(states, last_node(controller, multiple), controller.system.n)
    require_memory("a multiple of T", multiple, len(LAWS) * size, "give a smaller one")


def last_node(controller: Controller, multiple: float) -> int:
    """The node of the horizon's steps that is a multiple of T away, one after T at the least."""
    return max(math.ceil(multiple * controller.horizon.steps), controller.horizon.steps + 1)


def shown_nodes(controller: Controller, multiple: float) -> list[int]:
    """The nodes that a table has: T, and a tenth, a half and all of the time after it."""
    T, last = controller.horizon.steps, last_node(controller, multiple)
    return sorted({T, T + max((last - T) // 10, 1), T + max((last - T) // 2, 1), last})


def in_plain_data(found: Sequence[Afterwards], controller: Controller, multiple: float) -> list[dict[str, Any]]:
    """For JSON and tables: of each law, the mean distance at some times in s, or why there is none."""
    nodes, dt = shown_nodes(controller, multiple), controller.horizon.dt
    return [
        {
            "beyond": one.beyond,
            "distances": [{"time": n * dt, "mean": one.mean_at(n)} for n in nodes],
            "refused": one.refused,
        }
        for one in found
    ]

"""What a controller does after T, for which V was not trained, under each law that can follow."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor

from lyapnet.beyond import BEYOND
from lyapnet.controller import Controller
from lyapnet.drawing import CYCLE, legend_below, numpy_of
from lyapnet.errors import DivergenceError, UsageError
from lyapnet.sizes import require_memory, size_of_loops
from lyapnet.types import State

LAWS = tuple(name for name in BEYOND if name != "error")
LEAST, FAR = 1e-12, 1e3  # times the greatest distance before T: what the axis shows at the most


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
    steps, found = last_node(controller, multiple), []
    for beyond in LAWS:
        distance, refused = None, ""
        try:
            x = controller.continued(beyond).rollout(x0, steps).x
            distance = torch.linalg.vector_norm(controller.cost.from_goal(x), dim=-1)
        except DivergenceError as error:
            refused = f"the closed loop diverges: {error}"
        except ValueError as error:  # which the law says of a goal that it cannot hold
            refused = str(error)
        found.append(Afterwards(beyond, distance, refused))
    return found


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


def distances(found: Sequence[Afterwards], controller: Controller) -> Figure:
    """‖x − x*‖ against t under each law: the mean, and the band from the closest closed loop to the furthest."""
    figure = Figure(figsize=(5.6, 3.6), layout="constrained")
    axes = figure.subplots()
    drawn = {one.beyond: one.distance for one in found if one.distance is not None}
    before = max(float(distance[: controller.horizon.steps + 1].max()) for distance in drawn.values())
    for color, (beyond, distance) in zip(CYCLE, drawn.items(), strict=False):
        t = numpy_of(controller.horizon.dt * torch.arange(len(distance)))
        shown = numpy_of(distance.clamp(min=LEAST * LEAST * before))  # zero too is below the axis
        axes.fill_between(t, shown.min(1), shown.max(1), color=color, alpha=0.15, lw=0)
        axes.semilogy(t, shown.mean(1), color=color, linewidth=1.4, label=beyond)
    bottom, top = axes.get_ylim()
    axes.set_ylim(max(bottom, LEAST * before), min(top, FAR * before))
    axes.axvline(controller.horizon.duration, color="black", linewidth=0.8, linestyle=":", label="T")
    axes.set_xlabel("time t (s)")
    axes.set_ylabel("‖x − x*‖")
    missing = [one.beyond for one in found if one.distance is None]
    also = f"; none of {', '.join(missing)}" if missing else ""
    axes.set_title(f"mean and range of {next(iter(drawn.values())).shape[1]} closed loops{also}", fontsize=8)
    legend_below(figure, axes)
    return figure

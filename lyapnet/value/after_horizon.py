"""Chooses which of the laws in law_after_horizon controls after T, so that closed loops stay near the goal."""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool
from torch import Tensor

from lyapnet.base.errors import DivergenceError, one_line
from lyapnet.base.types import PerState, State
from lyapnet.task.problem import Problem
from lyapnet.task.systems import moving_states

LAWS = {  # laws that can follow T, in order of preference
    "riccati": "the linear-quadratic regulator of the goal, for an infinite horizon",
    "receding": "V(0, x) and its law, as if the horizon began at every step",
    "hold": "V(T, x) and its law",
}
LOOPS, MULTIPLE = 64, 5  # number of test loops, and their duration in multiples of T
NEAR = 0.01  # share of the largest distance at t = 0 that always counts as near the goal
HELD = f"no farther from the goal at {MULTIPLE} T than at T"  # condition of is_held, in words
LONGEST = 20_000  # largest number of steps of a test loop
REMEDY = "to choose another, load with beyond=hold, receding, riccati or error"


class AfterHorizon(NamedTuple):
    """A law after T, and how many test loops it keeps near the goal; loops are those without noise."""

    beyond: str  # a key of LAWS
    held: int  # number of test loops that it keeps near the goal up to MULTIPLE T
    loops: int  # number of test loops; 0 if none was tried
    reason: str = ""  # why no law holds all of them; empty if this one does

    @property
    def holds(self) -> bool:
        """Whether the law holds every test loop, and there was one."""
        return 0 < self.loops == self.held

    def __str__(self) -> str:
        law = f"after T follows {self.beyond} ({LAWS[self.beyond]})"
        if self.holds:
            return f"{law}, under which {self.held} of {self.loops} closed loops are {HELD}"
        if not self.loops:
            return f"{law}: {self.reason}"
        return f"{law}; no law was found under which all closed loops are {HELD} ({self.reason})"


def choose_law(problem: Problem, closed_loops: Callable[[str, State, int], State]) -> AfterHorizon:
    """The first of LAWS that holds all test loops from X₀ up to MULTIPLE T; else the law that holds most.

    A stationary task has one law for all time, and only that law is tested.

    Args:
        closed_loops: (a key of LAWS, x₀ (b, n), steps) ↦ the states (steps + 1, b, n) under that law after T.
    """
    if not problem.has_goal:
        return AfterHorizon("hold", 0, 0, "the task has no goal")
    if problem.follows_reference:
        return AfterHorizon("receding", 0, 0, "the task follows a reference")
    if MULTIPLE * problem.horizon.steps > LONGEST:
        return AfterHorizon("hold", 0, 0, f"not tried, as {MULTIPLE} T are more than {LONGEST} steps")
    x0 = problem.initial_states.sample(LOOPS, torch.Generator().manual_seed(0))
    held, reasons = {"hold": 0}, []  # hold always exists
    for law in ("hold",) if problem.horizon.stationary else LAWS:
        try:
            stays = is_held(problem, closed_loops(law, x0, MULTIPLE * problem.horizon.steps))
            held[law] = int(stays.sum())
        except DivergenceError:
            held[law] = 0
        except Exception as refusal:  # f, g and the cost may be the user's
            reasons.append(f"{law}: {one_line(refusal)}")
            continue
        if held[law] == LOOPS:
            return AfterHorizon(law, LOOPS, LOOPS)
        reasons.append(f"{law}: {held[law]} of {LOOPS}")
    most = max(held, key=lambda law: held[law])  # hold, if it holds as many as others
    return AfterHorizon(most, held[most], LOOPS, "; ".join(reasons))


def is_held(problem: Problem, x: State) -> Bool[Tensor, " batch"]:
    """Whether closed loops x (nodes, batch, n) that continue after T are held near the goal at their last node.

    That is: ‖x − x*‖, in the states that the cost weighs, is at most its value at T, or at most NEAR times the largest
    at t = 0; and no constraint is violated after T by more than before.
    """
    N, distance = problem.horizon.steps, distance_to_goal(problem, x)
    stays = distance[-1] <= distance[N].clamp(min=NEAR * float(distance[0].max()))
    if problem.constraints is None:
        return stays
    h = problem.constraints(x)
    return stays & (h[N:] <= h[: N + 1].amax(0).clamp(min=0.0)).all(-1).all(0)


def distance_to_goal(problem: Problem, x: State) -> PerState:
    """‖x − x*‖ in the states that the cost weighs."""
    weighed = [i for i in moving_states(problem.system) if not problem.cost.ignores(i, problem.system.n)]
    return torch.linalg.vector_norm(problem.cost.from_goal(x)[..., weighed], dim=-1)


def from_plain(content: Any) -> AfterHorizon | None:
    """Restore from the plain data of _asdict in a checkpoint; None if it is missing or invalid."""
    types = {"beyond": str, "held": int, "loops": int, "reason": str}
    if not isinstance(content, dict) or {key: type(value) for key, value in content.items()} != types:
        return None
    found = AfterHorizon(**content)
    possible = found.beyond in LAWS and 0 <= found.held <= found.loops and found.reason.isprintable()
    return found if possible else None

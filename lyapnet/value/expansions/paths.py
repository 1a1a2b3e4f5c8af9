"""Trajectories of the discretised problem, computed step by step."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from lyapnet.base.contracts import copied
from lyapnet.base.types import Control, ControlPath, PerState, State, StatePath
from lyapnet.graphs.poles import Poles, poles_of
from lyapnet.task.noise import Increments
from lyapnet.task.problem import Problem


class Path(NamedTuple):
    """A batch of trajectories. If one is not finite, its J_N is infinite, and finite numbers replace NaN in x and u."""

    x: StatePath
    u: ControlPath
    cost: PerState

    def member(self, rows: Tensor) -> "Path":
        """The trajectories with some indices."""
        return Path(self.x[:, rows], self.u[:, rows], self.cost[rows])


@torch.no_grad()
def path_under(
    problem: Problem,
    law: Callable[[int, State], Control],
    x0: State,
    increments: Increments | None = None,
    step: Callable[[State, Control], tuple[State, PerState]] | None = None,
) -> Path:
    """The closed loops of a law (n, x_n) ↦ u_n from a batch of states; they may diverge.

    Args:
        increments: ΔW of each step; None: without noise.
        step: (x, u) ↦ (x⁺, ∫ℓ dt) of a plant that differs from the model; None: the step of the problem.
    """
    step = step or problem.step
    x, u, J = [x0], [], torch.zeros_like(x0[..., 0])
    for n in range(problem.horizon.steps):
        u.append(law(n, x[-1]))
        following, paid = step(x[-1], u[-1])
        if increments is not None and problem.noise is not None:
            following = following + problem.noise.displacement(x[-1], increments[n])
        x.append(following)
        J = J + paid
    return path_of(problem, torch.stack(x), torch.stack(u), J)


def path_of(problem: Problem, x: StatePath, u: ControlPath, running_cost: PerState) -> Path:
    """The path with given states and controls at the nodes and given ∫ℓ.

    Its cost is infinite if it is not finite, leaves the domain, or jumps over a pole of f, g, q or φ.
    """
    J = running_cost + problem.cost.terminal(x[-1])
    J, x = J.where(J.isfinite(), torch.inf), x.nan_to_num()
    if (poles := _poles_of(problem)) is not None:
        J = J.masked_fill(poles.crossed(x.double().cpu()).to(J.device), torch.inf)
    if problem.domain is not None:
        J = J.masked_fill(problem.domain.left(x), torch.inf)
    return Path(x, u.nan_to_num(), J)


def _poles_of(problem: Problem) -> Poles | None:
    """The poles of f, g, q and φ, where they divide by zero; searched once for each problem."""
    if "poles" not in problem.findings:
        own = in_float64(problem)
        functions = [*own.functions_of_state.values(), own.cost.state, own.cost.terminal]
        problem.findings["poles"] = poles_of(
            lambda x: tuple(function(x) for function in functions), own.initial_states.center
        )
    return problem.findings["poles"]


def cheapest(paths: Sequence[Path]) -> Path:
    """The cheapest of several trajectories for each initial state."""
    x, u, cost = (torch.stack(parts) for parts in zip(*paths, strict=True))
    best, each = cost.argmin(0), torch.arange(cost.shape[1])
    return Path(x[best, :, each].movedim(0, 1), u[best, :, each].movedim(0, 1), cost[best, each])


def exchanged(path: Path, rows: Tensor, others: Path) -> Path:
    """Replace some trajectories by others."""
    return Path(
        path.x.index_copy(1, rows, others.x),
        path.u.index_copy(1, rows, others.u),
        path.cost.index_copy(0, rows, others.cost),
    )


def in_float64(problem: Problem) -> Problem:
    """A float64 copy of a problem on the CPU without gradients of its parameters, for computations before training."""
    return copied(problem).requires_grad_(False)

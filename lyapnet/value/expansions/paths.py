"""Trajectories step by step: under a law, and of what is known of them."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from lyapnet.base.contracts import copied
from lyapnet.base.types import Control, ControlPath, PerState, State, StatePath
from lyapnet.graphs.poles import Poles, poles_of
from lyapnet.task.problem import Problem


class Path(NamedTuple):
    """Trajectories step by step; J_N is infinite where one is not finite, and x is then finite all the same."""

    x: StatePath
    u: ControlPath
    cost: PerState

    def member(self, rows: Tensor) -> "Path":
        """Those with some indices."""
        return Path(self.x[:, rows], self.u[:, rows], self.cost[rows])


@torch.no_grad()
def path_under(problem: Problem, law: Callable[[int, State], Control], x0: State) -> Path:
    """Where a law (n, x_n) ↦ u_n leads from a batch of states, whatever becomes of it."""
    x, u, J = [x0], [], torch.zeros_like(x0[..., 0])
    for n in range(problem.horizon.steps):
        u.append(law(n, x[-1]))
        following, paid = problem.step(x[-1], u[-1])
        x.append(following)
        J = J + paid
    return path_of(problem, torch.stack(x), torch.stack(u), J)


def path_of(problem: Problem, x: StatePath, u: ControlPath, running_cost: PerState) -> Path:
    """A path of which states and controls at the nodes and ∫ℓ over all of it are known, whatever they are.

    If it leaves the domain, or jumps over a pole of f, g, q or φ, as no trajectory does, its cost is infinite.
    """
    J, x = (running_cost + problem.cost.terminal(x[-1])).nan_to_num(torch.inf, torch.inf), x.nan_to_num()
    if (poles := _poles_of(problem)) is not None:
        J = J.masked_fill(poles.crossed(x.double().cpu()).to(J.device), torch.inf)
    if problem.domain is not None:
        J = J.masked_fill(problem.domain.left(x), torch.inf)
    return Path(x, u.nan_to_num(), J)


def _poles_of(problem: Problem) -> Poles | None:
    """Where f, g, q and φ of a problem divide by zero, sought once."""
    if "poles" not in problem.findings:
        own = in_float64(problem)
        f, g, cost = own.system.f, own.system.g, own.cost
        problem.findings["poles"] = poles_of(
            lambda x: (f(x), g(x), cost.state(x), cost.terminal(x)), own.initial_states.center
        )
    return problem.findings["poles"]


def cheapest(paths: Sequence[Path]) -> Path:
    """Of each state, that of several trajectories which costs least."""
    x, u, cost = (torch.stack(parts) for parts in zip(*paths, strict=True))
    best, each = cost.argmin(0), torch.arange(cost.shape[1])
    return Path(x[best, :, each].movedim(0, 1), u[best, :, each].movedim(0, 1), cost[best, each])


def exchanged(path: Path, rows: Tensor, others: Path) -> Path:
    """Some trajectories exchanged for others."""
    return Path(
        path.x.index_copy(1, rows, others.x),
        path.u.index_copy(1, rows, others.u),
        path.cost.index_copy(0, rows, others.cost),
    )


def in_float64(problem: Problem) -> Problem:
    """A copy of a problem for what is computed before training: on the CPU, without gradients of its parameters."""
    return copied(problem).requires_grad_(False)

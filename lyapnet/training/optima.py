"""Optimal trajectories from many states of X₀, each sought where its neighbours were found."""

import math
import time
from collections.abc import Callable, Sequence
from functools import partial

import torch
from torch import Tensor

from lyapnet.base.random_streams import START, stream
from lyapnet.base.types import Control, ControlPath, State
from lyapnet.evaluation.oracles import Optima, optimal_cost
from lyapnet.task.problem import Problem
from lyapnet.training.stages import Report, silent
from lyapnet.value.expansions import (
    Expansion,
    Optimum,
    Path,
    at_rest,
    cheapest,
    exchanged,
    follow_expansions,
    greedy_law,
    in_float64,
    optimal_trajectories,
    path_under,
    sizes,
)

OPTIMA, SOUGHT, FAR = 512, 96, 16  # in all; of which sought from scratch; of which by the oracle too
SMALL = {1: 48}  # in all, for tasks of one state, where they are close to one another so
WAVES = 6  # random controls from which optima are sought where there is no expansion
NUMBERS = 50_000_000  # in the second derivatives (400 MB): fewer optima where they would not fit
WILD = 100  # times the median of the greatest entries of V_xx, above which a trajectory is no minimum
SECONDS = 30.0  # of this thread's work, whatever else the machine does, for each of three ways to seek optima
FINER, MANY = 0.999, 0.25  # by which share an oracle's are better, and of how many, for it to go on
NEIGHBOURS, ROUNDS, BETTER = 4, 3, 0.99  # whose optima are tried, how often, and by which share they are better


def optima_for(problem: Problem, expansions: Sequence[Expansion], x0: State, report: Report = silent) -> Optimum:
    """Optimal trajectories from a batch of states.

    Each search has SECONDS, after which what it has found is taken. The first few are sought: from the controls that
    expansions ask for, or none if cheaper, or random waves where there is no expansion; and some of them by the oracle,
    where there is one, whose starts need not be trajectories. The others begin with the laws of the few that are
    nearest. Which local minimum a start leads to is luck, but the least cost is continuous in x₀: at last, what was
    found from one state is tried from the states around it.

    Args:
        report: is told what is being done.
    """
    exact = in_float64(problem)
    x0 = x0.double().cpu()[: how_many(problem)]
    few, others = x0[:SOUGHT], x0[SOUGHT:]
    laws = [*(greedy_law(exact, each) for each in expansions), at_rest(exact)]
    if not expansions:
        laws += waves(exact, float(sizes(exact, path_under(exact, laws[0], few).cost).median()), WAVES)
    progress = partial(report, f"optima from {len(few)} states of X₀ within {SECONDS:.0f} s of work")
    progress(0, len(few))
    u = cheapest([path_under(exact, law, few) for law in laws]).u
    optimum = optimal_trajectories(problem, few, u, progress=progress, seconds=SECONDS)
    optimum, known = _by_oracle(problem, optimum, others, report)
    optimum = _followed(exact, optimum, report)
    if len(others):
        progress = partial(report, f"optima from {len(others)} further states of X₀ within {SECONDS:.0f} s of work")
        progress(0, len(others))
        paths = [_along(exact, optimum, column, others) for column in nearest(others, few).unbind(1)]
        if known is not None:
            paths.append(path_under(exact, lambda n, _: known[n], others))
        u = cheapest(paths).u
        optimum = _joined(optimum, optimal_trajectories(problem, others, u, progress=progress, seconds=SECONDS))
    return _followed(exact, optimum, report)


def waves(problem: Problem, cost: float, count: int) -> list[Callable[[int, State], Control]]:
    """Laws (n, x_n) ↦ u_n whose controls are random waves in time, of about some cost."""
    N, m, own = problem.horizon.steps, problem.system.m, torch.arange(1, 5)
    dearest = float(torch.linalg.eigvalsh(problem.cost.R(problem.initial_states.center))[..., -1])
    amplitude = math.sqrt(abs(cost) / (dearest * problem.horizon.duration)) if math.isfinite(cost) else 1.0
    phase = torch.arange(N).double()[:, None] / N * torch.pi * own
    weights = torch.randn(count, m, 2, len(own), generator=stream(0, START, 1), dtype=torch.float64) / own
    u = amplitude * torch.einsum("gmaw,awn->gnm", weights, torch.stack([phase.sin(), phase.cos()]).mT)

    def along(controls: Tensor) -> Callable[[int, State], Control]:
        return lambda n, x: problem.controls.project(controls[n].to(x).expand(*x.shape[:-1], -1))

    return [along(controls) for controls in u]


def minima(problem: Problem, optimum: Optimum) -> Optimum:
    """Those with an expansion: where a trajectory that was not improved is no minimum, V_xx grows without bound.

    With constraints V_xx is that of the penalty too, and hence larger where it is paid.

    Source: Bryson, Ho, Applied Optimal Control, 1975, § 6.3 (conjugate points).
    """
    curvature = optimum.expansion.hessian.abs().amax((0, -2, -1)).nan_to_num(torch.inf)
    finite = optimum.path.cost.isfinite() & curvature.isfinite()
    wild = WILD if problem.constraints is None else WILD**3
    kept = finite & (curvature <= wild * curvature[finite].median()) if finite.any() else finite
    return optimum.member(kept)


def _by_oracle(problem: Problem, optimum: Optimum, others: State, report: Report) -> tuple[Optimum, ControlPath | None]:
    """Optima exchanged for those of the oracle that cost less: of the first FAR, and where these are many, of all.

    Then with its controls from other states, as far as there was time, NaN where it has none; else None.
    """
    oracle, began = optimal_cost(problem), time.thread_time()
    if oracle is None:  # none is installed, or none is for such a problem
        return optimum, None
    progress = partial(report, f"optima by the oracle within {SECONDS:.0f} s of work")
    x0, far = optimum.path.x[0], min(FAR, len(optimum.path.cost))
    found = oracle.solve(x0[:far], progress=progress, seconds=SECONDS)
    optimum, gained = _with_better(problem, optimum, torch.arange(far), found)
    left = SECONDS - (time.thread_time() - began)
    if gained < MANY * far or left < 0:
        return optimum, None
    found = oracle.solve(torch.cat([x0[far:], others]), progress=progress, seconds=left)
    optimum, _ = _with_better(problem, optimum, torch.arange(far, len(x0)), found)
    return optimum, None if found.u is None else found.u[:, len(x0) - far :]


def _with_better(problem: Problem, optimum: Optimum, rows: Tensor, found: Optima) -> tuple[Optimum, int]:
    """Some optima exchanged for those of an oracle from the same states that cost less, and how many these are."""
    if found.u is None:
        return optimum, 0
    size, cost = sizes(problem, optimum.path.cost)[rows], found.cost[: len(rows)]
    better = torch.nonzero(cost < optimum.path.cost[rows] - (1 - FINER) * size).flatten()
    if len(better):
        closer = optimal_trajectories(problem, optimum.path.x[0, rows[better]], found.u[:, better])
        optimum = _with(optimum, rows[better], closer)
    return optimum, len(better)


def _followed(exact: Problem, optimum: Optimum, report: Report) -> Optimum:
    """Optima of which each has been tried from the states around it."""
    x0 = optimum.path.x[0]
    for k in range(ROUNDS if len(x0) > 1 else 0):
        report("optima of neighbours", k, ROUNDS)
        paths = [_along(exact, optimum, column, x0) for column in nearest(x0, x0, itself=False).unbind(1)]
        best = cheapest(paths)
        improved = torch.nonzero(
            best.cost < optimum.path.cost - (1 - BETTER) * sizes(exact, optimum.path.cost)
        ).flatten()
        if not len(improved):
            break
        optimum = _with(optimum, improved, optimal_trajectories(exact, x0[improved], best.u[:, improved]))
    return optimum


def _along(exact: Problem, optimum: Optimum, which: Tensor, x0: State) -> Path:
    """From each of some states under the law of one of the optima."""
    return follow_expansions(exact, optimum.expansion.member(which), x0)


def nearest(x0: Tensor, others: Tensor, itself: bool = True) -> Tensor:
    """The indices of the nearest other states of each (b, k), each component in units of its spread."""
    spread = others.amax(0) - others.amin(0)
    scale = spread.where(spread > 0, 1)
    distance = torch.cdist(x0 / scale, others / scale)
    if not itself:
        distance.fill_diagonal_(torch.inf)
    return distance.argsort(1)[:, : min(NEIGHBOURS, len(others) - (not itself))]


def _joined(one: Optimum, other: Optimum) -> Optimum:
    """Two batches of optima as one."""
    path = Path(
        torch.cat([one.path.x, other.path.x], 1),
        torch.cat([one.path.u, other.path.u], 1),
        torch.cat([one.path.cost, other.path.cost]),
    )
    parts = zip(one.expansion, other.expansion, strict=True)
    return Optimum(path, Expansion(*(torch.cat(both, 1) for both in parts)), torch.cat([one.mended, other.mended]))


def _with(optimum: Optimum, rows: Tensor, others: Optimum) -> Optimum:
    """Some trajectories exchanged for others that cost less."""
    parts = zip(optimum.expansion, others.expansion, strict=True)
    expansion = Expansion(*(part.index_copy(1, rows, new) for part, new in parts))
    mended = optimum.mended.index_copy(0, rows, others.mended)
    return Optimum(exchanged(optimum.path, rows, others.path), expansion, mended)


def how_many(problem: Problem) -> int:
    """From how many states optima are sought: as many as V needs, and have second derivatives that fit into memory."""
    n, m = problem.system.n, problem.system.m
    return max(1, min(OPTIMA, SMALL.get(problem.system.n, OPTIMA), NUMBERS // (problem.horizon.steps * (n + m) ** 2)))

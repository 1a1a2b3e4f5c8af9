"""Optimal trajectories from many states of X₀, each search warm-started from its neighbours' optima."""

import math
from collections.abc import Callable, Sequence
from functools import partial

import torch
from torch import Tensor

from lyapnet.base.random_streams import START, stream
from lyapnet.base.threads import seconds_of_work
from lyapnet.base.types import Control, ControlPath, PerState, State, StatePath
from lyapnet.evaluation.oracles import Optima, optimal_cost
from lyapnet.task.problem import Problem
from lyapnet.training.stage_messages import StageReport, silent
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

MAX_OPTIMA = 512  # number of initial states
MAX_OPTIMA_OF_DIMENSION = {1: 48}  # the same by number of states: in one dimension fewer are dense enough
FROM_SCRATCH = 96  # first states, whose optima are searched for without warm start from neighbours
BY_ORACLE = 16  # first of these states, which the oracle solves too
RANDOM_GUESSES = 6  # random controls as initial guesses if there is no expansion
MAX_DERIVATIVE_ENTRIES = 50_000_000  # numbers in all second derivatives (400 MB), which limits the optima
MAX_CURVATURE_RATIO = 100  # largest entry of V_xx relative to its median: more than this is no minimum
SEARCH_SECONDS = 30.0  # seconds of work for each search
ORACLE_IMPROVEMENT = 0.999  # cost ratio below which the optimum of the oracle replaces ours
MIN_IMPROVED_SHARE = 0.25  # share of improved optima from which on the oracle solves all states
NEIGHBOURS = 4  # nearest states whose optima are tried as initial guesses
NEIGHBOUR_ROUNDS = 3  # how often, at most
NEIGHBOUR_IMPROVEMENT = 0.99  # cost ratio below which a neighbour's solution is used
OTHER_WAY = 0.05  # distance of two paths, relative to the ranges of the states, above which they are different ways
WAYS = 6  # nearest states whose ways are tried
FIRST_WAYS = 96  # ways that are tried first; the others only if one of these is cheaper
OTHER_WAY_IMPROVEMENT = 0.999  # cost ratio below which an optimum found on another way is used


def optima_for(problem: Problem, expansions: Sequence[Expansion], x0: State, report: StageReport = silent) -> Optimum:
    """Optimal trajectories from a batch of states.

    1. The first FROM_SCRATCH states: the initial guesses are the greedy laws of the expansions and the control at rest,
       or random controls if there is no expansion. The oracle, if there is one, solves some of these states too.
    2. The other states: the initial guesses are the laws of the nearest solved states.
    3. The result may be only a local minimum, but the least cost is continuous in x₀: therefore the solution from each
       state is finally tried from the states around it, and where that leads another way, searched from there.

    Each search stops after SEARCH_SECONDS with the best trajectories so far.

    Args:
        report: called with each stage of the work.
    """
    exact = in_float64(problem)
    x0 = x0.double().cpu()[: count_optima(problem)]
    few, others = x0[:FROM_SCRATCH], x0[FROM_SCRATCH:]
    laws = [*(greedy_law(exact, each) for each in expansions), at_rest(exact)]
    if not expansions:
        laws += waves(exact, float(sizes(exact, path_under(exact, laws[0], few).cost).median()), RANDOM_GUESSES)
    progress = partial(report, f"optima from {len(few)} states of X₀ within {SEARCH_SECONDS:.0f} s of work")
    progress(0, len(few))
    u = cheapest([path_under(exact, law, few) for law in laws]).u
    optimum = optimal_trajectories(problem, few, u, progress=progress, seconds=SEARCH_SECONDS)
    optimum, oracle_controls = _improve_by_oracle(problem, optimum, others, report)
    optimum = _improve_from_neighbours(exact, optimum, report)
    if len(others):
        progress = partial(
            report, f"optima from {len(others)} further states of X₀ within {SEARCH_SECONDS:.0f} s of work"
        )
        progress(0, len(others))
        paths = [_follow_optimum(exact, optimum, column, others) for column in nearest(others, few).unbind(1)]
        if oracle_controls is not None:
            paths.append(path_under(exact, lambda n, _: oracle_controls[n], others))
        u = cheapest(paths).u
        optimum = _concatenate(
            optimum,
            optimal_trajectories(problem, others, u, progress=progress, seconds=SEARCH_SECONDS, softer_first=False),
        )
    return _improve_by_other_ways(exact, _improve_from_neighbours(exact, optimum, report), report)


def waves(problem: Problem, cost: float, count: int) -> list[Callable[[int, State], Control]]:
    """Laws (n, x_n) ↦ u_n whose controls are random Fourier series in time, scaled to about the given cost."""
    N, m, own = problem.horizon.steps, problem.system.m, torch.arange(1, 5)
    largest_weight = float(torch.linalg.eigvalsh(problem.cost.R(problem.initial_states.center))[..., -1])
    amplitude = math.sqrt(abs(cost) / (largest_weight * problem.horizon.duration)) if math.isfinite(cost) else 1.0
    phase = torch.arange(N).double()[:, None] / N * torch.pi * own
    weights = torch.randn(count, m, 2, len(own), generator=stream(0, START, 1), dtype=torch.float64) / own
    u = amplitude * torch.einsum("gmaw,awn->gnm", weights, torch.stack([phase.sin(), phase.cos()]).mT)

    def along(controls: Tensor) -> Callable[[int, State], Control]:
        return lambda n, x: problem.controls.project(controls[n].to(x).expand(*x.shape[:-1], -1))

    return [along(controls) for controls in u]


def minima(problem: Problem, optimum: Optimum) -> Optimum:
    """The trajectories with a valid expansion: V_xx is finite and not too large.

    V_xx grows without bound where a stationary trajectory is no minimum. With constraints V_xx contains the curvature
    of the penalty, so a larger ratio is allowed.

    Source: Bryson, Ho, Applied Optimal Control, 1975, § 6.3 (conjugate points).
    """
    curvature = optimum.expansion.hessian.abs().amax((0, -2, -1)).nan_to_num(torch.inf)
    finite = optimum.path.cost.isfinite() & curvature.isfinite()
    wild = MAX_CURVATURE_RATIO if problem.constraints is None else MAX_CURVATURE_RATIO**3
    kept = finite & (curvature <= wild * curvature[finite].median()) if finite.any() else finite
    return optimum.member(kept)


def _improve_by_oracle(
    problem: Problem, optimum: Optimum, others: State, report: StageReport
) -> tuple[Optimum, ControlPath | None]:
    """Replace optima by cheaper ones of the oracle: for the first BY_ORACLE states, and for all if many improve.

    Also returns the oracle's controls from the other states, NaN where it ran out of time; None if it did not try them.
    """
    oracle, began = optimal_cost(problem.without_noise()), seconds_of_work()
    if oracle is None:  # not installed, or not applicable to this problem
        return optimum, None
    progress = partial(report, f"optima by the oracle within {SEARCH_SECONDS:.0f} s of work")
    x0, far = optimum.path.x[0], min(BY_ORACLE, len(optimum.path.cost))
    found = oracle.solve(x0[:far], progress=progress, seconds=SEARCH_SECONDS)
    until = began + SEARCH_SECONDS
    optimum, gained = _replace_improved(problem, optimum, torch.arange(far), found, until - seconds_of_work())
    left = until - seconds_of_work()
    if gained < MIN_IMPROVED_SHARE * far or left < 0:
        return optimum, None
    found = oracle.solve(torch.cat([x0[far:], others]), progress=progress, seconds=left)
    optimum, _ = _replace_improved(problem, optimum, torch.arange(far, len(x0)), found, until - seconds_of_work())
    return optimum, None if found.u is None else found.u[:, len(x0) - far :]


def _replace_improved(
    problem: Problem, optimum: Optimum, rows: Tensor, found: Optima, seconds: float
) -> tuple[Optimum, int]:
    """Replace some optima by cheaper ones of the oracle; returns also how many were replaced.

    Args:
        seconds: seconds of work after which their search ends.
    """
    if found.u is None:
        return optimum, 0
    size, cost = sizes(problem, optimum.path.cost)[rows], found.cost[: len(rows)]
    has_controls = found.u[:, : len(rows)].isfinite().all(-1).all(0)
    better = torch.nonzero(has_controls & (cost < optimum.path.cost[rows] - (1 - ORACLE_IMPROVEMENT) * size)).flatten()
    if len(better):
        x0, u = optimum.path.x[0, rows[better]], found.u[:, better]
        closer = optimal_trajectories(problem, x0, u, seconds=seconds, softer_first=False)
        optimum = _replace_rows(optimum, rows[better], closer)
    return optimum, len(better)


def _improve_from_neighbours(exact: Problem, optimum: Optimum, report: StageReport) -> Optimum:
    """Try each optimum from the states around it, and keep what is cheaper."""
    x0, until = optimum.path.x[0], seconds_of_work() + SEARCH_SECONDS
    for k in range(NEIGHBOUR_ROUNDS if len(x0) > 1 else 0):
        report(f"optima of neighbours within {SEARCH_SECONDS:.0f} s of work", k, NEIGHBOUR_ROUNDS)
        paths = [_follow_optimum(exact, optimum, column, x0) for column in nearest(x0, x0, itself=False).unbind(1)]
        best = cheapest(paths)
        improved = torch.nonzero(
            best.cost < optimum.path.cost - (1 - NEIGHBOUR_IMPROVEMENT) * sizes(exact, optimum.path.cost)
        ).flatten()
        seconds = until - seconds_of_work()
        if not len(improved) or seconds < 0:
            break
        better = optimal_trajectories(exact, x0[improved], best.u[:, improved], seconds=seconds, softer_first=False)
        optimum = _replace_rows(optimum, improved, better)
    return optimum


def _improve_by_other_ways(exact: Problem, optimum: Optimum, report: StageReport) -> Optimum:
    """Search on the ways of neighbours wherever they differ from the own one, and keep what is cheaper.

    Beside a cliff of the least cost, as within tight limits of the controls, the law of a neighbour on a cheaper way
    may cost many times as much, and only a search that begins with it tells that this way is cheaper from here too.
    If one of FIRST_WAYS does so, all others are tried too, and what is found is passed on to further neighbours, until
    no optimum improves.
    """
    x0, until = optimum.path.x[0], seconds_of_work() + SEARCH_SECONDS
    if len(x0) < 2:
        return optimum
    neighbours = nearest(x0, x0, itself=False, count=WAYS)
    changed, is_first = torch.ones(len(x0), dtype=torch.bool), True
    while changed.any() and seconds_of_work() < until:
        report(f"optima on other ways within {SEARCH_SECONDS:.0f} s of work")
        rows, controls = list[Tensor](), list[Tensor]()
        for column in neighbours.unbind(1):
            to_try = torch.nonzero(changed[column]).flatten()
            path = _follow_optimum(exact, optimum, column[to_try], x0[to_try])
            own, their = optimum.path.x[:, to_try], optimum.path.x[:, column[to_try]]
            apart = _path_distance(optimum, path.x, own)
            other = path.cost.isfinite() & (apart > OTHER_WAY) & (apart > _path_distance(optimum, own, their) / 2)
            rows.append(to_try[other])
            controls.append(path.u[:, other])
        tried, u = torch.cat(rows), torch.cat(controls, 1)
        seconds = until - seconds_of_work()
        if not len(tried) or seconds < 0:
            break
        if is_first:
            every = max(1, len(tried) // FIRST_WAYS)
            tried, u = tried[::every], u[:, ::every]
        found = optimal_trajectories(exact, x0[tried], u, seconds=seconds, softer_first=False)
        gain = optimum.path.cost[tried] - found.path.cost
        better = gain > (1 - OTHER_WAY_IMPROVEMENT) * sizes(exact, optimum.path.cost)[tried]
        best = {int(tried[k]): k for k in gain.argsort() if better[k]}  # of several for a state the last one stays
        if not best:
            break
        changed, is_first = changed if is_first else torch.zeros_like(changed), False
        rows = torch.tensor([*best])
        optimum, changed[rows] = _replace_rows(optimum, rows, found.member(torch.stack([*best.values()]))), True
    return optimum


def _path_distance(optimum: Optimum, x: StatePath, other: StatePath) -> PerState:
    """The largest differences (b,) of paths (N + 1, b, n), relative to the ranges of the states along the optima."""
    least, most = optimum.path.x.flatten(0, 1).aminmax(dim=0)
    return ((x - other).abs() / (most - least).where(most > least, 1)).amax((0, 2))


def _follow_optimum(exact: Problem, optimum: Optimum, which: Tensor, x0: State) -> Path:
    """The paths from some states, each under the local law of one of the optima."""
    return follow_expansions(exact, optimum.expansion.member(which), optimum.path.u[:, which], x0)


def nearest(x0: Tensor, others: Tensor, itself: bool = True, count: int = NEIGHBOURS) -> Tensor:
    """The indices (b, k) of the nearest states in `others`, `count` if there are, with components scaled by ranges."""
    spread = others.amax(0) - others.amin(0)
    scale = spread.where(spread > 0, 1)
    distance = torch.cdist(x0 / scale, others / scale)
    if not itself:
        distance.fill_diagonal_(torch.inf)
    return distance.argsort(1)[:, : min(count, len(others) - (not itself))]


def _concatenate(one: Optimum, other: Optimum) -> Optimum:
    """Concatenation of two batches of optima."""
    path = Path(
        torch.cat([one.path.x, other.path.x], 1),
        torch.cat([one.path.u, other.path.u], 1),
        torch.cat([one.path.cost, other.path.cost]),
    )
    parts = zip(one.expansion, other.expansion, strict=True)
    return Optimum(path, Expansion(*(torch.cat(both, 1) for both in parts)), torch.cat([one.replaced, other.replaced]))


def _replace_rows(optimum: Optimum, rows: Tensor, others: Optimum) -> Optimum:
    """Replace some rows of a batch of optima."""
    parts = zip(optimum.expansion, others.expansion, strict=True)
    expansion = Expansion(*(part.index_copy(1, rows, new) for part, new in parts))
    replaced = optimum.replaced.index_copy(0, rows, others.replaced)
    return Optimum(exchanged(optimum.path, rows, others.path), expansion, replaced)


def count_optima(problem: Problem) -> int:
    """The number of optima: limited by the number of states and by the memory for second derivatives."""
    n, m = problem.system.n, problem.system.m
    return max(
        1,
        min(
            MAX_OPTIMA,
            MAX_OPTIMA_OF_DIMENSION.get(problem.system.n, MAX_OPTIMA),
            MAX_DERIVATIVE_ENTRIES // (problem.horizon.steps * (n + m) ** 2),
        ),
    )

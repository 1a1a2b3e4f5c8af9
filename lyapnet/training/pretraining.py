"""Fitting V to optimal trajectories, before it trains in closed loop: supervised, and seconds long."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from lyapnet.calculus import ValueFunction
from lyapnet.evaluation.oracles import optimal_cost
from lyapnet.expansions import (
    FLOOR,
    Expansion,
    Optimum,
    Path,
    exchanged,
    greedy_law,
    in_float64,
    no_control,
    optimal_trajectories,
    path_under,
)
from lyapnet.linear_algebra import apply
from lyapnet.problem import Problem
from lyapnet.types import PerState, State, StatePath

OPTIMA, SOUGHT, FAR = 512, 96, 16  # in all; of which sought from scratch; of which by the oracle too
NUMBERS = 50_000_000  # in the second derivatives (400 MB): fewer optima where they would not fit
NEIGHBOURS, ROUNDS, BETTER = 4, 3, 0.99  # whose optima are tried, how often, and by which share they are better
STEPS, BATCH, RATE = 3000, 1024, 0.01
VALUE_WEIGHT = 10.0  # of the squared relative error of V, against the relative excess of the cost


class Examples(NamedTuple):
    """What is known along optimal trajectories and near them."""

    t: Tensor  # t_n (k,)
    x: State
    value: PerState  # V(t_n, x_n)
    after: Tensor  # t_{n+1}
    drifted: State  # x_n + Δt f
    gradient: State  # V_x(t_{n+1}, drifted)
    weight: Tensor  # L⁻¹gᵀ (k, m, n), LLᵀ = 2R + Δt gᵀHg: for what a wrong V_x costs
    mean_cost: float  # of the trajectories
    duration: float


def optima_for(problem: Problem, expansions: Sequence[Expansion], x0: State) -> Optimum:
    """Optimal trajectories from a batch of states.

    The first few are sought: from the controls that expansions ask for, or none if cheaper, and some of them by the
    oracle, where there is one, whose starts need not be trajectories. The others begin with the laws of the few that
    are nearest. Which local minimum a start leads to is luck, but the least cost is continuous in x₀: at last, what was
    found from one state is tried from the states around it.
    """
    exact = in_float64(problem)
    x0 = x0.double().cpu()[: _affordable(problem)]
    few, others = x0[:SOUGHT], x0[SOUGHT:]
    laws = [*(greedy_law(exact, each) for each in expansions), no_control(exact)]
    optimum = optimal_trajectories(problem, few, _cheapest([path_under(exact, law, few) for law in laws]).u)
    optimum = _followed(exact, _by_oracle(problem, optimum, few[:FAR]))
    if len(others):
        nearest = _nearest(others, few)
        u = _cheapest([_along(exact, optimum, column, others) for column in nearest.unbind(1)]).u
        optimum = _joined(optimum, optimal_trajectories(problem, others, u))
    return _followed(exact, optimum)


def _by_oracle(problem: Problem, optimum: Optimum, x0: State) -> Optimum:
    """The first of some optima, exchanged for those of the oracle that cost less."""
    oracle = optimal_cost(problem)
    if oracle is None:
        return optimum
    found = oracle.solve(x0)
    if found.u is None:
        return optimum
    better = torch.nonzero(found.cost < BETTER * optimum.path.cost[: len(x0)]).flatten()
    if not len(better):
        return optimum
    return _with(optimum, better, optimal_trajectories(problem, x0[better], found.u[:, better]))


def _followed(exact: Problem, optimum: Optimum) -> Optimum:
    """Optima of which each has been tried from the states around it."""
    x0 = optimum.path.x[0]
    for _ in range(ROUNDS if len(x0) > 1 else 0):
        paths = [_along(exact, optimum, column, x0) for column in _nearest(x0, x0, itself=False).unbind(1)]
        best = _cheapest(paths)
        improved = torch.nonzero(best.cost < BETTER * optimum.path.cost).flatten()
        if not len(improved):
            break
        optimum = _with(optimum, improved, optimal_trajectories(exact, x0[improved], best.u[:, improved]))
    return optimum


def _along(exact: Problem, optimum: Optimum, which: Tensor, x0: State) -> Path:
    """From each of some states under the law of one of the optima."""
    return path_under(exact, greedy_law(exact, optimum.expansion.member(which)), x0)


def _cheapest(paths: Sequence[Path]) -> Path:
    """Of each state, that of several trajectories which costs least."""
    x, u, cost = (torch.stack(parts) for parts in zip(*paths, strict=True))
    best, each = cost.argmin(0), torch.arange(cost.shape[1])
    return Path(x[best, :, each].movedim(0, 1), u[best, :, each].movedim(0, 1), cost[best, each])


def _nearest(x0: Tensor, others: Tensor, itself: bool = True) -> Tensor:
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
    return Optimum(path, Expansion(*(torch.cat(both, 1) for both in parts)))


def _with(optimum: Optimum, rows: Tensor, others: Optimum) -> Optimum:
    """Some trajectories exchanged for others that cost less."""
    parts = zip(optimum.expansion, others.expansion, strict=True)
    expansion = Expansion(*(part.index_copy(1, rows, new) for part, new in parts))
    return Optimum(exchanged(optimum.path, rows, others.path), expansion)


def _affordable(problem: Problem) -> int:
    """How many trajectories at a time have second derivatives that fit into memory."""
    n, m = problem.system.n, problem.system.m
    return max(1, min(OPTIMA, NUMBERS // (problem.horizon.steps * (n + m) ** 2)))


def examples_of(problem: Problem, optimum: Optimum, generator: torch.Generator) -> Examples:
    """The examples of those trajectories that are finite, in float64: a row at each node, and one at a state near it.

    The second is as far away, and in the direction, as a neighbour is at that time or before, halfway at most; V and
    V_x there are those of the expansion. A fit that knows V on optimal trajectories alone need not keep to them.
    """
    problem, finite = in_float64(problem), optimum.path.cost.isfinite()
    expansion = Expansion(*(part[:, finite] for part in optimum.expansion))
    deviations = torch.zeros_like(expansion.x[:-1]), _towards_neighbours(expansion.x, generator)
    parts = zip(*(_examples_at(problem, expansion, each) for each in deviations), strict=True)
    mean_cost = float(optimum.path.cost[finite].mean())
    return Examples(*(torch.cat(columns) for columns in parts), mean_cost, problem.horizon.duration)  # pyright: ignore


def _towards_neighbours(x: StatePath, generator: torch.Generator) -> Tensor:
    """A deviation (N, b, n) at each node but the last: the difference from a neighbour, then or before, times ±½."""
    nodes, b = len(x) - 1, x.shape[1]
    if b == 1:
        return torch.zeros_like(x[:-1])
    every, node = torch.arange(b), torch.arange(nodes)[:, None]
    near = _nearest(x[0], x[0], itself=False)
    neighbour = near[every, torch.randint(near.shape[1], (nodes, b), generator=generator)]
    before = (node * torch.rand(nodes, b, generator=generator)).long()
    share = torch.rand(nodes, b, 1, generator=generator, dtype=x.dtype) - 0.5
    return share * (x[before, neighbour] - x[before, every])


def _examples_at(problem: Problem, expansion: Expansion, deviation: Tensor) -> list[Tensor]:
    """The columns of the examples at the nodes of some expansions, each a deviation away from them."""
    (x, value, gradient, hessian), dt = expansion, problem.horizon.dt
    now, H = x[:-1] + deviation, hessian[1:]
    here = value[:-1] + ((gradient[:-1] + apply(hessian[:-1], deviation) / 2) * deviation).sum(-1)
    drifted = now + dt * problem.system.f(now)
    g, R = problem.system.g(now), problem.cost.R(now)
    values, vectors = torch.linalg.eigh(2 * R + dt * g.mT @ H @ g)
    floor = 2 * FLOOR * torch.linalg.eigvalsh(R)[..., :1]
    weight = (vectors / values.maximum(floor).sqrt()[..., None, :]).mT @ g.mT
    target = gradient[1:] + apply(H, drifted - x[1:])
    t = problem.horizon.times(now)[:, None].expand(value.shape)
    return [y.flatten(0, 1).detach() for y in (t[:-1], now, here, t[1:], drifted, target, weight)]


def errors(V: ValueFunction, examples: Examples, rows: Tensor | slice = slice(None)) -> tuple[Tensor, Tensor]:
    """Of some of the examples: the mean of (V − V*)²/J̄², and of T/(2J̄) ‖L⁻¹gᵀ(V_x − V_x*)‖².

    The second is what the held controls of V cost beyond the optimum, to second order, as a share of J̄: a step with
    controls u + e costs ½ Δt eᵀ(2R + Δt gᵀHg)e more.
    """
    t, x, value, after, drifted, gradient, weight = (column[rows] for column in examples[:7])
    wrong = weight @ (V.value_and_state_gradient(after, drifted)[1] - gradient)[..., None]
    excess = examples.duration / (2 * examples.mean_cost) * (wrong**2).sum((-2, -1)).mean()
    return ((V(t, x) - value) ** 2).mean() / examples.mean_cost**2, excess


def fit(V: ValueFunction, examples: Examples, generator: torch.Generator) -> None:
    """Lower both errors at the examples, by Adam."""
    trained = [p for p in V.parameters() if p.requires_grad]
    columns = [column.to(trained[0]) for column in examples[:7]]
    examples = Examples(*columns, *examples[7:])  # pyright: ignore[reportCallIssue]
    optimizer = torch.optim.Adam(trained, RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS, RATE / 1000)
    for _ in range(STEPS):
        rows = torch.randint(len(examples.t), (BATCH,), generator=generator).to(trained[0].device)
        value_error, excess = errors(V, examples, rows)
        optimizer.zero_grad()
        (VALUE_WEIGHT * value_error + excess).backward()
        torch.nn.utils.clip_grad_norm_(trained, 1.0)
        optimizer.step()
        schedule.step()
    optimizer.zero_grad()

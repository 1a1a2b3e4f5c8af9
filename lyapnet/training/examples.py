"""Examples of V on optimal trajectories and near them, to which it is fitted."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from lyapnet.base.linear_algebra import apply
from lyapnet.base.types import Control, PerState, State, StatePath
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Unbounded
from lyapnet.training.later_optima import later_optima
from lyapnet.training.learner import Learner
from lyapnet.training.optima import nearest
from lyapnet.value.expansions import (
    FLOOR,
    Optimum,
    Path,
    derivatives_of,
    held_control,
    in_float64,
    penalty_of_one_step,
    sizes,
    step_objective,
    without_penalty,
)
from lyapnet.value.policy import LookaheadPolicy

NEWTON_STEPS = 6  # Newton steps that find the best control, at which the lookahead law evaluates V
MIN_VALUE_SHARE = 1e-4  # of the trajectory's cost: floor of V in the relative errors of a stationary V
MIN_OPTIMA = 32  # with fewer, states beyond them outweigh those along them
TRUST_LIMIT = 0.01  # largest ½ δᵀ|H|δ relative to J for which an expansion is used at a deviation δ
NEIGHBOUR_TRUST_LIMIT = 1.0  # the same for deviations towards neighbours
LOST_EXCESS = 0.02  # cost of a closed loop above the optimum, relative to it, above which optima are sought from it
LATER_TIMES = (0.1, 0.25, 0.4, 0.55, 0.7, 0.85)  # shares of the horizon at which such optima begin
MAX_LATER_OPTIMA = 96  # at each of these times
SEARCH_SECONDS = 30.0  # seconds of work in which such optima are sought


class Examples(NamedTuple):
    """Data of V on optimal trajectories and near them, one row for each of k states."""

    t: Tensor  # t_n (k,)
    x: State
    value: PerState  # V(t_n, x_n)
    after: Tensor  # t_{n+1}
    about: Control  # c, the reference control: at F(x, c) the law evaluates V; the control at rest or the best one
    led: State  # F(x_n, c), the next state under c
    by_control: Tensor  # B (k, n, m), F_u/Δt there
    slope: Control  # ℓ_u there
    weight: Tensor  # W (k, m, m), ℓ_uu + Δt BᵀHB
    best: Control  # the minimiser of ½ (u − c)ᵀW(u − c) + bᵀ(u − c) over U, b = BᵀV_x + ℓ_u
    cost: PerState  # scale of errors of V: J of the trajectory, at least the median J of all
    rate: PerState  # scale of the excess cost per second: `cost` divided by T

    def concatenated_with(self, *others: "Examples") -> "Examples":
        """Concatenation with other examples of the same problem."""
        return Examples(*(torch.cat(columns) for columns in zip(self, *others, strict=True)))

    def each(self, change: Callable[[Tensor], Tensor]) -> "Examples":
        """Apply a function to every column."""
        return Examples(*map(change, self))

    def to(self, like: Tensor) -> "Examples":
        """Convert to the precision and device of a tensor."""
        return self.each(lambda column: column.to(like))


def draw_examples(problem: Problem, optimum: Optimum, generator: torch.Generator, ahead: bool = False) -> Examples:
    """The examples of the finite trajectories, in float64: one row at each node, and one at a state near it.

    The nearby state deviates towards a neighbouring trajectory, by at most half the distance to it at that time or
    earlier; its V and V_x are those of the expansion. A law fitted on optimal trajectories alone may leave them.

    Args:
        ahead: whether the law to be fitted is the lookahead law.
    """
    optimum = select_finite(optimum)
    drawn = _draw_deviations(optimum.expansion.x, generator)
    if problem.horizon.stationary:  # its V has the goal of the end of a range for each parameter beyond it
        drawn = _within_ranges(problem, optimum.expansion.x[:-1], drawn)
    near = _limit_deviations(problem, optimum, drawn, NEIGHBOUR_TRUST_LIMIT)
    return _build_examples(problem, optimum, [torch.zeros_like(near), near], ahead)


def examples_visited(problem: Problem, optimum: Optimum, path: Path, ahead: bool = False) -> Examples:
    """Examples at the states that a law visits from the initial states of the optima, with V from their expansions.

    The law of the fitted V leaves the states of the fit, in directions in which V was not determined. Fitting also at
    the states that this law visits closes the gap (dataset aggregation). States too far from the optimum for its
    expansion are moved closer.

    Source: Ross, Gordon, Bagnell, "A reduction of imitation learning and structured prediction to no-regret online
    learning", AISTATS 2011.
    """
    optimum = select_finite(optimum)
    deviation = path.x[:-1] - optimum.expansion.x[:-1]
    return _build_examples(problem, optimum, [_limit_deviations(problem, optimum, deviation, TRUST_LIMIT)], ahead)


def examples_beyond(
    learner: Learner, optimum: Optimum, path: Path, generator: torch.Generator, progress: Callable[[int, int], None]
) -> list[Examples]:
    """Examples along new optima from states at which costly closed loops have left the known ones; see later_optima."""
    if not seeks_later_optima(learner.problem, optimum):
        return []
    excess = path.cost - optimum.path.cost
    costly = path.cost.isfinite() & (excess > LOST_EXCESS * sizes(learner.problem, optimum.path.cost))
    starts = unknown_states(learner.problem, optimum, path, costly, LATER_TIMES, generator)
    return later_examples(learner, optimum, path, starts, generator, progress)


def seeks_later_optima(problem: Problem, optimum: Optimum) -> bool:
    """Whether optima are also sought from states beyond the known ones: of a horizon, and with enough known ones."""
    return not problem.horizon.stationary and len(optimum.path.cost) >= MIN_OPTIMA


def unknown_states(
    problem: Problem,
    optimum: Optimum,
    path: Path,
    chosen: Tensor,
    times: Sequence[float],
    generator: torch.Generator,
) -> dict[int, Tensor]:
    """Node k ↦ those of at most MAX_LATER_OPTIMA chosen loops whose x_k is too far from the optimum's.

    Args:
        chosen: (b,), which of the loops may be used.
        times: t_k as shares of the horizon.
    """
    N, loops = problem.horizon.steps, torch.nonzero(chosen).flatten()
    loops = loops[torch.randperm(len(loops), generator=generator)[:MAX_LATER_OPTIMA]]
    nodes = sorted({round(share * N) for share in times} - {N})
    at = torch.tensor(nodes)[:, None], loops
    deviation = path.x[at] - optimum.expansion.x[at]
    scale = _error_scale(problem, optimum)[at]
    is_known = _trusted_share(optimum.expansion.hessian[at], scale, deviation, TRUST_LIMIT) >= 1
    return {k: loops[~known] for k, known in zip(nodes, is_known, strict=True)}


def later_examples(
    learner: Learner,
    optimum: Optimum,
    path: Path,
    starts: Mapping[int, Tensor],
    generator: torch.Generator,
    progress: Callable[[int, int], None],
) -> list[Examples]:
    """The examples along optima from the states x_k of some closed loops, given for each node k."""
    problem, ahead = learner.problem, looks_ahead(learner)
    examples, least = list[Examples](), typical_cost(sizes(problem, optimum.path.cost))
    for node, later, optima in later_optima(problem, optimum, path, starts, SEARCH_SECONDS, progress):
        own, began = draw_examples(later, optima, generator, ahead), node * problem.horizon.dt
        cost = own.cost.clamp_min(least)
        examples.append(
            own._replace(t=own.t + began, after=own.after + began, cost=cost, rate=cost / problem.horizon.duration)
        )
    return examples


def _limit_deviations(problem: Problem, optimum: Optimum, deviation: StatePath, share: float) -> StatePath:
    """Scale down deviations δ (N, b, n) for which ½ δᵀ|H|δ is more than a share of the cost."""
    hessian, scale = optimum.expansion.hessian[:-1], _error_scale(problem, optimum)
    return _trusted_share(hessian, scale, deviation, share)[..., None] * deviation


def _trusted_share(hessian: Tensor, scale: Tensor, deviation: StatePath, share: float) -> Tensor:
    """The factor (N, b) ≤ 1 of deviations δ (N, b, n) with which ½ δᵀ|H|δ is at most a share of the scale of costs."""
    values, vectors = torch.linalg.eigh(hessian)
    quadratic = ((apply(vectors.mT, deviation) ** 2 * values.abs()).sum(-1) / 2).nan_to_num(torch.inf)
    ratio = share * scale / quadratic.clamp_min(torch.finfo(quadratic.dtype).tiny)
    return ratio.sqrt().clamp_max(1)


def _build_examples(problem: Problem, optimum: Optimum, deviations: Sequence[Tensor], ahead: bool) -> Examples:
    """The rows at some deviations (N, b, n) from the finite trajectories; rows with non-finite entries are left out."""
    problem, optimum = in_float64(problem), select_finite(optimum)
    blocks = [
        _example_columns(problem, optimum, each, about_best)
        for each in deviations
        for about_best in _reference_controls_are_best(problem, ahead)
    ]
    examples = Examples(*map(torch.cat, zip(*blocks, strict=True)))
    defined = torch.stack([column.reshape(len(column), -1).isfinite().all(1) for column in examples]).all(0)
    return examples.each(lambda column: column[defined])


def _reference_controls_are_best(problem: Problem, ahead: bool) -> Sequence[bool]:
    """The reference controls of a state's rows: True for the best control, False for the control at rest.

    The lookahead law searches from the control at rest to the best one, so V has to be accurate at both. With
    constraints the control at rest may violate one, where V is too steep for a network. The law adds the penalty of one
    step itself, so rows at the best control are sufficient.
    """
    if not ahead or not problem.system.affine:  # the search of the latter does not begin anew with V
        return [ahead]
    return [True] if problem.constraints is not None else [False, True]


def select_finite(optimum: Optimum) -> Optimum:
    """The trajectories of finite cost."""
    return optimum.member(optimum.path.cost.isfinite())


def _error_scale(problem: Problem, optimum: Optimum) -> Tensor:
    """The scale of errors of V at each node but the last, (N, b).

    It is the cost of the trajectory, at least the median of all. For a stationary V it is the value at that state, so
    that V is accurate near the goal too, at least MIN_VALUE_SHARE of the cost.
    """
    size = sizes(problem, optimum.path.cost)
    costs = size.clamp_min(typical_cost(size)).expand(len(optimum.path.u), -1)
    return optimum.expansion.value[:-1].maximum(MIN_VALUE_SHARE * costs) if problem.horizon.stationary else costs


def typical_cost(cost: PerState) -> float:
    """The median of some costs, or their mean if the median is zero."""
    return float(cost.median()) or float(cost.mean())


def _draw_deviations(x: StatePath, generator: torch.Generator) -> Tensor:
    """Random deviations (N, b, n) at all nodes but the last, each up to half an earlier difference to a neighbour."""
    nodes, b = len(x) - 1, x.shape[1]
    if b == 1:
        return torch.zeros_like(x[:-1])
    every, node = torch.arange(b), torch.arange(nodes)[:, None]
    near = nearest(x[0], x[0], itself=False)
    neighbour = near[every, torch.randint(near.shape[1], (nodes, b), generator=generator)]
    before = (node * torch.rand(nodes, b, generator=generator)).long()
    share = torch.rand(nodes, b, 1, generator=generator, dtype=x.dtype) - 0.5
    return share * (x[before, neighbour] - x[before, every])


def _within_ranges(problem: Problem, x: StatePath, deviation: Tensor) -> Tensor:
    """The deviations from x without what leads a constant state out of its range in X₀."""
    box, constants = problem.initial_states, list(problem.system.constants)
    if not constants:
        return deviation
    low, high = (side.to(x)[constants] - x[..., constants] for side in (box.lower, box.upper))
    within = deviation.clone()
    within[..., constants] = deviation[..., constants].maximum(low).minimum(high)
    return within


def _example_columns(problem: Problem, optimum: Optimum, deviation: Tensor, about_best: bool) -> list[Tensor]:
    """The columns of the examples at given deviations from the nodes of some optima.

    The reference control is the best control or the control at rest. For a system that is not affine it is the best
    one, as W says nothing of others, though V is evaluated where the law evaluates it. The constraint penalty of one
    step is not quadratic; its exact value is used.
    """
    (x, value, gradient, hessian), dt = without_penalty(problem, optimum.expansion), problem.horizon.dt
    now, H = x[:-1] + deviation, hessian[1:]
    here = value[:-1] + ((gradient[:-1] + apply(hessian[:-1], deviation) / 2) * deviation).sum(-1)
    here = here + penalty_of_one_step(problem, now)[0]
    floor = 2 * FLOOR * torch.linalg.eigvalsh(problem.cost.R(now))[..., :1]

    def responses(about: Control) -> tuple[State, Tensor, Control, Tensor, Control]:
        """(F, B, ℓ_u, W) at a control, and the best control by the second order expansion there."""
        answer = problem.response(now, about)
        _, slope, bend = penalty_of_one_step(problem, answer.x)
        B = answer.by_control
        W = _raise_eigenvalues(answer.curvature + dt * B.mT @ (H + bend) @ B, floor)
        b = apply(B.mT, gradient[1:] + apply(H, answer.x - x[1:]) + slope) + answer.slope
        return answer.x, B, answer.slope, W, best_control_of_fit(problem, W / 2, b - apply(W, about))

    if problem.system.affine:
        about = problem.rest_at(now)
        led, B, slope, W, best = responses(about)
        for _ in range(NEWTON_STEPS if about_best else 0):
            about = best
            led, B, slope, W, best = responses(about)
    else:
        free = problem.response(now)
        _, slope, bend = penalty_of_one_step(problem, free.x)
        V_x, V_xx = gradient[1:] + apply(H, free.x - x[1:]) + slope, H + bend
        about = best = held_control(problem, now, free, V_x, V_xx)
        W = _raise_eigenvalues(derivatives_of(step_objective(problem, now, free, V_x, V_xx), best)[1], floor)
        answer = problem.response(now, best)
        B, slope, led = answer.by_control, answer.slope, answer.x
        if not about_best:  # the law evaluates V where the nominal control leads
            slope, led = slope + apply(B.mT, apply(V_xx, led - free.x)), free.x
    t, cost = problem.horizon.times(now)[:, None].expand(value.shape), _error_scale(problem, optimum)
    rate = cost / problem.horizon.duration
    if problem.horizon.stationary:
        rate = rate.maximum(-value.diff(dim=0) / dt)
    columns = (t[:-1], now, here, t[1:], about, led, B, slope, W, best, cost, rate)
    return [y.flatten(0, 1).detach() for y in columns]


def _raise_eigenvalues(matrix: Tensor, floor: Tensor) -> Tensor:
    """Symmetric matrices with all eigenvalues raised to at least a floor."""
    values, vectors = torch.linalg.eigh(matrix)
    return (vectors * values.maximum(floor)[..., None, :]) @ vectors.mT


def best_control_of_fit(problem: Problem, W: Tensor, b: Control) -> Control:
    """argmin of uᵀWu + bᵀu + s(u) over U, or over ℝᵐ for a stationary V.

    A stationary V has to decrease wherever u is; without limits its slope is fitted at the limits of u too.
    """
    return problem.cost.best_control(Unbounded() if problem.horizon.stationary else problem.controls, W, b)


def looks_ahead(learner: Learner) -> bool:
    """Whether the learner's law is the lookahead law, which evaluates V at the state that its own control reaches."""
    return isinstance(learner.rollout.closed_loop.policy, LookaheadPolicy)

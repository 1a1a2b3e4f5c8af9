"""Initialises networks from what is known of V before the first step."""

from contextlib import suppress
from typing import Any

import torch
from torch import Tensor

from lyapnet.base.errors import DivergenceError
from lyapnet.base.random_streams import START, stream
from lyapnet.base.types import State, StatePath
from lyapnet.loop.programs.terms import costs_to_go
from lyapnet.task.cost import is_quadratic_about_target
from lyapnet.task.noise import Increments
from lyapnet.task.problem import Problem
from lyapnet.training.examples import typical_cost
from lyapnet.training.learner import Learner
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.expansions import (
    Expansion,
    Optimum,
    greedy_law,
    in_float64,
    path_under,
    riccati,
    sizes,
    without_penalty,
)
from lyapnet.value.networks import (
    ExpansionNetwork,
    IgnoringStates,
    StationaryNetwork,
    WithPenalty,
    kept_states,
    learned_part,
)
from lyapnet.value.networks.near_borders import SPREAD

GOAL_MARGIN = 0.25  # share of the optima's range, by which the goal may lie outside and still be the centre


def network_of(V: ValueFunction) -> Any:
    """The network that can be initialised from an expansion; None if V has none."""
    V = learned_part(V)
    inner = V.network if isinstance(V, IgnoringStates) else V
    return inner if isinstance(inner, ExpansionNetwork | StationaryNetwork) else None


def states_of_value(learner: Learner) -> list[int]:
    """The indices of the states on which a learner's V depends."""
    return kept_states(learner.V, learner.problem.system.n)


def start_from(learner: Learner, expansion: Expansion, x0: State, level: float = 1.0) -> None:
    """Initialise the network of a learner from an expansion.

    Args:
        level: a stationary V uses the regulator's value up to this share of its mean on X₀.
    """
    network, problem, kept = network_of(learner.V), learner.problem, states_of_value(learner)
    expansion, x0 = _remove_known_penalty(learner, expansion), x0.double().cpu()
    deviations = _deviations(problem, expansion, x0)[..., kept]
    expansion, x0 = expansion.restricted_to(kept), x0[..., kept]
    if isinstance(network, StationaryNetwork):
        mean = float(expansion.initially(x0).mean()) or 1.0  # zero if X₀ is the goal alone
        network.start_from_regulator(
            *(part[0].to(network.scale) for part in (expansion.x, expansion.hessian)), scale=level * mean
        )
        return
    curvature = _positive_curvature(network, expansion.hessian)
    parts = (problem.horizon.times(expansion.x), *expansion, curvature, deviations)
    growth = _growth_with_weights(network, problem, expansion, kept)
    network.start_from_expansion(
        *(part.to(network.scale) for part in parts),
        growth=None if growth is None else growth.to(network.scale),
        exact_end=is_quadratic_about_target(problem.cost),
    )
    if network.near_borders is not None:
        network.near_borders.fit(torch.cat([expansion.x, x0]))


def _growth_with_weights(
    network: ExpansionNetwork, problem: Problem, expansion: Expansion, kept: list[int]
) -> Tensor | None:
    """A of `ExpansionNetwork`: how half the logarithm of each H_ii at the goal changes with each weight's logarithm.

    None if V has no weights, if the expansion is not about the goal, or if weights come with targets.
    """
    H, weights = expansion.hessian, network.weights
    if not weights or bool(expansion.value.any()) or bool(H[..., network.constants].any()):
        return None
    exact = in_float64(problem)
    growth = H.new_zeros(*H.shape[:2], len(weights))
    for k, weight in enumerate(weights):
        i, ends = kept[weight], (exact.initial_states.lower, exact.initial_states.upper)
        if not float(ends[1][i]) > float(ends[0][i]):
            continue
        goals = [exact.goal.index_fill(0, torch.tensor(i), float(end[i])) for end in ends]
        low, high = (riccati(exact, goal).restricted_to(kept).hessian.diagonal(0, -2, -1) for goal in goals)
        known = (low > 0) & (high > 0)
        ratio = torch.where(known, high, 1.0) / torch.where(known, low, 1.0)
        growth[..., k] = ratio.log() / 2 / (ends[1][i] - ends[0][i])
    return growth


def _deviations(problem: Problem, expansion: Expansion, x0: State) -> StatePath:
    """Deviations from an expansion's path: of x₀ (k, n) alone, or under noise of closed loops of its law at all nodes.

    Under noise closed loops may spread farther than X₀, which may even be a single point.
    """
    initial = (x0 - expansion.x[0])[None]
    if problem.noise is None:
        return initial
    exact, (steps, dt) = in_float64(problem), (problem.horizon.steps, problem.horizon.dt)
    increments = problem.noise.draw(steps, dt, x0, stream(0, START, 11))
    path = path_under(exact, greedy_law(exact, expansion), x0, increments)
    finite = path.cost.isfinite()
    return path.x[:, finite] - expansion.x[:, None] if finite.any() else initial


def start_from_zero(learner: Learner, optimum: Optimum) -> None:
    """Initialise the network of a learner at V = 0, with the scales of the optima: states, cost and curvature of V.

    The centre is the goal in those states whose range along the optima contains it, else the mean of the optima.
    """
    network, problem, kept = network_of(learner.V), learner.problem, states_of_value(learner)
    expansion = _remove_known_penalty(learner, optimum.expansion).restricted_to(kept)
    goal, (least, most) = problem.goal.double().cpu()[kept], expansion.x.flatten(0, 1).aminmax(dim=0)
    reach = GOAL_MARGIN * (most - least)
    at_goal = (network.moves.cpu() > 0) & (least - reach <= goal) & (goal <= most + reach)
    centre = goal.where(at_goal, expansion.x.mean((0, 1)))
    spread = SPREAD * ((expansion.x - centre) ** 2).mean((0, 1)).sqrt()
    size = expansion.hessian.abs().amax((0, -2, -1))
    curvature = _positive_curvature(network, expansion.hessian[:, size <= size.median()].mean(1))
    cost, like = typical_cost(sizes(problem, optimum.path.cost)) or 1.0, network.scale
    t = problem.horizon.times(expansion.x)
    network.start_from_zero(t.to(like), centre.to(like), curvature.to(like), spread.to(like), cost)
    if network.near_borders is not None:
        network.near_borders.fit(expansion.x.flatten(0, 1))


@torch.no_grad()
def raise_to_costs(learner: Learner, x0: State, increments: Increments) -> None:
    """Change c(t) of a learner's V so that V has the mean of the costs to go at each node of loops under noise.

    What noise adds to V in each step is taken from the costs (see Trajectory.compensated), so that nothing changes
    where V is the cost to go. The law does not depend on c. Where V is zero at the goal, as the cost to go is, loops
    are not finite, or curves are smooth, V stays as it is.
    """
    network, times = network_of(learner.V), learner.problem.horizon.times(x0)
    if not isinstance(network, ExpansionNetwork) or network.at_goal:
        return
    with suppress(DivergenceError):
        loops = learner.rollout(x0, increments).compensated()
        missing = costs_to_go(loops.step_cost, loops.terminal_cost) - loops.require_value()
        network.raise_by(times, missing.mean(1))


def _remove_known_penalty(learner: Learner, expansion: Expansion) -> Expansion:
    """The expansion without the penalty of one step, if the network adds that penalty itself."""
    return without_penalty(learner.problem, expansion) if isinstance(learner.V, WithPenalty) else expansion


def _positive_curvature(network: ExpansionNetwork, hessian: Tensor) -> Tensor:
    """The positive part of V_xx in the states that move; the control law does not depend on the other entries."""
    moves = network.moves.double().cpu()
    values, vectors = torch.linalg.eigh(hessian * moves[:, None] * moves)
    return (vectors * values.clamp_min(0)[..., None, :]) @ vectors.mT

"""What is known of V, put into a network before the first step."""

from typing import Any

import torch
from torch import Tensor

from lyapnet.base.types import State
from lyapnet.task.cost import is_quadratic_about_target
from lyapnet.training.learner import Learner
from lyapnet.training.pretraining import typical
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.expansions import Expansion, Optimum, sizes, without_penalty
from lyapnet.value.networks import (
    ExpansionNetwork,
    IgnoringStates,
    StationaryNetwork,
    WithPenalty,
    kept_states,
    learned_part,
)
from lyapnet.value.networks.near_borders import SPREAD

AROUND = 0.25  # of how far optima go: how far beside them a goal may be that they begin or end at


def network_of(V: ValueFunction) -> Any:
    """The network that an expansion can be put into, if there is one."""
    V = learned_part(V)
    inner = V.network if isinstance(V, IgnoringStates) else V
    return inner if isinstance(inner, ExpansionNetwork | StationaryNetwork) else None


def kept_of(learner: Learner) -> list[int]:
    """The states on which the V of a learner depends."""
    return kept_states(learner.V, learner.problem.system.n)


def take(learner: Learner, expansion: Expansion, x0: State, level: float = 1.0) -> None:
    """Start the network of a learner from an expansion.

    Args:
        level: up to which share of its mean value on X₀ a stationary V takes the regulator for right.
    """
    network, problem, kept = network_of(learner.V), learner.problem, kept_of(learner)
    expansion, x0 = _of_network(learner, expansion).restricted_to(kept), x0[..., kept].double().cpu()
    if isinstance(network, StationaryNetwork):
        mean = float(expansion.initially(x0).mean()) or 1.0  # of an X₀ that is the goal alone
        network.take(*(part[0].to(network.scale) for part in (expansion.x, expansion.hessian)), scale=level * mean)
        return
    curvature = _curvature(network, expansion.hessian)
    parts = (problem.horizon.times(expansion.x), *expansion, curvature, x0 - expansion.x[0])
    network.take(*(part.to(network.scale) for part in parts), exact_end=is_quadratic_about_target(problem.cost))
    if network.near_borders is not None:
        network.near_borders.take(torch.cat([expansion.x, x0]))


def take_nothing(learner: Learner, optimum: Optimum) -> None:
    """Start the network of a learner from V = 0, in units of where optima lead, what they cost, and how V curves there.

    The centre is the goal, in those states in which optima begin, end or pass there, and else the mean of the optima.
    """
    network, problem, kept = network_of(learner.V), learner.problem, kept_of(learner)
    expansion = _of_network(learner, optimum.expansion).restricted_to(kept)
    goal, (least, most) = problem.goal.double().cpu()[kept], expansion.x.flatten(0, 1).aminmax(dim=0)
    reach = AROUND * (most - least)
    at_goal = (network.moves.cpu() > 0) & (least - reach <= goal) & (goal <= most + reach)
    centre = goal.where(at_goal, expansion.x.mean((0, 1)))
    spread = SPREAD * ((expansion.x - centre) ** 2).mean((0, 1)).sqrt()
    size = expansion.hessian.abs().amax((0, -2, -1))
    curvature = _curvature(network, expansion.hessian[:, size <= size.median()].mean(1))
    cost, like = typical(sizes(problem, optimum.path.cost)) or 1.0, network.scale
    t = problem.horizon.times(expansion.x)
    network.take_nothing(t.to(like), centre.to(like), curvature.to(like), spread.to(like), cost)
    if network.near_borders is not None:
        network.near_borders.take(expansion.x.flatten(0, 1))


def _of_network(learner: Learner, expansion: Expansion) -> Expansion:
    """What an expansion of V leaves for the network, which knows the penalty of one step."""
    return without_penalty(learner.problem, expansion) if isinstance(learner.V, WithPenalty) else expansion


def _curvature(network: ExpansionNetwork, hessian: Tensor) -> Tensor:
    """The positive part of V_xx in the states that move; of the others, no law asks how V curves in them."""
    moves = network.moves.double().cpu()
    values, vectors = torch.linalg.eigh(hessian * moves[:, None] * moves)
    return (vectors * values.clamp_min(0)[..., None, :]) @ vectors.mT

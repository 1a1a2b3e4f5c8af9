"""Where training starts from: what is known of V before the first step, chosen by trying."""

import copy
import math
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lyapnet.calculus import ValueFunction
from lyapnet.cost import is_quadratic_about_target
from lyapnet.evaluation.references import costs_of_holding, costs_of_plant
from lyapnet.expansions import (
    TRIES,
    Expansion,
    Optimum,
    at_rest,
    greedy_law,
    in_float64,
    optimal_trajectories,
    path_under,
    riccati,
)
from lyapnet.networks import ExpansionNetwork, IgnoringStates, StationaryNetwork, kept_states
from lyapnet.problem import Problem
from lyapnet.random_streams import START, stream
from lyapnet.training.learner import Learner
from lyapnet.training.optima import OPTIMA, minima, optima_for
from lyapnet.training.pretraining import Examples, examples_of, fit, misfit, relative_misfit, typical
from lyapnet.types import State

STATES = 64  # of X₀, on which a start is tried
GUESSES = 6  # random controls from which the optimum from the centre of X₀ is sought, besides none and Riccati's
CLOSE, FEW = 1e-5, 16  # share of the cost by which nothing may improve on a law that leaves nothing to fit, from FEW
SPREAD = 0.35  # of the distances from the goal along optima, in units of which a network begins without an expansion
MISSED = 0.02  # of the cost: what steps may miss of continuous time without a word
CALM = "V = 0"
LEVELS = tuple(4.0**-k for k in range(9))  # of the regulator's mean value on X₀, up to which it may be taken for right
REMEDY = "rollout.method=rk4, or a smaller horizon.dt"

Report = Callable[[str], None]


def silent(stage: str) -> None:
    """Tell nobody."""


class Candidate(NamedTuple):
    """A start that was tried."""

    name: str
    cost: float  # mean J_N from states of X₀; infinite where a closed loop is not finite
    finite: float  # share of the closed loops
    seconds: float  # from when starts began to be sought until it was rolled out


class Start(NamedTuple):
    """The start of a training: the candidate of least cost, and the others."""

    chosen: Candidate
    candidates: Sequence[Candidate]
    held_cost: float  # of the chosen one in continuous time, u held for Δt

    @property
    def steps_miss(self) -> str:
        """What the steps of the rollout miss of continuous time; empty where that is little."""
        if self.chosen.finite < 1 or not self.chosen.cost or self.chosen.name == CALM:
            return ""
        ratio = self.held_cost / self.chosen.cost
        if abs(ratio - 1) <= MISSED:
            return ""
        by = f"{ratio:.3g} times as much" if math.isfinite(ratio) else "more than any number"
        return f"in continuous time, u held for Δt, the law that training starts from costs {by}"

    def __str__(self) -> str:
        others = "; ".join(self._beside(other) for other in self.candidates if other != self.chosen)
        finite = "" if self.chosen.finite == 1 else f", {_shown(self.chosen)} of X₀"
        return f"start: {self.chosen.name}, the cheapest of {len(self.candidates)}{finite}" + (
            others and f" ({others})"
        )

    def _beside(self, other: Candidate) -> str:
        """A candidate against the chosen one: a ratio, as the states are not those of which a training tells costs."""
        if other.finite < 1 or not 0 < self.chosen.cost < math.inf:
            return f"{other.name}: {_shown(other)}"
        return f"{other.name}: {other.cost / self.chosen.cost:.4g} times its cost"

    def as_json(self) -> dict[str, Any]:
        return {
            "chosen": self.chosen.name,
            "tried": {c.name: c.cost if c.finite == 1 else None for c in self.candidates},
            "held_cost": self.held_cost if math.isfinite(self.held_cost) else None,
            "seconds": {c.name: round(c.seconds, 2) for c in self.candidates},
        }


def choose_start(learners: Sequence[Learner], report: Report = silent) -> Start | None:
    """Put the best of what is known into the networks of learners of one problem; None where there is no place.

    Each candidate's closed loop is rolled out from states of X₀ that no training or evaluation draws: V = 0, each
    expansion, and the expansion that is least wrong along optima from further states of X₀, or nothing, with its
    network fitted to them.

    Args:
        report: told what is being done.
    """
    if not has_place_for_start(learners):
        return None
    networks = [_network_of(learner.V) for learner in learners]
    problem, kept = learners[0].problem, _kept(learners[0])
    x0 = problem.initial_states.sample(STATES, stream(0, START)).to(problem.goal)
    calm = [copy.deepcopy(network.state_dict()) for network in networks]
    report("the optimum from the centre of X₀")
    began, expansions, tried = time.perf_counter(), dict[str, Expansion](), list[Candidate]()
    for name, expansion in expansions_of(problem):
        expansions[name] = expansion
        take(networks[0], problem, expansion, kept, x0)
        tried.append(_tried(name, learners[0], x0, began))
        networks[0].load_state_dict(calm[0])
    if not problem.horizon.stationary or not expansions:
        tried.insert(0, _tried(CALM, learners[0], x0, began))
    if expansions:
        base = _best([each for each in tried if each.name != CALM])
        for network in networks:
            take(network, problem, expansions[base.name], kept, x0)
        if _can_be_improved(problem, expansions[base.name], x0[:FEW]):
            tried += _fitted(learners, list(expansions.values()), calm, base, x0, began, report)
    chosen = _best(tried)
    if chosen.name == CALM:
        for network, state in zip(networks, calm, strict=True):
            network.load_state_dict(state)
            if math.isfinite(chosen.cost) and chosen.cost > 0:
                network.scale.fill_(chosen.cost)
    policy = learners[0].rollout.closed_loop.policy
    return Start(chosen, tried, float(costs_of_plant(problem, policy, x0).mean()))


def has_place_for_start(learners: Sequence[Learner]) -> bool:
    """Whether an expansion can be put into every one of some networks."""
    return all(_network_of(learner.V) is not None for learner in learners)


def _can_be_improved(problem: Problem, expansion: Expansion, x0: State) -> bool:
    """Whether differential dynamic programming gains on the law of an expansion, from any of some states.

    Of all its damping one step at least has to be tried.
    """
    x0 = x0.double().cpu()
    path = path_under(in_float64(problem), greedy_law(in_float64(problem), expansion), x0)
    better = optimal_trajectories(problem, x0, path.u, iterations=TRIES + 1).path.cost
    return not bool((path.cost - better <= CLOSE * better.abs()).all())


def _fitted(
    learners: Sequence[Learner],
    expansions: Sequence[Expansion],
    calm: Sequence[dict[str, Tensor]],
    base: Candidate,
    x0: State,
    began: float,
    report: Report,
) -> list[Candidate]:
    """The candidate whose networks are fitted to optima; none where there are none.

    Where it is no better than the base, the networks are what they were before.
    """
    problem, before = learners[0].problem, [copy.deepcopy(learner.V.state_dict()) for learner in learners]
    report(f"optima from {OPTIMA} states of X₀")
    states = problem.initial_states.sample(OPTIMA, stream(0, START, 2)).to(x0)
    optimum = minima(problem, optima_for(problem, expansions, states))
    found = len(optimum.path.cost)
    if not found:
        return []
    examples = examples_of(problem, optimum, stream(0, START, 4))
    _take_least_wrong(learners, expansions, calm, optimum, examples, x0)
    without_fit = list[Candidate]()
    if problem.horizon.stationary:
        without_fit.append(_tried("the regulator, up to where it is right", learners[0], x0, began))
        if _best([base, *without_fit]) != base:
            before = [copy.deepcopy(learner.V.state_dict()) for learner in learners]
    report(f"fitting V to {found} optima")
    for learner in learners:
        fit(learner, optimum, examples)
    fitted = _tried(f"{found} optima from states of X₀", learners[0], x0, began)
    if _best([base, *without_fit, fitted]) != fitted:
        for learner, state in zip(learners, before, strict=True):
            learner.V.load_state_dict(state)
    return [*without_fit, fitted]


def _take_least_wrong(
    learners: Sequence[Learner],
    expansions: Sequence[Expansion],
    calm: Sequence[dict[str, Tensor]],
    optimum: Optimum,
    examples: Examples,
    x0: State,
) -> None:
    """Put into the networks what a fit to examples begins with: of several expansions, and none, or of several levels
    up to which the regulator is taken for right, the least wrong one.

    An expansion says much near its own path, and away from it, in a task with limits or several ways to the goal, worse
    than nothing.
    """
    problem, kept, first = learners[0].problem, _kept(learners[0]), learners[0]

    def put(choice: tuple[Expansion | None, float], learner: Learner, own: dict[str, Tensor]) -> None:
        network, (expansion, level) = _network_of(learner.V), choice
        network.load_state_dict(own)
        if expansion is None:
            take_nothing(network, problem, optimum, kept)
        else:
            take(network, problem, expansion, kept, x0, level)

    wrong = list[float]()
    choices: list[tuple[Expansion | None, float]] = [(each, 1.0) for each in (*expansions, None)]
    if problem.horizon.stationary:
        choices = [(expansions[0], level) for level in LEVELS]
    for choice in choices:
        put(choice, first, calm[0])
        wrong.append((relative_misfit if problem.horizon.stationary else misfit)(first.V, examples))
    best = choices[wrong.index(min(wrong))]
    for learner, own in zip(learners, calm, strict=True):
        put(best, learner, own)


def _best(candidates: Sequence[Candidate]) -> Candidate:
    return min(candidates, key=lambda each: (-each.finite, each.cost))


def _tried(name: str, learner: Learner, x0: State, began: float) -> Candidate:
    """What the closed loop of a learner costs as it is now."""
    problem = learner.problem
    cost = costs_of_holding(learner.rollout.closed_loop.policy, problem.horizon, problem, x0)
    share = float(cost.isfinite().double().mean())
    return Candidate(name, float(cost.mean()), share, time.perf_counter() - began)


def expansions_of(problem: Problem) -> Iterator[tuple[str, Expansion]]:
    """What can be known of the value function before training, by name, and finite; for controls in a box, or all."""
    if problem.controls.limits is None:
        return
    at_goal, has_rest = riccati(problem), bool(problem.controls.contains(problem.rest))
    if has_rest and all(part.isfinite().all() for part in at_goal):
        yield "the Riccati solution at the goal", at_goal
    centre = problem.initial_states.center.double().cpu()
    if problem.horizon.stationary:
        return
    if has_rest and torch.equal(centre, problem.goal.double().cpu()):
        return
    guesses = _guesses(problem, centre, at_goal)
    optimum = optimal_trajectories(problem, centre.expand(guesses.shape[1], -1), guesses, rivals=True)
    best = optimum.expansion.member(int(optimum.path.cost.argmin()))
    if optimum.path.cost.isfinite().any() and all(part.isfinite().all() for part in best):
        yield "the optimum from the centre of X₀", best


def take(
    network: ExpansionNetwork | StationaryNetwork,
    problem: Problem,
    expansion: Expansion,
    kept: list[int],
    x0: State,
    level: float = 1.0,
) -> None:
    """Start a network from an expansion.

    Args:
        level: up to which share of its mean value on X₀ a stationary V takes the regulator for right.
    """
    expansion, x0 = expansion.restricted_to(kept), x0[..., kept].double().cpu()
    if isinstance(network, StationaryNetwork):
        mean = float(expansion.initially(x0).mean()) or 1.0  # of an X₀ that is the goal alone
        network.take(*(part[0].to(network.scale) for part in (expansion.x, expansion.hessian)), scale=level * mean)
        return
    curvature = _curvature(network, expansion.hessian)
    parts = (problem.horizon.times(expansion.x), *expansion, curvature, x0 - expansion.x[0])
    network.take(*(part.to(network.scale) for part in parts), exact_end=is_quadratic_about_target(problem.cost))


def take_nothing(network: ExpansionNetwork, problem: Problem, optimum: Optimum, kept: list[int]) -> None:
    """Start a network from V = 0, in units of where optima lead, what they cost, and how V curves along them."""
    expansion = optimum.expansion.restricted_to(kept)
    moves = network.moves.cpu() > 0
    centre = problem.goal.double().cpu()[kept].where(moves, expansion.x.mean((0, 1)))
    spread = SPREAD * ((expansion.x - centre) ** 2).mean((0, 1)).sqrt()
    size = expansion.hessian.abs().amax((0, -2, -1))
    curvature = _curvature(network, expansion.hessian[:, size <= size.median()].mean(1))
    cost, like = typical(optimum.path.cost) or 1.0, network.scale
    t = problem.horizon.times(expansion.x)
    network.take_nothing(t.to(like), centre.to(like), curvature.to(like), spread.to(like), cost)


def _curvature(network: ExpansionNetwork, hessian: Tensor) -> Tensor:
    """The positive part of V_xx in the states that move; of the others, no law asks how V curves in them."""
    moves = network.moves.double().cpu()
    values, vectors = torch.linalg.eigh(hessian * moves[:, None] * moves)
    return (vectors * values.clamp_min(0)[..., None, :]) @ vectors.mT


def _guesses(problem: Problem, x0: State, at_goal: Expansion) -> Tensor:
    """Controls (N, guesses, m) from which an optimum from x₀ may be found: Riccati's, none, and random waves.

    The waves cost about what the better of the first two does.
    """
    N, m, waves = problem.horizon.steps, problem.system.m, torch.arange(1, 5)
    exact = in_float64(problem)
    laws = greedy_law(exact, at_goal), at_rest(exact)
    paths = [path_under(exact, law, x0) for law in laws]
    cost = min(float(path.cost) for path in paths)
    dearest = float(torch.linalg.eigvalsh(exact.cost.R(x0))[..., -1])
    amplitude = math.sqrt(cost / (dearest * problem.horizon.duration)) if math.isfinite(cost) else 1.0
    phase = torch.arange(N).double()[:, None] / N * torch.pi * waves
    weights = torch.randn(GUESSES, m, 2, len(waves), generator=stream(0, START, 1), dtype=torch.float64) / waves
    random = torch.einsum("gmaw,awn->ngm", weights, torch.stack([phase.sin(), phase.cos()]).mT)
    return torch.cat([*(path.u[:, None] for path in paths), amplitude * random], 1)


def _network_of(V: ValueFunction) -> Any:
    """The network that an expansion can be put into, if there is one."""
    inner = V.network if isinstance(V, IgnoringStates) else V
    return inner if isinstance(inner, ExpansionNetwork | StationaryNetwork) else None


def _kept(learner: Learner) -> list[int]:
    return kept_states(learner.V, learner.problem.system.n)


def _shown(candidate: Candidate) -> str:
    return f"{candidate.cost:.4g}" if candidate.finite == 1 else f"not finite on {1 - candidate.finite:.0%}"

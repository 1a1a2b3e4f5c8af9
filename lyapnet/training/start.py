"""Where training starts from: what is known of V before the first step, chosen by trying."""

import copy
import math
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
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
)
from lyapnet.linearisation import TO_WRITE, LinAlgError, Missing, riccati_or_reason, singular
from lyapnet.networks import ExpansionNetwork, IgnoringStates, StationaryNetwork, kept_states
from lyapnet.problem import Problem
from lyapnet.random_streams import START, stream
from lyapnet.training.learner import Learner
from lyapnet.training.optima import OPTIMA, minima, optima_for
from lyapnet.training.pretraining import Examples, examples_of, fit, misfit, relative_misfit, typical
from lyapnet.training.stages import Report, silent
from lyapnet.types import State

STATES = 64  # of X₀, on which a start is tried
GUESSES = 6  # random controls from which the optimum from the centre of X₀ is sought, besides none and Riccati's
CLOSE, FEW = 1e-5, 16  # share of the cost by which nothing may improve on a law that leaves nothing to fit, from FEW
SPREAD = 0.35  # of the distances from the goal along optima, in units of which a network begins without an expansion
MISSED = 0.02  # of the cost: what steps may miss of continuous time without a word
CALM = "V = 0"
LEVELS = tuple(4.0**-k for k in range(9))  # of the regulator's mean value on X₀, up to which it may be taken for right
SMALLER = "choose a smaller X₀, or a shorter horizon"
REMEDY = "rollout.method=rk4, or a smaller horizon.dt"


class Candidate(NamedTuple):
    """A start that was tried, or that could not be."""

    name: str
    cost: float  # mean J_N from states of X₀; infinite where a closed loop is not finite
    finite: float  # share of the closed loops
    seconds: float  # from when starts began to be sought until it was rolled out
    missing: Missing | None = None  # why there is nothing to try


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
        finite = "" if self.chosen.finite == 1 else f", {format_cost(self.chosen)} of X₀"
        tried = sum(each.missing is None for each in self.candidates)
        return f"start: {self.chosen.name}, the cheapest of {tried}{finite}" + (others and f" ({others})")

    def _beside(self, other: Candidate) -> str:
        """What is said of a candidate that was not chosen: a ratio, as other states than these are told costs of."""
        if other.missing is not None:
            return f"no {other.name.removeprefix('the ')}: {other.missing.reason}"
        if other.finite < 1 or not 0 < self.chosen.cost < math.inf:
            return f"{other.name}: {format_cost(other)}"
        return f"{other.name}: {other.cost / self.chosen.cost:.4g} times its cost"

    def as_json(self) -> dict[str, Any]:
        return {
            "chosen": self.chosen.name,
            "tried": {c.name: c.cost if c.finite == 1 else None for c in self.candidates},
            "held_cost": self.held_cost if math.isfinite(self.held_cost) else None,
            "seconds": {c.name: round(c.seconds, 2) for c in self.candidates},
        }


def choose_start(
    learners: Sequence[Learner], report: Report = silent, known: Callable[[Candidate], None] = lambda candidate: None
) -> Start | None:
    """Put the best of what is known into the networks of learners of one problem; None where there is no place.

    Each candidate's closed loop is rolled out from states of X₀ that no training or evaluation draws: V = 0, each
    expansion, and the expansion that is least wrong along optima from further states of X₀, or nothing, with its
    network fitted to them.

    Args:
        report: told what is being done.
        known: told each candidate as soon as it is.
    """
    if not has_place_for_start(learners):
        return None
    networks = [_network_of(learner.V) for learner in learners]
    problem, kept = learners[0].problem, _kept(learners[0])
    x0 = problem.initial_states.sample(STATES, stream(0, START)).to(problem.goal)
    calm = [copy.deepcopy(network.state_dict()) for network in networks]
    trials, expansions = _Trials(learners[0], x0, report, known), dict[str, Expansion]()
    for name, expansion in expansions_of(problem, report):
        if isinstance(expansion, Missing):
            trials.leave_out(name, expansion)
            continue
        expansions[name] = expansion
        take(networks[0], problem, expansion, kept, x0)
        trials.roll_out(name)
        networks[0].load_state_dict(calm[0])
    if not problem.horizon.stationary or not expansions:
        trials.roll_out(CALM)
    if expansions:
        base = _best([each for each in trials.tried if each.name != CALM])
        for network in networks:
            take(network, problem, expansions[base.name], kept, x0)
        progress = partial(report, f"improving on {base.name}")
        progress(0, FEW)
        if _can_be_improved(problem, expansions[base.name], x0[:FEW], progress):
            _fit_to_optima(learners, list(expansions.values()), calm, base, trials)
    chosen = _best(trials.tried)
    if chosen.name == CALM:
        for network, state in zip(networks, calm, strict=True):
            network.load_state_dict(state)
            if math.isfinite(chosen.cost) and chosen.cost > 0:
                network.scale.fill_(chosen.cost)
    policy = learners[0].rollout.closed_loop.policy
    held_cost = float(costs_of_plant(problem, policy, x0).mean())
    return Start(chosen, [*trials.tried, *trials.left_out], held_cost)


def has_place_for_start(learners: Sequence[Learner]) -> bool:
    """Whether an expansion can be put into every one of some networks."""
    return all(_network_of(learner.V) is not None for learner in learners)


def _can_be_improved(problem: Problem, expansion: Expansion, x0: State, progress: Callable[[int, int], None]) -> bool:
    """Whether differential dynamic programming gains on the law of an expansion, from any of some states.

    Of all its damping one step at least has to be tried.
    """
    x0 = x0.double().cpu()
    path = path_under(in_float64(problem), greedy_law(in_float64(problem), expansion), x0)
    better = optimal_trajectories(problem, x0, path.u, iterations=TRIES + 1, progress=progress).path.cost
    return not bool((path.cost - better <= CLOSE * better.abs()).all())


def _fit_to_optima(
    learners: Sequence[Learner],
    expansions: Sequence[Expansion],
    calm: Sequence[dict[str, Tensor]],
    base: Candidate,
    trials: "_Trials",
) -> None:
    """Try networks that are fitted to optima, where there are any.

    Where they are no better than the base, the networks are what they were before.
    """
    problem, x0, report = learners[0].problem, trials.x0, trials.report
    before = [copy.deepcopy(learner.V.state_dict()) for learner in learners]
    report(f"optima from {OPTIMA} states of X₀")
    states = problem.initial_states.sample(OPTIMA, stream(0, START, 2)).to(x0)
    try:
        sought = optima_for(problem, expansions, states, report)
    except LinAlgError as error:
        trials.leave_out("optima from states of X₀", singular(error))
        return
    optimum = minima(problem, sought)
    found = len(optimum.path.cost)
    if not found:
        trials.leave_out("optima from states of X₀", _why_none(sought))
        return
    examples = examples_of(problem, optimum, stream(0, START, 4))
    _take_least_wrong(learners, expansions, calm, optimum, examples, x0)
    rivals = [base]
    if problem.horizon.stationary:
        rivals.append(trials.roll_out("the regulator, up to where it is right"))
        if _best(rivals) != base:
            before = [copy.deepcopy(learner.V.state_dict()) for learner in learners]
    report(f"fitting V to {found} optima")
    for learner in learners:
        fit(learner, optimum, examples, report)
    fitted = trials.roll_out(f"{found} optima from states of X₀")
    if _best([*rivals, fitted]) != fitted:
        for learner, state in zip(learners, before, strict=True):
            learner.V.load_state_dict(state)


def _why_none(sought: Optimum) -> Missing:
    """Why there is no minimum with an expansion among trajectories."""
    if sought.path.cost.isfinite().any():
        return Missing("around none of those found has V a finite second order", TO_WRITE)
    return Missing("no trajectory that was tried is finite", SMALLER)


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


class _Trials:
    """The candidates: each is told as soon as it is known."""

    def __init__(self, learner: Learner, x0: State, report: Report, known: Callable[[Candidate], None]):
        self.learner, self.x0, self.report, self.known = learner, x0, report, known
        self.began, self.tried, self.left_out = time.perf_counter(), list[Candidate](), list[Candidate]()

    def roll_out(self, name: str) -> Candidate:
        """Find what the closed loop of the learner costs as it is now."""
        self.report(f"closed loops from {name}")
        problem = self.learner.problem
        cost = costs_of_holding(self.learner.rollout.closed_loop.policy, problem.horizon, problem, self.x0)
        share = float(cost.isfinite().double().mean())
        candidate = Candidate(name, float(cost.mean()), share, time.perf_counter() - self.began)
        self.tried.insert(0 if name == CALM else len(self.tried), candidate)
        self.known(candidate)
        return candidate

    def leave_out(self, name: str, missing: Missing) -> None:
        """Note that there is nothing to try, and why."""
        candidate = Candidate(name, math.inf, 0.0, time.perf_counter() - self.began, missing)
        self.left_out.append(candidate)
        self.known(candidate)


def expansions_of(problem: Problem, report: Report = silent) -> Iterator[tuple[str, Expansion | Missing]]:
    """What can be known of V before training, by name, or why it is not known; for controls in a box, or all.

    Args:
        report: told what is being done.
    """
    if problem.controls.limits is None:
        return
    report("the Riccati solution at the goal")
    at_goal, has_rest = riccati_or_reason(problem), bool(problem.controls.contains(problem.rest))
    if has_rest:
        yield "the Riccati solution at the goal", at_goal
    centre = problem.initial_states.center.double().cpu()
    if problem.horizon.stationary:
        return
    if has_rest and torch.equal(centre, problem.goal.double().cpu()):
        return
    progress = partial(report, "the optimum from the centre of X₀")
    progress(0, 0)
    try:
        guesses = _guesses(problem, centre, at_goal)
        states = centre.expand(guesses.shape[1], -1)
        optimum = optimal_trajectories(problem, states, guesses, rivals=True, progress=progress)
    except LinAlgError as error:
        yield "the optimum from the centre of X₀", singular(error)
        return
    best = optimum.expansion.member(int(optimum.path.cost.argmin()))
    if not optimum.path.cost.isfinite().any():
        missing = Missing("from there no trajectory that was tried is finite", SMALLER)
    elif not all(part.isfinite().all() for part in best):
        missing = Missing("around what was found V has no finite second order", TO_WRITE)
    else:
        missing = None
    yield "the optimum from the centre of X₀", missing or best


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


def _guesses(problem: Problem, x0: State, at_goal: Expansion | Missing) -> Tensor:
    """Controls (N, guesses, m) from which an optimum from x₀ may be found: Riccati's, none, and random waves.

    The waves cost about what the better of the first two does; without Riccati's there is one more of them.
    """
    N, m, waves = problem.horizon.steps, problem.system.m, torch.arange(1, 5)
    exact = in_float64(problem)
    laws = [at_rest(exact)] if isinstance(at_goal, Missing) else [greedy_law(exact, at_goal), at_rest(exact)]
    paths = [path_under(exact, law, x0) for law in laws]
    cost = min(float(path.cost) for path in paths)
    dearest = float(torch.linalg.eigvalsh(exact.cost.R(x0))[..., -1])
    amplitude = math.sqrt(cost / (dearest * problem.horizon.duration)) if math.isfinite(cost) else 1.0
    phase = torch.arange(N).double()[:, None] / N * torch.pi * waves
    weights = (
        torch.randn(GUESSES + 2 - len(laws), m, 2, len(waves), generator=stream(0, START, 1), dtype=torch.float64)
        / waves
    )
    random = torch.einsum("gmaw,awn->ngm", weights, torch.stack([phase.sin(), phase.cos()]).mT)
    return torch.cat([*(path.u[:, None] for path in paths), amplitude * random], 1)


def _network_of(V: ValueFunction) -> Any:
    """The network that an expansion can be put into, if there is one."""
    inner = V.network if isinstance(V, IgnoringStates) else V
    return inner if isinstance(inner, ExpansionNetwork | StationaryNetwork) else None


def _kept(learner: Learner) -> list[int]:
    return kept_states(learner.V, learner.problem.system.n)


def format_cost(candidate: Candidate) -> str:
    """A mean cost, or on what share of the states it is not finite."""
    return f"{candidate.cost:.4g}" if candidate.finite == 1 else f"not finite on {1 - candidate.finite:.0%}"

"""Where training starts from: what is known of V before the first step, chosen by trying."""

import copy
import math
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import torch
from torch import Tensor

from lyapnet.base.random_streams import START, stream
from lyapnet.base.types import State
from lyapnet.evaluation.references import costs_of_holding, costs_of_plant
from lyapnet.task.problem import Problem
from lyapnet.training.candidates import CALM, MUCH, Candidate, Start
from lyapnet.training.initial_networks import network_of, take, take_nothing
from lyapnet.training.learner import Learner
from lyapnet.training.optima import OPTIMA, how_many, minima, optima_for, waves
from lyapnet.training.pretraining import Examples, examples_of, fit, fit_briefly, looks_ahead, misfit, relative_misfit
from lyapnet.training.stages import Report, silent
from lyapnet.value.expansions import (
    TRIES,
    Expansion,
    Optimum,
    at_rest,
    greedy_law,
    in_float64,
    optimal_trajectories,
    path_under,
    sizes,
)
from lyapnet.value.linearisation import TO_WRITE, LinAlgError, Missing, riccati_or_reason, singular
from lyapnet.value.policy import LookaheadPolicy, SampledPolicy

STATES = 64  # of X₀, on which a start is tried
GUESSES = 6  # random controls from which the optimum from the centre of X₀ is sought, besides none and Riccati's
CLOSE, FEW = 1e-5, 16  # share of the cost by which nothing may improve on a law that leaves nothing to fit, from FEW
LEVELS = tuple(4.0**-k for k in range(9))  # of the regulator's mean value on X₀, up to which it may be taken for right
MISLEADING = 0.1  # misfit from which on an expansion says little of how wrong it is once it is fitted
SMALLER = "choose a smaller X₀, or a shorter horizon"
REMEDY = "rollout.method=rk4, or a smaller horizon.dt"


def choose_start(
    learners: Sequence[Learner],
    report: Report = silent,
    known: Callable[[Candidate], None] = lambda candidate: None,
    may_look_ahead: bool = False,
) -> Start | None:
    """Put the best of what is known into the networks of learners of one problem; None where there is no place.

    Each candidate's closed loop is rolled out from states of X₀ that no training or evaluation draws: V = 0, each
    expansion, and the expansion that is least wrong along optima from further states of X₀, or nothing, with its
    network fitted to them. Where the law that looks ahead costs much less with that V, V is fitted for it.

    Args:
        report: told what is being done.
        known: told each candidate as soon as it is.
        may_look_ahead: whether that law may be trained in the place of the sampled one.
    """
    if not has_place_for_start(learners):
        return None
    networks = [network_of(learner.V) for learner in learners]
    problem = learners[0].problem
    x0 = problem.initial_states.sample(STATES, stream(0, START)).to(problem.goal)
    calm = [copy.deepcopy(network.state_dict()) for network in networks]
    trials, expansions = _Trials(learners[0], x0, report, known), dict[str, Expansion]()
    for name, expansion in expansions_of(problem, report, trials.note):
        if isinstance(expansion, Missing):
            trials.leave_out(name, expansion)
            continue
        expansions[name] = expansion
        take(learners[0], expansion, x0)
        trials.roll_out(name)
        networks[0].load_state_dict(calm[0])
    if not problem.horizon.stationary or not expansions:
        trials.roll_out(CALM)
    base = _best([each for each in trials.tried if each.name != CALM or not expansions])
    if expansions:
        for learner in learners:
            take(learner, expansions[base.name], x0)
    sought = _worth_seeking(problem, expansions.get(base.name), x0[:FEW], partial(report, f"improving on {base.name}"))
    optimum = _fit_to_optima(learners, list(expansions.values()), calm, base, trials) if sought else None
    chosen = _best(trials.tried)
    if chosen.name == CALM:
        for network, state in zip(networks, calm, strict=True):
            network.load_state_dict(state)
            if math.isfinite(chosen.cost) and chosen.cost:
                network.scale.fill_(abs(chosen.cost))
    policy, gain_ahead = learners[0].rollout.closed_loop.policy, 0.0
    if sought and type(policy) is SampledPolicy:
        report("closed loops of the law that looks ahead")
        gain_ahead = _gain_by_looking_ahead(policy, x0[:FEW])
        if gain_ahead > MUCH and may_look_ahead and optimum is not None:
            policy = LookaheadPolicy(problem, policy.V)
            chosen = _fit_for_looking_ahead(learners, list(expansions.values()), calm, optimum, trials)
    held_cost = float(costs_of_plant(problem, policy, x0).mean())
    return Start(chosen, [*trials.tried, *trials.left_out], held_cost, gain_ahead)


def _gain_by_looking_ahead(policy: SampledPolicy, x0: State) -> float:
    """By how much the law that looks ahead costs less than V's sampled law, as a share of what costs are held against;
    zero where one of its closed loops is not finite."""
    problem = policy.problem
    laws = policy, LookaheadPolicy(problem, policy.V)
    now, ahead = (costs_of_holding(law, problem.horizon, problem, x0) for law in laws)
    if not now.isfinite().all():
        return float(ahead.isfinite().sum() > now.isfinite().sum())
    gain = (now - ahead).mean() / sizes(problem, ahead).mean()
    return max(float(gain), 0.0) if math.isfinite(gain) else 0.0


def _fit_for_looking_ahead(
    learners: Sequence[Learner],
    expansions: Sequence[Expansion],
    calm: Sequence[dict[str, Tensor]],
    optimum: Optimum,
    trials: "_Trials",
) -> Candidate:
    """Fit each V anew, as the law that looks ahead asks for it; the better of both, under that law."""
    problem, others = learners[0].problem, [learner.looking_ahead() for learner in learners]
    before = [copy.deepcopy(learner.V.state_dict()) for learner in learners]
    with_old = trials.roll_out("the law that looks ahead", others[0])
    examples = examples_of(problem, optimum, stream(0, START, 7), ahead=True)
    _take_least_wrong(others, expansions, calm, optimum, examples, trials.x0)
    for other in others:
        fit(other, optimum, examples, trials.report)
    fitted = trials.roll_out("V fitted for the law that looks ahead", others[0])
    best = _best([with_old, fitted])
    if best != fitted:
        for learner, state in zip(learners, before, strict=True):
            learner.V.load_state_dict(state)
    return best


def has_place_for_start(learners: Sequence[Learner]) -> bool:
    """Whether an expansion can be put into every one of some networks."""
    return all(network_of(learner.V) is not None for learner in learners)


def _worth_seeking(
    problem: Problem, expansion: Expansion | None, x0: State, progress: Callable[[int, int], None]
) -> bool:
    """Whether optima may say more than an expansion: where differential dynamic programming gains on its law, from any
    of some states; and where there is none.

    Of all its damping one step at least has to be tried.
    """
    if expansion is None:
        return problem.controls.limits is not None and not problem.horizon.stationary
    progress(0, len(x0))
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
) -> Optimum | None:
    """Try networks that are fitted to optima, where there are any; the optima.

    Where they are no better than the base, the networks are what they were before.
    """
    problem, x0, report = learners[0].problem, trials.x0, trials.report
    before = [copy.deepcopy(learner.V.state_dict()) for learner in learners]
    states = problem.initial_states.sample(OPTIMA, stream(0, START, 2)).to(x0)
    report(f"optima from {min(OPTIMA, how_many(problem))} states of X₀")
    try:
        sought = optima_for(problem, expansions, states, report)
    except LinAlgError as error:
        trials.leave_out("optima from states of X₀", singular(error))
        return None
    optimum = minima(problem, sought)
    found = len(optimum.path.cost)
    if not found:
        trials.leave_out("optima from states of X₀", _why_none(sought))
        return None
    examples = examples_of(problem, optimum, stream(0, START, 4), looks_ahead(learners[0]))
    name = f"{found} optima from states of X₀"
    trials.note(name, _mended(optimum))
    _take_least_wrong(learners, expansions, calm, optimum, examples, x0)
    rivals = [base]
    if problem.horizon.stationary:
        rivals.append(trials.roll_out("the regulator, up to where it is right"))
        if _best(rivals) != base:
            before = [copy.deepcopy(learner.V.state_dict()) for learner in learners]
    for learner in learners:
        fit(learner, optimum, examples, report)
    fitted = trials.roll_out(name)
    if _best([*rivals, fitted]) != fitted:
        for learner, state in zip(learners, before, strict=True):
            learner.V.load_state_dict(state)
    return optimum


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
    up to which the regulator is taken for right, the least wrong one; where all mislead, after a brief fit.

    An expansion says much near its own path, and away from it, in a task with limits or several ways to the goal, worse
    than nothing.
    """
    problem, first = learners[0].problem, learners[0]

    def put(choice: tuple[Expansion | None, float], learner: Learner, own: dict[str, Tensor]) -> None:
        expansion, level = choice
        network_of(learner.V).load_state_dict(own)
        if expansion is None:
            take_nothing(learner, optimum)
        else:
            take(learner, expansion, x0, level)

    choices: list[tuple[Expansion | None, float]] = [(each, 1.0) for each in (*expansions, None)]
    if problem.horizon.stationary:
        choices = [(expansions[0], level) for level in LEVELS]

    def wrongs(briefly_fitted: bool = False) -> Iterator[float]:
        for choice in choices:
            put(choice, first, calm[0])
            if briefly_fitted:
                fit_briefly(first, examples)
            stationary = problem.horizon.stationary
            yield relative_misfit(first.V, examples) if stationary else misfit(first.V, examples, problem)

    wrong = list(wrongs())
    if min(wrong) > MISLEADING and not problem.horizon.stationary:
        wrong = list(wrongs(briefly_fitted=True))
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
        self.notes = dict[str, str]()

    def note(self, name: str, what: str) -> None:
        """Keep what was done to have a candidate, for when it is tried."""
        self.notes[name] = what

    def roll_out(self, name: str, learner: Learner | None = None) -> Candidate:
        """Find what the closed loop of the learner, or of another one, costs as it is now."""
        self.report(f"closed loops from {name}")
        cost = (learner or self.learner).path_from(self.x0).cost
        share = float(cost.isfinite().double().mean())
        seconds = time.perf_counter() - self.began
        candidate = Candidate(name, float(cost.mean()), share, seconds, note=self.notes.get(name, ""))
        self.tried.insert(0 if name == CALM else len(self.tried), candidate)
        self.known(candidate)
        return candidate

    def leave_out(self, name: str, missing: Missing) -> None:
        """Note that there is nothing to try, and why."""
        candidate = Candidate(name, math.inf, 0.0, time.perf_counter() - self.began, missing)
        self.left_out.append(candidate)
        self.known(candidate)


def expansions_of(
    problem: Problem, report: Report = silent, note: Callable[[str, str], None] = lambda name, what: None
) -> Iterator[tuple[str, Expansion | Missing]]:
    """What can be known of V before training, by name, or why it is not known; for controls in a box, or all.

    Args:
        report: told what is being done.
        note: told by name what was done to have it, where there is something to say.
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
    if has_rest and problem.has_goal and torch.equal(centre, problem.goal.double().cpu()):
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
    optimum = optimum.member(optimum.path.cost.argmin()[None])
    best = optimum.expansion.member(0)
    note("the optimum from the centre of X₀", _mended(optimum))
    if not optimum.path.cost.isfinite().any():
        missing = Missing("from there no trajectory that was tried is finite", SMALLER)
    elif not all(part.isfinite().all() for part in best):
        missing = Missing("around what was found V has no finite second order", TO_WRITE)
    else:
        missing = None
    yield "the optimum from the centre of X₀", missing or best


def _mended(optimum: Optimum) -> str:
    """At how many nodes of optima a derivative does not exist; empty where all do."""
    count, nodes = int(optimum.mended.sum()), optimum.path.x.shape[0] * len(optimum.mended)
    return f"derivatives that do not exist at {count} of {nodes} nodes are those beside them" if count else ""


def _guesses(problem: Problem, x0: State, at_goal: Expansion | Missing) -> Tensor:
    """Controls (N, guesses, m) from which an optimum from x₀ may be found: Riccati's, none, and random waves.

    The waves cost about what the better of the first two does; without Riccati's there is one more of them.
    """
    exact = in_float64(problem)
    laws = [at_rest(exact)] if isinstance(at_goal, Missing) else [greedy_law(exact, at_goal), at_rest(exact)]
    cost = min(float(path_under(exact, law, x0).cost) for law in laws)
    laws += waves(exact, cost, GUESSES + 2 - len(laws))
    return torch.stack([path_under(exact, law, x0).u for law in laws], 1)

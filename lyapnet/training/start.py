"""Chooses the initial V of a training: tries what is known of V before the first step."""

import copy
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial

import torch
from torch import Tensor, nn

from lyapnet.base.errors import UsageError
from lyapnet.base.random_streams import START, stream
from lyapnet.base.types import State
from lyapnet.evaluation.references import costs_of_holding, costs_of_plant
from lyapnet.task.problem import Problem
from lyapnet.training.candidates import MIN_LOOKAHEAD_GAIN, ZERO_VALUE, Candidate, Start
from lyapnet.training.examples import MIN_OPTIMA, Examples, draw_examples, looks_ahead
from lyapnet.training.initial_networks import network_of, raise_to_costs, start_from, start_from_zero
from lyapnet.training.learner import Learner
from lyapnet.training.optima import MAX_OPTIMA, count_optima, minima, optima_for, waves
from lyapnet.training.pretraining import (
    NOT_FITTED,
    FitResult,
    fit,
    fit_briefly,
    misfit,
    relative_misfit,
)
from lyapnet.training.stage_messages import StageReport, silent
from lyapnet.value.expansions import (
    TRIES,
    Expansion,
    Optimum,
    at_rest,
    expansion_of_another_way,
    expansion_under_noise,
    greedy_law,
    in_float64,
    optimal_trajectories,
    path_under,
    sizes,
)
from lyapnet.value.linearisation import TO_WRITE, TOO_MUCH_RISK, LinAlgError, Missing, riccati_or_reason, singular
from lyapnet.value.policy import LookaheadPolicy, SampledPolicy
from lyapnet.value.risk import mean_with_risk

TRIAL_STATES = 64  # states of X₀ on which candidates are compared
RANDOM_GUESSES = 6  # random controls as initial guesses for the optimum from the centre of X₀
OPTIMALITY_TOLERANCE = 1e-5  # relative gain below which a law counts as optimal, so that V needs no fit
TEST_STATES = 16  # states of X₀ on which that is tested
REGULATOR_LEVELS = tuple(4.0**-k for k in range(9))  # levels tried in `start_from`, relative to the mean V on X₀
MAX_INITIAL_MISFIT = 0.1  # above this misfit an expansion does not predict the misfit after a fit
LOOPS_UNDER_NOISE = "loops under noise from states of X₀"  # name of the candidate around them
ANOTHER_WAY = "loops under noise on another way"  # name of the candidate that begins with random controls
GUESSES_UNDER_NOISE = 8  # random controls with which it begins
PATHS_UNDER_NOISE = 4  # paths of the noise from each state on which candidates are compared
NOT_FINITE_REMEDY = "choose a smaller X₀, or a shorter horizon"
STEP_ERROR_REMEDY = "rollout.method=rk4, or a smaller horizon.dt"


def choose_start(
    learners: Sequence[Learner],
    report: StageReport = silent,
    known: Callable[[Candidate], None] = lambda candidate: None,
    may_look_ahead: bool = False,
) -> Start | None:
    """Initialise the networks of some learners of one problem with the best candidate; None if they cannot hold one.

    The candidates are V = 0, each expansion, and a network that is fitted to optimal trajectories. The closed loop of
    each candidate is rolled out from states of X₀ that neither training nor evaluation uses, under noise if there is
    some. Where the lookahead law costs much less with the chosen V, V is fitted again for that law.

    Args:
        report: called with each stage of the work.
        known: called with each candidate as soon as its cost is known.
        may_look_ahead: whether training may replace the sampled law by the lookahead law.

    Raises:
        UsageError: in a task with risk no expansion exists, as with too large a risk.
    """
    if not has_place_for_start(learners):
        return None
    networks = [network_of(learner.V) for learner in learners]
    problem = learners[0].problem
    x0 = problem.initial_states.sample(TRIAL_STATES, stream(0, START)).to(problem.goal)
    drawn = [copy.deepcopy(network.state_dict()) for network in networks]
    trials, expansions = _Trials(learners[0], x0, report, known), dict[str, Expansion]()

    def attempt(name: str, expansion: Expansion) -> None:
        expansions[name] = expansion
        start_from(learners[0], expansion, x0)
        trials.roll_out(name)
        networks[0].load_state_dict(drawn[0])

    for name, expansion in expansions_of(problem, report, trials.note):
        if isinstance(expansion, Missing):
            trials.leave_out(name, expansion)
        else:
            attempt(name, expansion)
    if problem.noise is not None:
        _attempt_expansions_under_noise(trials, expansions, attempt)
    if not expansions and any(each.missing == TOO_MUCH_RISK for each in trials.left_out):
        raise UsageError(
            f"Expected a risk with which some law keeps E exp(risk · J) finite, got {problem.risk:g}, with which V has "
            "no expansion; choose a smaller risk."
        )
    if not problem.horizon.stationary or not expansions:
        trials.roll_out(ZERO_VALUE)
    base = _cheapest([each for each in trials.tried if each.name != ZERO_VALUE or not expansions])
    if expansions:
        for learner in learners:
            start_from(learner, expansions[base.name], x0)
    seeks_optima = _optima_may_help(
        problem, expansions.get(base.name), x0[:TEST_STATES], partial(report, f"improving on {base.name}")
    )
    may_look_ahead = may_look_ahead and not problem.risk  # which that law does not know
    optimum, fitted = None, NOT_FITTED
    if seeks_optima:
        optimum, fitted = _fit_to_optima(learners, list(expansions.values()), drawn, base, trials, may_look_ahead)
    chosen = _cheapest(trials.tried)
    if chosen.name == ZERO_VALUE:
        for network, state in zip(networks, drawn, strict=True):
            network.load_state_dict(state)
            if math.isfinite(chosen.cost) and chosen.cost:
                network.scale.fill_(abs(chosen.cost))
    policy, gain_ahead = learners[0].rollout.closed_loop.policy, fitted.gain_of_another_law
    may_save = gain_ahead > 0 or fitted.excess > MIN_LOOKAHEAD_GAIN  # no law saves more than this excess
    if seeks_optima and type(policy) is SampledPolicy and may_save:
        report("closed loops of the law that looks ahead")
        gain_ahead = gain_ahead or _gain_by_looking_ahead(policy, x0[:TEST_STATES])
        if gain_ahead > MIN_LOOKAHEAD_GAIN and may_look_ahead and optimum is not None:
            policy = LookaheadPolicy(problem, policy.V)
            chosen = _fit_for_looking_ahead(learners, list(expansions.values()), drawn, optimum, trials)
    if trials.increments is not None and not problem.risk:
        for learner in learners:
            raise_to_costs(learner, trials.x0, trials.increments)
    # under noise nothing is said of continuous time
    held_cost = chosen.cost if problem.noise is not None else float(costs_of_plant(problem, policy, x0).mean())
    return Start(chosen, [*trials.tried, *trials.left_out], held_cost, gain_ahead)


def _attempt_expansions_under_noise(
    trials: "_Trials", expansions: Mapping[str, Expansion], attempt: Callable[[str, Expansion], None]
) -> None:
    """Attempt the expansions around loops under noise, those of the cheapest law known and those on another way."""
    problem = trials.learner.problem
    best = expansions[_cheapest(trials.tried).name] if trials.tried else None
    progress = partial(trials.report, LOOPS_UNDER_NOISE)
    if (expansion := expansion_under_noise(problem, best, stream(0, START, 8), progress)) is not None:
        attempt(LOOPS_UNDER_NOISE, expansion)
    if trials.tried and not problem.risk:  # ways are compared by mean costs
        known_best, progress = _cheapest(trials.tried), partial(trials.report, ANOTHER_WAY)
        guesses = waves(in_float64(problem), known_best.cost, GUESSES_UNDER_NOISE)
        other = expansion_of_another_way(problem, expansions[known_best.name], guesses, stream(0, START, 10), progress)
        if other is not None:
            attempt(ANOTHER_WAY, other)


def _gain_by_looking_ahead(policy: SampledPolicy, x0: State, typically: bool = False) -> float:
    """The relative cost that the lookahead law saves against the sampled law of V; 0 if it saves nothing.

    It is 1 if more closed loops of the lookahead law are finite, and 0 if one of them is not finite otherwise.

    Args:
        typically: the median of these gains from each state, so that it does not depend on a few lost loops.
    """
    problem = policy.problem
    laws = policy, LookaheadPolicy(problem, policy.V)
    now, ahead = (costs_of_holding(law, problem.horizon, problem, x0) for law in laws)
    if typically:
        gain = ((now - ahead) / sizes(problem, ahead)).nan_to_num(math.inf).median()
    elif not now.isfinite().all():
        return float(ahead.isfinite().sum() > now.isfinite().sum())
    else:
        gain = (now - ahead).mean() / sizes(problem, ahead).mean()
    return max(float(gain), 0.0) if math.isfinite(gain) else 0.0


def _fit_for_looking_ahead(
    learners: Sequence[Learner],
    expansions: Sequence[Expansion],
    drawn: Sequence[dict[str, Tensor]],
    optimum: Optimum,
    trials: "_Trials",
) -> Candidate:
    """Fit each V again for the lookahead law; keep the better V under that law."""
    problem, others = learners[0].problem, [learner.looking_ahead() for learner in learners]
    before = [copy.deepcopy(learner.V.state_dict()) for learner in learners]
    with_old = trials.roll_out("the law that looks ahead", others[0])
    examples = draw_examples(problem, optimum, stream(0, START, 7), ahead=True)
    _start_from_best(others, expansions, drawn, optimum, examples, trials.x0)
    for other in others:
        fit(other, optimum, examples, trials.report)
    fitted = trials.roll_out("V fitted for the law that looks ahead", others[0])
    best = _cheapest([with_old, fitted])
    if best != fitted:
        for learner, state in zip(learners, before, strict=True):
            learner.V.load_state_dict(state)
    return best


def has_place_for_start(learners: Sequence[Learner]) -> bool:
    """Whether the networks of all learners can be initialised from an expansion."""
    return all(network_of(learner.V) is not None for learner in learners)


def _optima_may_help(
    problem: Problem, expansion: Expansion | None, x0: State, progress: Callable[[int, int], None]
) -> bool:
    """Whether optimal trajectories may be better than the law of an expansion.

    That is the case if differential dynamic programming improves the law from any of some states, or if there is no
    expansion and the controls have limits. TRIES + 1 iterations suffice to try every damping once.
    """
    if expansion is None:
        return problem.controls.limits is not None and not problem.horizon.stationary
    progress(0, len(x0))
    x0 = x0.double().cpu()
    path = path_under(in_float64(problem), greedy_law(in_float64(problem), expansion), x0)
    better = optimal_trajectories(problem, x0, path.u, iterations=TRIES + 1, progress=progress).path.cost
    return not bool((path.cost - better <= OPTIMALITY_TOLERANCE * better.abs()).all())


def _fit_to_optima(
    learners: Sequence[Learner],
    expansions: Sequence[Expansion],
    drawn: Sequence[dict[str, Tensor]],
    base: Candidate,
    trials: "_Trials",
    may_look_ahead: bool,
) -> tuple[Optimum | None, FitResult]:
    """Fit the networks to optimal trajectories.

    If the fitted networks are no better than the base candidate, they are restored.

    Args:
        may_look_ahead: whether a fit may end early because the lookahead law of its V costs much less.

    Returns:
        The optimal trajectories, None if there are none; and how the fits ended: the largest excess, infinite
        if the fitted networks are not kept or few optima are known, and the least gain.
    """
    problem, x0, report = learners[0].problem, trials.x0, trials.report
    before = [copy.deepcopy(learner.V.state_dict()) for learner in learners]
    states = problem.initial_states.sample(MAX_OPTIMA, stream(0, START, 2)).to(x0)
    report(f"optima from {min(MAX_OPTIMA, count_optima(problem))} states of X₀")
    try:
        solutions = optima_for(problem, expansions, states, report)
    except LinAlgError as error:
        trials.leave_out("optima from states of X₀", singular(error))
        return None, NOT_FITTED
    optimum = minima(problem, solutions)
    found = len(optimum.path.cost)
    if not found:
        trials.leave_out("optima from states of X₀", _reason_for_no_optimum(solutions))
        return None, NOT_FITTED
    examples = draw_examples(problem, optimum, stream(0, START, 4), looks_ahead(learners[0]))
    name = f"{found} optima from states of X₀"
    trials.note(name, _describe_replaced_derivatives(optimum))
    _start_from_best(learners, expansions, drawn, optimum, examples, x0)
    rivals = [base]
    if problem.horizon.stationary:
        rivals.append(trials.roll_out("the regulator, up to where it is right"))
        if _cheapest(rivals) != base:
            before = [copy.deepcopy(learner.V.state_dict()) for learner in learners]
    fits = list[FitResult]()
    for learner in learners:
        policy = learner.rollout.closed_loop.policy

        def gain_by_looking_ahead(policy: nn.Module = policy) -> float:
            if not may_look_ahead or type(policy) is not SampledPolicy:
                return 0.0
            gain = _gain_by_looking_ahead(policy, x0[:TEST_STATES], typically=True)
            return gain if gain > MIN_LOOKAHEAD_GAIN else 0.0

        fits.append(fit(learner, optimum, examples, report, gain_by_looking_ahead))
    fitted = trials.roll_out(name)
    is_best = _cheapest([*rivals, fitted]) == fitted
    if not is_best:
        for learner, state in zip(learners, before, strict=True):
            learner.V.load_state_dict(state)
    excess, gain = zip(*fits, strict=True)
    is_known = is_best and found >= min(MIN_OPTIMA, len(solutions.path.cost))
    return optimum, FitResult(max(excess) if is_known else math.inf, min(gain))


def _reason_for_no_optimum(solutions: Optimum) -> Missing:
    """The reason why no trajectory is a minimum with a valid expansion."""
    if solutions.path.cost.isfinite().any():
        return Missing("around none of those found has V a finite second order", TO_WRITE)
    return Missing("no trajectory that was tried is finite", NOT_FINITE_REMEDY)


def _start_from_best(
    learners: Sequence[Learner],
    expansions: Sequence[Expansion],
    drawn: Sequence[dict[str, Tensor]],
    optimum: Optimum,
    examples: Examples,
    x0: State,
) -> None:
    """Choose the initial networks of a fit: the expansion, or V = 0, with the smallest misfit to the examples.

    For a stationary V the choice is between levels up to which the regulator's value is used. If all misfits are large,
    they are compared again after a brief fit. An expansion is accurate near its own path; elsewhere, with limits or
    several ways to the goal, it may be worse than V = 0.
    """
    problem, first = learners[0].problem, learners[0]

    def initialise(choice: tuple[Expansion | None, float], learner: Learner, own: dict[str, Tensor]) -> None:
        expansion, level = choice
        network_of(learner.V).load_state_dict(own)
        if expansion is None:
            start_from_zero(learner, optimum)
        else:
            start_from(learner, expansion, x0, level)

    choices: list[tuple[Expansion | None, float]] = [(each, 1.0) for each in (*expansions, None)]
    if problem.horizon.stationary:
        choices = [(expansions[0], level) for level in REGULATOR_LEVELS]

    def misfits(briefly_fitted: bool = False) -> Iterator[float]:
        for choice in choices:
            initialise(choice, first, drawn[0])
            if briefly_fitted:
                fit_briefly(first, examples)
            stationary = problem.horizon.stationary
            yield relative_misfit(first.V, examples) if stationary else misfit(first.V, examples, problem)

    errors = list(misfits())
    if min(errors) > MAX_INITIAL_MISFIT and not problem.horizon.stationary:
        errors = list(misfits(briefly_fitted=True))
    best = choices[errors.index(min(errors))]
    for learner, own in zip(learners, drawn, strict=True):
        initialise(best, learner, own)


def _cheapest(candidates: Sequence[Candidate]) -> Candidate:
    return min(candidates, key=lambda each: (-each.finite, each.cost))


class _Trials:
    """Tries the candidates, with noise all on the same paths of it, and collects their results."""

    def __init__(self, learner: Learner, x0: State, report: StageReport, known: Callable[[Candidate], None]):
        self.learner, self.x0, self.report, self.known = learner, x0, report, known
        noise, horizon, self.increments = learner.problem.noise, learner.problem.horizon, None
        if noise is not None:
            self.x0 = x0.repeat(PATHS_UNDER_NOISE, 1)
            self.increments = noise.draw(horizon.steps, horizon.dt, self.x0, stream(0, START, 9))
        self.began, self.tried, self.left_out = time.perf_counter(), list[Candidate](), list[Candidate]()
        self.notes = dict[str, str]()

    def note(self, name: str, what: str) -> None:
        """Store a remark about a candidate for its report."""
        self.notes[name] = what

    def roll_out(self, name: str, learner: Learner | None = None) -> Candidate:
        """Compute the cost of a learner's closed loop with its current V."""
        self.report(f"closed loops from {name}")
        cost = (learner or self.learner).path_from(self.x0, self.increments).cost
        share = float(cost.isfinite().double().mean())
        seconds = time.perf_counter() - self.began
        mean = mean_with_risk(cost.unflatten(0, (-1, TRIAL_STATES)), self.learner.problem.risk).mean()
        candidate = Candidate(name, float(mean), share, seconds, note=self.notes.get(name, ""))
        self.tried.insert(0 if name == ZERO_VALUE else len(self.tried), candidate)
        self.known(candidate)
        return candidate

    def leave_out(self, name: str, missing: Missing) -> None:
        """Report a candidate that does not exist, with the reason."""
        candidate = Candidate(name, math.inf, 0.0, time.perf_counter() - self.began, missing)
        self.left_out.append(candidate)
        self.known(candidate)


def expansions_of(
    problem: Problem, report: StageReport = silent, note: Callable[[str, str], None] = lambda name, what: None
) -> Iterator[tuple[str, Expansion | Missing]]:
    """The known expansions of V by name, or the reasons why they do not exist; for controls in a box or unbounded.

    Args:
        report: called with each stage of the work.
        note: called with the name of an expansion and a remark on how it was obtained.
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
        guesses = _initial_controls(problem, centre, at_goal)
        states = centre.expand(guesses.shape[1], -1)
        optimum = optimal_trajectories(problem, states, guesses, rivals=True, progress=progress)
    except LinAlgError as error:
        yield "the optimum from the centre of X₀", singular(error)
        return
    optimum = optimum.member(optimum.path.cost.argmin()[None])
    best = optimum.expansion.member(0)
    note("the optimum from the centre of X₀", _describe_replaced_derivatives(optimum))
    if not optimum.path.cost.isfinite().any():
        missing = Missing("from there no trajectory that was tried is finite", NOT_FINITE_REMEDY)
    elif not all(part.isfinite().all() for part in best):
        missing = Missing("around what was found V has no finite second order", TO_WRITE)
    else:
        missing = None
    yield "the optimum from the centre of X₀", missing or best


def _describe_replaced_derivatives(optimum: Optimum) -> str:
    """Describe at how many nodes a derivative does not exist; empty if all exist."""
    count, nodes = int(optimum.replaced.sum()), optimum.path.x.shape[0] * len(optimum.replaced)
    return f"derivatives that do not exist at {count} of {nodes} nodes are those beside them" if count else ""


def _initial_controls(problem: Problem, x0: State, at_goal: Expansion | Missing) -> Tensor:
    """Initial guesses of the controls (N, guesses, m) for an optimum from x₀: of the Riccati law, at rest, and random.

    The random controls cost about as much as the cheaper of the first two; without the Riccati law there is one more.
    """
    exact = in_float64(problem)
    laws = [at_rest(exact)] if isinstance(at_goal, Missing) else [greedy_law(exact, at_goal), at_rest(exact)]
    cost = min(float(path_under(exact, law, x0).cost) for law in laws)
    laws += waves(exact, cost, RANDOM_GUESSES + 2 - len(laws))
    return torch.stack([path_under(exact, law, x0).u for law in laws], 1)

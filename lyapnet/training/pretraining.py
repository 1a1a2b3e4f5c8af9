"""Supervised pretraining: fits V to optimal trajectories before the training in closed loop."""

import copy
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor, nn

from lyapnet.base.linear_algebra import apply
from lyapnet.base.random_streams import START, stream
from lyapnet.base.threads import seconds_of_work
from lyapnet.base.types import Control, PerState, State, StatePath
from lyapnet.graphs.loss_gradient import gradient_of_loss
from lyapnet.graphs.stateless import trained_of
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Unbounded
from lyapnet.training.later_optima import TIMES, later_optima
from lyapnet.training.learner import Learner
from lyapnet.training.optima import nearest
from lyapnet.training.optimizer import Muon
from lyapnet.training.stage_messages import StageReport, silent
from lyapnet.value.calculus import ValueFunction
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

BATCH_SIZE = 512  # examples in a step
BRIEF_STEPS = 200  # steps of a brief fit, which compares initial values of V
FIT_SECONDS = 60.0, 30.0  # seconds of work for the first fit and for each further round, at most
PACE_SHARE = 0.1  # share of these seconds after which the pace decides whether the learning rate falls by time instead
MIN_GAIN = 2e-4  # relative to the optimal cost: a round that lowers the law's cost by less counts as no gain
NEWTON_STEPS = 6  # Newton steps that find the best control, at which the lookahead law evaluates V
MISFIT_SAMPLES = 20_000  # examples at which the misfit is evaluated
ROUNDS_SECONDS = 120.0  # seconds of work after the first fit, after which no further round begins
SUFFICIENT_COST_RATIO = 1.001  # cost relative to the optima at which the rounds stop
PATIENCE = 2  # consecutive rounds without gain after which the rounds stop
FAR_PATIENCE = 4  # the same while the cost of the best law so far is far above that of the optima
FAR_STEPS_FACTOR = 4  # factor of the steps of a round meanwhile
POOR_COST_RATIO = 1.05  # median cost relative to the optima above which another law is asked for
VALUE_WEIGHT = 10.0  # weight of the squared relative error of V, against the relative excess cost
MIN_VALUE_SHARE = 1e-4  # of the trajectory's cost: floor of V in the relative errors of a stationary V
MIN_OPTIMA = 32  # with fewer, states beyond them outweigh those along them
TRUST_LIMIT = 0.01  # largest ½ δᵀ|H|δ relative to J for which an expansion is used at a deviation δ
NEIGHBOUR_TRUST_LIMIT = 1.0  # the same for deviations towards neighbours


class Method(NamedTuple):
    """How V is fitted to optima, and then in rounds at the states that its law visits."""

    optimizer: Callable[..., torch.optim.Optimizer]
    steps: tuple[int, int]  # of the first fit, and of a round
    rate: tuple[float, float]  # largest learning rate of each
    rounds: int  # largest number of rounds after the first fit
    far_cost_ratio: float  # cost of the best law so far, relative to the optima, above which it is far above them


# With limits or other costs of controls, or limits of states, V_x has kinks. There a V fitted by Muon is accurate along
# optimal trajectories but oscillates beside them, hence Adam; and V may have cliffs, which many steps have to find.
SMOOTH = Method(partial(Muon, weight_decay=0.0), (1000, 500), (0.02, 0.01), rounds=4, far_cost_ratio=math.inf)
WITH_KINKS = Method(torch.optim.Adam, (2000, 1000), (0.01, 0.005), rounds=8, far_cost_ratio=1.003)


def method_for(problem: Problem) -> Method:
    """How V is fitted to optima of a problem."""
    return SMOOTH if problem.has_linear_law and problem.constraints is None else WITH_KINKS


class FitResult(NamedTuple):
    """How a fit ended."""

    excess: float  # mean cost of the fitted law relative to that of the optima, less 1; infinite if a loop is lost
    gain_of_another_law: float  # relative cost that another law of V saves, if that has ended the fit, else 0


NOT_FITTED = FitResult(math.inf, 0.0)


class LawCost(NamedTuple):
    """What a law costs from the initial states of the optima; the smaller of two is better."""

    share_lost: float  # of closed loops that end in infinite costs
    mean: float  # of J, infinite if a loop is lost


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

    def concatenated_with(self, others: "Examples") -> "Examples":
        """Concatenation with other examples of the same problem."""
        return Examples(*(torch.cat(both) for both in zip(self, others, strict=True)))

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
    optimum = _select_finite(optimum)
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
    optimum = _select_finite(optimum)
    deviation = path.x[:-1] - optimum.expansion.x[:-1]
    return _build_examples(problem, optimum, [_limit_deviations(problem, optimum, deviation, TRUST_LIMIT)], ahead)


def examples_beyond(
    learner: Learner, optimum: Optimum, path: Path, generator: torch.Generator, progress: Callable[[int, int], None]
) -> list[Examples]:
    """Examples along new optima from states at which costly closed loops have left the known ones; see later_optima."""
    problem, ahead = learner.problem, looks_ahead(learner)
    if problem.horizon.stationary or len(optimum.path.cost) < MIN_OPTIMA:
        return []
    deviation = path.x[:-1] - optimum.expansion.x[:-1]
    is_known = _trusted_share(problem, optimum, deviation, TRUST_LIMIT) >= 1
    found = later_optima(problem, optimum, path, is_known, generator, FIT_SECONDS[1] / len(TIMES), progress)
    examples, least = list[Examples](), typical_cost(sizes(problem, optimum.path.cost))
    for node, later, optima in found:
        own, began = draw_examples(later, optima, generator, ahead), node * problem.horizon.dt
        cost = own.cost.clamp_min(least)
        examples.append(
            own._replace(t=own.t + began, after=own.after + began, cost=cost, rate=cost / problem.horizon.duration)
        )
    return examples


def _limit_deviations(problem: Problem, optimum: Optimum, deviation: StatePath, share: float) -> StatePath:
    """Scale down deviations δ (N, b, n) for which ½ δᵀ|H|δ is more than a share of the cost."""
    return _trusted_share(problem, optimum, deviation, share)[..., None] * deviation


def _trusted_share(problem: Problem, optimum: Optimum, deviation: StatePath, share: float) -> Tensor:
    """The factor (N, b) ≤ 1 of deviations δ (N, b, n) with which ½ δᵀ|H|δ is at most a share of the cost."""
    values, vectors = torch.linalg.eigh(optimum.expansion.hessian[:-1])
    quadratic = ((apply(vectors.mT, deviation) ** 2 * values.abs()).sum(-1) / 2).nan_to_num(torch.inf)
    ratio = share * _error_scale(problem, optimum) / quadratic.clamp_min(torch.finfo(quadratic.dtype).tiny)
    return ratio.sqrt().clamp_max(1)


def _build_examples(problem: Problem, optimum: Optimum, deviations: Sequence[Tensor], ahead: bool) -> Examples:
    """The rows at some deviations (N, b, n) from the finite trajectories; rows with non-finite entries are left out."""
    problem, optimum = in_float64(problem), _select_finite(optimum)
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


def _select_finite(optimum: Optimum) -> Optimum:
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
        return answer.x, B, answer.slope, W, _best_control_of_fit(problem, W / 2, b - apply(W, about))

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


def errors(V: ValueFunction, examples: Examples, problem: Problem) -> tuple[Tensor, Tensor]:
    """The mean squared value error (V − V*)²/J², and the mean excess cost T/J (Q(u*) − min over u ∈ U of Q(u)).

    Q(u) = ½ (u − c)ᵀW(u − c) + bᵀ(u − c) + s(u), b = BᵀV_x + ℓ_u, is the second order cost per second of a control u
    predicted by V. The excess is zero if V yields the optimal control u*; it is convex in V_x with slope B(u* − u).
    Without control limits it is ½ (b − b*)ᵀW⁻¹(b − b*), the excess cost of V's law. An error of V_x that leaves u at
    its limit costs nothing. For a stationary V, V* replaces J, ℓ at each state replaces J/T, and limits are ignored.

    Source: Blondel, Martins, Niculae, "Learning with Fenchel-Young losses", JMLR 2020.
    """
    t, x, value, after, about, led, B, slope, W, best, cost, rate = examples
    b = apply(B.mT, V.value_and_state_gradient(after, led)[1]) + slope
    with torch.no_grad():
        u = _best_control_of_fit(problem, W / 2, b - apply(W, about))
        besides = problem.cost.beside(best) - problem.cost.beside(u)
    excess = ((best - u) * (apply(W, (best + u) / 2 - about) + b)).sum(-1) + besides  # Q(u*) − Q(u)
    return (((V(t, x) - value) / cost) ** 2).mean(), (excess / rate).mean()


class _Misfit(nn.Module):
    """The loss of a fit: columns of examples ↦ VALUE_WEIGHT times the value error, plus the excess cost."""

    def __init__(self, V: ValueFunction, problem: Problem):
        super().__init__()
        self.V = V
        self._problem = [problem]  # in a list, so that it is no submodule with trained parameters

    def forward(self, *columns: Tensor) -> Tensor:
        (problem,) = self._problem
        value_error, excess = errors(self.V, Examples(*columns), problem)
        return VALUE_WEIGHT * value_error + excess


def _best_control_of_fit(problem: Problem, W: Tensor, b: Control) -> Control:
    """argmin of uᵀWu + bᵀu + s(u) over U, or over ℝᵐ for a stationary V.

    A stationary V has to decrease wherever u is; without limits its slope is fitted at the limits of u too.
    """
    return problem.cost.best_control(Unbounded() if problem.horizon.stationary else problem.controls, W, b)


def misfit(V: ValueFunction, examples: Examples, problem: Problem) -> float:
    """The loss of a fit, at MISFIT_SAMPLES of the examples."""
    rows = torch.linspace(0, len(examples.t) - 1, min(MISFIT_SAMPLES, len(examples.t))).long()
    some = examples.each(lambda column: column[rows])
    with torch.no_grad():
        return float(_Misfit(V, problem)(*some.to(next(V.parameters()))).nan_to_num(torch.inf))


def relative_misfit(V: ValueFunction, examples: Examples) -> float:
    """The mean of (log V − log V*)², for a V that is positive except at the goal."""
    like = next(V.parameters())
    with torch.no_grad():
        own, known = V(examples.t.to(like), examples.x.to(like)), examples.value.to(like)
        least = MIN_VALUE_SHARE * examples.cost.to(like).min()
        return float((own.maximum(least).log() - known.maximum(least).log()).square().mean().nan_to_num(torch.inf))


def fit(
    learner: Learner,
    optimum: Optimum,
    examples: Examples,
    report: StageReport = silent,
    gain_of_another_law: Callable[[], float] = lambda: 0.0,
) -> FitResult:
    """Fit V to examples from optimal trajectories, and then in rounds to the states that its own law visits too.

    The rounds end after those of the Method or ROUNDS_SECONDS, after PATIENCE rounds without gain, when the law costs
    at most SUFFICIENT_COST_RATIO times the optima, or when another law of V costs less while half of the closed loops
    cost POOR_COST_RATIO times their optimum. The V with the cheapest law is kept. Where ROUNDS_SECONDS end the rounds,
    the result depends on the machine.

    Args:
        report: called with each stage of the work.
        gain_of_another_law: the relative cost that another law of the current V saves, 0 if it does not save enough.
    """
    fitting, optimum = _Fit(learner, examples, stream(learner.seed, START, 3)), _select_finite(optimum)
    later_states, method, gain_of_other = stream(learner.seed, START, 12), fitting.method, 0.0
    optimal_cost, cost_sizes = float(optimum.path.cost.mean()), sizes(learner.problem, optimum.path.cost)
    size = float(cost_sizes.mean())
    sufficient_cost, far_cost = (optimal_cost + (r - 1) * size for r in (SUFFICIENT_COST_RATIO, method.far_cost_ratio))
    best_weights, best = copy.deepcopy(learner.V.state_dict()), LawCost(1.0, math.inf)
    is_far, rounds_without_gain, last_start = False, 0, math.inf
    for k in range(method.rounds + 1):
        phase = min(k, 1)  # the first fit, or a further round
        where = f" where its law leads (round {k} of at most {method.rounds} in {ROUNDS_SECONDS:.0f} s)" if k else ""
        stage = f"fitting V to {len(optimum.path.cost)} optima{where} within {FIT_SECONDS[phase]:.0f} s of work"
        steps = method.steps[phase] * (FAR_STEPS_FACTOR if is_far else 1)
        fitting.lower(examples, steps, method.rate[phase], FIT_SECONDS[phase], partial(report, stage))
        if k == 0:
            last_start = seconds_of_work() + ROUNDS_SECONDS
        path = learner.path_from(optimum.path.x[0])
        cost = LawCost(float((~path.cost.isfinite()).double().mean()), float(path.cost.mean()))
        has_gained = cost < best._replace(mean=best.mean - MIN_GAIN * size)
        rounds_without_gain = 0 if has_gained else rounds_without_gain + 1
        if cost < best:
            best_weights, best = copy.deepcopy(learner.V.state_dict()), cost
        is_far = best.mean > far_cost
        is_over = k == method.rounds or seconds_of_work() > last_start
        if is_over or cost.mean <= sufficient_cost or rounds_without_gain >= (FAR_PATIENCE if is_far else PATIENCE):
            break
        if float(((path.cost - optimum.path.cost) / cost_sizes).median()) > POOR_COST_RATIO - 1:
            gain_of_other = gain_of_another_law()
            if gain_of_other:
                break
        examples = examples.concatenated_with(examples_visited(learner.problem, optimum, path, looks_ahead(learner)))
        searching = partial(report, "optima from states where its law leads")
        for later in examples_beyond(learner, optimum, path, later_states, searching):
            examples = examples.concatenated_with(later)
    learner.V.load_state_dict(best_weights)
    excess = math.inf if best.share_lost else (best.mean - optimal_cost) / size
    return FitResult(excess, gain_of_other)


def looks_ahead(learner: Learner) -> bool:
    """Whether the learner's law is the lookahead law, which evaluates V at the state that its own control reaches."""
    return isinstance(learner.rollout.closed_loop.policy, LookaheadPolicy)


def fit_briefly(learner: Learner, examples: Examples) -> None:
    """Fit V to examples in BRIEF_STEPS steps."""
    fitting = _Fit(learner, examples, stream(learner.seed, START, 6))
    fitting.lower(examples, BRIEF_STEPS, fitting.method.rate[0], FIT_SECONDS[0], lambda done, total: None)


class _Fit:
    """Minimises the loss of a fit; its gradient is traced once.

    Args:
        examples: some examples, with which the gradient is traced.
        generator: draws the rows of each step.
    """

    def __init__(self, learner: Learner, examples: Examples, generator: torch.Generator):
        self._trained, self._generator = trained_of(learner.V), generator
        some = examples.each(lambda column: column[torch.linspace(0, len(column) - 1, BATCH_SIZE).long()])
        loss = _Misfit(learner.V, learner.problem)
        self._differentiate = gradient_of_loss(loss, some.to(self._trained[0]))
        self.method = method_for(learner.problem)

    def lower(
        self, examples: Examples, steps: int, rate: float, seconds: float, progress: Callable[[int, int], None]
    ) -> None:
        """Minimise the loss with a cosine learning rate, over a number of steps or seconds of work.

        Where the seconds suffice for all steps the result does not depend on them.
        """
        trained, began = self._trained, seconds_of_work()
        examples, optimizer = examples.to(trained[0]), self.method.optimizer(trained, rate)
        for k in range(steps):
            spent = (seconds_of_work() - began) / seconds
            share = max(k / steps, spent if spent > PACE_SHARE else 0.0)
            if share >= 1:
                break
            for group in optimizer.param_groups:
                group["lr"] = rate * (1e-3 + (1 - 1e-3) * (1 + math.cos(math.pi * share)) / 2)
            progress(k, steps)
            rows = torch.randint(len(examples.t), (BATCH_SIZE,), generator=self._generator).to(trained[0].device)
            self._differentiate(*(column[rows] for column in examples))
            torch.nn.utils.clip_grad_norm_(trained, 1.0)
            optimizer.step()
        optimizer.zero_grad()

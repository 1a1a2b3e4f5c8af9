"""Supervised pretraining: fits V to optimal trajectories before the training in closed loop."""

import copy
import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor, nn

from lyapnet.base.linear_algebra import apply
from lyapnet.base.random_streams import START, stream
from lyapnet.base.threads import seconds_of_work
from lyapnet.graphs.loss_gradient import gradient_of_loss
from lyapnet.graphs.stateless import trained_of
from lyapnet.task.problem import Problem
from lyapnet.training.disturbed_loops import disturbed_path
from lyapnet.training.examples import (
    MIN_VALUE_SHARE,
    Examples,
    best_control_of_fit,
    examples_beyond,
    examples_visited,
    later_examples,
    looks_ahead,
    seeks_later_optima,
    select_finite,
    unknown_states,
)
from lyapnet.training.learner import Learner
from lyapnet.training.optimizer import Muon
from lyapnet.training.stage_messages import StageReport, silent
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.expansions import Optimum, sizes

BATCH_SIZE = 512  # examples in a step
BRIEF_STEPS = 200  # steps of a brief fit, which compares initial values of V
FIT_SECONDS = 60.0, 30.0  # seconds of work for the first fit and for each further round, at most
PACE_SHARE = 0.1  # share of these seconds after which the pace decides whether the learning rate falls by time instead
MIN_GAIN = 2e-4  # relative to the optimal cost: a round that lowers the law's cost by less counts as no gain
MISFIT_SAMPLES = 20_000  # examples at which the misfit is evaluated
ROUNDS_SECONDS = 120.0  # seconds of work after the first fit, after which no further round begins
SUFFICIENT_COST_RATIO = 1.001  # cost relative to the optima at which the rounds stop
PATIENCE = 2  # consecutive rounds without gain after which the rounds stop
FAR_PATIENCE = 4  # the same while the cost of the best law so far is far above that of the optima
FAR_STEPS_FACTOR = 4  # factor of the steps of a round meanwhile
POOR_COST_RATIO = 1.05  # median cost relative to the optima above which another law is asked for
VALUE_WEIGHT = 10.0  # weight of the squared relative error of V, against the relative excess cost
MAX_WIDENED_EXCESS = 0.05  # excess cost of a law up to which V is also fitted where it leads on other plants
DISTURBED_TIMES = tuple(k / 7 for k in range(7))  # shares of the horizon at which optima begin there
DISTURBED_ROUNDS = 3  # largest number of fits to such optima
DISTURBED_STEPS_FACTOR = 2  # each takes this many times the steps of the first fit
TRIED_OPTIMA = 8  # such optima at each time, at which it is seen whether V needs a fit
MAX_DISTURBED_EXCESS = 0.05  # mean relative excess cost there, above which it does
MAX_LOSS = 0.01  # relative cost that the law may lose on the model by a fit; training regains it


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
        u = best_control_of_fit(problem, W / 2, b - apply(W, about))
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


def misfit(V: ValueFunction, examples: Examples, problem: Problem) -> float:
    """The loss of a fit, at MISFIT_SAMPLES of the examples."""
    rows = torch.linspace(0, len(examples.t) - 1, min(MISFIT_SAMPLES, len(examples.t))).long()
    some = examples.each(lambda column: column[rows])
    with torch.no_grad():
        return float(_Misfit(V, problem)(*some.to(next(V.parameters()))).nan_to_num(torch.inf))


@torch.no_grad()
def excess_at(V: ValueFunction, examples: Examples, problem: Problem) -> float:
    """The mean relative excess cost of the law of V at some examples."""
    return float(errors(V, examples.to(next(V.parameters())), problem)[1])


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
    fitting, optimum = _Fit(learner, examples, stream(learner.seed, START, 3)), select_finite(optimum)
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
        visited = examples_visited(learner.problem, optimum, path, looks_ahead(learner))
        searching = partial(report, "optima from states where its law leads")
        examples = examples.concatenated_with(
            visited, *examples_beyond(learner, optimum, path, later_states, searching)
        )
    learner.V.load_state_dict(best_weights)
    excess = math.inf if best.share_lost else (best.mean - optimal_cost) / size
    if not gain_of_other and excess <= MAX_WIDENED_EXCESS and seeks_later_optima(learner.problem, optimum):
        excess = _fit_on_other_plants(learner, fitting, optimum, examples, report, excess)
    return FitResult(excess, gain_of_other)


def _fit_on_other_plants(
    learner: Learner, fitting: "_Fit", optimum: Optimum, examples: Examples, report: StageReport, excess: float
) -> float:
    """Fit V also to optima from states where its law leads on other plants and from beyond X₀; see disturbed_path.

    V is optimal there for the model: its law then meets a plant that differs as well as the model's optimal feedback.
    The fits end when that of the round before holds at new such states, or when the law has become worse on the model.

    Args:
        excess: relative excess cost of the law on the model.

    Returns:
        the excess of the law that is kept.
    """
    generator, problem = stream(learner.seed, START, 13), learner.problem
    mean_size = float(sizes(problem, optimum.path.cost).mean())
    searching = partial(report, "optima from states where its law leads on other plants")
    for k in range(DISTURBED_ROUNDS):
        path = disturbed_path(learner, optimum.path, generator)
        starts = unknown_states(problem, optimum, path, path.cost.isfinite(), DISTURBED_TIMES, generator)
        few = {node: loops[:TRIED_OPTIMA] for node, loops in starts.items()}
        others = {node: loops[TRIED_OPTIMA:] for node, loops in starts.items()}
        new = later_examples(learner, optimum, path, few, generator, searching)
        if not new or excess_at(learner.V, new[0].concatenated_with(*new[1:]), problem) <= MAX_DISTURBED_EXCESS:
            break
        visited = examples_visited(problem, optimum, path, looks_ahead(learner))
        new += later_examples(learner, optimum, path, others, generator, searching)
        examples = examples.concatenated_with(visited, *new)
        before = copy.deepcopy(learner.V.state_dict())
        stage = f"fitting V where its law leads on other plants (round {k + 1} of at most {DISTURBED_ROUNDS})"
        steps = DISTURBED_STEPS_FACTOR * fitting.method.steps[0]
        fitting.lower(examples, steps, fitting.method.rate[1], FIT_SECONDS[1], partial(report, stage))
        cost = learner.path_from(optimum.path.x[0]).cost
        now = float((cost - optimum.path.cost).mean()) / mean_size
        if not now <= excess + MAX_LOSS:
            learner.V.load_state_dict(before)
            break
        excess = now
    return excess


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

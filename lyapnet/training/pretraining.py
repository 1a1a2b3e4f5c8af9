"""Fitting V to optimal trajectories, before it trains in closed loop: supervised, and seconds long."""

import copy
import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor, nn

from lyapnet.base.linear_algebra import apply
from lyapnet.base.random_streams import START, stream
from lyapnet.base.types import Control, PerState, State, StatePath
from lyapnet.graphs.loss_gradient import gradient_of_loss
from lyapnet.graphs.stateless import trained_of
from lyapnet.task.problem import Problem
from lyapnet.task.sets import ControlSet, Unbounded
from lyapnet.training.learner import Learner
from lyapnet.training.optima import nearest
from lyapnet.training.optimizer import Muon
from lyapnet.training.stages import Report, silent
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.expansions import FLOOR, Optimum, Path, in_float64, penalty_of_one_step, sizes, without_penalty
from lyapnet.value.policy import LookaheadPolicy

BATCH = 512  # examples in a step
BRIEF = 200  # steps that tell what a fit can begin with
SECONDS = 60.0, 30.0  # of this thread's work, in which those steps are taken, or as many of them as there is time for
GAIN = 2e-4  # of the cost of the optima, by which a further fit has to lower that of the law for another one
NEWTON = 6  # steps to where a law that looks ahead looks at V
SOME = 20_000  # examples that tell how wrong an expansion is before a fit
ROUNDS, GOOD = 4, 1.001  # of fitting where the fitted law leads, at most; times the optimum, when that is enough
IN_VAIN = 2  # rounds without a gain, one after the other, that are the last
VALUE_WEIGHT = 10.0  # of the squared relative error of V, against the relative excess of the cost
LEAST = 1e-4  # of the cost of its trajectory, against which an error of a stationary V counts where V is less
TRUSTED, TRUSTED_NEAR = 0.01, 1.0  # ½ δᵀ|H|δ, as a share of J, up to which an expansion is believed


class Method(NamedTuple):
    """How a fit moves the weights, before and after the fitted law shows where it leads."""

    optimizer: Callable[..., torch.optim.Optimizer]
    steps: tuple[int, int]
    rate: tuple[float, float]  # the greatest


# Where controls or states are at a limit V_x has kinks: a V that Muon fits is as right along optimal trajectories, and
# wild beside them.
SMOOTH = Method(partial(Muon, weight_decay=0.0), (1000, 500), (0.02, 0.01))
WITH_LIMITS = Method(torch.optim.Adam, (2000, 1000), (0.01, 0.005))


def method_for(problem: Problem) -> Method:
    """The method of a fit to optima of a problem."""
    return WITH_LIMITS if problem.controls.limited or problem.constraints is not None else SMOOTH


class Examples(NamedTuple):
    """What is known along optimal trajectories and near them."""

    t: Tensor  # t_n (k,)
    x: State
    value: PerState  # V(t_n, x_n)
    after: Tensor  # t_{n+1}
    about: Control  # c, where the law looks at V: the control that costs nothing, or the best one
    led: State  # F(x_n, c)
    by_control: Tensor  # B (k, n, m), F_u/Δt there
    slope: Control  # ℓ_u there
    weight: Tensor  # W (k, m, m), ℓ_uu + Δt BᵀHB
    best: Control  # the minimiser of ½ (u − c)ᵀW(u − c) + bᵀ(u − c) over U, b = BᵀV_x + ℓ_u
    cost: PerState  # what errors of V are held against: J of the trajectory, or the median of all if that is more
    rate: PerState  # what excess cost per second is held against: the same per second of T

    def with_further(self, others: "Examples") -> "Examples":
        """These and others of the same problem."""
        return Examples(*(torch.cat(both) for both in zip(self, others, strict=True)))

    def each(self, change: Callable[[Tensor], Tensor]) -> "Examples":
        """The same with every column changed alike."""
        return Examples(*map(change, self))

    def to(self, like: Tensor) -> "Examples":
        """The same in the precision and on the device of a tensor."""
        return self.each(lambda column: column.to(like))


def examples_of(problem: Problem, optimum: Optimum, generator: torch.Generator, ahead: bool = False) -> Examples:
    """The examples of those trajectories that are finite, in float64: a row at each node, and one at a state near it.

    The second is as far away, and in the direction, as a neighbour is at that time or before, halfway at most; V and
    V_x there are those of the expansion. A fit that knows V on optimal trajectories alone need not keep to them.

    Args:
        ahead: whether the law that is fitted looks at V where its own control leads.
    """
    optimum = _finite(optimum)
    near = _trusted(problem, optimum, _towards_neighbours(optimum.expansion.x, generator), TRUSTED_NEAR)
    return _examples(problem, optimum, [torch.zeros_like(near), near], ahead)


def examples_visited(problem: Problem, optimum: Optimum, path: Path, ahead: bool = False) -> Examples:
    """A row at each state that a law led to from where the optimal trajectories begin, as their expansions say.

    A law that V defines leaves the states that V was fitted at, along directions in which V is then free; so the
    states of that very law are examples too. Those too far from the optimum for its expansion are drawn nearer.

    Source: Ross, Gordon, Bagnell, "A reduction of imitation learning and structured prediction to no-regret online
    learning", AISTATS 2011, for the loop.
    """
    optimum = _finite(optimum)
    deviation = path.x[:-1] - optimum.expansion.x[:-1]
    return _examples(problem, optimum, [_trusted(problem, optimum, deviation, TRUSTED)], ahead)


def _trusted(problem: Problem, optimum: Optimum, deviation: StatePath, share: float) -> StatePath:
    """Deviations (N, b, n) from trajectories, drawn nearer where ½ δᵀ|H|δ is more than a share of the cost."""
    values, vectors = torch.linalg.eigh(optimum.expansion.hessian[:-1])
    quadratic = ((apply(vectors.mT, deviation) ** 2 * values.abs()).sum(-1) / 2).nan_to_num(torch.inf)
    ratio = share * _costs_of(problem, optimum) / quadratic.clamp_min(torch.finfo(quadratic.dtype).tiny)
    return ratio.sqrt().clamp_max(1)[..., None] * deviation


def _examples(problem: Problem, optimum: Optimum, deviations: Sequence[Tensor], ahead: bool) -> Examples:
    """The rows at some deviations (N, b, n) from the finite trajectories, where f, g and the cost are defined."""
    problem, optimum = in_float64(problem), _finite(optimum)
    columns = (_columns(problem, optimum, each, at) for each in deviations for at in _looked_at(problem, ahead))
    parts = zip(*columns, strict=True)
    examples = Examples(*(torch.cat(columns) for columns in parts))
    defined = torch.stack([column.reshape(len(column), -1).isfinite().all(1) for column in examples]).all(0)
    return examples.each(lambda column: column[defined])


def _looked_at(problem: Problem, ahead: bool) -> Sequence[bool]:
    """Whether rows are about the best control, or about the one that costs nothing, or there are rows about each.

    A law that looks ahead searches from the second to the first, so that V has to be right at both. With constraints
    the control that costs nothing may lead across one, where V is steeper than a network can follow; as the law knows
    the penalty of one step by itself, rows about the best control are enough.
    """
    if not ahead:
        return [False]
    return [True] if problem.constraints is not None else [False, True]


def _finite(optimum: Optimum) -> Optimum:
    return optimum.member(optimum.path.cost.isfinite())


def _costs_of(problem: Problem, optimum: Optimum) -> Tensor:
    """What errors of V at each node but the last are held against, (N, b).

    It is the cost of the trajectory, or the median of all if that is more. A stationary V is to be right in relation to
    what it is at that state, near the goal too, but for LEAST of the same.
    """
    size = sizes(problem, optimum.path.cost)
    costs = size.clamp_min(typical(size)).expand(len(optimum.path.u), -1)
    return optimum.expansion.value[:-1].maximum(LEAST * costs) if problem.horizon.stationary else costs


def typical(cost: PerState) -> float:
    """The median of some costs, or their mean where half of them are none."""
    return float(cost.median()) or float(cost.mean())


def _towards_neighbours(x: StatePath, generator: torch.Generator) -> Tensor:
    """A deviation (N, b, n) at each node but the last: the difference from a neighbour, then or before, times ±½."""
    nodes, b = len(x) - 1, x.shape[1]
    if b == 1:
        return torch.zeros_like(x[:-1])
    every, node = torch.arange(b), torch.arange(nodes)[:, None]
    near = nearest(x[0], x[0], itself=False)
    neighbour = near[every, torch.randint(near.shape[1], (nodes, b), generator=generator)]
    before = (node * torch.rand(nodes, b, generator=generator)).long()
    share = torch.rand(nodes, b, 1, generator=generator, dtype=x.dtype) - 0.5
    return share * (x[before, neighbour] - x[before, every])


def _columns(problem: Problem, optimum: Optimum, deviation: Tensor, about_best: bool) -> list[Tensor]:
    """The columns of the examples at the nodes of some optima, each a deviation away from them.

    They are about the best control, or the one that costs nothing.

    A penalty for constraints is no quadratic: of what V has of it in one step the known value is taken.
    """
    (x, value, gradient, hessian), dt = without_penalty(problem, optimum.expansion), problem.horizon.dt
    now, H = x[:-1] + deviation, hessian[1:]
    here = value[:-1] + ((gradient[:-1] + apply(hessian[:-1], deviation) / 2) * deviation).sum(-1)
    here = here + penalty_of_one_step(problem, now)[0]
    floor = 2 * FLOOR * torch.linalg.eigvalsh(problem.cost.R(now))[..., :1]

    def responses(about: Control) -> tuple[State, Tensor, Control, Tensor, Control]:
        """(F, B, ℓ_u, W) about a control, and the best one as V is to second order there."""
        answer = problem.response(now, about)
        _, slope, bend = penalty_of_one_step(problem, answer.x)
        B = answer.by_control
        values, vectors = torch.linalg.eigh(answer.curvature + dt * B.mT @ (H + bend) @ B)
        W = (vectors * values.maximum(floor)[..., None, :]) @ vectors.mT
        b = apply(B.mT, gradient[1:] + apply(H, answer.x - x[1:]) + slope) + answer.slope
        return answer.x, B, answer.slope, W, _compared(problem).minimise(W / 2, b - apply(W, about))

    about = problem.rest.to(now).expand(*now.shape[:-1], -1)
    led, B, slope, W, best = responses(about)
    for _ in range(NEWTON if about_best else 0):
        about = best
        led, B, slope, W, best = responses(about)
    t, cost = problem.horizon.times(now)[:, None].expand(value.shape), _costs_of(problem, optimum)
    rate = cost / problem.horizon.duration
    if problem.horizon.stationary:
        rate = rate.maximum(-value.diff(dim=0) / dt)
    columns = (t[:-1], now, here, t[1:], about, led, B, slope, W, best, cost, rate)
    return [y.flatten(0, 1).detach() for y in columns]


def errors(V: ValueFunction, examples: Examples, problem: Problem) -> tuple[Tensor, Tensor]:
    """The means of (V − V*)²/J², and of T/J (Q(u*) − min over u ∈ U of Q(u)).

    Q(u) = ½ (u − c)ᵀW(u − c) + bᵀ(u − c) is what one second of u costs to second order as V has it, b = BᵀV_x + ℓ_u:
    the second is zero where V asks for the optimal control u*, and convex in V_x, of slope B(u* − u). Without limits it
    is ½ (b − b*)ᵀW⁻¹(b − b*), what the law of V costs beyond the optimum; a V_x that is wrong where u is at its limit
    all the same costs nothing. Of a stationary V, J stands for V* and J/T for ℓ at each state, and limits are left out.

    Source: Blondel, Martins, Niculae, "Learning with Fenchel-Young losses", JMLR 2020.
    """
    t, x, value, after, about, led, B, slope, W, best, cost, rate = examples
    b = apply(B.mT, V.value_and_state_gradient(after, led)[1]) + slope
    with torch.no_grad():
        u = _compared(problem).minimise(W / 2, b - apply(W, about))
    excess = ((best - u) * (apply(W, (best + u) / 2 - about) + b)).sum(-1)  # Q(u*) − Q(u)
    return (((V(t, x) - value) / cost) ** 2).mean(), (excess / rate).mean()


class _Misfit(nn.Module):
    """Columns of examples ↦ what a fit lowers."""

    def __init__(self, V: ValueFunction, problem: Problem):
        super().__init__()
        self.V = V
        self._problem = [problem]  # which has no part in what is trained

    def forward(self, *columns: Tensor) -> Tensor:
        (problem,) = self._problem
        value_error, excess = errors(self.V, Examples(*columns), problem)
        return VALUE_WEIGHT * value_error + excess


def _compared(problem: Problem) -> ControlSet:
    """The controls among which those of V are compared with the best ones.

    A stationary V is asked whether it falls, wherever u is: its slopes are to be right at the limits of u too.
    """
    return Unbounded() if problem.horizon.stationary else problem.controls


def misfit(V: ValueFunction, examples: Examples, problem: Problem) -> float:
    """What a fit lowers, at SOME of the examples."""
    rows = torch.linspace(0, len(examples.t) - 1, min(SOME, len(examples.t))).long()
    some = examples.each(lambda column: column[rows])
    with torch.no_grad():
        return float(_Misfit(V, problem)(*some.to(next(V.parameters()))).nan_to_num(torch.inf))


def relative_misfit(V: ValueFunction, examples: Examples) -> float:
    """The mean of (log V − log V*)², of a V that is positive but at the goal."""
    like = next(V.parameters())
    with torch.no_grad():
        own, known = V(examples.t.to(like), examples.x.to(like)), examples.value.to(like)
        least = LEAST * examples.cost.to(like).min()
        return float((own.maximum(least).log() - known.maximum(least).log()).square().mean().nan_to_num(torch.inf))


def fit(learner: Learner, optimum: Optimum, examples: Examples, report: Report = silent) -> None:
    """Lower both errors of V at examples from optimal trajectories, and then where its own law leads too.

    The second is repeated, ROUNDS times at most, until the law costs no more than GOOD times the optima, or a further
    round gains nothing. The V whose law cost least stays.

    Args:
        report: is told what is being done.
    """
    fitting, optimum = _Fit(learner, examples, stream(learner.seed, START, 3)), _finite(optimum)
    method = fitting.method
    best, least, in_vain = copy.deepcopy(learner.V.state_dict()), (0.0, math.inf), 0
    size = float(sizes(learner.problem, optimum.path.cost).mean())
    enough, gain = float(optimum.path.cost.mean()) + (GOOD - 1) * size, GAIN * size
    for k in range(ROUNDS + 1):
        again = f" where its law leads ({k} of at most {ROUNDS})" if k else ""
        late = min(k, 1)
        within = f"within {SECONDS[late]:.0f} s of work"
        progress = partial(report, f"fitting V to {len(optimum.path.cost)} optima{again} {within}")
        fitting.lower(examples, method.steps[late], method.rate[late], SECONDS[late], progress)
        path = learner.path_from(optimum.path.x[0])
        now = -float(path.cost.isfinite().double().mean()), float(path.cost.mean())
        in_vain = 0 if now < (least[0], least[1] - gain) else in_vain + 1
        if now < least:
            best, least = copy.deepcopy(learner.V.state_dict()), now
        if k == ROUNDS or now[1] <= enough or in_vain == IN_VAIN:
            break
        examples = examples.with_further(examples_visited(learner.problem, optimum, path, looks_ahead(learner)))
    learner.V.load_state_dict(best)


def looks_ahead(learner: Learner) -> bool:
    """Whether the law of a learner looks at V where its own control leads, and not the one that costs nothing."""
    return isinstance(learner.rollout.closed_loop.policy, LookaheadPolicy)


def fit_briefly(learner: Learner, examples: Examples) -> None:
    """Lower both errors of V at examples in a few steps."""
    briefly = _Fit(learner, examples, stream(learner.seed, START, 6))
    briefly.lower(examples, BRIEF, briefly.method.rate[0], SECONDS[0], lambda done, total: None)


class _Fit:
    """Lowers both errors of V at examples; their gradient is traced once.

    Args:
        examples: like all that V is fitted to.
        generator: draws the rows of each step.
    """

    def __init__(self, learner: Learner, examples: Examples, generator: torch.Generator):
        self._trained, self._generator = trained_of(learner.V), generator
        some = examples.each(lambda column: column[torch.linspace(0, len(column) - 1, BATCH).long()])
        loss = _Misfit(learner.V, learner.problem)
        self._differentiate = gradient_of_loss(loss, some.to(self._trained[0]))
        self.method = method_for(learner.problem)

    def lower(
        self, examples: Examples, steps: int, rate: float, seconds: float, progress: Callable[[int, int], None]
    ) -> None:
        """The learning rate falls as a cosine over the steps, or the seconds of this thread's work."""
        trained, began = self._trained, time.thread_time()
        examples, optimizer = examples.to(trained[0]), self.method.optimizer(trained, rate)
        for k in range(steps):
            share = max(k / steps, (time.thread_time() - began) / seconds)
            if share >= 1:
                break
            for group in optimizer.param_groups:
                group["lr"] = rate * (1e-3 + (1 - 1e-3) * (1 + math.cos(math.pi * share)) / 2)
            progress(k, steps)
            rows = torch.randint(len(examples.t), (BATCH,), generator=self._generator).to(trained[0].device)
            self._differentiate(*(column[rows] for column in examples))
            torch.nn.utils.clip_grad_norm_(trained, 1.0)
            optimizer.step()
        optimizer.zero_grad()

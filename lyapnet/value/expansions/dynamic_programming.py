"""Optimal trajectories of the discretised problem, and the value function to second order around them.

The problem is J_N = Σ_{n<N} l(x_n, u_n) + φ(x_N) along x_{n+1} = F(x_n, u_n), both of them `Problem.step`: with Euler
F = x + Δt(f + gu) and l = Δt ℓ. With Q(x, u) = l + V_{n+1}(F(x, u)), backwards from V_N = φ and to second order in
(x, u),

    k = −Q_uu⁻¹Q_u,   K = −Q_uu⁻¹Q_ux,   V_n = Q at u = ū + k + K(x − x̄).

Along an optimal trajectory k = 0, and V_n is the value function to second order. Around a state that stays where it is,
with F linearised and q, φ quadratic, it is the Riccati solution; of an affine system, if f does not vanish there.

Source: Jacobson, Mayne, Differential Dynamic Programming, 1970; the line search as in Tassa, Mansard, Todorov,
"Control-limited differential dynamic programming", ICRA 2014.
"""

import math
import time
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from lyapnet.base.linear_algebra import is_positive_definite, solve
from lyapnet.base.types import Control, ControlPath, PerState, State, StatePath
from lyapnet.task.cost import PenaltyCost, spread
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Unbounded
from lyapnet.value.derivatives import StepDerivatives, Steps, costates, jacobian, steps_along, with_curvature
from lyapnet.value.expansions.laws import Expansion, greedy_law
from lyapnet.value.expansions.paths import Path, cheapest, exchanged, in_float64, path_of, path_under
from lyapnet.value.expansions.step_programs import StepPrograms

STEP_SIZES = tuple(0.5**k for k in range(10))
FLOOR = 0.1  # least eigenvalue of Q_uu, as a share of that of the control cost
NEAR = 1e-3  # share of J_N of which no more is expected or gained when the second derivatives of F join
SETTLED, OPTIMAL = 1e-9, 1e-12  # with them: share that the last search gains, and that is left of an optimum
HOPELESS, GRACE = 2.0, 20  # times the cost of a settled rival; iterations for which that is not asked
ROUNDING = 1e-12  # of the largest eigenvalue of Q_uu, below which the others are lost in it
TRIES = 9  # failures in a row, each with ten times the damping, after which a trajectory is left as it is


class Optimum(NamedTuple):
    """Locally optimal trajectories from a batch of states, with the value function around each."""

    path: Path
    expansion: Expansion
    mended: PerState  # at how many of the nodes of each some derivative does not exist, and is taken beside them

    def member(self, rows: Tensor) -> "Optimum":
        """Those with some indices."""
        return Optimum(self.path.member(rows), self.expansion.member(rows), self.mended[rows])


class _Backward(NamedTuple):
    k: ControlPath
    K: Tensor  # (N, *batch, m, n)
    expansion: Expansion
    mended: Tensor  # (N + 1, *batch) the nodes with a derivative that does not exist

    def member(self, rows: Tensor) -> "_Backward":
        """Those with some indices."""
        return _Backward(self.k[:, rows], self.K[:, rows], self.expansion.member(rows), self.mended[:, rows])


def riccati(problem: Problem) -> Expansion:
    """The value function of the problem linearised at its goal, x̄ = x*: F to first order, q, R and φ to second.

    Limits of the controls are left out: near a goal that needs no control none is active.
    """
    return _at_goal(problem).expansion


def regulator(problem: Problem) -> tuple[ControlPath, Tensor]:
    """(ū, K) of the law ū_n + K_n(x − x*) whose value `riccati` is: the linear-quadratic regulator of N steps.

    ū_n (N, m) is the control that holds x*, or what is least dear where none does; K is (N, m, n).
    """
    backward = _at_goal(problem)
    return problem.rest.double().cpu() + backward.k, backward.K


def _at_goal(problem: Problem) -> "_Backward":
    """The backward pass around x*, without limits."""
    problem, N = in_float64(problem).replaced(controls=Unbounded()), problem.horizon.steps
    x, u = problem.goal.expand(N + 1, -1), problem.rest.expand(N, -1)
    return _backward(problem, StepDerivatives(problem.step, problem.system.n), x, u, curved=False)


def optimal_trajectories(
    problem: Problem,
    x0: State,
    u: ControlPath,
    iterations: int = 80,
    rivals: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
    seconds: float = math.inf,
) -> Optimum:
    """Locally optimal trajectories from a batch of states (b, n), from controls (N, b, m) on, all at once.

    First without the second derivatives of F, which far from an optimum point anywhere, then with them. Steps of higher
    order begin with what Euler steps lead to, where that is cheaper than the controls that are given: far from an
    optimum those are as good a guide, and less work. Where the controls lead nowhere finite the cost is infinite.

    Args:
        iterations: of each of the two kinds, at the most.
        rivals: the controls are guesses from one state, of which only the best counts: once one has settled, those
            that still cost HOPELESS times as much are left as they are.
        progress: is told how many trajectories are done, of how many, each descent counting for its share.
        seconds: of this thread's work, after which trajectories are left as they are then.
    """
    until = time.thread_time() + seconds
    problem = in_float64(problem)
    x0, u = x0.double(), problem.controls.project(u.double())

    def under(controls: ControlPath, problem: Problem = problem) -> Path:
        return path_under(problem, lambda n, _: controls[n], x0)

    def descended(programs: StepPrograms, now: Path, curved: bool, kind: int) -> "_Descent":
        descent = _Descent(programs, now, curved)
        descent.run(iterations, rivals, lambda count: progress((kind * b + count) // kinds, b), until)
        return descent

    higher_order = problem.horizon.method != "euler"
    now, kinds, b = under(u), 2 + higher_order, len(x0)
    if higher_order:
        roughly = problem.in_steps(method="euler")
        rough = StepPrograms(roughly, STEP_SIZES)
        euler = descended(rough, under(u, roughly), curved=False, kind=0).now
        now = cheapest([now, under(euler.u)])
    programs = StepPrograms(problem, STEP_SIZES)
    now = descended(programs, now, curved=False, kind=kinds - 2).now
    descent = descended(programs, now, curved=True, kind=kinds - 1)
    if not programs.agrees(descent.now) and programs.forget():  # its numbers changed since programs were written
        return optimal_trajectories(problem, x0, u, iterations, rivals, progress, until - time.thread_time())
    return descent.optimum()


def follow_expansions(problem: Problem, expansion: Expansion, x0: State) -> Path:
    """Where each of a batch of states is led by the law that an expansion of its own asks for.

    Args:
        problem: in float64, on the CPU.
        expansion: one for each state of x0 (b, n).
    """
    if not len(x0):
        return path_under(problem, greedy_law(problem, expansion), x0)
    programs = StepPrograms(problem, STEP_SIZES)
    path = path_of(problem, *programs.follow(expansion, x0))
    if not programs.agrees(path) and programs.forget():  # its numbers changed since programs were written
        return follow_expansions(problem, expansion, x0)
    return path


class _Descent:
    """Line searches until no trajectory gains, or is expected to gain, more than a share of its cost.

    What a pass without damping expects is its V_0(x₀) beside J_N: to second order what the full step leads to. Each
    trajectory has its own damping.

    Args:
        programs: of the problem's steps.
        now: trajectories to begin with.
        curved: with the second derivatives of F.
    """

    def __init__(self, programs: StepPrograms, now: Path, curved: bool):
        self.programs, self.curved = programs, curved
        self._gained, self._expected = (SETTLED, OPTIMAL) if curved else (NEAR, NEAR)
        self.now, self._passes = now, list[tuple[Tensor, _Backward]]()  # (rows, the pass that expected no more of them)

    def run(self, iterations: int, rivals: bool, progress: Callable[[int], None], until: float) -> None:
        """Iterate; see optimal_trajectories."""
        cost = self.now.cost
        damping, failures, settled = torch.zeros_like(cost), torch.zeros_like(cost), ~cost.isfinite()
        for k in range(iterations):
            rows = torch.nonzero(~settled).flatten()
            progress(len(settled) - len(rows))
            if not len(rows) or time.thread_time() > until:
                break
            was, backward = self._pass(rows, damping[rows])
            expected = (was.cost - backward.expansion.value[0]).abs()
            unsettled = (damping[rows] > 0) | ~(expected <= self._expected * was.cost.abs())
            if not unsettled.all():
                self._passes.append((rows[~unsettled], backward.member(~unsettled)))
                settled[rows[~unsettled]] = True
                rows, was, backward = rows[unsettled], was.member(unsettled), backward.member(unsettled)
            if len(rows):
                tried = _line_search(self.programs.problem, self.programs, was, backward)
                better = tried.cost < was.cost
                gain = torch.where(better, was.cost - tried.cost, 0)
                self.now = exchanged(self.now, rows[better], tried.member(better))
                failures[rows] = torch.where(better, 0, failures[rows] + 1)
                damping[rows] = torch.where(better, damping[rows] / 10, (10 * damping[rows]).clamp_min(1e-3))
                settled[rows] = better & (gain <= self._gained * was.cost.abs()) | (failures[rows] > TRIES)
            if rivals and (self.curved or k >= GRACE) and settled.any():
                least = self.now.cost[settled].min()
                settled |= self.now.cost > least + (HOPELESS - 1) * least.abs()

    def optimum(self) -> Optimum:
        """The trajectories, with V around each; one without a kept pass gets its pass now."""
        has_no_pass = torch.ones_like(self.now.cost, dtype=torch.bool)
        for rows, _ in self._passes:
            has_no_pass[rows] = False
        others, passes = torch.nonzero(has_no_pass).flatten(), self._passes
        if len(others):
            passes = [*passes, (others, self._pass(others)[1])]
        order = torch.cat([rows for rows, _ in passes]).argsort()
        parts = zip(*(backward.expansion for _, backward in passes), strict=True)
        mended = torch.cat([backward.mended for _, backward in passes], 1)[:, order].sum(0)
        return Optimum(self.now, Expansion(*(torch.cat(each, 1)[:, order] for each in parts)), mended)

    def _pass(self, rows: Tensor, damping: Tensor | None = None) -> tuple[Path, _Backward]:
        """Some of the trajectories, and the pass backwards along them."""
        path = self.now.member(rows)
        return path, _backward(self.programs.problem, self.programs, path.x, path.u, damping, self.curved)


def sizes(problem: Problem, cost: PerState) -> PerState:
    """What differences of the costs of some trajectories are held against: each cost; without a goal their spread."""
    finite = cost[cost.isfinite()]
    if problem.has_goal or not len(finite):
        return cost
    return spread(finite).expand_as(cost)


def penalty_of_one_step(problem: Problem, x: State) -> tuple[PerState, State, Tensor]:
    """What states pay in one step for being close to constraints, to second order; zero where nothing is relaxed."""
    if not isinstance(problem.cost, PenaltyCost):
        return torch.zeros_like(x[..., 0]), torch.zeros_like(x), torch.zeros_like(x[..., None] * x[..., None, :])
    with torch.enable_grad():
        z = x.detach().requires_grad_()
        value = problem.horizon.dt * problem.cost.penalty(z)
        gradient = jacobian(value[..., None], z)[..., 0, :]
        return value.detach(), gradient.detach(), jacobian(gradient, z)


def without_penalty(problem: Problem, expansion: Expansion) -> Expansion:
    """What is left of an expansion of V without what each state pays in one step for being close to constraints."""
    value, gradient, hessian = penalty_of_one_step(in_float64(problem), expansion.x)
    return Expansion(expansion.x, expansion.value - value, expansion.gradient - gradient, expansion.hessian - hessian)


def _line_search(problem: Problem, programs: StepPrograms, now: Path, backward: _Backward) -> Path:
    """The best of u + αk + K(x' − x) over step sizes α, of each trajectory."""
    tried = path_of(problem, *programs.search(now.x, now.u, backward.k, backward.K))
    best, each = tried.cost.argmin(0), torch.arange(now.x.shape[1])
    return Path(tried.x[:, best, each], tried.u[:, best, each], tried.cost[best, each])


def _backward(
    problem: Problem,
    derivatives: StepDerivatives,
    x: StatePath,
    u: ControlPath,
    damping: Tensor | None = None,
    curved: bool = True,
) -> _Backward:
    """The backward pass along x, which need not be a trajectory: V_{n+1} is expanded where F(x_n, u_n) lands.

    The second derivatives of F enter as those of pᵀF, n + m derivatives of one sum and not of each component. p is the
    costate of the controls as they are: V_x where k = 0. A pass without second derivatives would give another p, where
    it meets negative eigenvalues of Q_uu that the task does not have.

    Derivatives that do not exist at a node are those beside it (`steps_along`).

    Args:
        derivatives: of the problem's steps.
        damping: added to Q_uu, in units of the control cost.
        curved: with the second derivatives of F.
    """
    steps = steps_along(derivatives, problem.cost.terminal, x, u)
    if curved:
        steps = with_curvature(derivatives, steps, costates(steps))
    return _recursion(problem, x, u, steps, damping)


def _recursion(problem: Problem, x: StatePath, u: ControlPath, steps: Steps, damping: Tensor | None) -> _Backward:
    """V_n(δ) = ½ (1, δ)ᵀW_n(1, δ), W = [[2c, pᵀ], [p, H]], from W_N on: one matrix holds all that is known of V."""
    n = x.shape[-1]
    least = 2 * problem.horizon.dt * torch.linalg.eigvalsh(problem.cost.R(x[:-1]))[..., 0]
    one = torch.eye(1, 1 + steps.z.shape[-1]).to(x).expand(*steps.paid.shape, 1, -1)
    M = torch.cat([one, torch.cat([(steps.F - x[1:])[..., None], steps.F_z], -1)], -2)
    L = _quadratic(steps.paid, steps.l_z, steps.l_zz)
    W = _quadratic(*steps.end)
    nodes, gains = [W], []
    for k in reversed(range(len(M))):
        Q = L[k] + M[k].mT @ W @ M[k]
        Q_uu, Q_ua = Q[..., 1 + n :, 1 + n :], Q[..., 1 + n :, : 1 + n]
        raised = _raised(Q_uu, FLOOR * least[k], None if damping is None else damping * least[k])
        gain = _gains(problem, u[k], raised, Q_ua)
        W = Q[..., : 1 + n, : 1 + n] + gain.mT @ (Q_ua + Q_uu @ gain) + Q_ua.mT @ gain
        W = (W + W.mT) / 2
        nodes.append(W)
        gains.append(gain)
    W, gain = torch.stack(nodes[::-1]), torch.stack(gains[::-1])
    expansion = Expansion(x, W[..., 0, 0] / 2, W[..., 1:, 0], W[..., 1:, 1:])
    return _Backward(gain[..., 0], gain[..., 1:], expansion, steps.mended)


def _quadratic(c: PerState, p: Tensor, H: Tensor) -> Tensor:
    """[[2c, pᵀ], [p, H]]: c + pᵀz + ½ zᵀHz as one matrix."""
    first = torch.cat([2 * c[..., None], p], -1)
    return torch.cat([first[..., None, :], torch.cat([p[..., None], H], -1)], -2)


def _gains(problem: Problem, u: Control, Q_uu: Tensor, Q_ua: Tensor) -> Tensor:
    """(k, K) from Q_ua = (Q_u, Q_ux): k = argmin of ½ kᵀQ_uu k + Q_uᵀk over u + k ∈ U; controls that a limit holds have
    no part in K.

    Source: Tassa, Mansard, Todorov, "Control-limited differential dynamic programming", ICRA 2014.
    """
    if not problem.controls.limited:
        return -solve(Q_uu, Q_ua)
    Q_u, Q_ux = Q_ua[..., 0], Q_ua[..., 1:]
    to = problem.controls.minimise(Q_uu / 2, Q_u - (Q_uu @ u[..., None])[..., 0])
    k = to - u
    slope = Q_u + (Q_uu @ k[..., None])[..., 0]
    further = problem.controls.project(to - slope.sign() * (1 + to.abs()))
    share = ((further != to) | (slope == 0)).to(Q_uu)  # 1 for a control that is free, 0 for one that a limit holds
    A = share[..., :, None] * Q_uu * share[..., None, :] + torch.diag_embed(1 - share)
    return torch.cat([k[..., None], -torch.linalg.solve(A, share[..., None] * Q_ux)], -1)


def _raised(Q_uu: Tensor, floor: Tensor, damping: Tensor | None) -> Tensor:
    """Q_uu with eigenvalues of no less than a floor, and with damping added; what overflowed is zero."""
    Q_uu, one = Q_uu.where(Q_uu.isfinite(), 0), torch.eye(Q_uu.shape[-1]).to(Q_uu)
    least = floor.maximum(ROUNDING * Q_uu.diagonal(0, -2, -1).sum(-1))
    if Q_uu.shape[-1] == 1:
        raised = Q_uu.maximum(floor[..., None, None])
    elif is_positive_definite(Q_uu - one * least[..., None, None]).all():
        raised = Q_uu
    else:
        values, vectors = torch.linalg.eigh(Q_uu)
        values = values.clamp_min(0).maximum(floor[..., None])
        values = values.maximum(ROUNDING * values[..., -1:])
        raised = (vectors * values[..., None, :]) @ vectors.mT
    return raised if damping is None else raised + one * damping[..., None, None]

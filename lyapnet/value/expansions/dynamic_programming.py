"""Differential dynamic programming: optimal trajectories, and second order expansions of V around them.

The discretised problem is J_N = Σ_{n<N} l(x_n, u_n) + φ(x_N) along x_{n+1} = F(x_n, u_n), with F and l from
`Problem.step`; with Euler steps F = x + Δt(f + gu) and l = Δt ℓ. With Q(x, u) = l + V_{n+1}(F(x, u)), the backward pass
from V_N = φ is, to second order in (x, u),

    k = −Q_uu⁻¹Q_u,   K = −Q_uu⁻¹Q_ux,   V_n = Q at u = ū + k + K(x − x̄).

With noise V_n also has the mean of V_{n+1} over σ(x)ΔW, ½ Δt tr(σᵀHσ) with σ to first order in x; with risk Q has the
certainty equivalent of V_{n+1} (see lyapnet.value.risk), with σ constant over a step. Trajectories are those without
noise: around them V_n is the value function to first order in σσᵀ, and exact for a linear system.

Along an optimal trajectory k = 0, and V_n is the value function to second order. At a constant state, with F linearised
and q, φ quadratic, it is the Riccati solution, of an affine system if f does not vanish there.

Source: Jacobson, Mayne, Differential Dynamic Programming, 1970; the line search as in Tassa, Mansard, Todorov,
"Control-limited differential dynamic programming", ICRA 2014.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from lyapnet.base.contracts import copied
from lyapnet.base.threads import seconds_of_work
from lyapnet.base.types import ControlPath, PerState, State, StatePath
from lyapnet.task.cost import PenaltyCost, spread, squared_distance, time_cost_of
from lyapnet.task.noise import Noise, once_if_constant
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Unbounded
from lyapnet.task.systems.contact import variable_lengths
from lyapnet.value.derivatives import StepDerivatives, Steps, costates, jacobian, steps_along, with_curvature
from lyapnet.value.expansions.gains import as_matrix, cost_beside, gain_of_node, regularise
from lyapnet.value.expansions.laws import Expansion, certainty_equivalents, greedy_law
from lyapnet.value.expansions.paths import Path, cheapest, exchanged, in_float64, path_of, path_under
from lyapnet.value.expansions.step_programs import StepPrograms
from lyapnet.value.risk import with_risk

STEP_SIZES = tuple(0.5**k for k in range(10))  # α of the line search
FLOOR = 0.1  # smallest allowed eigenvalue of Q_uu, relative to that of the control cost
ROUGH_TOLERANCE = 1e-3  # relative gain, made or expected, at which the phase without second derivatives of F ends
GAIN_TOLERANCE = 1e-9  # relative gain of a line search at which the phase with second derivatives ends
EXPECTED_TOLERANCE = 1e-12  # relative expected gain at which this phase ends
HOPELESS_COST_RATIO = 2.0  # cost relative to a settled rival, above which a trajectory is abandoned
GRACE_ITERATIONS = 20  # first iterations in which no trajectory is abandoned
SOFTNESS = (10.0, 3.0, 1.0, 0.3, 0.1, 0.03, 0.01)  # ρ of softer costs, see _softness_of_kinks for the unit
NARROWING = 3.0  # ratio of the distances at which consecutive costs of time end
WIDENING_STATES = 256  # states of X₀ that give the first of these distances
LONGER = (300.0, 100.0, 30.0, 10.0, 3.0)  # factors of the smoothing lengths of contacts, from soft to hard
UNREACHED = 1e300  # cost of a path that is no trajectory, so that any trajectory found from it is better
TRIES = 9  # consecutive failed line searches, each with ten times the damping, after which a trajectory is given up


class Optimum(NamedTuple):
    """Locally optimal trajectories from a batch of states, with the value function around each."""

    path: Path
    expansion: Expansion
    replaced: PerState  # number of nodes at which a missing derivative was replaced, see `steps_along`

    def member(self, rows: Tensor) -> "Optimum":
        """The trajectories with some indices."""
        return Optimum(self.path.member(rows), self.expansion.member(rows), self.replaced[rows])


class Backward(NamedTuple):
    """The result of a backward pass: the law u + k + K(x − x̄), and V along the path."""

    k: ControlPath
    K: Tensor  # (N, *batch, m, n)
    expansion: Expansion
    replaced: Tensor  # (N + 1, *batch), whether a missing derivative was replaced

    def member(self, rows: Tensor) -> "Backward":
        """The trajectories with some indices."""
        return Backward(self.k[:, rows], self.K[:, rows], self.expansion.member(rows), self.replaced[:, rows])


def riccati(problem: Problem, goal: State | None = None) -> Expansion:
    """The value function of the problem linearised at its goal x̄ = x*: F to first order; q, R and φ to second order.

    Control limits are ignored: they are not active near a goal that needs no control.

    Args:
        goal: (x*(p), p) of a member of a family; None: the goal of the problem.
    """
    return _at_goal(problem, goal).expansion


def regulator(problem: Problem) -> tuple[ControlPath, Tensor]:
    """(ū, K) of the linear-quadratic regulator ū_n + K_n(x − x*) over N steps, whose value is `riccati`.

    ū_n (N, m) is the control that holds x*, or the optimal one if none does; K is (N, m, n).
    """
    backward = _at_goal(problem)
    return problem.rest.double().cpu() + backward.k, backward.K


def _at_goal(problem: Problem, goal: State | None = None) -> "Backward":
    """The backward pass at x*, without control limits."""
    problem, N = in_float64(problem).replaced(controls=Unbounded()), problem.horizon.steps
    center = problem.goal if goal is None else goal
    x, u = center.expand(N + 1, -1), problem.rest_at(center).expand(N, -1)
    return _backward(
        problem, StepDerivatives(problem.smooth_step, problem.system.n), x, u, curved=False, noise=problem.noise
    )


def optimal_trajectories(
    problem: Problem,
    x0: State,
    u: ControlPath,
    iterations: int = 80,
    rivals: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
    seconds: float = math.inf,
    softer_first: bool = True,
) -> Optimum:
    """Locally optimal trajectories from a batch of states (b, n), with controls (N, b, m) as initial guess.

    The first phase ignores the second derivatives of F, which are misleading far from an optimum; the second phase
    includes them. For integrators of higher order a phase with Euler steps comes first, because these are cheaper and
    equally good far from an optimum; its result is used if it improves the initial guess. The cost is infinite if the
    controls lead to a non-finite trajectory. Trajectories and costs are those without noise; the expansions include it.

    Args:
        iterations: largest number of iterations of each phase.
        rivals: whether the controls are guesses from one state, of which only the best counts. Once one has settled,
            those that cost HOPELESS_COST_RATIO times as much are abandoned.
        progress: called with the number of finished trajectories and their total, averaged over the phases.
        seconds: seconds of work after which the descent stops.
        softer_first: whether softer costs come first if the task needs them; False if the guess is nearly optimal.
    """
    until = seconds_of_work() + seconds
    noise, problem = in_float64(problem).noise, in_float64(problem).without_noise()
    x0, u = x0.double(), problem.controls.project(u.double())

    def under(controls: ControlPath, problem: Problem = problem) -> Path:
        return path_under(problem, lambda n, _: controls[n], x0)

    def descend(programs: StepPrograms, now: Path, curved: bool, kind: int, until: float = until) -> "_Descent":
        descent = _Descent(programs, now, curved)
        descent.run(iterations, rivals, lambda count: progress((kind * b + count) // kinds, b), until)
        return descent

    higher_order = problem.horizon.method != "euler"
    now, kinds, b = under(u), 2 + higher_order, len(x0)
    if higher_order:
        roughly = problem.in_steps(method="euler")
        rough = StepPrograms(roughly, STEP_SIZES)
        euler = descend(rough, under(u, roughly), curved=False, kind=0).now
        now = cheapest([now, under(euler.u)])
    if softer_first and (stages := _softer_costs(problem)):
        now = cheapest([now, under(_from_softer_costs(problem, stages, under, descend, now.u))])
    programs = StepPrograms(problem, STEP_SIZES)
    softer = _from_softer_contact(problem, now, descend, until) if softer_first else None
    now = descend(programs, now, curved=False, kind=kinds - 2).now
    if softer is not None:
        now = cheapest([now, _reached(descend(programs, _as_guess(softer), curved=False, kind=kinds - 2))])
    descent = descend(programs, now, curved=True, kind=kinds - 1)
    if not programs.agrees(descent.now) and programs.forget():  # the problem's constants have changed
        problem = problem if noise is None else problem.replaced(noise=noise)
        return optimal_trajectories(
            problem, x0, u, iterations, rivals, progress, until - seconds_of_work(), softer_first
        )
    return descent.optimum(noise)


class SofterCost(NamedTuple):
    """A cost that is softer than that of the problem."""

    softness: float = 0.0  # ρ of the cost ρ‖u‖² that is added where costs of controls have kinks
    widening: float = 1.0  # factor of the distances at which a cost of time ends


def _softer_costs(problem: Problem) -> list[SofterCost]:
    """Softer costs, each closer to that of the problem; empty if it needs none.

    At a kink of a cost of controls, and between limits, optimal controls jump; far from the goal a cost of time has no
    slope. Quadratic models show neither.
    """
    softness, widening = _softness_of_kinks(problem), _widening_of_time(problem)
    if softness:
        stages = len(SOFTNESS)
        return [SofterCost(share * softness, widening ** (1 - (k + 1) / stages)) for k, share in enumerate(SOFTNESS)]
    stages = math.ceil(math.log(widening) / math.log(NARROWING))
    return [SofterCost(widening=widening ** (1 - k / stages)) for k in range(stages)]


def _from_softer_costs(
    problem: Problem,
    stages: Sequence[SofterCost],
    under: Callable[..., Path],
    descend: Callable[..., "_Descent"],
    u: ControlPath,
) -> ControlPath:
    """Controls that are optimal for the last of some softer costs; each search starts from the previous result.

    Source: Bertrand, Epenoy, "New smoothing techniques for solving bang-bang optimal control problems", Optimal Control
    Applications and Methods 2002.
    """
    softer = copied(problem)
    costs, time = softer.cost.nonquadratic, time_cost_of(softer.cost)
    programs = StepPrograms(softer, STEP_SIZES)
    for stage in stages:
        if costs is not None:
            costs.softness.fill_(stage.softness)
        if time is not None:
            time.widening.fill_(stage.widening)
        u = descend(programs, under(u, softer), curved=False, kind=0).now.u
    return u


def _from_softer_contact(
    problem: Problem, guess: Path, descend: Callable[..., "_Descent"], until: float
) -> Path | None:
    """Paths that are optimal for contact with three times its smoothing length; None without contact.

    A hard contact that does not occur has no slope, and one that occurs changes trajectories abruptly; with a long
    smoothing length it acts from a distance. The search proceeds from long lengths to short ones. At each length
    descents begin from the path of the length before, from the first guess and from the linear law, and the cheapest
    result is used. A path is passed on with its states, as an initial guess that need not be a trajectory: controls
    alone would lead elsewhere when the forces change.
    """
    softer = copied(problem)
    lengths = variable_lengths(softer)
    if not lengths:
        return None
    programs, best = StepPrograms(softer, STEP_SIZES), None
    share = (until - seconds_of_work()) / (
        2 * 3 * len(LONGER)
    )  # all of them together take at most half of the remaining time
    for factor in LONGER:
        for length, value in lengths:
            length.fill_(factor * value)
        starts = [_as_guess(path) for path in (guess, best) if path is not None]
        if softer.has_goal:
            starts.append(path_under(softer, greedy_law(softer, riccati(softer)), guess.x[0]))
        best = cheapest([_reached(descend(programs, start, False, 0, seconds_of_work() + share)) for start in starts])
    return best


def _as_guess(path: Path) -> Path:
    """A path that need not be a trajectory, as the start of a descent."""
    return path._replace(cost=path.cost.where(~path.cost.isfinite(), UNREACHED))


def _reached(descent: "_Descent") -> Path:
    """The result of a descent, with an infinite cost if it found no trajectory."""
    now = descent.now
    return now._replace(cost=now.cost.where(now.cost < UNREACHED, torch.inf))


@torch.no_grad()
def _widening_of_time(problem: Problem) -> float:
    """The distance of X₀ from the goal, in units of that at which a cost of time ends; 1 without such a cost."""
    if time_cost_of(problem.cost) is None:
        return 1.0
    x0 = problem.initial_states.sample(WIDENING_STATES, torch.Generator().manual_seed(0)).to(problem.goal)
    return max(float(squared_distance(problem.cost, x0).mean().sqrt()), 1.0)


def follow_expansions(problem: Problem, expansion: Expansion, u: ControlPath, x0: State) -> Path:
    """The closed loops from a batch of states, each under the greedy law of its own expansion.

    Args:
        problem: in float64, on the CPU.
        expansion: one expansion for each state of x0 (b, n).
        u: the controls (N, b, m) around which each expansion is; the law of a system that is not control-affine is the
            local minimum near them.
    """
    if not len(x0):
        return path_under(problem, greedy_law(problem, expansion), x0)
    programs = StepPrograms(problem, STEP_SIZES)
    path = path_of(problem, *programs.follow(certainty_equivalents(problem, expansion), u, x0))
    if not programs.agrees(path) and programs.forget():  # the problem's constants have changed
        return follow_expansions(problem, expansion, u, x0)
    return path


class _Descent:
    """One phase of the descent: line searches until the relative gain of each trajectory, made or expected, is small.

    The expected gain is J_N − V_0(x₀) of a backward pass without damping, the gain of the full step to second order.
    Each trajectory has its own damping.

    Args:
        programs: compiled steps of the problem.
        now: the initial trajectories.
        curved: whether to include the second derivatives of F.
    """

    def __init__(self, programs: StepPrograms, now: Path, curved: bool):
        self.programs, self.curved = programs, curved
        self._gained, self._expected = (
            (GAIN_TOLERANCE, EXPECTED_TOLERANCE) if curved else (ROUGH_TOLERANCE, ROUGH_TOLERANCE)
        )
        self.now, self._passes = now, list[tuple[Tensor, Backward]]()  # (settled rows, their last backward pass)

    def run(self, iterations: int, rivals: bool, progress: Callable[[int], None], until: float) -> None:
        """Iterate; see optimal_trajectories."""
        cost = self.now.cost
        damping, failures, settled = torch.zeros_like(cost), torch.zeros_like(cost), ~cost.isfinite()
        for k in range(iterations):
            rows = torch.nonzero(~settled).flatten()
            progress(len(settled) - len(rows))
            if not len(rows) or seconds_of_work() > until:
                break
            previous, backward = self._pass(rows, damping[rows])
            expected = (previous.cost - backward.expansion.value[0]).abs()
            unsettled = (damping[rows] > 0) | ~(expected <= self._expected * previous.cost.abs())
            if not unsettled.all():
                self._passes.append((rows[~unsettled], backward.member(~unsettled)))
                settled[rows[~unsettled]] = True
                rows, previous, backward = rows[unsettled], previous.member(unsettled), backward.member(unsettled)
            if len(rows):
                tried = _line_search(self.programs.problem, self.programs, previous, backward)
                better = tried.cost < previous.cost
                gain = torch.where(better, previous.cost - tried.cost, 0)
                self.now = exchanged(self.now, rows[better], tried.member(better))
                failures[rows] = torch.where(better, 0, failures[rows] + 1)
                damping[rows] = torch.where(better, damping[rows] / 10, (10 * damping[rows]).clamp_min(1e-3))
                settled[rows] = better & (gain <= self._gained * previous.cost.abs()) | (failures[rows] > TRIES)
            if rivals and (self.curved or k >= GRACE_ITERATIONS) and settled.any():
                least = self.now.cost[settled].min()
                settled |= self.now.cost > least + (HOPELESS_COST_RATIO - 1) * least.abs()

    def optimum(self, noise: Noise | None) -> Optimum:
        """The trajectories with their expansions; those without a stored backward pass get one now.

        Args:
            noise: σ, which the stored passes ignore.
        """
        has_no_pass = torch.ones_like(self.now.cost, dtype=torch.bool)
        passes = self._passes if noise is None else []
        for rows, _ in passes:
            has_no_pass[rows] = False
        others = torch.nonzero(has_no_pass).flatten()
        if len(others):
            passes = [*passes, (others, self._pass(others, noise=noise)[1])]
        order = torch.cat([rows for rows, _ in passes]).argsort()
        parts = zip(*(backward.expansion for _, backward in passes), strict=True)
        replaced = torch.cat([backward.replaced for _, backward in passes], 1)[:, order].sum(0)
        return Optimum(self.now, Expansion(*(torch.cat(each, 1)[:, order] for each in parts)), replaced)

    def _pass(self, rows: Tensor, damping: Tensor | None = None, noise: Noise | None = None) -> tuple[Path, Backward]:
        """Some of the trajectories, and the backward pass along them."""
        path = self.now.member(rows)
        return path, _backward(self.programs.problem, self.programs, path.x, path.u, damping, self.curved, noise)


def sizes(problem: Problem, cost: PerState) -> PerState:
    """The scale of cost differences of some trajectories: the cost of each; without a goal the spread of the costs."""
    finite = cost[cost.isfinite()]
    if problem.has_goal or not len(finite):
        return cost
    return spread(finite).expand_as(cost)


def penalty_of_one_step(problem: Problem, x: State) -> tuple[PerState, State, Tensor]:
    """The constraint penalty of one step at some states, to second order; zero without a penalty."""
    if not isinstance(problem.cost, PenaltyCost):
        return torch.zeros_like(x[..., 0]), torch.zeros_like(x), torch.zeros_like(x[..., None] * x[..., None, :])
    with torch.enable_grad():
        z = x.detach().requires_grad_()
        value = problem.horizon.dt * problem.cost.penalty(z)
        gradient = jacobian(value[..., None], z)[..., 0, :]
        return value.detach(), gradient.detach(), jacobian(gradient, z)


def _softness_of_kinks(problem: Problem) -> float:
    """ρ at which ρ‖u‖² of the largest controls costs as much as the kinks of their cost; 0 without kinks."""
    costs = problem.cost.nonquadratic
    if costs is None or not costs.kinked:
        return 0.0
    weight = float(sum(cost.weight.max() for cost in costs.kinked))
    R = float(torch.linalg.eigvalsh(problem.cost.R(problem.initial_states.center))[..., 0])
    sizes = [float(torch.stack([side.abs() for side in problem.controls.limits or ()] or [torch.tensor(0.0)]).max())]
    sizes = [size for size in (*sizes, weight / R) if 0 < size < math.inf]
    return weight / min(sizes)


def without_penalty(problem: Problem, expansion: Expansion) -> Expansion:
    """An expansion of V minus the constraint penalty of one step at each state."""
    value, gradient, hessian = penalty_of_one_step(in_float64(problem), expansion.x)
    return Expansion(expansion.x, expansion.value - value, expansion.gradient - gradient, expansion.hessian - hessian)


def _line_search(problem: Problem, programs: StepPrograms, now: Path, backward: Backward) -> Path:
    """The cheapest closed loop under u + αk + K(x' − x) over the step sizes α, for each trajectory."""
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
    noise: Noise | None = None,
) -> Backward:
    """The backward pass along x, which need not be a trajectory: V_{n+1} is expanded at F(x_n, u_n).

    The second derivatives of F enter as those of pᵀF, which needs only n + m derivatives of a single sum. p is the
    costate under the current controls, equal to V_x if k = 0. The V_x of a pass without second derivatives would differ
    from it, and lead to negative eigenvalues of Q_uu that the task does not have.

    Derivatives that do not exist at a node are replaced, see `steps_along`.

    Args:
        derivatives: derivatives of the problem's steps.
        damping: added to Q_uu, in units of the control cost.
        curved: whether to include the second derivatives of F.
        noise: σ; None: without noise.
    """
    steps = steps_along(derivatives, problem.cost.terminal, x, u)
    if curved:
        steps = with_curvature(derivatives, steps, costates(steps))
    return backward_recursion(problem, x, u, steps, damping, noise)


def backward_recursion(
    problem: Problem, x: StatePath, u: ControlPath, steps: Steps, damping: Tensor | None, noise: Noise | None
) -> Backward:
    """The recursion of V_n(δ) = ½ (1, δ)ᵀW_n(1, δ) backwards from W_N, with c, p and H in W = [[2c, pᵀ], [p, H]]."""
    n = x.shape[-1]
    least = 2 * problem.horizon.dt * torch.linalg.eigvalsh(problem.cost.R(x[:-1]))[..., 0]
    one = torch.eye(1, 1 + steps.z.shape[-1]).to(x).expand(*steps.paid.shape, 1, -1)
    M = torch.cat([one, torch.cat([(steps.F - x[1:])[..., None], steps.F_z], -1)], -2)
    L = as_matrix(steps.paid, steps.l_z, steps.l_zz)
    W = as_matrix(*steps.end)
    spread, S = (None, None) if noise is None else _spread_and_maps(problem, noise, x[:-1])
    sigma = None if noise is None or not problem.risk else noise(x[:-1])
    nodes, gains = [W], []
    for k in reversed(range(len(M))):
        later = W if sigma is None else with_risk(W, sigma[k], problem.horizon.dt, problem.risk)
        Q = L[k] + M[k].mT @ later @ M[k]
        if spread is not None:
            Q[..., 0, 0] += (W[..., 1:, 1:] * spread[k]).sum((-2, -1))
        if S is not None:
            Q[..., : 1 + n, : 1 + n] += (S[k].mT @ W[..., None, 1:, 1:] @ S[k]).sum(-3)
        Q_uu, Q_ua = Q[..., 1 + n :, 1 + n :], Q[..., 1 + n :, : 1 + n]
        regularised = regularise(Q_uu, FLOOR * least[k], None if damping is None else damping * least[k])
        gain = gain_of_node(problem, u[k], regularised, Q_ua)
        W = Q[..., : 1 + n, : 1 + n] + gain.mT @ (Q_ua + Q_uu @ gain) + Q_ua.mT @ gain
        if problem.cost.nonquadratic is not None or not problem.controls.is_box:
            W += cost_beside(problem, u[k], gain, Q_ua + regularised @ gain)
        W = (W + W.mT) / 2
        nodes.append(W)
        gains.append(gain)
    W, gain = torch.stack(nodes[::-1]), torch.stack(gains[::-1])
    expansion = Expansion(x, W[..., 0, 0] / 2, W[..., 1:, 0], W[..., 1:, 1:])
    return Backward(gain[..., 0], gain[..., 1:], expansion, steps.replaced)


def _spread_and_maps(problem: Problem, noise: Noise, x: StatePath) -> tuple[Tensor | None, Tensor | None]:
    """(Δt σσᵀ, None) for a constant σ, else (None, S): √Δt (σ_j, ∂σ_j/∂x), (N, *batch, k, n, 1 + n).

    S maps (1, δx) to the displacement by each column σ_j of σ. If σ has no finite slope, as √x at 0, it counts as
    constant.
    """
    dt = problem.horizon.dt
    with torch.enable_grad():
        z = x.detach().requires_grad_()
        sigma = noise(z).mT  # (N, *batch, k, n)
        if not sigma.requires_grad:
            once = once_if_constant(noise(x))
            return (dt * once @ once.mT).expand(len(x), *[-1] * x.ndim), None
        slope = jacobian(sigma.flatten(-2), z).unflatten(-2, sigma.shape[-2:])
    maps = torch.cat([sigma[..., None], slope.nan_to_num(0.0, 0.0, 0.0)], -1)
    return None, math.sqrt(dt) * maps.detach()

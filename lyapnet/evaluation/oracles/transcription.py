"""Optima by direct transcription: all states and controls are variables of a nonlinear program (CasADi, IPOPT).

A reference for tests and tables. The model is the torch system itself, translated by `symbolic`.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import redirect_stderr
from functools import cached_property
from io import StringIO
from typing import Any

import casadi
import numpy as np
import torch
from torch import Tensor

from lyapnet.base.contracts import copied
from lyapnet.base.errors import Interrupted, signals_taken
from lyapnet.base.threads import seconds_of_work
from lyapnet.base.types import ControlPath, PerState, State, StatePath
from lyapnet.evaluation.oracles.base import Optima, Oracle, Report, silent
from lyapnet.evaluation.oracles.cache import OptimaCache
from lyapnet.evaluation.oracles.casadi_task import CasadiTask
from lyapnet.evaluation.oracles.multistart import EXPLORED, EXPLORED_AGAIN, SAME, Candidate, MultiStart, is_better
from lyapnet.evaluation.oracles.scales import Scales
from lyapnet.task.horizon import Horizon
from lyapnet.task.problem import Problem

CONVERGED = ("Solve_Succeeded", "Solved_To_Acceptable_Level")
ACCEPTABLE = 1e-7  # scaled tolerance at which IPOPT may stop after five iterations without progress
CONSTRAINT_TOLERANCE = 1e-6  # largest h that counts as zero
GOAL_OFFSET = 1e-3  # distance from the goal at which initial lines end, in units of the extents: slopes may not exist
START_OFFSET = 1e-8  # shift of x₀ if slopes do not exist there, in units of the extents
INVALID = "IPOPT: Invalid_Number_Detected"
DOMAIN_MARGIN = 1e-6  # distance of optima from the borders of the domain, relative to a state's size
ROUNDING = 1e-9  # difference of two costs that counts as rounding, relative to the size of J*
SECONDS = 10.0  # IPOPT's seconds for one initial guess
BRIEF_ITERATIONS = 40, 150  # smallest and largest limit of iterations, if a minimum of the state is known
BRIEF_FACTOR = 3  # this limit, relative to the iterations of a first minimum
MIN_SPREAD = 0.5  # share of the widths of X₀ over which explored states must extend
_SINGLE_MINIMUM_TASKS = set[tuple[Any, ...]]()  # tasks with their X₀ that had one minimum from each explored state
RANDOM_CURVE_STATES = 8  # first initial states that try random curves as initial guesses, at most
CURVES_PER_STATE = 2  # random curves for each of these states; more if there are fewer, so that the total stays


class Transcription(Oracle):
    """min over x₁ … x_N, u₀ … u_{N−1} ∈ U of Δt Σ_{n<N} ℓ(x_n, u_n) + φ(x_N) subject to x_{n+1} = x_n + Δt(f + gu)
    and h(x_n) ≤ 0 for n ≥ 1, within the domain; other Runge-Kutta methods use their own steps and costs, with u held.

    All variables and J are scaled by the extents of trial paths; these scales are parameters of the nonlinear program.

    The problem is not convex, and IPOPT finds local minima. Each initial state has several initial guesses: a straight
    line towards the goal, random curves, controls known to the caller, the optima of its neighbours in the batch, and a
    trial path if none of these leads to a minimum. If all guesses lead to one minimum for each of the first states, the
    other states use only their neighbours' optima. The reported cost is that of a rollout in torch; the best controls
    are stored on disk. Where the system amplifies rounding so much that no controls lead along the minimum, as over a
    long time near an unstable equilibrium, a closed loop that stays on IPOPT's path has to confirm it, and the controls
    are NaN. A state has NaN if no guess leads to a minimum or it is not confirmed. If all of the first few states fail,
    the others are not tried. Known controls that violate a constraint are ignored.

    Args:
        problem: the problem; it is copied to float64 on the CPU.
        method: integrator of the steps, a key of TABLEAUX; None: that of the horizon.
        iterations: largest number of IPOPT's iterations from one initial guess.

    Raises:
        OracleError: dynamics or cost use torch operations that CasADi lacks.

    Source: Betts, Practical Methods for Optimal Control Using Nonlinear Programming, ch. 4; Wächter, Biegler, "On the
    implementation of an interior-point filter line-search algorithm", Mathematical Programming 2006 (IPOPT).
    """

    def __init__(self, problem: Problem, method: str | None = None, iterations: int = 500):
        self.problem = copied(problem).in_steps(method=method or problem.horizon.method)
        system, horizon = self.problem.system, self.problem.horizon
        self.task = CasadiTask(self.problem)
        self.cache = OptimaCache(self.task.graphs, horizon.steps, system.m, self.problem.controls)
        box = self.problem.initial_states
        self._task_and_box = self.cache.folder.name, *box.lower.tolist(), *box.upper.tolist()
        self._stopped = False
        limits = self.problem.controls.limits
        domain = self.problem.domain
        bounded = self.problem.controls.limited or self.task.inside is not None or domain is not None
        self._limit, self._solver, sizes, inequalities = _solver(self.task, horizon, iterations, bounded)
        self._iterations = iterations
        self._most_iterations = 0  # largest number of iterations of a first minimum; 0: none yet
        self._scales = Scales(self.problem)
        assert limits is not None  # checked by oracle_of
        free = torch.full((system.n,), torch.inf)
        ends = (-free, free) if domain is None else domain.narrowed(DOMAIN_MARGIN)
        self._bounds = [
            np.concatenate([
                np.tile(side.expand(system.m).numpy() / self._scales.of_controls, horizon.steps),
                np.tile(end.numpy() / self._scales.of_states, horizon.steps),
                np.full(sizes, size),
            ])
            for side, end, size in zip(limits, ends, (0.0, np.inf), strict=True)
        ]  # fmt: skip
        self._sizes = sizes
        # bounds of the constraints: defects of the steps = 0, h ≤ 0 and the inequalities of controls
        defects = np.zeros(system.n * horizon.steps)
        self._held = [np.concatenate([defects, np.full(inequalities, side)]) for side in (-np.inf, 0.0)]

    def rollout(self, x0: State, u: ControlPath) -> tuple[StatePath, PerState]:
        """(x, J_N) under given controls, computed in torch."""
        x, J = [x0], torch.zeros_like(x0[..., 0])
        for control in u:
            following, step_cost = self.problem.step(x[-1], control)
            x, J = [*x, following], J + step_cost
        return torch.stack(x), J + self.problem.cost.terminal(x[-1])

    def solve(
        self, x0: State, known: ControlPath | None = None, progress: Report = silent, seconds: float = math.inf
    ) -> Optima:
        """The optima of a batch (b, n); those on disk are used unless the `known` controls cost less."""
        states = x0.detach().double().cpu()
        nothing: list[Tensor | None] = [None] * len(states)
        stored = self._replay(states, [self.cache.read(x) for x in states])
        within = None if known is None else self.problem.controls.project(known.detach().double().cpu())
        given = self._replay(states, nothing if within is None else within.unbind(1))
        explored = EXPLORED_AGAIN if self._task_and_box in _SINGLE_MINIMUM_TASKS else EXPLORED
        search = MultiStart(states.numpy(), stored, self.minimise, explored)
        pending = [i for i in range(len(states)) if stored[i] is None or is_better(given[i], stored[i])]
        if pending:
            first = [pending[len(pending) * k // explored] for k in range(min(explored, len(pending)))]
            pending = [*first, *(i for i in pending if i not in first)]
            starts = dict(zip(pending, self._starts(states, pending, given, search), strict=True))
            self._search(search, starts, progress, seconds_of_work() + seconds)
            if search.several:
                _SINGLE_MINIMUM_TASKS.discard(self._task_and_box)
            elif explored == EXPLORED and self._is_spread(states[pending[:EXPLORED]], search):
                _SINGLE_MINIMUM_TASKS.add(self._task_and_box)
        cost, reasons, u = self._verify(states, search, given)
        for i, best in enumerate(search.best):
            if best is not None and best is not stored[i] and bool(u[:, i].isfinite().all()):
                self.cache.write(states[i], torch.from_numpy(best.u))
        return Optima(cost.to(x0), reasons, u.to(x0))

    def _is_spread(self, states: Tensor, search: MultiStart) -> bool:
        """Whether EXPLORED states have a minimum and extend over MIN_SPREAD of X₀ in each component."""
        if len(states) < EXPLORED or any(best is None for best in search.best):
            return False
        box = self.problem.initial_states
        return bool((states.amax(0) - states.amin(0) >= MIN_SPREAD * (box.upper - box.lower)).all())

    def _replay(self, states: Tensor, controls: Sequence[Tensor | None]) -> list[Candidate | None]:
        """The trajectories of given controls; None if they are not finite, violate constraints or leave the domain."""
        candidates: list[Candidate | None] = [None] * len(states)
        some = [i for i, u in enumerate(controls) if u is not None]
        if some:
            u = torch.stack([controls[i] for i in some], 1)  # pyright: ignore[reportArgumentType]
            with torch.no_grad():
                x, J = self.rollout(states[some], u)
                admitted = self._are_admitted(x) & J.isfinite()
            columns = (x.unbind(1), u.unbind(1), J.tolist(), admitted.tolist())
            for i, path, control, cost, good in zip(some, *columns, strict=True):
                if good:
                    candidates[i] = Candidate(path[1:].numpy(), control.numpy(), cost)
        return candidates

    def _are_admitted(self, x: StatePath) -> Tensor:
        """Whether trajectories are finite, satisfy the constraints and stay within the domain."""
        admitted = torch.isfinite(x).all(-1).all(0)
        if self.problem.domain is not None:
            admitted &= ~self.problem.domain.left(x, slack=0.0)
        if self.problem.constraints is not None:
            admitted &= self.problem.constraints.worst(x[1:]).amax(0) <= CONSTRAINT_TOLERANCE
        return admitted

    def _starts(
        self, states: Tensor, pending: Sequence[int], given: Sequence[Candidate | None], search: MultiStart
    ) -> Iterator[Iterator[Candidate]]:
        """The initial guesses of each pending state: known controls, and a line to the goal with the control at rest.

        The first explored states, at most RANDOM_CURVE_STATES, also try random curves around that line: the fewer these
        states, the more curves for each. A better minimum from these is passed on to the other states. If nothing leads
        to a minimum, the trial path is the last guess.
        """
        N, random = self.problem.horizon.steps, np.random.default_rng(0)
        goal, rest = self.problem.goal.numpy(), self.problem.rest.expand(N, -1).numpy()
        s = np.arange(1, N + 1)[:, None] / N
        waves = np.stack([np.sin(k * np.pi * s) / k for k in (1, 2, 3)])  # smooth, and zero at both ends
        extent = states.abs().amax(0).numpy()
        scale = np.where(extent > 0, extent, 1.0)
        tried, aside = self._scales.paths(states), GOAL_OFFSET * self._scales.of_states * s
        with_curves = min(RANDOM_CURVE_STATES, search.explored, len(pending))
        curves = math.ceil(RANDOM_CURVE_STATES * CURVES_PER_STATE / with_curves)
        for k, i in enumerate(pending):
            line = goal + (1 - s) * (states[i].numpy() - goal) + aside
            bends = scale * (waves * random.standard_normal((curves, 3, 1, len(scale)))).sum(1)
            paths = (line, *(line + bends)) if k < with_curves else (line,)
            cold = [Candidate(x, rest, math.inf) for x in paths]
            known = given[i]
            path = Candidate(tried.x[1:, i].numpy(), tried.u[:, i].numpy(), math.inf)
            yield _with_fallback(search, i, cold if known is None else [known, *cold], path)

    def _search(
        self, search: MultiStart, starts: Mapping[int, Iterable[Candidate]], progress: Report, until: float
    ) -> None:
        """Run a search; Ctrl-C and SIGTERM end it."""
        self._stopped = False
        with signals_taken(self._stop):
            try:
                search.run(starts, progress, until)
            finally:  # CasADi may have replaced the exception by its own
                if self._stopped:
                    self._stop()

    def _stop(self, *_: object) -> None:
        """Handle a signal. CasADi stops at this exception, but may swallow or replace it."""
        self._stopped = True
        raise Interrupted("Stopped while seeking optima; those of earlier evaluations are kept.", 130)

    def minimise(self, x0: np.ndarray, start: Candidate, briefly: bool = False) -> Candidate | str:
        """The local minimum that IPOPT finds from an initial guess, or the reason for none.

        Args:
            briefly: whether to limit the iterations by BRIEF_FACTOR times those of a first minimum.
        """
        most = self._iterations
        if briefly:
            least, most = BRIEF_ITERATIONS
            most = min(
                most,
                self._iterations,
                max(least, BRIEF_FACTOR * self._most_iterations) if self._most_iterations else most,
            )
        found = self._minimum(x0, start, most)
        if found == INVALID:  # slopes may not exist at x₀ itself, such as that of |v| at rest
            found = self._minimum(x0 + START_OFFSET * self._scales.of_states, start, most)
        if not briefly and not isinstance(found, str):
            self._most_iterations = max(self._most_iterations, self._limit.done)
        return found

    def _minimum(self, x0: np.ndarray, start: Candidate, iterations: int) -> Candidate | str:
        lower, upper = self._bounds
        of_x, of_u, scale = self._scales.of_states, self._scales.of_controls, self._scales.of_cost(x0)
        guess = np.concatenate([(start.u / of_u).ravel(), (start.x / of_x).ravel(), np.ones(self._sizes)])
        given = np.concatenate([x0, [scale], of_x, of_u])
        least, greatest = self._held
        self._limit.start(iterations)
        with redirect_stderr(StringIO()):  # hides CasADi's warning; the reason is returned
            result = self._solver(x0=guess, p=given, lbx=lower, ubx=upper, lbg=least, ubg=greatest)
        status = self._solver.stats()["return_status"]
        if self._stopped:
            self._stop()
        if status not in CONVERGED:
            return f"IPOPT: {'Maximum_Iterations_Exceeded' if self._limit.is_reached() else status}"
        u, x, _ = np.split(np.asarray(result["x"]).ravel(), [start.u.size, start.u.size + start.x.size])
        u = of_u * u.reshape(start.u.shape)
        u = self.problem.controls.project(torch.from_numpy(u)).numpy()  # IPOPT may slightly violate U
        return Candidate(of_x * x.reshape(start.x.shape), u, scale * float(result["f"]))

    def _verify(
        self, states: Tensor, search: MultiStart, given: Sequence[Candidate | None]
    ) -> tuple[PerState, list[str], ControlPath]:
        """(costs of the best controls in a rollout, or of loops along IPOPT's paths, reasons for none, the controls).

        Costs are NaN if neither confirms them, and controls if a rollout does not.
        """
        replayed = self._replay(states, [None if b is None else torch.from_numpy(b.u) for b in search.best])
        cost = torch.full((len(states),), math.nan, dtype=torch.float64)
        u = torch.full((self.problem.horizon.steps, len(states), self.problem.system.m), math.nan, dtype=torch.float64)
        reasons = list[str]()
        for i, (best, candidate) in enumerate(zip(search.best, replayed, strict=True)):
            reason = self._reason_to_reject(states[i], best, candidate, given[i], search.reasons[i])
            if not reason and candidate is not None:
                cost[i], u[:, i] = candidate.cost, torch.from_numpy(candidate.u)
            elif best is not None and not (is_better(candidate, best) or is_better(given[i], best)):
                along = self._cost_along(states[i], best)
                if along is not None:
                    cost[i], reason = along, ""
            reasons.append(reason)
        return cost, reasons, u

    def _reason_to_reject(
        self, x0: State, best: Candidate | None, replayed: Candidate | None, given: Candidate | None, reason: str
    ) -> str:
        """The reason why a cost is not accepted as the optimum; empty if it is accepted."""
        if best is None:
            return reason
        if replayed is None or abs(replayed.cost - best.cost) > self._tolerance(best.cost, x0):
            got = "no finite number" if replayed is None else f"{replayed.cost:.9g}"
            return f"IPOPT's cost {best.cost:.9g} is {got} in a rollout of its controls"
        return _reason_against(given, replayed)

    def _tolerance(self, cost: float, x0: State) -> float:
        """The difference up to which IPOPT's cost and that in torch count as equal."""
        return SAME * abs(cost) + ROUNDING * self._scales.of_cost(x0.numpy())

    def _cost_along(self, x0: State, minimum: Candidate) -> float | None:
        """The cost of a closed loop that stays on a minimum's path; None if it differs from that of the minimum.

        The control ū_n − K_n(x_n − x̄_n), projected onto U, holds an unstable system on the path (x̄, ū).
        """
        u, K = torch.from_numpy(minimum.u), torch.from_numpy(self._gains_along(x0.numpy(), minimum))
        path, nodes = torch.cat([x0[None], torch.from_numpy(minimum.x)]), [x0[None]]
        J = torch.zeros(1, dtype=torch.float64)
        with torch.no_grad():
            for k in range(len(u)):
                control = self.problem.controls.project(u[k] - (K[k] @ (nodes[-1][0] - path[k])))
                following, step_cost = self.problem.step(nodes[-1], control[None])
                nodes, J = [*nodes, following], J + step_cost
            cost = float(J + self.problem.cost.terminal(nodes[-1]))
            admitted = bool(self._are_admitted(torch.stack(nodes)).all())
        return cost if admitted and abs(cost - minimum.cost) <= self._tolerance(minimum.cost, x0) else None

    @cached_property
    def _slopes(self) -> casadi.Function:
        """The slopes of all steps; made when they are first asked for, since most tasks never do."""
        return self.task.slopes().map(self.problem.horizon.steps)

    def _gains_along(self, x0: np.ndarray, minimum: Candidate) -> np.ndarray:
        """K (N, m, n) of linear-quadratic regulators with unit weights about a path, in units of the scales."""
        of_x, of_u = self._scales.of_states, self._scales.of_controls
        states = np.vstack([x0, minimum.x[:-1]])
        slopes = self._slopes(states.T, minimum.u.T)
        A, B = (np.asarray(part).T.reshape(len(states), -1, len(of_x)).swapaxes(1, 2) for part in slopes)
        A, B = A * of_x / of_x[:, None], B * of_u / of_x[:, None]
        P, gains = np.eye(len(of_x)), list[np.ndarray]()
        for a, b in zip(A[::-1], B[::-1], strict=True):
            K = np.linalg.solve(np.eye(len(of_u)) + b.T @ P @ b, b.T @ P @ a)
            P = np.eye(len(of_x)) + a.T @ P @ (a - b @ K)
            gains.append(K * of_u[:, None] / of_x)
        return np.stack(gains[::-1])


def _with_fallback(search: MultiStart, i: int, starts: Sequence[Candidate], last: Candidate) -> Iterator[Candidate]:
    """The initial guesses of a state, and a last one if none of them has led to a minimum."""
    yield from starts
    if search.best[i] is None:
        yield last


def _reason_against(given: Candidate | None, best: Candidate) -> str:
    """The reason why a minimum is not the optimum: cheaper known controls; empty if there are none."""
    if is_better(given, best):
        return f"known controls cost less than the {best.cost:.6g} of every local minimum that was found"
    return ""


class _IterationLimit(casadi.Callback):
    """Stops IPOPT after a number of iterations that each call may choose; CasADi has no such parameter.

    IPOPT calls it at each iteration, and at the start of a restoration phase, which counts as an iteration.

    Args:
        sizes: the sizes of the variables x, the constraints g and the parameters p.
    """

    def __init__(self, sizes: Mapping[str, int]):
        super().__init__()
        self.sizes, self.done, self.most = sizes, 0, 0
        self.construct("iteration_limit", {})

    def start(self, most: int) -> None:
        """Restart the count."""
        self.done, self.most = -1, most  # -1: IPOPT also calls it before the first iteration

    def is_reached(self) -> bool:
        return self.done > self.most  # >: the last allowed iteration may be the minimum

    def get_n_in(self) -> int:
        return casadi.nlpsol_n_out()

    def get_n_out(self) -> int:
        return 1

    def get_sparsity_in(self, i: int) -> casadi.Sparsity:
        name = casadi.nlpsol_out(i)
        return casadi.Sparsity.dense(1 if name == "f" else self.sizes[name.removeprefix("lam_")])

    def eval(self, arg: Sequence[casadi.DM]) -> list[int]:
        self.done += 1
        return [int(self.is_reached())]


def _solver(
    task: CasadiTask, horizon: Horizon, iterations: int, limited: bool
) -> tuple[_IterationLimit, casadi.Function, int, int]:
    """The iteration limit, IPOPT for the transcribed task with exact sparse derivatives, and two numbers.

    The variables are the scaled (u, x), and sizes of controls; the parameters are x₀, the scale of J, and the scales of
    x and u. The numbers are those of the sizes, and of the inequalities.
    """
    steps = horizon.steps
    n, m = task.step.size1_in(0), task.step.size1_in(1)
    x0, scaled_x, scaled_u = casadi.MX.sym("x0", n), casadi.MX.sym("x", n, steps), casadi.MX.sym("u", m, steps)
    scale, of_x, of_u = casadi.MX.sym("scale"), casadi.MX.sym("of_x", n), casadi.MX.sym("of_u", m)
    x, u = casadi.diag(of_x) @ scaled_x, casadi.diag(of_u) @ scaled_u
    following, step_cost = task.step.map(steps)(casadi.horzcat(x0, x[:, :-1]), u)
    of_controls = task.terms_of_controls(u, of_u)
    J = casadi.sum2(step_cost) + task.end(x[:, -1]) + horizon.dt * of_controls.cost
    variables = casadi.veccat(scaled_u, scaled_x, of_controls.variables)
    zero = casadi.vec(casadi.diag(1 / of_x) @ (following - x))
    inside = casadi.MX(0, 1) if task.inside is None else casadi.vec(task.inside.map(steps)(x))
    held = casadi.veccat(zero, inside, of_controls.inequalities)
    problem = {"x": variables, "p": casadi.vertcat(x0, scale, of_x, of_u), "f": J / scale, "g": held}
    # tight: an unstable system amplifies errors of the controls, and the barrier changes J; limits are not relaxed
    exact = {"ipopt.tol": 1e-10, **({"ipopt.bound_relax_factor": 0.0} if limited else {})}
    # looser, if rounding or a kink stops IPOPT earlier; a rollout then has to confirm the cost
    enough = {"tol": ACCEPTABLE, "constr_viol_tol": ACCEPTABLE, "compl_inf_tol": ACCEPTABLE, "dual_inf_tol": 1e-4}
    acceptable = {f"ipopt.acceptable_{name}": value for name, value in enough.items()}
    quiet = {"print_time": False, "show_eval_warnings": False, "ipopt.print_level": 0, "ipopt.sb": "yes"}
    limit = _IterationLimit({name: problem[name].numel() for name in ("x", "g", "p")})
    ends = {
        "iteration_callback": limit,
        "ipopt.max_iter": iterations,
        "ipopt.max_wall_time": SECONDS,
        "ipopt.acceptable_iter": 5,
    }
    options = {**quiet, **exact, **acceptable, **ends}
    solver = casadi.nlpsol("transcription", "ipopt", problem, options)
    return limit, solver, of_controls.variables.numel(), held.numel() - zero.numel()

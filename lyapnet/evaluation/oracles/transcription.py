"""The optimum of any task by direct transcription: all states and controls at once, by CasADi and IPOPT.

Ground truth for tests and tables, never used in training. The model is the torch system itself, read by `symbolic`.
"""

import math
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import redirect_stderr
from io import StringIO
from typing import Any

import casadi
import numpy as np
import torch
from torch import Tensor

from lyapnet.base.contracts import copied
from lyapnet.base.errors import Interrupted, signals_taken
from lyapnet.base.types import ControlPath, PerState, State, StatePath
from lyapnet.evaluation.oracles.base import Optima, Oracle, Report, silent
from lyapnet.evaluation.oracles.cache import OptimaCache
from lyapnet.evaluation.oracles.casadi_task import CasadiTask
from lyapnet.evaluation.oracles.multistart import EXPLORED, EXPLORED_AGAIN, SAME, Candidate, MultiStart, is_better
from lyapnet.evaluation.oracles.scales import Scales
from lyapnet.task.problem import Problem

CONVERGED = ("Solve_Succeeded", "Solved_To_Acceptable_Level")
ACCEPTABLE = 1e-7  # tolerances in units of the scales, at which IPOPT may end after five iterations that gain nothing
VIOLATED = 1e-6  # h that is still taken for zero
ASIDE = 1e-3  # of the extents: how far from the goal straight lines end, where slopes may not exist
BESIDE = 1e-8  # of the extents: how far from x₀ a path may begin, for a cost that is the same
INVALID = "IPOPT: Invalid_Number_Detected"
WITHIN = 1e-6  # of a state's size: how far within the borders of the domain optima stay, where slopes are moderate
SECONDS = 10.0  # of one start
BRIEF = 40, 150  # iterations at least and at most, after which a further start of a state with a minimum is given up
LONGER = 3  # times the iterations that a first minimum has taken, between these two
SPREAD = 0.5  # of the widths of X₀, over which explored states reach
_WITH_ONE_MINIMUM = set[tuple[Any, ...]]()  # tasks and their X₀, of which this process has explored a batch
BENT, BENDS = 8, 2  # of how many initial states random starts are tried, and how many of each


class Transcription(Oracle):
    """min over x₁ … x_N, u₀ … u_{N−1} ∈ U of Δt Σ_{n<N} ℓ(x_n, u_n) + φ(x_N) subject to x_{n+1} = x_n + Δt(f + gu)
    and h(x_n) ≤ 0 for n ≥ 1, within the domain; by another Runge-Kutta method, of the cost and along the steps that it
    makes with u held.

    States, controls, steps and J are in units of the extents of tried paths, which are parameters of the program.

    The problem is not convex, and IPOPT finds local minima. Each initial state has several starts: a straight line to
    close by the goal, random curves, the controls that the caller knows, a tried path where none of these leads to a
    minimum, and the optima of its neighbours in the batch; where these lead to one minimum from each of the first
    states, spread over the batch, the others follow their neighbours alone. The least cost counts, as a rollout of its
    controls in torch has it, and is kept on disk. What no start leads to, or the rollout does not confirm, is NaN, and
    once the first few states have none, the others are not tried. Controls that violate a constraint are none to
    compare with.

    Args:
        problem: what is solved; a copy of it, in float64 on the CPU, whatever its own precision.
        method: of the steps, a key of TABLEAUX; None: the horizon's.
        iterations: of IPOPT from one start, at most.

    Raises:
        OracleError: dynamics or cost are not in torch operations that CasADi has too.

    Source: Betts, Practical Methods for Optimal Control Using Nonlinear Programming, ch. 4; Wächter, Biegler, "On the
    implementation of an interior-point filter line-search algorithm", Mathematical Programming 2006 (IPOPT).
    """

    def __init__(self, problem: Problem, method: str | None = None, iterations: int = 500):
        self.problem = copied(problem).in_steps(method=method or problem.horizon.method)
        system, horizon = self.problem.system, self.problem.horizon
        self.task = CasadiTask(self.problem)
        self.cache = OptimaCache(self.task.graphs, horizon.steps, system.m, self.problem.controls)
        box = self.problem.initial_states
        self._where = self.cache.folder.name, *box.lower.tolist(), *box.upper.tolist()
        self._stopped = False
        limits = self.problem.controls.limits
        domain = self.problem.domain
        bounded = self.problem.controls.limited or self.task.inside is not None or domain is not None
        self._limit, self._solver = _solver(self.task, horizon.steps, iterations, bounded)
        self._iterations = iterations
        self._taken = 0  # most iterations of a first minimum so far; 0: none is known
        self._scales = Scales(self.problem)
        assert limits is not None  # oracle_of asks before
        free = torch.full((system.n,), torch.inf)
        ends = (-free, free) if domain is None else domain.narrowed(WITHIN)
        self._bounds = [
            np.concatenate([
                np.tile(side.expand(system.m).numpy() / self._scales.of_controls, horizon.steps),
                np.tile(end.numpy() / self._scales.of_states, horizon.steps),
            ])
            for side, end in zip(limits, ends, strict=True)
        ]  # fmt: skip
        # the defects of the steps vanish, and h ≤ 0
        more = 0 if self.task.inside is None else horizon.steps * self.task.inside.size1_out(0)
        defects = np.zeros(system.n * horizon.steps)
        self._held = [np.concatenate([defects, np.full(more, side)]) for side in (-np.inf, 0.0)]

    def rollout(self, x0: State, u: ControlPath) -> tuple[StatePath, PerState]:
        """(x, J_N) under given controls, by the torch system."""
        x, J = [x0], torch.zeros_like(x0[..., 0])
        for control in u:
            following, step_cost = self.problem.step(x[-1], control)
            x, J = [*x, following], J + step_cost
        return torch.stack(x), J + self.problem.cost.terminal(x[-1])

    def solve(
        self, x0: State, known: ControlPath | None = None, progress: Report = silent, seconds: float = math.inf
    ) -> Optima:
        """The optima of a batch (b, n): from disk, unless `known` controls cost less than those."""
        states = x0.detach().double().cpu()
        nothing: list[Tensor | None] = [None] * len(states)
        stored = self._replayed(states, [self.cache.read(x) for x in states])
        within = None if known is None else self.problem.controls.project(known.detach().double().cpu())
        given = self._replayed(states, nothing if within is None else within.unbind(1))
        explored = EXPLORED_AGAIN if self._where in _WITH_ONE_MINIMUM else EXPLORED
        search = MultiStart(states.numpy(), stored, self.minimise, explored)
        pending = [i for i in range(len(states)) if stored[i] is None or is_better(given[i], stored[i])]
        if pending:
            first = [pending[len(pending) * k // explored] for k in range(min(explored, len(pending)))]
            pending = [*first, *(i for i in pending if i not in first)]
            starts = dict(zip(pending, self._starts(states, pending, given, search), strict=True))
            self._search(search, starts, progress, time.thread_time() + seconds)
            if search.several:
                _WITH_ONE_MINIMUM.discard(self._where)
            elif explored == EXPLORED and self._is_spread(states[pending[:EXPLORED]], search):
                _WITH_ONE_MINIMUM.add(self._where)
        optima = self._verified(states, search, given)
        for i, best in enumerate(search.best):
            if best is not None and best is not stored[i] and not optima.reasons[i]:
                self.cache.write(states[i], torch.from_numpy(best.u))
        return Optima(optima.cost.to(x0), optima.reasons, None if optima.u is None else optima.u.to(x0))

    def _is_spread(self, states: Tensor, search: MultiStart) -> bool:
        """Whether there are EXPLORED states, they reach over half of X₀ in each component, and all have a minimum."""
        if len(states) < EXPLORED or any(best is None for best in search.best):
            return False
        box = self.problem.initial_states
        return bool((states.amax(0) - states.amin(0) >= SPREAD * (box.upper - box.lower)).all())

    def _replayed(self, states: Tensor, controls: Sequence[Tensor | None]) -> list[Candidate | None]:
        """The trajectories of the controls that there are, and that keep the state finite and within constraints."""
        candidates: list[Candidate | None] = [None] * len(states)
        some = [i for i, u in enumerate(controls) if u is not None]
        if some:
            u = torch.stack([controls[i] for i in some], 1)  # pyright: ignore[reportArgumentType]
            with torch.no_grad():
                x, J = self.rollout(states[some], u)
                admitted = torch.isfinite(x).all(-1).all(0) & J.isfinite()
                if self.problem.domain is not None:
                    admitted &= ~self.problem.domain.left(x, slack=0.0)
                if self.problem.constraints is not None:
                    admitted &= self.problem.constraints.worst(x[1:]).amax(0) <= VIOLATED
            columns = (x.unbind(1), u.unbind(1), J.tolist(), admitted.tolist())
            for i, path, control, cost, good in zip(some, *columns, strict=True):
                if good:
                    candidates[i] = Candidate(path[1:].numpy(), control.numpy(), cost)
        return candidates

    def _starts(
        self, states: Tensor, pending: Sequence[int], given: Sequence[Candidate | None], search: MultiStart
    ) -> Iterator[Iterator[Candidate]]:
        """For each pending state: what the caller knows, and the line to the goal with the control that costs nothing.

        The first BENT states try random curves around that line too; a better minimum that these find reaches the
        others from neighbour to neighbour. Where nothing has led to a minimum, the path that was tried is the last one.
        """
        N, random = self.problem.horizon.steps, np.random.default_rng(0)
        goal, rest = self.problem.goal.numpy(), self.problem.rest.expand(N, -1).numpy()
        s = np.arange(1, N + 1)[:, None] / N
        waves = np.stack([np.sin(k * np.pi * s) / k for k in (1, 2, 3)])  # smooth, and zero at both ends
        extent = states.abs().amax(0).numpy()
        scale = np.where(extent > 0, extent, 1.0)
        tried, aside = self._scales.paths(states), ASIDE * self._scales.of_states * s
        curves = math.ceil(BENT * BENDS / min(BENT, len(pending)))
        for k, i in enumerate(pending):
            line = goal + (1 - s) * (states[i].numpy() - goal) + aside
            bends = scale * (waves * random.standard_normal((curves, 3, 1, len(scale)))).sum(1)
            paths = (line, *(line + bends)) if k < BENT else (line,)
            cold = [Candidate(x, rest, math.inf) for x in paths]
            known = given[i]
            path = Candidate(tried.x[1:, i].numpy(), tried.u[:, i].numpy(), math.inf)
            yield _until(search, i, cold if known is None else [known, *cold], path)

    def _search(
        self, search: MultiStart, starts: Mapping[int, Iterable[Candidate]], progress: Report, until: float
    ) -> None:
        """Run a search; Ctrl-C and SIGTERM end it."""
        self._stopped = False
        with signals_taken(self._stop):
            try:
                search.run(starts, progress, until)
            finally:  # where CasADi made an error of its own of what ended it
                if self._stopped:
                    self._stop()

    def _stop(self, *_: object) -> None:
        """Take a signal: CasADi ends at what this raises, and keeps it to itself or raises something else."""
        self._stopped = True
        raise Interrupted("Stopped while seeking optima; those of earlier evaluations are kept.", 130)

    def minimise(self, x0: np.ndarray, start: Candidate, briefly: bool = False) -> Candidate | str:
        """The local minimum that IPOPT finds from a start, or its reason for none.

        Args:
            briefly: in not many more iterations than a first minimum has taken.
        """
        most = self._iterations
        if briefly:
            least, most = BRIEF
            most = min(most, self._iterations, max(least, LONGER * self._taken) if self._taken else most)
        found = self._minimum(x0, start, most)
        if found == INVALID:  # where slopes do not exist at x₀ itself, as those of |v| at rest
            found = self._minimum(x0 + BESIDE * self._scales.of_states, start, most)
        if not briefly and not isinstance(found, str):
            self._taken = max(self._taken, self._limit.done)
        return found

    def _minimum(self, x0: np.ndarray, start: Candidate, iterations: int) -> Candidate | str:
        lower, upper = self._bounds
        of_x, of_u, scale = self._scales.of_states, self._scales.of_controls, self._scales.of_cost(x0)
        guess = np.concatenate([(start.u / of_u).ravel(), (start.x / of_x).ravel()])
        given = np.concatenate([x0, [scale], of_x, of_u])
        least, greatest = self._held
        self._limit.start(iterations)
        with redirect_stderr(StringIO()):  # CasADi warns of what ends it; it goes on as a reason, or as what was raised
            result = self._solver(x0=guess, p=given, lbx=lower, ubx=upper, lbg=least, ubg=greatest)
        status = self._solver.stats()["return_status"]
        if self._stopped:
            self._stop()
        if status not in CONVERGED:
            return f"IPOPT: {'Maximum_Iterations_Exceeded' if self._limit.is_reached() else status}"
        u, x = np.split(np.asarray(result["x"]).ravel(), [start.u.size])
        u = of_u * u.reshape(start.u.shape)
        u = self.problem.controls.project(torch.from_numpy(u)).numpy()  # which IPOPT may pass
        return Candidate(of_x * x.reshape(start.x.shape), u, scale * float(result["f"]))

    def _verified(self, states: Tensor, search: MultiStart, given: Sequence[Candidate | None]) -> Optima:
        """The costs of the best controls in a rollout, where that confirms them."""
        replayed = self._replayed(states, [None if b is None else torch.from_numpy(b.u) for b in search.best])
        reasons = list(map(_doubt, search.best, replayed, given, search.reasons))
        cost = torch.full((len(states),), math.nan, dtype=torch.float64)
        u = torch.full((self.problem.horizon.steps, len(states), self.problem.system.m), math.nan, dtype=torch.float64)
        for i, candidate in enumerate(replayed):
            if candidate is not None and not reasons[i]:
                cost[i], u[:, i] = candidate.cost, torch.from_numpy(candidate.u)
        return Optima(cost, reasons, u)


def _until(search: MultiStart, i: int, starts: Sequence[Candidate], last: Candidate) -> Iterator[Candidate]:
    """Some starts of a state, and one more where none of them has led to a minimum."""
    yield from starts
    if search.best[i] is None:
        yield last


def _doubt(best: Candidate | None, replayed: Candidate | None, given: Candidate | None, reason: str) -> str:
    """Why a cost is not to be taken for the optimum; empty where it is."""
    if best is None:
        return reason
    if replayed is None or abs(replayed.cost - best.cost) > SAME * abs(best.cost) + 1e-9:
        got = "no finite number" if replayed is None else f"{replayed.cost:.9g}"
        return f"IPOPT's cost {best.cost:.9g} is {got} in a rollout of its controls"
    if is_better(given, replayed):
        return f"known controls cost less than the {best.cost:.6g} of every local minimum that was found"
    return ""


class _IterationLimit(casadi.Callback):
    """Ends IPOPT after a number of iterations that each call may choose, as CasADi has no such parameter.

    IPOPT reports each iteration, and the start of a restoration phase too, which counts as one.

    Args:
        sizes: numbers in the variables x, the constraints g and the parameters p.
    """

    def __init__(self, sizes: Mapping[str, int]):
        super().__init__()
        self.sizes, self.done, self.most = sizes, 0, 0
        self.construct("iteration_limit", {})

    def start(self, most: int) -> None:
        """Count from here."""
        self.done, self.most = -1, most  # the start is reported too

    def is_reached(self) -> bool:
        return self.done > self.most  # the last one may be the minimum

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


def _solver(task: CasadiTask, steps: int, iterations: int, limited: bool) -> tuple[_IterationLimit, casadi.Function]:
    """IPOPT for the transcribed task, with exact sparse derivatives, and what limits its iterations.

    Variables are (u, x) in units of their scales, parameters x₀, what J is divided by, and those scales.
    """
    n, m = task.step.size1_in(0), task.step.size1_in(1)
    x0, scaled_x, scaled_u = casadi.MX.sym("x0", n), casadi.MX.sym("x", n, steps), casadi.MX.sym("u", m, steps)
    scale, of_x, of_u = casadi.MX.sym("scale"), casadi.MX.sym("of_x", n), casadi.MX.sym("of_u", m)
    x, u = casadi.diag(of_x) @ scaled_x, casadi.diag(of_u) @ scaled_u
    following, step_cost = task.step.map(steps)(casadi.horzcat(x0, x[:, :-1]), u)
    J = casadi.sum2(step_cost) + task.end(x[:, -1])
    variables, zero = casadi.veccat(scaled_u, scaled_x), casadi.vec(casadi.diag(1 / of_x) @ (following - x))
    held = zero if task.inside is None else casadi.veccat(zero, task.inside.map(steps)(x))
    problem = {"x": variables, "p": casadi.vertcat(x0, scale, of_x, of_u), "f": J / scale, "g": held}
    # so exact that an unstable system does not make another path of the controls, nor the barrier another J; and within
    # the limits themselves
    exact = {"ipopt.tol": 1e-10, **({"ipopt.bound_relax_factor": 0.0} if limited else {})}
    # where rounding or a kink ends it before: a rollout confirms the cost, or nothing is found
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
    return limit, casadi.nlpsol("transcription", "ipopt", problem, options)

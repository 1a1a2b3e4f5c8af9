"""The optimum of any task by direct transcription: all states and controls at once, by CasADi and IPOPT.

Ground truth for tests and tables, never used in training. The model is the torch system itself, read by `symbolic`.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import redirect_stderr
from io import StringIO

import casadi
import numpy as np
import torch
from torch import Tensor

from lyapnet.contracts import copied
from lyapnet.errors import Interrupted, signals_taken
from lyapnet.evaluation.oracles.base import Optima, Oracle, Report, silent
from lyapnet.evaluation.oracles.cache import OptimaCache
from lyapnet.evaluation.oracles.casadi_task import CasadiTask
from lyapnet.evaluation.oracles.multistart import SAME, Candidate, MultiStart, is_better
from lyapnet.expansions import riccati
from lyapnet.problem import Problem
from lyapnet.types import ControlPath, PerState, State, StatePath

VIOLATED = 1e-6  # h that is still taken for zero
BENT, BENDS = 8, 2  # of how many initial states random starts are tried, and how many of each; the others follow them


class Transcription(Oracle):
    """min over x₁ … x_N, u₀ … u_{N−1} ∈ U of Δt Σ_{n<N} ℓ(x_n, u_n) + φ(x_N) subject to x_{n+1} = x_n + Δt(f + gu)
    and h(x_n) ≤ 0 for n ≥ 1; by another Runge-Kutta method, of the cost and along the steps that it makes with u held.

    The problem is not convex, and IPOPT finds local minima. Each initial state has several starts: a straight line to
    the goal, random curves, the controls that the caller knows, and the optima of its neighbours in the batch. The
    least cost counts, as a rollout of its controls in torch has it, and is kept on disk. What no start leads to, or
    the rollout does not confirm, is NaN. Controls that violate a constraint are none to compare with.

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
        self._stopped = False
        limits = self.problem.controls.limits
        bounded = self.problem.controls.limited or self.task.inside is not None
        self._solver = _solver(self.task, horizon.steps, iterations, bounded)
        self._riccati = riccati(self.problem) if bounded else None
        assert limits is not None  # oracle_of asks before
        free = np.full(system.n * horizon.steps, np.inf)
        self._bounds = [
            np.concatenate([np.tile(side.expand(system.m).numpy(), horizon.steps), sign * free])
            for side, sign in zip(limits, (-1, 1), strict=True)
        ]
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

    def solve(self, x0: State, known: ControlPath | None = None, progress: Report = silent) -> Optima:
        """The optima of a batch (b, n): from disk, unless `known` controls cost less than those."""
        states = x0.detach().double().cpu()
        nothing: list[Tensor | None] = [None] * len(states)
        stored = self._replayed(states, [self.cache.read(x) for x in states])
        within = None if known is None else self.problem.controls.project(known.detach().double().cpu())
        given = self._replayed(states, nothing if within is None else within.unbind(1))
        search = MultiStart(states.numpy(), stored, self.minimise)
        pending = [i for i in range(len(states)) if stored[i] is None or is_better(given[i], stored[i])]
        if pending:
            self._search(search, dict(zip(pending, self._starts(states, pending, given), strict=True)), progress)
        optima = self._verified(states, search, given)
        for i, best in enumerate(search.best):
            if best is not None and best is not stored[i] and not optima.reasons[i]:
                self.cache.write(states[i], torch.from_numpy(best.u))
        return Optima(optima.cost.to(x0), optima.reasons, None if optima.u is None else optima.u.to(x0))

    def _replayed(self, states: Tensor, controls: Sequence[Tensor | None]) -> list[Candidate | None]:
        """The trajectories of the controls that there are, and that keep the state finite and within constraints."""
        candidates: list[Candidate | None] = [None] * len(states)
        some = [i for i, u in enumerate(controls) if u is not None]
        if some:
            u = torch.stack([controls[i] for i in some], 1)  # pyright: ignore[reportArgumentType]
            with torch.no_grad():
                x, J = self.rollout(states[some], u)
                admitted = torch.isfinite(x).all(-1).all(0) & J.isfinite()
                if self.problem.constraints is not None:
                    admitted &= self.problem.constraints.worst(x[1:]).amax(0) <= VIOLATED
            columns = (x.unbind(1), u.unbind(1), J.tolist(), admitted.tolist())
            for i, path, control, cost, good in zip(some, *columns, strict=True):
                if good:
                    candidates[i] = Candidate(path[1:].numpy(), control.numpy(), cost)
        return candidates

    def _starts(
        self, states: Tensor, pending: Sequence[int], given: Sequence[Candidate | None]
    ) -> Iterator[list[Candidate]]:
        """For each pending state: what the caller knows, and the line to the goal with the control that costs nothing.

        A few states, evenly spread over the batch, try random curves around that line too; a better minimum that these
        find reaches the others from neighbour to neighbour.
        """
        N, random = self.problem.horizon.steps, np.random.default_rng(0)
        goal, rest = self.problem.goal.numpy(), self.problem.rest.expand(N, -1).numpy()
        s = np.arange(1, N + 1)[:, None] / N
        waves = np.stack([np.sin(k * np.pi * s) / k for k in (1, 2, 3)])  # smooth, and zero at both ends
        extent = states.abs().amax(0).numpy()
        scale = np.where(extent > 0, extent, 1.0)
        curves = math.ceil(BENT * BENDS / min(BENT, len(pending)))
        bent = {len(pending) * k // BENT for k in range(BENT)}
        for k, i in enumerate(pending):
            line = goal + (1 - s) * (states[i].numpy() - goal)
            bends = scale * (waves * random.standard_normal((curves, 3, 1, len(scale)))).sum(1)
            paths = (line, *(line + bends)) if k in bent else (line,)
            cold = [Candidate(x, rest, math.inf) for x in paths]
            known = given[i]
            yield cold if known is None else [known, *cold]

    def _search(self, search: MultiStart, starts: Mapping[int, list[Candidate]], progress: Report) -> None:
        """Run a search; Ctrl-C and SIGTERM end it."""
        self._stopped = False
        with signals_taken(self._stop):
            try:
                search.run(starts, progress)
            finally:  # where CasADi made an error of its own of what ended it
                if self._stopped:
                    self._stop()

    def _stop(self, *_: object) -> None:
        """Take a signal: CasADi ends at what this raises, and keeps it to itself or raises something else."""
        self._stopped = True
        raise Interrupted("Stopped while seeking optima; those of earlier evaluations are kept.", 130)

    def minimise(self, x0: np.ndarray, start: Candidate) -> Candidate | str:
        """The local minimum that IPOPT finds from a start, or its reason for none."""
        lower, upper = self._bounds
        guess = np.concatenate([start.u.ravel(), start.x.ravel()])
        scale = self._scale(torch.from_numpy(x0))
        least, greatest = self._held
        with redirect_stderr(StringIO()):  # CasADi warns of what ends it; it goes on as a reason, or as what was raised
            result = self._solver(x0=guess, p=np.append(x0, scale), lbx=lower, ubx=upper, lbg=least, ubg=greatest)
        status = self._solver.stats()["return_status"]
        if self._stopped:
            self._stop()
        if status != "Solve_Succeeded":
            return f"IPOPT: {status}"
        u, x = np.split(np.asarray(result["x"]).ravel(), [start.u.size])
        u = self.problem.controls.project(torch.from_numpy(u.reshape(start.u.shape))).numpy()  # which IPOPT may pass
        return Candidate(x.reshape(start.x.shape), u, scale * float(result["f"]))

    def _scale(self, x0: State) -> float:
        """A cost of about the size of J*, as IPOPT's barrier is absolute; 1 where there is none, or no barrier."""
        if self._riccati is None:
            return 1.0
        cost = float(self._riccati.initially(x0))
        return cost if 0 < cost < math.inf else 1.0

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


def _solver(task: CasadiTask, steps: int, iterations: int, limited: bool) -> casadi.Function:
    """IPOPT for the transcribed task, with exact sparse derivatives.

    Variables are (u, x), parameters x₀ and what J is divided by.
    """
    n, m = task.step.size1_in(0), task.step.size1_in(1)
    x0, x, u = casadi.MX.sym("x0", n), casadi.MX.sym("x", n, steps), casadi.MX.sym("u", m, steps)
    following, step_cost = task.step.map(steps)(casadi.horzcat(x0, x[:, :-1]), u)
    J = casadi.sum2(step_cost) + task.end(x[:, -1])
    variables, scale = casadi.veccat(u, x), casadi.MX.sym("scale")
    zero = casadi.vec(following - x)
    held = zero if task.inside is None else casadi.veccat(zero, task.inside.map(steps)(x))
    problem = {"x": variables, "p": casadi.vertcat(x0, scale), "f": J / scale, "g": held}
    # within the limits themselves, and with a barrier of which nothing is seen in J
    exact = {"ipopt.bound_relax_factor": 0.0, "ipopt.tol": 1e-10} if limited else {}
    quiet = {"print_time": False, "show_eval_warnings": False, "ipopt.print_level": 0, "ipopt.sb": "yes"}
    # acceptable_iter 0: only what meets the tolerances themselves has converged
    options = {**quiet, **exact, "ipopt.max_iter": iterations, "ipopt.acceptable_iter": 0}
    return casadi.nlpsol("transcription", "ipopt", problem, options)

"""Model predictive control by CasADi: at each step an optimal control problem of the next H steps, warm-started."""

from typing import NamedTuple

import casadi
import numpy as np
import torch
from numpy.typing import NDArray

from lyapnet.base.contracts import copied
from lyapnet.base.errors import OracleError, UsageError
from lyapnet.controller.controller import Controller
from lyapnet.evaluation.oracles.casadi_task import CasadiTask
from lyapnet.exchange.export.law import Law
from lyapnet.graphs.casadi_functions import casadi_function
from lyapnet.lab.comparison.planners.planner import LoopLaw, Planner
from lyapnet.task.problem import Problem
from lyapnet.value.expansions import riccati

SOLVER, ITERATIONS, TOLERANCE = "fatrop", 1000, 1e-6
LEAST = 5  # least number of steps of a horizon: on shorter ones with many states fatrop does not converge
QUIET = {"print_time": False, "show_eval_warnings": False, "fatrop.print_level": 0}


class TerminalCost(NamedTuple):
    """The terminal cost of the horizon.

    Args:
        function: (x, parameters) ↦ its cost.
        parameters: those after each number of steps from the start of the task, up to N.
    """

    function: casadi.Function
    parameters: NDArray  # (N + 1, k)


class PredictiveControl(Planner):
    """u_n is the first control of argmin over u_n … u_{n+H−1} ∈ U of Δt Σℓ + V_{n+H}(x_{n+H}), along the task's steps.

    What follows the H steps costs V, the value of LQR there, as is usual, or a learned one; at T it is φ. Near the end
    fewer than H steps are left: those beyond T leave x where it is and cost what u is off its rest, so that one solver
    serves all steps and T is where it is. With H = N it is the optimal law, but for local minima. A plan is
    warm-started with the last one, a step later; the first begins with the straight line to the goal and the control
    that costs nothing, or with the closed loop of the controller that V comes from. Of a solve that does not converge,
    the last iterate is the plan. Noise is unknown to the plan, which is made again at each step: certainty-equivalent
    control.

    Args:
        problem: the task; its constraints are not known here.
        steps: H; LEAST at the least.
        controller: whose V(t, x) is the cost of what follows; None: LQR's.

    Raises:
        UsageError: the task has operations that CasADi lacks, or controls without limits that it could be told.

    Source: fatrop, Vanroye et al., "FATROP: A Fast Constrained Optimal Control Problem Solver for Robot Trajectory
    Optimization and Control", IROS 2023.
    """

    def __init__(self, problem: Problem, steps: int, controller: Controller | None = None):
        self.problem, self.controller = copied(problem), controller
        steps = max(steps, LEAST)
        self.steps, self.horizon = steps, problem.horizon.steps
        if self.problem.controls.limits is None:
            name = type(self.problem.controls).__name__
            raise UsageError(f"Expected controls whose limits are told, for MPC, got {name}; give it `limits`.")
        try:
            task = CasadiTask(self.problem)
        except OracleError as error:
            raise UsageError(f"{error} MPC cannot plan without.") from error
        if not task.is_program_of_steps:
            raise UsageError(
                "Expected limits and uᵀRu alone for MPC, got another set or cost of controls; leave it out."
            )
        n, m = task.step.size1_in(0), task.step.size1_in(1)
        self._tail = (
            terminal_cost_of_regulator(self.problem) if controller is None else learned_terminal_cost(controller)
        )
        self._solver = _solver(task, steps, self._tail.function, self._rest)
        free = np.full((steps + 1, n), np.inf)
        lower, upper = (side.expand(m).double().cpu().numpy() for side in self.problem.controls.limits)
        self._bounds = [_stacked(sign * free, np.tile(side, (steps, 1))) for sign, side in ((-1, lower), (1, upper))]

    @property
    def _rest(self) -> NDArray:
        """The projection of u* onto U."""
        return self.problem.controls.project(self.problem.rest).double().cpu().numpy()

    @property
    def _goal(self) -> NDArray:
        return self.problem.goal.double().cpu().numpy()

    def law(self) -> LoopLaw:
        kept: list[tuple[NDArray, NDArray]] = []  # the plan (x, u), as of the last step

        def control(step: int, x: NDArray) -> NDArray:
            start = _later(*kept.pop()) if kept else self._first_plan(step, x)
            kept.append(self._solve(step, x, *start))
            return kept[0][1][0]

        return control

    def _solve(self, step: int, x0: NDArray, x: NDArray, u: NDArray) -> tuple[NDArray, NDArray]:
        """The plan from x₀ at a step, with an initial guess; the guess itself if the solver's result is not finite."""
        inside, end = (np.arange(self.steps) < self.horizon - step).astype(float), step + self.steps
        tail = self._tail.parameters[min(end, self.horizon)]
        given = np.concatenate([x0, inside, [float(end >= self.horizon)], tail])
        lower, upper = self._bounds
        x[0] = x0
        found = self._solver(x0=_stacked(x, u), p=given, lbx=lower, ubx=upper, lbg=0, ubg=0)
        plan = np.asarray(found["x"]).ravel()
        finite = bool(np.isfinite(plan).all())
        self.count(finite and self._solver.stats()["success"])
        if not finite:
            return x, u
        width = x.shape[1] + u.shape[1]
        rows = plan[: self.steps * width].reshape(self.steps, width)
        last = plan[self.steps * width :]
        return np.concatenate([rows[:, : x.shape[1]], last[None]]), rows[:, x.shape[1] :]

    def _first_plan(self, step: int, x0: NDArray) -> tuple[NDArray, NDArray]:
        """The closed loop of the controller that V comes from; without one, the straight line to the goal at rest."""
        if self.controller is None:
            s = np.linspace(0, 1, self.steps + 1)[:, None]
            return (1 - s) * x0 + s * self._goal, np.tile(self._rest, (self.steps, 1))
        law, x, u = self.controller.law, [torch.as_tensor(x0)[None]], list[torch.Tensor]()
        with torch.no_grad():
            for k in range(step, step + self.steps):
                u.append(law.at_any_time(torch.full((1,), k * self.problem.horizon.dt, dtype=torch.float64), x[-1]))
                x.append(self.problem.step(x[-1], u[-1])[0])
        return torch.cat(x).numpy(), torch.cat(u).numpy()


def _later(x: NDArray, u: NDArray) -> tuple[NDArray, NDArray]:
    """A plan shifted by one step, with its last entry repeated."""
    return np.concatenate([x[1:], x[-1:]]), np.concatenate([u[1:], u[-1:]])


def _stacked(x: NDArray, u: NDArray) -> NDArray:
    """x₀, u₀, x₁, u₁, …, x_H, the order of variables in fatrop."""
    return np.concatenate([np.concatenate([x[:-1], u], 1).ravel(), x[-1]])


def terminal_cost_of_regulator(problem: Problem) -> TerminalCost:
    """½ δᵀHδ + pᵀδ with δ = x − x*, which is V of LQR up to a constant; 0 for a task with a reference, for which a
    linearisation at one point is not valid.
    """
    tail, n = riccati(problem), problem.system.n
    x, H, p = casadi.SX.sym("x", n), casadi.SX.sym("H", n, n), casadi.SX.sym("p", n)
    away = x - problem.goal.double().cpu().numpy()
    value = casadi.bilin(H, away, away) / 2 + casadi.dot(p, away)
    parameters = torch.cat([tail.hessian.flatten(1), tail.gradient], 1).numpy()
    function = casadi.Function("tail", [x, casadi.veccat(H, p)], [value])
    return TerminalCost(function, 0 * parameters if problem.follows_reference else parameters)


def learned_terminal_cost(controller: Controller) -> TerminalCost:
    """V(t, x) of a controller of one system, in float64."""
    law = Law(controller)
    value = casadi_function(law.value, list(law.arguments.values()))
    x, t = casadi.SX.sym("x", controller.system.n), casadi.SX.sym("t")
    (cost,) = value.call([t, x])
    times = controller.horizon.dt * np.arange(controller.horizon.steps + 1)
    return TerminalCost(casadi.Function("tail", [x, t], [cost]), times[:, None])


def _solver(task: CasadiTask, steps: int, tail: casadi.Function, rest: NDArray) -> casadi.Function:
    """fatrop for H stages.

    Parameters are x₀, 1 for each step that is within T, else 0, whether the last is at T or beyond, and those of what
    follows it else.
    """
    n, m = task.step.size1_in(0), task.step.size1_in(1)
    x = [casadi.MX.sym(f"x_{k}", n) for k in range(steps + 1)]
    u = [casadi.MX.sym(f"u_{k}", m) for k in range(steps)]
    start, inside, ended = casadi.MX.sym("start", n), casadi.MX.sym("inside", steps), casadi.MX.sym("ended")
    following = casadi.MX.sym("following", tail.size1_in(1))
    J, zero = ended * task.end(x[-1]) + (1 - ended) * tail(x[-1], following), []
    for k in range(steps):
        after, paid = task.step(x[k], u[k])
        J += inside[k] * paid + (1 - inside[k]) * casadi.sumsqr(u[k] - rest)
        zero.append(x[k + 1] - x[k] - inside[k] * (after - x[k]))
        zero += [x[0] - start] if k == 0 else []
    variables = casadi.veccat(*(part for pair in zip(x[:-1], u, strict=True) for part in pair), x[-1])
    held = casadi.veccat(*zero)
    problem = {"x": variables, "p": casadi.veccat(start, inside, ended, following), "f": J, "g": held}
    options = {
        **QUIET, "expand": True, "structure_detection": "auto", "equality": [True] * held.size1(),
        "fatrop.max_iter": ITERATIONS, "fatrop.tol": TOLERANCE,
    }  # fmt: skip
    return casadi.nlpsol("predictive_control", SOLVER, problem, options)

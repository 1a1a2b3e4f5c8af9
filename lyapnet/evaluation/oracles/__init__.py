"""Ground truth: optima known by another route than learning; training asks for none but of other states, to start."""

import importlib.util

from lyapnet.base.errors import OracleError, one_line
from lyapnet.evaluation.oracles.base import Optima, Oracle, Report, silent
from lyapnet.evaluation.oracles.of_rounded import OracleOfRounded
from lyapnet.evaluation.oracles.riccati import (
    RiccatiOracle,
    RiccatiSolution,
    continuous_riccati,
    discrete_riccati,
)
from lyapnet.loop.rollout import ADAPTIVE_METHODS
from lyapnet.task.cost import is_quadratic
from lyapnet.task.problem import Problem
from lyapnet.task.systems import is_linear
from lyapnet.value.linearisation import SOLVED, rounded

__all__ = [
    "Optima",
    "Oracle",
    "Report",
    "RiccatiOracle",
    "RiccatiSolution",
    "continuous_riccati",
    "discrete_riccati",
    "optimal_cost",
    "oracle_of",
    "silent",
]


def oracle_of(problem: Problem, method: str | None = None) -> Oracle:
    """x₀ ↦ J*(x₀), the least cost from each of a batch of initial states, in their own dtype.

    Where the system is `Linear`, R a matrix, U = ℝᵐ and nothing constrained, it is Riccati's: that of the discretised
    task, J_N*, with Euler, and that of the continuous task with any other integrator. Else it is found by direct
    transcription, within the limits of U and h(x) ≤ 0: with the steps of that integrator, rk4 for an adaptive one, and
    u held over each. Rollouts of laws that are not held read them at every stage of a step, and may so cost less, by
    O(Δt²). Where the cost has a kink at the goal, the optimum is that of the rounded task, and its controls count for
    what they cost in the task as it is written.

    Args:
        method: of the steps; None: the horizon's.

    Raises:
        OracleError: there is none; says why, and what to do.
        ValueError: a weight of the cost does not fit the system's dimensions.
    """
    if problem.controls.limits is None:
        raise OracleError(
            f"Expected controls without limits, or a set that tells its `limits`, for an optimum, got "
            f"{type(problem.controls).__name__}; costs stand alone."
        )
    system, cost, horizon = problem.system, problem.cost, problem.horizon
    method = method or horizon.method
    free = problem.constraints is None and not problem.controls.limited
    if free and is_linear(system) and is_quadratic(cost) and cost.R_constant is not None:
        solve = discrete_riccati if method == "euler" else continuous_riccati
        try:
            return RiccatiOracle(solve(system, cost, horizon))
        except (RuntimeError, OverflowError) as error:  # torch's LinAlgError is no public name
            raise OracleError(
                f"Expected matrices whose Riccati equation rounding lets be solved, got others ({one_line(error)}); "
                "choose units in which they are of similar size."
            ) from error
    if importlib.util.find_spec("casadi") is None:
        raise OracleError(
            "Expected CasADi for the optimum of a nonlinear task, got none; pip install 'lyapnet[oracle]'."
        )
    from lyapnet.evaluation.oracles.transcription import Transcription  # needs the extra

    steps, smooth = "rk4" if method in ADAPTIVE_METHODS else method, rounded(problem, SOLVED)
    found = Transcription(smooth, steps)
    return found if smooth is problem else OracleOfRounded(found, problem, steps)


def optimal_cost(problem: Problem, method: str | None = None) -> Oracle | None:
    """The oracle of a task, or None where there is none.

    Raises:
        ValueError: a weight of the cost does not fit the system's dimensions.
    """
    try:
        return oracle_of(problem, method)
    except OracleError:
        return None

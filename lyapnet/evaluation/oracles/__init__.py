"""Oracles: optimal costs by methods without learning, for tests, tables and the optima from which a training starts."""

import importlib.util

from lyapnet.base.errors import OracleError, one_line
from lyapnet.evaluation.oracles.base import Optima, Oracle, Report, silent
from lyapnet.evaluation.oracles.noisy_riccati import noisy_riccati
from lyapnet.evaluation.oracles.of_smoothed import OracleOfSmoothed
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
from lyapnet.value.linearisation import SOLVED, smooth_kinks

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
    """The oracle x₀ ↦ J*(x₀) of a problem, the least cost from each of a batch of initial states.

    * Riccati, if the system is `Linear`, R is a constant matrix, U = ℝᵐ and there are no constraints: of the
      discretised task for Euler steps, of the continuous task for any other integrator.
    * With noise, the Riccati recursion of the steps for such tasks whose σ is affine in x; no other task with noise has
      an oracle.
    * Direct transcription otherwise, within the limits of U and h(x) ≤ 0, with the steps of the integrator (rk4 for an
      adaptive one) and u held over each step. A law that is not held is evaluated at every stage of a step, and may
      therefore cost less, by O(Δt²).

    If the cost has a kink at the goal, the controls are optimal for the smoothed cost; J* is their original cost.

    Args:
        method: integrator of the steps; None: that of the horizon.

    Raises:
        OracleError: there is no oracle; says why, and what to do.
        ValueError: a weight of the cost does not fit the system's dimensions.
    """
    if problem.controls.limits is None:
        raise OracleError(
            f"Expected controls without limits, or a set with known `limits`, for an optimum, got "
            f"{type(problem.controls).__name__}; costs stand alone."
        )
    system, cost, horizon = problem.system, problem.cost, problem.horizon
    method = method or horizon.method
    free = problem.constraints is None and not problem.controls.limited
    if problem.noise is not None:
        return noisy_riccati(problem, free)
    if free and is_linear(system) and is_quadratic(cost) and cost.R_constant is not None:
        solve = discrete_riccati if method == "euler" else continuous_riccati
        try:
            return RiccatiOracle(solve(system, cost, horizon))
        except (RuntimeError, OverflowError) as error:  # RuntimeError: torch's LinAlgError is not public
            raise OracleError(
                f"Expected a Riccati equation that can be solved despite rounding, got another ({one_line(error)}); "
                "choose units in which they are of similar size."
            ) from error
    if importlib.util.find_spec("casadi") is None:
        raise OracleError(
            "Expected CasADi for the optimum of a nonlinear task, got none; pip install 'lyapnet[oracle]'."
        )
    from lyapnet.evaluation.oracles.transcription import Transcription  # needs CasADi

    steps, smooth = "rk4" if method in ADAPTIVE_METHODS else method, smooth_kinks(problem, SOLVED)
    found = Transcription(smooth, steps)
    return found if smooth is problem else OracleOfSmoothed(found, problem, steps)


def optimal_cost(problem: Problem, method: str | None = None) -> Oracle | None:
    """The oracle of a task; None if there is none.

    Raises:
        ValueError: a weight of the cost does not fit the system's dimensions.
    """
    try:
        return oracle_of(problem, method)
    except OracleError:
        return None

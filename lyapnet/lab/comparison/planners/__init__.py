"""What controls a task by its model without training: no control, LQR, iLQR, and model predictive control."""

import importlib.util

from lyapnet.base.errors import UsageError
from lyapnet.lab.comparison.planners.feedback import IterativeRegulator, Regulator, Rest
from lyapnet.lab.comparison.planners.planner import Planner, PlannerPolicy
from lyapnet.task.problem import Problem

__all__ = ["Planner", "PlannerPolicy", "planner_of"]

REGULATORS = {"rest": Rest, "lqr": Regulator, "ilqr": IterativeRegulator}


def planner_of(method: str, problem: Problem) -> Planner:
    """The planner of a name in PLANNED: rest, lqr, ilqr, or mpc_P whose horizon is P % of the task's.

    Raises:
        UsageError: MPC without CasADi, or of a task that CasADi has no operations for; iLQR of a task with noise.
    """
    if method in REGULATORS:
        return REGULATORS[method](problem)
    if importlib.util.find_spec("casadi") is None:
        raise UsageError(f"Expected CasADi for {method}, got none; pip install 'lyapnet[oracle]'.")
    from lyapnet.lab.comparison.planners.mpc import PredictiveControl  # needs the extra

    percent = int(method.removeprefix("mpc_"))
    return PredictiveControl(problem, max(1, round(problem.horizon.steps * percent / 100)))

"""Laws from the model without training: no control, LQR, iLQR, and model predictive control."""

import importlib.util

from lyapnet.base.errors import UsageError
from lyapnet.controller.controller import Controller
from lyapnet.lab.comparison.planners.feedback import IterativeRegulator, Regulator, Rest
from lyapnet.lab.comparison.planners.planner import Planner, PlannerPolicy
from lyapnet.lab.comparison.results import WITH_VALUE
from lyapnet.task.problem import Problem

__all__ = ["Planner", "PlannerPolicy", "planner_of"]

REGULATORS = {"rest": Rest, "lqr": Regulator, "ilqr": IterativeRegulator}


def planner_of(method: str, problem: Problem, controller: Controller | None = None) -> Planner:
    """The planner of a name in PLANNED: rest, lqr, ilqr, mpc_P with P % of the task's horizon, or mpc_V_H of H steps.

    Args:
        controller: whose V is the terminal cost of mpc_V_H.

    Raises:
        UsageError: MPC without CasADi, or of a task that CasADi has no operations for; iLQR of a task with noise.
    """
    if method in REGULATORS:
        return REGULATORS[method](problem)
    if importlib.util.find_spec("casadi") is None:
        raise UsageError(f"Expected CasADi for {method}, got none; pip install 'lyapnet[oracle]'.")
    from lyapnet.lab.comparison.planners.mpc import PredictiveControl  # needs the extra

    if method.startswith(WITH_VALUE):
        return PredictiveControl(problem, int(method.removeprefix(WITH_VALUE)), controller)
    percent = int(method.removeprefix("mpc_"))
    return PredictiveControl(problem, max(1, round(problem.horizon.steps * percent / 100)))

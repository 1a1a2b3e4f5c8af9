"""What controls a task by its model without training: LQR, iLQR, and model predictive control."""

from lyapnet.comparison.planners.planner import Planner, PlannerPolicy, planner_of

__all__ = ["Planner", "PlannerPolicy", "planner_of"]

"""The closed loop: its vector field, its integration, and the gradients of what it costs."""

from lyapnet.rollout.closed_loop import ClosedLoop
from lyapnet.rollout.discrete_adjoint import DiscreteAdjoint
from lyapnet.rollout.integration import (
    ADAPTIVE_METHODS,
    FIXED_STEP_METHODS,
    GRADIENTS,
    METHODS,
    Rollout,
    Trajectory,
)
from lyapnet.rollout.runge_kutta import TABLEAUX, held_step

__all__ = [
    "ADAPTIVE_METHODS",
    "FIXED_STEP_METHODS",
    "GRADIENTS",
    "METHODS",
    "TABLEAUX",
    "ClosedLoop",
    "DiscreteAdjoint",
    "Rollout",
    "Trajectory",
    "held_step",
]

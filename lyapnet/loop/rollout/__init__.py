"""The closed loop: its vector field, its integration, and the gradients of its cost."""

from lyapnet.loop.rollout.closed_loop import ClosedLoop
from lyapnet.loop.rollout.discrete_adjoint import DiscreteAdjoint
from lyapnet.loop.rollout.integration import (
    ADAPTIVE_METHODS,
    FIXED_STEP_METHODS,
    GRADIENTS,
    METHODS,
    NoisyTrajectory,
    Rollout,
    Trajectory,
)

__all__ = [
    "ADAPTIVE_METHODS",
    "FIXED_STEP_METHODS",
    "GRADIENTS",
    "METHODS",
    "ClosedLoop",
    "DiscreteAdjoint",
    "NoisyTrajectory",
    "Rollout",
    "Trajectory",
]

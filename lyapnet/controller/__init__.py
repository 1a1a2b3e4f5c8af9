"""The controller: V, its control law and the closed loop as one object; and its loading from a checkpoint."""

from lyapnet.controller.controller import ArrayTrajectory, Controller
from lyapnet.controller.loading import load

__all__ = ["ArrayTrajectory", "Controller", "load"]

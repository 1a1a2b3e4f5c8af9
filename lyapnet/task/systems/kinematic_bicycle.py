"""A car that drives and steers, whose dynamics are not affine in the steering angle."""

import numpy as np
import torch

from lyapnet.base.shapes import Line, Shape, rectangle
from lyapnet.base.types import Control, State
from lyapnet.task.systems.base import ControlSystem, require_positive


class KinematicBicycle(ControlSystem):
    """ẋ = v cos θ, ẏ = v sin θ, θ̇ = (v/L) tan δ, v̇ = a: a car whose wheels do not slip, about its rear axle.

    The controls are the acceleration a and the steering angle δ, which needs limits within ±90°.

    Args:
        length: wheelbase L in m.
    """

    state_names, state_units = ("x", "y", "heading", "speed"), ("m", "m", "rad", "m/s")
    control_names, control_units = ("acceleration", "steering"), ("m/s²", "rad")
    angles = (2,)

    def __init__(self, length: float = 1.0):
        require_positive(length=length)
        super().__init__()
        self.length = length

    def dynamics(self, x: State, u: Control) -> State:
        heading, speed = x[..., 2], x[..., 3]
        turning = speed / self.length * torch.tan(u[..., 1])
        return torch.stack([speed * torch.cos(heading), speed * torch.sin(heading), turning, u[..., 0]], -1)

    def draw(self, x: np.ndarray, u: np.ndarray) -> list[Shape]:
        """The body, and a wheel at each axle, of which the front one is steered."""
        place, heading = x[:2], x[2]
        ahead = np.array([np.cos(heading), np.sin(heading)])
        shapes: list[Shape] = [
            rectangle(place + self.length / 2 * ahead, 1.3 * self.length, 0.5 * self.length, heading)
        ]
        for axle, angle in ((place, heading), (place + self.length * ahead, heading + u[1])):
            half = 0.2 * self.length * np.array([np.cos(angle), np.sin(angle)])
            shapes.append(Line(np.stack([axle - half, axle + half]), 4.0))
        return shapes

"""A car that follows a circle."""

import torch

from lyapnet.base.types import InputMatrix, State
from lyapnet.task.systems.base import ControlAffineSystem, require_positive


class PathTracking(ControlAffineSystem):
    """A kinematic bicycle at constant speed along a circle: ė = v sin θ, θ̇ = (v/L) u − cos θ / (r/v − sin θ).

    e is the distance from the path, θ the heading error, u the tangent of the steering angle; u = L/r holds e = 0.

    Args:
        speed: v in m/s.
        length: wheelbase L in m.
        radius: radius r of the path in m; more than v · 1 s.
    """

    state_names, state_units = ("distance", "heading"), ("m", "rad")
    control_names, control_units = ("steering",), ("1",)
    angles = (1,)

    def __init__(self, speed: float = 2.0, length: float = 1.0, radius: float = 10.0):
        require_positive(speed=speed, length=length)
        require_positive(**{"radius − speed": radius - speed})
        super().__init__()
        self.speed, self.length, self.radius = speed, length, radius

    def f(self, x: State) -> State:
        theta = x[..., 1]
        turning = torch.cos(theta) / (self.radius / self.speed - torch.sin(theta))
        return torch.stack([self.speed * torch.sin(theta), -turning], -1)

    def g(self, x: State) -> InputMatrix:
        zero = torch.zeros_like(x[..., 0])
        return torch.stack([zero, zero + self.speed / self.length], -1)[..., None]

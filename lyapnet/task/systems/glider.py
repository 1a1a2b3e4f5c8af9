"""A glider whose lift and drag depend on the angle of attack."""

import torch

from lyapnet.base.types import Control, State
from lyapnet.task.systems.base import ControlSystem, require_positive


class Glider(ControlSystem):
    """V̇ = −D/m − g sin γ, γ̇ = L/(mV) − (g/V) cos γ: speed and path angle of a point mass without thrust.

    With α the angle of attack, the control, L = ½ρV²S C_L and D = ½ρV²S(C_D0 + k C_L²), C_L = C_Lα α: the drag is
    quadratic in α.

    Args:
        mass: m in kg.
        area: S of the wing in m².
        lift_slope: C_Lα in 1/rad.
        drag: C_D0, the drag coefficient without lift.
        induced: k, 1/(π e) times the inverse of the aspect ratio.
        density: ρ of the air in kg/m³.
        gravity: g in m/s².
    """

    state_names, state_units = ("speed", "path angle"), ("m/s", "rad")
    control_names, control_units = ("angle of attack",), ("rad",)
    angles = (1,)

    def __init__(
        self, mass: float = 2.0, area: float = 0.5, lift_slope: float = 5.0, drag: float = 0.02, induced: float = 0.04,
        density: float = 1.225, gravity: float = 9.81,
    ):  # fmt: skip
        require_positive(
            mass=mass, area=area, lift_slope=lift_slope, drag=drag, induced=induced, density=density, gravity=gravity
        )
        super().__init__()
        self.mass, self.area, self.lift_slope, self.drag = mass, area, lift_slope, drag
        self.induced, self.density, self.gravity = induced, density, gravity

    def dynamics(self, x: State, u: Control) -> State:
        speed, angle = x.unbind(-1)
        lift = self.lift_slope * u[..., 0]
        pressed = self.density * self.area / (2 * self.mass) * speed  # force/(m V) for each unit of a coefficient
        slowing = pressed * speed * (self.drag + self.induced * lift * lift)
        return torch.stack(
            [-slowing - self.gravity * torch.sin(angle), pressed * lift - self.gravity / speed * torch.cos(angle)], -1
        )

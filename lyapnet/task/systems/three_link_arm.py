"""The planar three-link arm."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lyapnet.base.shapes import Disk, Line, Shape, chain
from lyapnet.base.types import Coordinates, MassMatrix, PerState, State
from lyapnet.task.systems.base import MechanicalSystem, require_positive


class ThreeLinkArm(MechanicalSystem):
    """Three equal rods in the horizontal plane with absolute angles and torques at the joints:

    M_ij = c_ij cos(θ_i − θ_j),   h_i = −Σ_j c_ij sin(θ_i − θ_j) θ̇_j²,

    c = m l² [[7/3, 3/2, 1/2], [3/2, 4/3, 1/2], [1/2, 1/2, 1/3]] for uniform rods.

    Args:
        mass: m of each rod in kg.
        length: l of each in m.
        damping: on each absolute rate, in N·m·s/rad.
    """

    state_names = ("first angle", "second angle", "third angle", "first rate", "second rate", "third rate")
    state_units = ("rad",) * 3 + ("rad/s",) * 3
    control_names, control_units = ("shoulder torque", "elbow torque", "wrist torque"), ("N·m",) * 3
    angles = (0, 1, 2)
    dampings = ("damping", "damping", "damping")
    c: Float[Tensor, "3 3"]

    def __init__(self, mass: float = 1.0, length: float = 0.5, damping: float = 0.25):
        require_positive(mass=mass, length=length)
        super().__init__([[1.0, -1.0, 0.0], [0.0, 1.0, -1.0], [0.0, 0.0, 1.0]], [damping] * 3)
        self.length, self.damping = length, damping
        c = torch.tensor([[7 / 3, 3 / 2, 1 / 2], [3 / 2, 4 / 3, 1 / 2], [1 / 2, 1 / 2, 1 / 3]])
        self.register_buffer("c", mass * length**2 * c.to(self.B), persistent=False)

    def mass_matrix(self, q: Coordinates) -> MassMatrix:
        return self.c * torch.cos(q[..., :, None] - q[..., None, :])

    def forces(self, q: Coordinates, qdot: Coordinates) -> Coordinates:
        return -(self.c * torch.sin(q[..., :, None] - q[..., None, :]) * qdot[..., None, :] ** 2).sum(-1)

    def energy(self, x: State) -> PerState:
        return self.kinetic_energy(*self._split(x))

    def draw(self, x: np.ndarray, u: np.ndarray) -> list[Shape]:
        arm = chain([self.length] * 3, x[:3])
        return [Line(arm), *(Disk(joint, 0.05 * self.length) for joint in arm)]

"""The pendulum."""

import numpy as np
import torch

from lyapnet.base.shapes import Disk, Line, Shape, chain
from lyapnet.base.types import Coordinates, MassMatrix, PerState, State
from lyapnet.task.systems.base import MechanicalSystem, require_positive


class Pendulum(MechanicalSystem):
    """A point mass on a massless rod with a torque at its hinge; θ = 0 is upright, θ = π is hanging down.

    m l² θ̈ = u + m g l sin θ − b θ̇.

    Args:
        mass: m in kg.
        length: l in m.
        damping: b in N·m·s/rad.
        gravity: g in m/s².
    """

    state_names, state_units = ("angle", "velocity"), ("rad", "rad/s")
    control_names, control_units = ("torque",), ("N·m",)
    angles = (0,)
    dampings = ("damping",)

    def __init__(self, mass: float = 1.0, length: float = 1.0, damping: float = 0.0, gravity: float = 9.81):
        require_positive(mass=mass, length=length, gravity=gravity)
        super().__init__(actuation=[[1.0]], damping=[damping])
        self.mass, self.length, self.damping, self.gravity = mass, length, damping, gravity

    def mass_matrix(self, q: Coordinates) -> MassMatrix:
        inertia = self.mass * self.length**2 + torch.zeros_like(q[..., 0])
        return inertia[..., None, None]

    def forces(self, q: Coordinates, qdot: Coordinates) -> Coordinates:
        return (self.mass * self.gravity * self.length * torch.sin(q[..., 0]))[..., None]

    def energy(self, x: State) -> PerState:
        q, qdot = self._split(x)
        return self.kinetic_energy(q, qdot) + self.mass * self.gravity * self.length * torch.cos(q[..., 0])

    def draw(self, x: np.ndarray, u: np.ndarray) -> list[Shape]:
        rod = chain([self.length], [np.pi / 2 - x[0]])
        return [Line(rod), Disk(rod[-1], 0.08 * self.length)]

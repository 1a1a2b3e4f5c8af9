"""The acrobot."""

import numpy as np
import torch

from lyapnet.base.shapes import Disk, Line, Shape, chain
from lyapnet.base.types import Coordinates, MassMatrix, PerState, State
from lyapnet.task.systems.base import MechanicalSystem, require_positive


class Acrobot(MechanicalSystem):
    """Two equal rods in a vertical plane with a torque at the elbow only; at θ = 0 both are upright.

    With each rod's mass m, length l and inertia I about its end, and c = ½ m l²:

        M = [[2I + m l² + 2c cos θ₂, I + c cos θ₂], [I + c cos θ₂, I]],
        h = c sin θ₂ (θ̇₂(2θ̇₁ + θ̇₂), −θ̇₁²) + ½ m g l (3 sin θ₁ + sin(θ₁ + θ₂), sin(θ₁ + θ₂)).

    Args:
        mass: m in kg.
        length: l in m; the rods are uniform, I = m l²/3.
        damping: at each joint, in N·m·s/rad.
        gravity: g in m/s².

    Source: Tedrake, Underactuated Robotics, ch. 3, with angles measured from upright.
    """

    state_names = ("shoulder angle", "elbow angle", "shoulder velocity", "elbow velocity")
    state_units = ("rad", "rad", "rad/s", "rad/s")
    control_names, control_units = ("elbow torque",), ("N·m",)
    angles = (0, 1)
    dampings = ("damping", "damping")

    def __init__(self, mass: float = 1.0, length: float = 1.0, damping: float = 0.1, gravity: float = 9.81):
        require_positive(mass=mass, length=length, gravity=gravity)
        super().__init__(actuation=[[0.0], [1.0]], damping=[damping, damping])
        self.inertia, self.coupling = mass * length**2 / 3, mass * length**2 / 2
        self.length, self.damping, self.weight = length, damping, mass * gravity * length / 2

    def mass_matrix(self, q: Coordinates) -> MassMatrix:
        swing = self.coupling * torch.cos(q[..., 1])
        coupling = self.inertia + swing
        first = 2 * self.inertia + 2 * self.coupling + 2 * swing
        elements = [first, coupling, coupling, torch.full_like(coupling, self.inertia)]
        return torch.stack(elements, -1).unflatten(-1, (2, 2))

    def forces(self, q: Coordinates, qdot: Coordinates) -> Coordinates:
        first, second = qdot.unbind(-1)
        coriolis = torch.stack([second * (2 * first + second), -(first**2)], -1)
        upper, lower = torch.sin(q[..., 0]), torch.sin(q[..., 0] + q[..., 1])
        gravity = self.weight * torch.stack([3 * upper + lower, lower], -1)
        return self.coupling * torch.sin(q[..., 1:]) * coriolis + gravity

    def energy(self, x: State) -> PerState:
        q, qdot = self._split(x)
        height = 3 * torch.cos(q[..., 0]) + torch.cos(q[..., 0] + q[..., 1])
        return self.kinetic_energy(q, qdot) + self.weight * height

    def draw(self, x: np.ndarray, u: np.ndarray) -> list[Shape]:
        rods = chain([self.length] * 2, np.pi / 2 - np.cumsum(x[:2]))
        return [Line(rods), *(Disk(joint, 0.05 * self.length) for joint in rods)]

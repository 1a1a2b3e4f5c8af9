"""The planar two-link arm."""

import numpy as np
import torch

from lyapnet.base.shapes import Disk, Line, Shape, chain
from lyapnet.base.types import Coordinates, MassMatrix, PerState, State
from lyapnet.task.systems.base import MechanicalSystem, require_positive

DRAWN = (0.3, 0.33)  # lengths of the drawn links in m, from Li and Todorov; a₁, a₂ and a₃ do not determine them


class Reacher(MechanicalSystem):
    """Two links in the horizontal plane (no gravity), both joints actuated.

    M(q) = [[a₁ + 2a₂ cos q₂, a₃ + a₂ cos q₂], [a₃ + a₂ cos q₂, a₃]],
    M q̈ = u + a₂ sin q₂ · (q̇₂(2q̇₁ + q̇₂), −q̇₁²) − b q̇.

    Args:
        a1: I₁ + I₂ + m l₁² in kg·m²; 0.025 + 0.045 + 1.4·0.3² with the arm constants of Li and Todorov.
        a2: m₂ l₁ s₂ in kg·m²; 1·0.3·0.16.
        a3: I₂ in kg·m².
        damping: b at each joint, in N·m·s/rad.

    Raises:
        ValueError: a parameter is not positive, or M(q) would not be positive definite for every q:
            det M = a₃(a₁ − a₃) − a₂² cos² q₂.

    Source: Li and Todorov, "Iterative linear quadratic regulator design for nonlinear biological movement
    systems", ICINCO 2004. M and the Coriolis force have the same a₂; two different ones would create energy.
    """

    state_names = ("shoulder angle", "elbow angle", "shoulder velocity", "elbow velocity")
    state_units = ("rad", "rad", "rad/s", "rad/s")
    control_names, control_units = ("shoulder torque", "elbow torque"), ("N·m", "N·m")
    angles = (0, 1)
    dampings = ("damping", "damping")

    def __init__(self, a1: float = 0.196, a2: float = 0.048, a3: float = 0.045, damping: float = 0.25):
        require_positive(a1=a1, a2=a2, a3=a3)
        if not a3 * (a1 - a3) > a2**2:
            raise ValueError(
                f"Expected a3 (a1 − a3) > a2², got a1={a1}, a2={a2}, a3={a3}; no arm has such a mass matrix."
            )
        super().__init__(actuation=[[1.0, 0.0], [0.0, 1.0]], damping=[damping, damping])
        self.a1, self.a2, self.a3, self.damping = a1, a2, a3, damping

    def mass_matrix(self, q: Coordinates) -> MassMatrix:
        a2_cos = self.a2 * torch.cos(q[..., 1])
        coupling = self.a3 + a2_cos
        elements = [self.a1 + 2 * a2_cos, coupling, coupling, self.a3 + torch.zeros_like(coupling)]
        return torch.stack(elements, -1).unflatten(-1, (2, 2))

    def forces(self, q: Coordinates, qdot: Coordinates) -> Coordinates:
        first, second = qdot.unbind(-1)
        coriolis = torch.stack([second * (2 * first + second), -(first**2)], -1)
        return (self.a2 * torch.sin(q[..., 1]))[..., None] * coriolis

    def energy(self, x: State) -> PerState:
        return self.kinetic_energy(*self._split(x))

    def draw(self, x: np.ndarray, u: np.ndarray) -> list[Shape]:
        arm = chain(DRAWN, np.cumsum(x[:2]))
        return [Line(arm), *(Disk(joint, 0.02) for joint in arm)]

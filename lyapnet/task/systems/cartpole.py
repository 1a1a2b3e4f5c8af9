"""The cartpole."""

import numpy as np
import torch

from lyapnet.base.shapes import Arrow, Disk, Line, Shape, chain, rectangle
from lyapnet.base.types import Coordinates, MassMatrix, PerState, State
from lyapnet.task.systems.base import MechanicalSystem, require_positive


class Cartpole(MechanicalSystem):
    """A pole (point mass on a massless rod) hinged on a cart; θ = 0 is upright, θ > 0 leans towards positive x.

    M(q) = [[m_c + m_p, m_p l cos θ], [m_p l cos θ, m_p l²]],
    M q̈ = (u + m_p l θ̇² sin θ − b_c ẋ, m_p g l sin θ − b_p θ̇).
    The angle is unwrapped: θ = 2π is another state than the goal, because V is a function on ℝⁿ.

    Args:
        cart_mass: m_c in kg.
        pole_mass: m_p in kg.
        length: l in m.
        cart_damping: b_c in N·s/m.
        pole_damping: b_p in N·m·s/rad.
        gravity: g in m/s².

    Source: Tedrake, Underactuated Robotics, ch. 3, with the angle measured from upright.
    """

    state_names = ("cart position", "pole angle", "cart velocity", "pole velocity")
    state_units = ("m", "rad", "m/s", "rad/s")
    control_names, control_units = ("force",), ("N",)
    angles = (1,)
    dampings = ("cart_damping", "pole_damping")

    def __init__(
        self,
        cart_mass: float = 1.0,
        pole_mass: float = 1.0,
        length: float = 1.0,
        cart_damping: float = 0.0,
        pole_damping: float = 0.1,
        gravity: float = 9.81,
    ):
        require_positive(cart_mass=cart_mass, pole_mass=pole_mass, length=length, gravity=gravity)
        super().__init__(actuation=[[1.0], [0.0]], damping=[cart_damping, pole_damping])
        self.cart_mass, self.pole_mass, self.length, self.gravity = cart_mass, pole_mass, length, gravity
        self.cart_damping, self.pole_damping = cart_damping, pole_damping

    def mass_matrix(self, q: Coordinates) -> MassMatrix:
        coupling = self.pole_mass * self.length * torch.cos(q[..., 1])
        cart = self.cart_mass + self.pole_mass + torch.zeros_like(coupling)
        pole = self.pole_mass * self.length**2 + torch.zeros_like(coupling)
        return torch.stack([cart, coupling, coupling, pole], -1).unflatten(-1, (2, 2))

    def forces(self, q: Coordinates, qdot: Coordinates) -> Coordinates:
        ml_sin = self.pole_mass * self.length * torch.sin(q[..., 1])
        return torch.stack([ml_sin * qdot[..., 1] ** 2, self.gravity * ml_sin], -1)

    def energy(self, x: State) -> PerState:
        q, qdot = self._split(x)
        return self.kinetic_energy(q, qdot) + self.pole_mass * self.gravity * self.length * torch.cos(q[..., 1])

    def draw(self, x: np.ndarray, u: np.ndarray) -> list[Shape]:
        """A force that equals the total weight is drawn as long as the pole."""
        length, cart = self.length, np.array([x[0], 0.0])
        pole = cart + chain([length], [np.pi / 2 - x[1]])
        push = (x[0] + length * u[0] / (self.gravity * (self.cart_mass + self.pole_mass)), 0.0)
        rail = Line([(min(x[0], 0.0) - length, 0), (max(x[0], 0.0) + length, 0)], width=1, faint=True)
        body = rectangle(cart, 0.4 * length, 0.2 * length)
        return [rail, body, Line(pole), Disk(pole[-1], 0.07 * length), Arrow(cart, push)]

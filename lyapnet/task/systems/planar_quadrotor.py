"""The planar quadrotor."""

import numpy as np
import torch

from lyapnet.base.shapes import Arrow, Line, Shape
from lyapnet.base.types import ControlMatrix, InputMatrix, State
from lyapnet.task.systems.base import ControlAffineSystem, require_positive


class PlanarQuadrotor(ControlAffineSystem):
    """A rigid body in a vertical plane with two rotors; the controls are their thrusts minus the hover thrusts.

    With F = m g + u₁ + u₂:   m ẍ = −F sin θ,   m z̈ = F cos θ − m g,   I θ̈ = r (u₁ − u₂).

    Args:
        mass: m in kg.
        inertia: I in kg·m².
        arm: r in m, from the centre to each rotor.
        gravity: g in m/s².

    Source: Tedrake, Underactuated Robotics, ch. 3, with thrusts relative to hovering.
    """

    state_names = ("x", "z", "pitch", "x velocity", "z velocity", "pitch velocity")
    state_units = ("m", "m", "rad", "m/s", "m/s", "rad/s")
    control_names, control_units = ("right thrust", "left thrust"), ("N", "N")
    angles = (2,)

    def __init__(self, mass: float = 0.486, inertia: float = 0.00383, arm: float = 0.25, gravity: float = 9.81):
        super().__init__()
        require_positive(mass=mass, inertia=inertia, arm=arm, gravity=gravity)
        self.mass, self.inertia, self.arm, self.gravity = mass, inertia, arm, gravity

    def f(self, x: State) -> State:
        pitch = x[..., 2]
        sideways, up = -self.gravity * torch.sin(pitch), self.gravity * (torch.cos(pitch) - 1)
        falling = torch.stack([sideways, up, torch.zeros_like(pitch)], -1)
        return torch.cat([x[..., 3:], falling], -1)

    def g(self, x: State) -> InputMatrix:
        pitch, turn = x[..., 2], self.arm / self.inertia
        push = [-torch.sin(pitch) / self.mass, torch.cos(pitch) / self.mass]
        right, left = (torch.stack([*push, a + torch.zeros_like(pitch)], -1) for a in (turn, -turn))
        accelerations = torch.stack([right, left], -1)
        return torch.cat([torch.zeros_like(accelerations), accelerations], -2)

    def inverse_mass(self, x: State) -> ControlMatrix:
        """BᵀM⁻¹B, the control weight R of the reference tasks; the same at every state."""
        zero = torch.zeros_like(x[..., 0])
        push, turn = 1 / self.mass + zero, self.arm**2 / self.inertia + zero
        return torch.stack([push + turn, push - turn, push - turn, push + turn], -1).unflatten(-1, (2, 2))

    def draw(self, x: np.ndarray, u: np.ndarray) -> list[Shape]:
        """A thrust that equals the weight is drawn twice as long as an arm."""
        along, up = np.array([np.cos(x[2]), np.sin(x[2])]), np.array([-np.sin(x[2]), np.cos(x[2])])
        rotors = x[:2] + self.arm * np.stack([along, -along])
        shares = (u / (self.mass * self.gravity) + 0.5)[:, None] * up
        thrusts = [Arrow(*ends) for ends in zip(rotors, rotors + 2 * self.arm * shares, strict=True)]
        return [Line(rotors, width=4), *thrusts]

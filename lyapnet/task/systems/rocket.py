"""A rocket as a point mass with a thrust in any direction."""

import numpy as np
import torch

from lyapnet.base.linear_algebra import norm
from lyapnet.base.shapes import Arrow, Disk, Shape, oblique
from lyapnet.base.types import InputMatrix, State
from lyapnet.task.systems.base import ControlAffineSystem, require_positive

AXES = ("x", "y", "z")


class Rocket(ControlAffineSystem):
    """A point mass under a thrust, gravity and air drag: ṗ = v, v̇ = u − g e_z − k‖v‖v.

    The controls are the thrust over the mass, in m/s²; `controls: {name: ball}` bounds its size.

    Args:
        dimensions: 2 (x, z), or 3 (x, y, z).
        gravity: g in m/s²; that of the moon.
        drag: k ≥ 0 in 1/m.
    """

    angles = ()

    def __init__(self, dimensions: int = 2, gravity: float = 1.62, drag: float = 0.0):
        if dimensions not in (2, 3):
            raise ValueError(f"Expected dimensions 2 or 3, got {dimensions!r}; choose one.")
        super().__init__()
        axes = AXES if dimensions == 3 else ("x", "z")
        self.state_names = (*axes, *(f"{axis} velocity" for axis in axes))
        self.state_units = ("m",) * dimensions + ("m/s",) * dimensions
        self.control_names = tuple(f"{axis} thrust" for axis in axes)
        self.control_units = ("m/s²",) * dimensions
        require_positive(gravity=gravity)
        if not (isinstance(drag, int | float) and 0 <= drag < np.inf):
            raise ValueError(f"Expected drag ≥ 0, got {drag!r}; it takes energy away.")
        self.dimensions, self.gravity, self.drag = dimensions, gravity, drag

    def f(self, x: State) -> State:
        v = x[..., self.dimensions :]
        gravity = self.gravity + torch.zeros_like(v[..., 0])  # a number, or in a family one for each state
        falling = torch.cat([torch.zeros_like(v[..., 1:]), gravity[..., None]], -1)
        return torch.cat([v, -falling - (self.drag * norm(v))[..., None] * v], -1)

    def g(self, x: State) -> InputMatrix:
        one = torch.eye(self.dimensions).to(x)
        return torch.cat([torch.zeros_like(one), one]).expand(*x.shape[:-1], -1, -1)

    def draw(self, x: np.ndarray, u: np.ndarray) -> list[Shape]:
        """A flame as long as the thrust, one metre for the weight, opposite to it."""
        ends = np.stack([x[: self.dimensions], x[: self.dimensions] - u / self.gravity])
        place, tip = ends if self.dimensions == 2 else oblique(ends)
        return [Disk(place, 0.15), Arrow(place, tip)]

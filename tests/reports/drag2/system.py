"""A drone in the plane with quadratic air drag; its goal is to rest at the origin, where |v| = 0."""

import torch

import lyapnet


class Drone(lyapnet.ControlAffineSystem):
    state_names, state_units = ("x", "y", "vx", "vy"), ("m", "m", "m/s", "m/s")
    control_names, control_units = ("fx", "fy"), ("N", "N")

    def __init__(self, mass: float = 1.2, drag: float = 0.4):
        super().__init__()
        self.mass, self.drag = mass, drag

    def f(self, x):
        vx, vy = x[..., 2], x[..., 3]
        speed = torch.linalg.vector_norm(x[..., 2:], dim=-1)
        return torch.stack([vx, vy, -self.drag / self.mass * speed * vx, -self.drag / self.mass * speed * vy], -1)

    def g(self, x):
        G = torch.tensor([[0.0, 0], [0, 0], [1 / self.mass, 0], [0, 1 / self.mass]])
        return G.to(x).expand(*x.shape[:-1], 4, 2)

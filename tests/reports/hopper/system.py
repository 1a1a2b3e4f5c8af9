"""A mass on a foot that lands on springy ground, y = 0 where the foot just touches; a motor works along the leg."""

import torch

import lyapnet


class Hopper(lyapnet.ControlAffineSystem):
    state_names, state_units = ("height", "speed"), ("m", "m/s")
    control_names, control_units = ("leg",), ("N",)

    def __init__(self, mass: float = 2.0, stiffness: float = 800.0):
        super().__init__()
        self.mass, self.stiffness = mass, stiffness

    def f(self, x):
        y, v = x[..., 0], x[..., 1]
        return torch.stack([v, self.stiffness / self.mass * torch.relu(-y) - 9.81], -1)

    def g(self, x):
        return torch.tensor([[0.0], [0.5]]).to(x).expand(*x.shape[:-1], 2, 1)

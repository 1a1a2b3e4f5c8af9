"""A block on a rough table, pulled by F; Coulomb friction mu m g sign(v)."""

import torch

import lyapnet


class Block(lyapnet.ControlAffineSystem):
    state_names, state_units = ("position", "speed"), ("m", "m/s")
    control_names, control_units = ("force",), ("N",)

    def __init__(self, mass: float = 1.0, mu: float = 0.6):
        super().__init__()
        self.mass, self.mu = mass, mu

    def f(self, x):
        return torch.stack([x[..., 1], -self.mu * 9.81 * torch.sign(x[..., 1])], -1)

    def g(self, x):
        return torch.tensor([[0.0], [1 / self.mass]]).to(x).expand(*x.shape[:-1], 2, 1)

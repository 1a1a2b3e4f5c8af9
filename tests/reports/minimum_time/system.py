"""A double integrator that is to be at rest at 0 as soon as possible."""

import torch

import lyapnet


class Trolley(lyapnet.ControlAffineSystem):
    state_names, state_units = ("position", "speed"), ("m", "m/s")
    control_names, control_units = ("acceleration",), ("m/s²",)

    def f(self, x):
        return torch.stack([x[..., 1], torch.zeros_like(x[..., 0])], -1)

    def g(self, x):
        return torch.tensor([[0.0], [1.0]]).to(x).expand(*x.shape[:-1], 2, 1)


class Time(lyapnet.Cost):
    """1 per second away from the goal, 0 at it."""

    def __init__(self, width: float = 0.1):
        super().__init__()
        self.width = width

    def state(self, x):
        return 1 - torch.exp(-(x**2).sum(-1) / self.width**2)

    def R(self, x):
        return torch.full((*x.shape[:-1], 1, 1), 1e-3, dtype=x.dtype)

    def terminal(self, x):
        return 100 * (x**2).sum(-1)

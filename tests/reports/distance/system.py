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


class Distance(lyapnet.Cost):
    """The distance to the goal, not its square."""

    def state(self, x):
        return torch.linalg.vector_norm(x, dim=-1)

    def R(self, x):
        return torch.full((*x.shape[:-1], 1, 1), 0.05, dtype=x.dtype)

    def terminal(self, x):
        return 10 * torch.linalg.vector_norm(x, dim=-1)

"""A sledge that is to slide as far as can be, pushed for two seconds; its speed is not to exceed 0.8 m/s."""

import torch

import lyapnet


class Sledge(lyapnet.ControlAffineSystem):
    state_names, state_units = ("position", "speed"), ("m", "m/s")
    control_names, control_units = ("push",), ("m/s²",)

    def f(self, x):
        v = x[..., 1]
        return torch.stack([v, -0.3 * v - 0.2 * v * torch.sqrt(v**2 + 0.01)], -1)

    def g(self, x):
        return torch.tensor([[0.0], [1.0]]).to(x).expand(*x.shape[:-1], 2, 1)


class Far(lyapnet.Cost):
    """What is missing of one metre at the end: negative beyond it."""

    goal = torch.tensor([1.0, 0.0], dtype=torch.float64)

    def state(self, x):
        return torch.zeros_like(x[..., 0])

    def R(self, x):
        return torch.full((*x.shape[:-1], 1, 1), 0.05, dtype=x.dtype)

    def terminal(self, x):
        return 1 - x[..., 0]

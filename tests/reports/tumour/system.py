"""Tumour volume p and vasculature q (mm^3) under an anti-angiogenic drug u (mg/day), Hahnfeldt's model."""

import torch

import lyapnet


class Tumour(lyapnet.ControlAffineSystem):
    state_names, state_units = ("tumour", "vessels"), ("mm³", "mm³")
    control_names, control_units = ("dose",), ("mg/day",)

    def __init__(self, xi: float = 0.084, b: float = 5.85, d: float = 0.00873, G: float = 0.15, mu: float = 0.02):
        super().__init__()
        self.xi, self.b, self.d, self.G, self.mu = xi, b, d, G, mu

    def f(self, x):
        p, q = x[..., 0], x[..., 1]
        return torch.stack([-self.xi * p * torch.log(p / q), q * (self.b - self.mu - self.d * p ** (2 / 3))], -1)

    def g(self, x):
        return torch.stack([torch.zeros_like(x[..., 0]), -self.G * x[..., 1]], -1)[..., None]


class SmallTumour(lyapnet.Cost):
    """The tumour that is left at T, and the drug squared."""

    def state(self, x):
        return torch.zeros_like(x[..., 0])

    def R(self, x):
        return torch.full((*x.shape[:-1], 1, 1), 0.05, dtype=x.dtype)

    def terminal(self, x):
        return x[..., 0]

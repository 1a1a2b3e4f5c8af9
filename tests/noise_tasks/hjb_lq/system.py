"""A hundred dimensions, a logarithmic end, and noise that no control can do much about.

Source: Han, Jentzen, E, "Solving high-dimensional partial differential equations using deep learning", PNAS 2018.
"""

import torch

import lyapnet
from lyapnet.task.systems import Linear


class Brownian(Linear):
    """dx = 2u dt + √2 dW."""

    def __init__(self, dimension: int = 100):
        super().__init__(torch.zeros(dimension, dimension), 2 * torch.eye(dimension))

    def noise(self, x):
        return 2**0.5 * torch.eye(self.n).to(x).expand(*x.shape, self.n)


class Logarithm(lyapnet.Cost):
    """‖u‖² on the way, and ln((1 + ‖x‖²)/2) at the end."""

    R_constant = torch.eye(100)

    def state(self, x):
        return torch.zeros_like(x[..., 0])

    def R(self, x):
        return self.R_constant.expand(*x.shape, 100)

    def terminal(self, x):
        return torch.log((1 + (x**2).sum(-1)) / 2)

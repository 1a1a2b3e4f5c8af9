"""An Ornstein–Uhlenbeck process in ten dimensions whose end is to be as far down as can be: there is no goal.

Source: Domingo-Enrich, Han, Amos, Bruna, Chen, "Stochastic optimal control matching", NeurIPS 2024.
"""

import torch

import lyapnet
from lyapnet.task.systems import Linear


class OrnsteinUhlenbeck(Linear):
    """dx = (A x + σu) dt + σ dW, with A = −I + ξ and σ = I + ξ', both ξ of normal numbers with deviation 0.1."""

    def __init__(self, dimension: int = 10):
        generator = torch.Generator().manual_seed(0)
        drawn = 0.1 * torch.randn(2, dimension, dimension, generator=generator, dtype=torch.float64)
        super().__init__(drawn[0] - torch.eye(dimension), drawn[1] + torch.eye(dimension))

    def noise(self, x):
        return self.g(x)


class Height(lyapnet.Cost):
    """½ ‖u‖² on the way, and the sum of the states at the end."""

    R_constant = 0.5 * torch.eye(10)

    def state(self, x):
        return torch.zeros_like(x[..., 0])

    def R(self, x):
        return self.R_constant.expand(*x.shape, 10)

    def terminal(self, x):
        return x.sum(-1)

"""An Ornstein–Uhlenbeck process in twenty dimensions, dx = (a x + u) dt + dW.

Source: Domingo-Enrich, Han, Amos, Bruna, Chen, "Stochastic optimal control matching", NeurIPS 2024.
"""

import torch

from lyapnet.task.systems import Linear


class OrnsteinUhlenbeck(Linear):
    """dx = (a x + u) dt + dW."""

    def __init__(self, a: float, dimension: int = 20):
        super().__init__(a * torch.eye(dimension), torch.eye(dimension))

    def noise(self, x):
        return torch.eye(self.n).to(x).expand(*x.shape, self.n)

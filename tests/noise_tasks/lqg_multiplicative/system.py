"""A mass on a line, in gusts that grow with its speed and its distance.

Source: Wonham, "On a matrix Riccati equation of stochastic control", SIAM Journal on Control 1968.
"""

import torch

from lyapnet.task.systems import DoubleIntegrator


class Gusts(DoubleIntegrator):
    """q̈ = u with dq̇ += (0.1 + 0.6 q̇) dW₁ + 0.4 q dW₂."""

    def noise(self, x):
        q, v = x.unbind(-1)
        still = torch.zeros_like(q)
        return torch.stack([torch.stack([still, still], -1), torch.stack([0.1 + 0.6 * v, 0.4 * q], -1)], -2)

"""Ten coordinates, each between two wells, that start on the hills between them.

Source: Domingo-Enrich, Han, Amos, Bruna, Chen, "Stochastic optimal control matching", NeurIPS 2024; the task is that of
Nüsken, Richter, 2021.
"""

import torch

import lyapnet

DEEP, ALL = 3, 10  # coordinates with deep wells, and all


def weights(x, deep):
    return torch.cat([x.new_full((DEEP,), deep), x.new_ones(ALL - DEEP)])


class DoubleWell(lyapnet.ControlAffineSystem):
    """dx = (−∇ Σ κ_i (x_i² − 1)² + u) dt + dW, with κ = 5 for three coordinates and 1 for seven."""

    state_names, state_units = [f"x{i + 1}" for i in range(ALL)], [""] * ALL
    control_names, control_units = [f"u{i + 1}" for i in range(ALL)], [""] * ALL

    def f(self, x):
        return -4 * weights(x, 5.0) * x * (x**2 - 1)

    def g(self, x):
        return torch.eye(ALL).to(x).expand(*x.shape, ALL)

    def noise(self, x):
        return self.g(x)


class Distance(lyapnet.Cost):
    """½ ‖u‖² on the way, and Σ ν_i (x_i² − 1)² at the end, with ν = 3 for three coordinates and 1 for seven."""

    R_constant = 0.5 * torch.eye(ALL)

    def state(self, x):
        return torch.zeros_like(x[..., 0])

    def R(self, x):
        return self.R_constant.expand(*x.shape, ALL)

    def terminal(self, x):
        return (weights(x, 3.0) * (x**2 - 1) ** 2).sum(-1)

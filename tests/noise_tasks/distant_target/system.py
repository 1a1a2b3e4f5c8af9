"""A hundred dimensions, and a target away from the start ("Benchmark2"), on a clock that slows down.

V grows like 1 / (time left), so that equal steps cost much: the best law on 20 of them costs +511.7, on 40 +151.4,
where continuous time has −401.9. Here time is s(τ) with ds/dτ = λ (time left + ε), and equal steps of τ are ever
shorter ones of s.

Source: Li, Verma, Ruthotto, "A neural network approach for stochastic optimal control", SIAM J. Sci. Comput. 2024.
"""

import torch

import lyapnet

D, RATE, STRENGTH = 100, 8.762162, 0.4 * 2**0.5  # λ per unit of τ; σ per √s


class Brownian(lyapnet.ControlAffineSystem):
    """dx = 2u ds + σ dW(s) with ds = λ z dτ, and dz = −λ z dτ."""

    state_names, state_units = [*(f"x{i + 1}" for i in range(D)), "left"], [""] * D + ["s"]
    control_names, control_units = [f"u{i + 1}" for i in range(D)], [""] * D

    def f(self, x):
        return torch.cat([torch.zeros_like(x[..., :D]), -RATE * x[..., D:]], -1)

    def g(self, x):
        return 2 * RATE * x[..., D:, None] * self.directions(x)

    def noise(self, x):
        return STRENGTH * torch.sqrt(RATE * x[..., D:, None]) * self.directions(x)

    def directions(self, x):
        return torch.eye(D + 1).to(x)[:, :D].expand(*x.shape[:-1], D + 1, D)


class Logarithm(lyapnet.Cost):
    """‖u‖² ds on the way, and 1000 ln((1 + ‖x − 3‖²)/2) at the end."""

    def state(self, x):
        return torch.zeros_like(x[..., 0])

    def R(self, x):
        return RATE * x[..., D:, None] * torch.eye(D).to(x)

    def terminal(self, x):
        return 1000 * torch.log((1 + ((x[..., :D] - 3) ** 2).sum(-1)) / 2)

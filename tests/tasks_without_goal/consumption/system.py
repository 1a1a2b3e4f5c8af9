"""What a village consumes of its capital: whatever the horizon, best plans spend most of it near the golden rule.

Source: Ramsey, "A mathematical theory of saving", 1928; Dorfman, Samuelson, Solow, "Linear programming and economic
analysis", 1958, chapter 12 (the turnpike).
"""

import torch

import lyapnet


class Village(lyapnet.ControlAffineSystem):
    """k̇ = 0.8 k^0.4 − 0.1 k − c."""

    state_names, state_units, control_names, control_units = ("capital",), ("",), ("consumption",), ("1/year",)

    def f(self, x):
        return 0.8 * x**0.4 - 0.1 * x

    def g(self, x):
        return -torch.ones_like(x)[..., None]


class Displeasure(lyapnet.Cost):
    """(c − 3)²/6 − 1.5 per year, with 3 as much as anybody wants, and −scrap for each unit of capital that is left."""

    rest = torch.tensor([3.0])
    scrap = 0.6

    def state(self, x):
        return torch.full_like(x[..., 0], -1.5)

    def R(self, x):
        return torch.full((*x.shape[:-1], 1, 1), 1 / 6, dtype=x.dtype)

    def terminal(self, x):
        return -self.scrap * x[..., 0]

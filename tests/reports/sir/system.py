"""Susceptible and infectious shares of a population; contacts can be cut, which costs."""

import torch

import lyapnet


class Epidemic(lyapnet.ControlAffineSystem):
    state_names, state_units = ("susceptible", "infectious"), ("", "")
    control_names, control_units = ("distance",), ("",)

    def __init__(self, beta: float = 0.5, gamma: float = 0.25):
        super().__init__()
        self.beta, self.gamma = beta, gamma

    def f(self, x):
        new = self.beta * x[..., 0] * x[..., 1]
        return torch.stack([-new, new - self.gamma * x[..., 1]], -1)

    def g(self, x):
        new = self.beta * x[..., 0] * x[..., 1]
        return torch.stack([new, -new], -1)[..., None]


class Cases(lyapnet.Cost):
    """What the distance costs, and a little for the infectious left over at the end."""

    def state(self, x):
        return torch.zeros_like(x[..., 0])

    def R(self, x):
        return torch.ones_like(x[..., 0])[..., None, None]

    def terminal(self, x):
        return 100 * x[..., 1]

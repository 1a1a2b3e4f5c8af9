"""A stock of fish and what its catch has earned; the greatest profit after ten years."""

import torch

import lyapnet


class Fishery(lyapnet.ControlAffineSystem):
    state_names, state_units = ("stock", "profit"), ("kt", "M")
    control_names, control_units = ("effort",), ("",)

    def __init__(
        self, growth: float = 0.71, capacity: float = 80.5, price: float = 1.0, cost: float = 17.5, most: float = 20.0
    ):
        super().__init__()
        self.growth, self.capacity, self.price, self.cost, self.most = growth, capacity, price, cost, most

    def f(self, x):
        s = x[..., 0]
        return torch.stack([self.growth * s * (1 - s / self.capacity), torch.zeros_like(s)], -1)

    def g(self, x):
        s = x[..., 0]
        return torch.stack([torch.full_like(s, -self.most), (self.price - self.cost / s) * self.most], -1)[..., None]


class Profit(lyapnet.Cost):
    """What is short of 200 at the end; hardly anything for the effort itself."""

    def state(self, x):
        return torch.zeros_like(x[..., 0])

    def R(self, x):
        return torch.full_like(x[..., 0], 0.01)[..., None, None]

    def terminal(self, x):
        return 200 - x[..., 1]

"""A battery that buys when power is cheap and sells when it is dear.

Source: Sioshansi, Denholm, Jenkin, Weiss, "Estimating the value of electricity storage in PJM: arbitrage and some
welfare effects", 2009.
"""

import math

import torch

import lyapnet


class Battery(lyapnet.ControlAffineSystem):
    """Ė = η c − d/η, and the bill grows by the tariff times c − d; the hour of the day is a state."""

    state_names, state_units = ("energy", "hour", "bill"), ("kWh", "h", "€")
    control_names, control_units = ("charging", "discharging"), ("kW", "kW")

    def __init__(self, efficiency: float = 0.95):
        super().__init__()
        self.efficiency = efficiency

    def tariff(self, hour):
        """In € per kWh, dear in the morning and most of all in the evening."""
        day = math.pi / 12
        return 0.25 + 0.06 * torch.cos(day * (hour - 17)) + 0.06 * torch.cos(2 * day * (hour - 20))

    def f(self, x):
        none = torch.zeros_like(x[..., 0])
        return torch.stack([none, none + 1, none], -1)

    def g(self, x):
        one, price = torch.ones_like(x[..., 0]), self.tariff(x[..., 1])
        charging = torch.stack([self.efficiency * one, 0 * one, price], -1)
        discharging = torch.stack([-one / self.efficiency, 0 * one, -price], -1)
        return torch.stack([charging, discharging], -1)


class Expenses(lyapnet.Cost):
    """The bill of a day, less what is stored at its end, and the wear of the cells, in €."""

    def state(self, x):
        return torch.zeros_like(x[..., 0])

    def R(self, x):
        return torch.diag(x.new_tensor([0.01, 0.01])).expand(*x.shape[:-1], 2, 2)

    def terminal(self, x):
        return x[..., 2] - 0.2 * x[..., 0]

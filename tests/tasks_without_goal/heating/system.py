"""Two rooms and their walls, heated by heat pumps at a tariff that changes with the hour.

Source: Bacher, Madsen, "Identifying suitable models for the heat dynamics of buildings", 2011; Oldewurtel and others,
"Use of model predictive control and weather forecasts for energy efficient building climate control", 2012.
"""

import math

import torch

import lyapnet


class House(lyapnet.ControlAffineSystem):
    """C Ṫ = the heat that flows in, for rooms and walls in °C; the hour of the day and the bill are states."""

    state_names = ("living room", "bedroom", "living room wall", "bedroom wall", "hour", "bill")
    state_units = ("°C", "°C", "°C", "°C", "h", "€")
    control_names, control_units = ("living room heating", "bedroom heating"), ("kW", "kW")

    def __init__(self, efficiency: float = 3.0):
        super().__init__()
        self.efficiency = efficiency  # heat per electricity

    def outside(self, hour):
        """In °C."""
        return 3 + 4 * torch.cos(math.pi / 12 * (hour - 15))

    def tariff(self, hour):
        """In € per kWh."""
        return 0.25 + 0.1 * torch.cos(math.pi / 12 * (hour - 18))

    def f(self, x):
        living, bed, living_wall, bed_wall, hour, _ = x.unbind(-1)
        outside, one = self.outside(hour), torch.ones_like(hour)
        between = 0.15 * (living - bed)
        return torch.stack(
            [
                (1.0 * (living_wall - living) + 0.06 * (outside - living) - between) / 1.2,
                (0.7 * (bed_wall - bed) + 0.05 * (outside - bed) + between) / 0.9,
                (1.0 * (living - living_wall) + 0.08 * (outside - living_wall)) / 9,
                (0.7 * (bed - bed_wall) + 0.07 * (outside - bed_wall)) / 6,
                one,
                0 * one,
            ],
            -1,
        )

    def g(self, x):
        hour = x[..., 4]
        none, price = torch.zeros_like(hour), self.tariff(hour)
        living = torch.stack([none + self.efficiency / 1.2, none, none, none, none, price], -1)
        bed = torch.stack([none, none + self.efficiency / 0.9, none, none, none, price], -1)
        return torch.stack([living, bed], -1)


class Expenses(lyapnet.Cost):
    """The bill of a day less what warmth above 18 °C is worth at its end, in €; a little for even heating."""

    def state(self, x):
        return torch.zeros_like(x[..., 0])

    def R(self, x):
        return torch.diag(x.new_tensor([0.02, 0.02])).expand(*x.shape[:-1], 2, 2)

    def terminal(self, x):
        return x[..., 5] - 0.08 * (1.2 * x[..., 0] + 0.9 * x[..., 1] + 9 * x[..., 2] + 6 * x[..., 3] - 17.1 * 18)

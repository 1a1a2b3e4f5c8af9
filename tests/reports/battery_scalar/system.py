"""A home battery: the charger takes the share u of what the cells admit at this state of charge (a measured table)."""

import torch

import lyapnet


class Battery(lyapnet.ControlAffineSystem):
    state_names, state_units = ("charge",), ("1",)
    control_names, control_units = ("share",), ("1",)

    def __init__(self, capacity: float = 16.2):
        super().__init__()
        self.capacity = capacity  # kWh
        self.power = lyapnet.Table(
            [[0.0, 0.48, 0.52, 0.68, 0.72, 0.88, 0.92, 1.0]],
            [10.8, 10.8, 8.9, 8.9, 4.5, 4.5, 2.5, 2.5],
            method="linear",
        )  # kW

    def f(self, x):
        return torch.zeros_like(x)

    def g(self, x):
        return (self.power(x) / self.capacity / 3600)[..., None, None]  # per second

"""Averaged boost converter, 10 V to 15 V into 50 ohm; u is the duty cycle; time in seconds, a control each 10 us."""

import torch

import lyapnet


class Boost(lyapnet.ControlAffineSystem):
    state_names, state_units = ("current", "voltage"), ("A", "V")
    control_names, control_units = ("duty",), ("1",)

    def __init__(self, L: float = 360e-6, C: float = 66e-6, load: float = 50.0, source: float = 10.0, r: float = 0.2):
        super().__init__()
        self.L, self.C, self.load, self.source, self.r = L, C, load, source, r

    def f(self, x):
        i, v = x[..., 0], x[..., 1]
        return torch.stack([(self.source - self.r * i - v) / self.L, (i - v / self.load) / self.C], -1)

    def g(self, x):
        i, v = x[..., 0], x[..., 1]
        return torch.stack([v / self.L, -i / self.C], -1)[..., None]

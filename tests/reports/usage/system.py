"""A temperature that rises with the use of a device: one state, two one-sided inputs."""

import torch

import lyapnet


class Usage(lyapnet.ControlAffineSystem):
    state_names, state_units = ("temperature",), ("°C",)
    control_names, control_units = ("up", "down"), ("W", "W")

    def f(self, x):
        return torch.zeros_like(x)

    def g(self, x):
        return torch.ones(1, 2, dtype=x.dtype).expand(*x.shape[:-1], 1, 2)

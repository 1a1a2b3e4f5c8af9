"""A satellite in the plane with six jets that only push, each on its own lever."""

import math

import torch

import lyapnet

ANGLES = [k * math.pi / 3 for k in range(6)]
LEVERS = [0.3, -0.3, 0.3, -0.3, 0.3, -0.3]


class Satellite(lyapnet.ControlAffineSystem):
    state_names = ("x", "y", "angle", "x speed", "y speed", "rate")
    state_units = ("m", "m", "rad", "m/s", "m/s", "rad/s")
    control_names, control_units = tuple(f"jet {k}" for k in range(6)), ("N",) * 6

    def f(self, x):
        return torch.cat([x[..., 3:], torch.zeros_like(x[..., :3])], -1)

    def g(self, x):
        theta, zero = x[..., 2], torch.zeros_like(x[..., 2])
        columns = [
            torch.stack([zero, zero, zero, torch.cos(theta + a), torch.sin(theta + a), zero + 5 * lever], -1)
            for a, lever in zip(ANGLES, LEVERS, strict=True)
        ]
        return torch.stack(columns, -1)

"""An algal-bacterial consortium in a chemostat: substrate, bacteria, vitamin, quota, algae, algae harvested."""

import torch

import lyapnet

S_IN, BETA, GAMMA = 0.5, 23e-3, 0.44
QMIN = 2.7628e-3


class Consortium(lyapnet.ControlAffineSystem):
    state_names = ("substrate", "bacteria", "vitamin", "quota", "algae", "harvest")
    state_units = ("g/l", "g/l", "mg/l", "mg/g", "g/l", "g/l")
    control_names, control_units = ("allocation", "dilution"), ("1", "1/day")

    def f(self, x):
        s, e, v, q, c, _ = x.unbind(-1)
        phi = 6.48 * s / (0.09 + s)
        rho = 27.3e-3 * v / (0.57e-3 + v)
        mu = 1.0211 * (1 - QMIN / q)
        return torch.stack([-phi * e / GAMMA, phi * e, -rho * c, rho - mu * q, mu * c, torch.zeros_like(s)], -1)

    def g(self, x):
        s, e, v, _, c, _ = x.unbind(-1)
        phi = 6.48 * s / (0.09 + s)
        z = torch.zeros_like(s)
        allocation = torch.stack([z, -phi * e, BETA * phi * e, z, z, z], -1)
        dilution = torch.stack([S_IN - s, -e, -v, z, -c, c], -1)
        return torch.stack([allocation, dilution], -1)


class Harvest(lyapnet.Cost):
    """What the harvest is short of 10."""

    def __init__(self):
        super().__init__()
        self.register_buffer("goal", torch.tensor([0.1, 0.05, 0.0003, 0.0177, 0.05, 10.0], dtype=torch.float64))

    def state(self, x):
        return torch.zeros_like(x[..., 0])

    def R(self, x):
        return torch.diag(torch.tensor([1e-3, 1e-3], dtype=x.dtype)).expand(*x.shape[:-1], 2, 2)

    def terminal(self, x):
        return 10 - x[..., 5]

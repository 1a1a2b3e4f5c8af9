"""A walker at a constant pace: a wall that he passes through a gap or around its end, or a pond with a narrow bridge.

Source of the wall: Kappen, "Linear theory for control of nonlinear stochastic systems", Physical Review Letters 2005
(the double slit); "Path integrals and symmetry breaking for optimal control theory", 2005 (the drunken spider).
"""

import torch

import lyapnet


class Walker(lyapnet.ControlAffineSystem):
    """Forward at 1 m/s, and aside at the speed u."""

    state_names, state_units, control_names, control_units = ("forward", "aside"), ("m", "m"), ("speed",), ("m/s",)

    def f(self, x):
        return torch.stack([torch.ones_like(x[..., 0]), torch.zeros_like(x[..., 0])], -1)

    def g(self, x):
        return torch.tensor([[0.0], [1.0]]).to(x).expand(*x.shape[:-1], 2, 1)


class Wall(lyapnet.Cost):
    """A wall about 1 m ahead, from 0.8 m on one side to far on the other, with a gap of 0.3 m straight ahead.

    Its end and the gap are smooth over some centimetres. At the end of the way the walker is to be straight ahead.
    """

    R_constant = 0.5 * torch.eye(1)

    def state(self, x):
        forward, aside = x.unbind(-1)

        def beyond(edge):
            return torch.sigmoid((aside - edge) / 0.03)

        return 40 * torch.exp(-(((forward - 1) / 0.1) ** 2)) * (beyond(-0.8) - beyond(-0.15) + beyond(0.15))

    def R(self, x):
        return self.R_constant.expand(*x.shape[:-1], 1, 1)

    def terminal(self, x):
        return 2 * x[..., 1] ** 2


class Pond(lyapnet.Cost):
    """A pond from 0.7 to 1.5 m ahead and from 0.5 m on one side to 1.5 m on the other, with a bridge of 0.4 m.

    Its shore is smooth over some centimetres. At the end of the way the walker is to be straight ahead.
    """

    R_constant = 0.3 * torch.eye(1)

    def state(self, x):
        forward, aside = x.unbind(-1)

        def beyond(place, edge):
            return torch.sigmoid((place - edge) / 0.04)

        along = beyond(forward, 0.7) - beyond(forward, 1.5)
        return 8 * along * (beyond(aside, -1.5) - beyond(aside, -0.2) + beyond(aside, 0.2) - beyond(aside, 0.5))

    def R(self, x):
        return self.R_constant.expand(*x.shape[:-1], 1, 1)

    def terminal(self, x):
        return x[..., 1] ** 2

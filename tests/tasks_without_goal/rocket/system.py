"""A sounding rocket in thickening and thinning air, whose propellant is to carry it as high as can be.

Source: Tsiotras, Kelley, "Goddard problem with constrained time of flight", 1992; with numbers of a small rocket.
"""

import torch

import lyapnet


class Rocket(lyapnet.ControlAffineSystem):
    """m v̇ = F − D(h, v) − m g and ṁ = −F/c, in km, s and kg, with D = D₀ e^(−h/8) v|v|."""

    state_names, state_units = ("altitude", "speed", "mass"), ("km", "km/s", "kg")
    control_names, control_units = ("thrust",), ("kN",)

    def __init__(self, exhaust: float = 2.0, drag: float = 6.0, gravity: float = 0.00981):
        super().__init__()
        self.exhaust, self.drag, self.gravity = exhaust, drag, gravity  # km/s; kN per (km/s)² at the ground; km/s²

    def f(self, x):
        altitude, speed, mass = x.unbind(-1)
        drag = self.drag * torch.exp(-altitude / 8) * speed * torch.sqrt(speed**2 + 1e-6)  # v|v|, rounded at 1 m/s
        return torch.stack([speed, -drag / mass - self.gravity, torch.zeros_like(mass)], -1)

    def g(self, x):
        mass = x[..., 2]
        return torch.stack([torch.zeros_like(mass), 1 / mass, torch.full_like(mass, -1 / self.exhaust)], -1)[..., None]


class Lowness(lyapnet.Cost):
    """The negative altitude in km after a minute, and a little for the thrust."""

    def state(self, x):
        return torch.zeros_like(x[..., 0])

    def R(self, x):
        return x.new_full((*x.shape[:-1], 1, 1), 0.002)

    def terminal(self, x):
        return -x[..., 0]

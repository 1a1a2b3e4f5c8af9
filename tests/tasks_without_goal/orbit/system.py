"""A spacecraft with a weak engine on its way from the orbit of the Earth to as wide a circle as can be.

Source: Bryson, Ho, "Applied optimal control", 1975, section 2.5; here the engine's power is limited, not its mass flow.
"""

import torch

import lyapnet


class Spacecraft(lyapnet.ControlAffineSystem):
    """Polar coordinates about the Sun; lengths in AU, times in units of 58.13 days, in which its gravity is 1."""

    state_names = ("radius", "radial speed", "tangential speed")
    state_units = ("AU", "AU/58 d", "AU/58 d")
    control_names, control_units = ("radial", "tangential"), ("AU/(58 d)²", "AU/(58 d)²")

    def f(self, x):
        radius, radial, tangential = x.unbind(-1)
        return torch.stack(
            [radial, tangential**2 / radius - 1 / radius**2, -radial * tangential / radius],
            -1,
        )

    def g(self, x):
        return x.new_tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]).expand(*x.shape[:-1], 3, 2)


class Width(lyapnet.Cost):
    """The negative radius in AU, what the orbit is short of a circle, and the energy of the engine."""

    def state(self, x):
        return torch.zeros_like(x[..., 0])

    def R(self, x):
        return torch.diag(x.new_tensor([2.0, 2.0])).expand(*x.shape[:-1], 2, 2)

    def terminal(self, x):
        radius, radial, tangential = x.unbind(-1)
        return -radius + 10 * (radial**2 + (tangential - radius**-0.5) ** 2)

"""A hang glider that crosses a thermal and is to get far without giving away its height.

Source: Bulirsch, Nerz, Pesch, von Stryk, "Combining direct and indirect methods in optimal control: range maximization
of a hang glider", 1993; the lift coefficient is a state here, and the pilot changes it.
"""

import torch

import lyapnet


class Glider(lyapnet.ControlAffineSystem):
    """m v̇ = −D − m g sin γ, m v γ̇ = L − m g cos γ, with a parabolic polar; ḣ = v sin γ + w(x), w the thermal."""

    state_names, state_units = ("distance", "height", "speed", "path angle", "lift"), ("m", "m", "m/s", "rad", "")
    control_names, control_units = ("pitching",), ("1/s",)

    def __init__(self, pressure: float = 0.0791, gravity: float = 9.81, thermal: float = 2.5):
        super().__init__()
        self.pressure, self.gravity, self.thermal = pressure, gravity, thermal  # ½ρS/m in 1/m; m/s²; m/s

    def f(self, x):
        distance, _, speed, angle, lift = x.unbind(-1)
        wind = self.thermal * torch.exp(-(((distance - 90) / 40) ** 2))
        drag = self.pressure * (0.034 + 0.07 * lift**2) * speed**2
        turning = self.pressure * lift * speed - self.gravity * torch.cos(angle) / speed
        return torch.stack(
            [
                speed * torch.cos(angle),
                speed * torch.sin(angle) + wind,
                -drag - self.gravity * torch.sin(angle),
                turning,
                torch.zeros_like(lift),
            ],
            -1,
        )

    def g(self, x):
        return x.new_tensor([[0.0], [0.0], [0.0], [0.0], [1.0]]).expand(*x.shape[:-1], 5, 1)


class Range(lyapnet.Cost):
    """The negative distance in m, a metre of energy height h + v²/(2g) being worth ten of distance."""

    def state(self, x):
        return torch.zeros_like(x[..., 0])

    def R(self, x):
        return x.new_full((*x.shape[:-1], 1, 1), 10.0)

    def terminal(self, x):
        return -x[..., 0] - 10 * (x[..., 1] + x[..., 2] ** 2 / (2 * 9.81))

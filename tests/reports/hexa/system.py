"""A hexarotor: position, velocity, quaternion (scalar first), body rates; the squared speeds of six rotors."""

import math

import torch

import lyapnet


class Hexarotor(lyapnet.ControlAffineSystem):
    state_names = ("x", "y", "z", "vx", "vy", "vz", "qw", "qx", "qy", "qz", "p", "q", "r")
    state_units = ("m",) * 3 + ("m/s",) * 3 + ("",) * 4 + ("rad/s",) * 3
    control_names, control_units = tuple(f"rotor{k}" for k in range(6)), ("N",) * 6

    def __init__(
        self,
        mass: float = 1.5,
        arm: float = 0.27,
        turn: float = 0.016,
        Ix: float = 0.035,
        Iy: float = 0.035,
        Iz: float = 0.055,
    ):
        super().__init__()
        self.mass, self.arm, self.turn, self.inertia = mass, arm, turn, (Ix, Iy, Iz)

    def f(self, x):
        v, (w, i, j, k), (p, q, r) = x[..., 3:6], x[..., 6:10].unbind(-1), x[..., 10:].unbind(-1)
        o = torch.zeros_like(w)
        Ix, Iy, Iz = self.inertia
        rest = torch.stack(
            [
                o,
                o,
                o - 9.81,
                -(i * p + j * q + k * r) / 2,
                (w * p + j * r - k * q) / 2,
                (w * q + k * p - i * r) / 2,
                (w * r + i * q - j * p) / 2,
                (Iy - Iz) / Ix * q * r,
                (Iz - Ix) / Iy * r * p,
                (Ix - Iy) / Iz * p * q,
            ],
            -1,
        )
        return torch.cat([v, rest], -1)

    def g(self, x):
        w, i, j, k = x[..., 6:10].unbind(-1)
        o = torch.zeros_like(w)
        up = torch.stack([2 * (i * k + w * j), 2 * (j * k - w * i), w**2 - i**2 - j**2 + k**2], -1) / self.mass
        Ix, Iy, Iz = self.inertia
        columns = []
        for n in range(6):
            a = math.pi * n / 3
            torque = torch.tensor(
                [self.arm * math.sin(a) / Ix, -self.arm * math.cos(a) / Iy, self.turn * (-1) ** n / Iz]
            ).to(x)
            columns.append(
                torch.cat(
                    [torch.stack([o, o, o], -1), up, torch.stack([o, o, o, o], -1), torque.expand(*x.shape[:-1], 3)], -1
                )
            )
        return torch.stack(columns, -1)

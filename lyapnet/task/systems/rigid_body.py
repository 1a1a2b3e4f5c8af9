"""Rigid bodies in space with Euler angles η = (φ, θ, ψ) = (roll, pitch, yaw).

With sφ = sin φ and so on and S(w)v = −w × v, the rotation into the body frame and the rates of the angles are

    R(η) = [[cθcψ, cθsψ, −sθ], [sφsθcψ − cφsψ, sφsθsψ + cφcψ, sφcθ], [cφsθcψ + sφsψ, cφsθsψ − sφcψ, cφcθ]],
    η̇ = E(η)w,   E(η) = [[1, sφ tan θ, cφ tan θ], [0, cφ, −sφ], [0, sφ/cθ, cφ/cθ]],

where E is singular at θ = ±π/2.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from lyapnet.base.shapes import Arrow, Line, Polygon, Shape, oblique
from lyapnet.base.types import InputMatrix, State
from lyapnet.task.systems.base import ControlAffineSystem, require_positive

ATTITUDE = ("roll", "pitch", "yaw")
RATES = ("roll rate", "pitch rate", "yaw rate")
UPWARD = (0.0, 0.0, 1.0)


def to_body_frame(attitude: Tensor) -> Tensor:
    """R(η), (*batch, 3, 3)."""
    (sr, sp, sy), (cr, cp, cy) = torch.sin(attitude).unbind(-1), torch.cos(attitude).unbind(-1)
    rows = (
        (cp * cy, cp * sy, -sp),
        (sr * sp * cy - cr * sy, sr * sp * sy + cr * cy, sr * cp),
        (cr * sp * cy + sr * sy, cr * sp * sy - sr * cy, cr * cp),
    )
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def attitude_rates(attitude: Tensor, w: Tensor) -> Tensor:
    """η̇ = E(η)w."""
    roll, pitch, _ = attitude.unbind(-1)
    along = torch.sin(roll) * w[..., 1] + torch.cos(roll) * w[..., 2]
    across = torch.cos(roll) * w[..., 1] - torch.sin(roll) * w[..., 2]
    return torch.stack([w[..., 0] + torch.tan(pitch) * along, across, along / torch.cos(pitch)], -1)


def project_points(points: Sequence[Sequence[float]], attitude: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Project points (k, 3) in the body frame onto the drawing plane, (k, 2)."""
    R = to_body_frame(torch.as_tensor(attitude)).numpy()
    return oblique(np.asarray(points) @ R + position)


def rotorcraft(attitude: np.ndarray, position: np.ndarray, lift: float) -> list[Shape]:
    """Four arms of 0.3 m, an upward thrust that is as long as an arm for lift = 1, and a line to the level z = 0."""
    arms = project_points([(0.3, 0, 0), (-0.3, 0, 0), (0, 0.3, 0), (0, -0.3, 0)], attitude, position)
    center, thrust = project_points([(0, 0, 0), (0, 0, 0.3 * lift)], attitude, position)
    below = oblique(np.stack([position, position * (1, 1, 0)]))
    return [Line(below, width=0.8, faint=True), Line(arms[:2]), Line(arms[2:]), Arrow(center, thrust)]


def per_axis(name: str, values: Sequence[float]) -> Tensor:
    """A physical parameter with one number for each axis.

    Raises:
        ValueError: there are not three numbers, or one is not finite.
    """
    if len(values) != 3 or not all(isinstance(value, int | float) and math.isfinite(value) for value in values):
        raise ValueError(f"Expected three numbers as {name}, got {values!r}; give one for each axis, in SI units.")
    return torch.tensor(values, dtype=torch.get_default_dtype())


def cross(a: Tensor, b: Tensor) -> Tensor:
    """a × b along the last axis."""
    (a1, a2, a3), (b1, b2, b3) = a.unbind(-1), b.unbind(-1)
    return torch.stack([a2 * b3 - a3 * b2, a3 * b1 - a1 * b3, a1 * b2 - a2 * b1], -1)


class Satellite(ControlAffineSystem):
    """A satellite with three reaction wheels of total angular momentum h (in the inertial frame):

        η̇ = E(η)w,   J ẇ = S(w)R(η)h + B u.

    Args:
        inertia: the diagonal of J in kg·m².
        momentum: h in N·m·s.

    Source: the parameters of Kang and Wilcox, "Mitigating the curse of dimensionality: sparse grid characteristics
    method for optimal feedback control and HJB equations", Computational Optimization and Applications 2017.
    """

    state_names, state_units = (*ATTITUDE, *RATES), ("rad",) * 3 + ("rad/s",) * 3
    control_names, control_units = ("first torque", "second torque", "third torque"), ("N·m",) * 3
    angles = (0, 1, 2)
    inertia: Tensor
    momentum: Tensor
    torques: Tensor

    def __init__(self, inertia: Sequence[float] = (2.0, 3.0, 4.0), momentum: Sequence[float] = (1.0, 1.0, 1.0)):
        super().__init__()
        require_positive(**{f"inertia[{i}]": value for i, value in enumerate(inertia)})
        B = torch.tensor([[1, 1 / 20, 1 / 10], [1 / 15, 1, 1 / 10], [1 / 10, 1 / 15, 1]])
        self.register_buffer("inertia", per_axis("inertia", inertia), persistent=False)
        self.register_buffer("momentum", per_axis("momentum", momentum), persistent=False)
        self.register_buffer("torques", B.to(self.inertia), persistent=False)

    def f(self, x: State) -> State:
        attitude, w = x[..., :3], x[..., 3:]
        h = (to_body_frame(attitude) * self.momentum).sum(-1)
        return torch.cat([attitude_rates(attitude, w), -cross(w, h) / self.inertia], -1)

    def g(self, x: State) -> InputMatrix:
        turning = self.torques / self.inertia[:, None]
        return torch.cat([torch.zeros_like(turning), turning]).expand(*x.shape[:-1], 6, 3)

    def draw(self, x: np.ndarray, u: np.ndarray) -> list[Shape]:
        """A cube of 1 m with two panels, and the body axes 1, 2 and 3."""
        face = [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5), (-0.5, -0.5)]
        here = np.zeros(3)
        edges = [project_points([(side, *corner) for corner in face], x[:3], here) for side in (-0.5, 0.5)]
        across = [np.stack(pair) for pair in zip(*edges, strict=True)][:4]
        panels = [[(-0.3, s, 0), (0.3, s, 0), (0.3, 3 * s, 0), (-0.3, 3 * s, 0)] for s in (-0.6, 0.6)]
        center, *axes = project_points([(0, 0, 0), (1.2, 0, 0), (0, 1.2, 0), (0, 0, 1.2)], x[:3], here)
        return [
            *(Polygon(project_points(panel, x[:3], here)) for panel in panels),
            *(Line(edge, width=1.5) for edge in (*edges, *across)),
            *(Arrow(center, axis) for axis in axes),
        ]


class BodyFrameQuadrotor(ControlAffineSystem):
    """A quadrotor with velocity v and angular velocity w in the body frame; u is the thrust minus m g, and torques:

        ṗ = R(η)ᵀv,   v̇ = S(w)v − R(η)(0, 0, g) + (0, 0, g + u₁/m),   η̇ = E(η)w,   J ẇ = S(w)J w + (u₂, u₃, u₄).

    Args:
        mass: m in kg.
        inertia: the diagonal of J in kg·m².
        gravity: g in m/s².
    """

    state_names = ("x", "y", "z", "forward velocity", "left velocity", "upward velocity", *ATTITUDE, *RATES)
    state_units = ("m",) * 3 + ("m/s",) * 3 + ("rad",) * 3 + ("rad/s",) * 3
    control_names = ("thrust", "roll torque", "pitch torque", "yaw torque")
    control_units = ("N", "N·m", "N·m", "N·m")
    angles = (6, 7, 8)
    inertia: Tensor

    def __init__(
        self,
        mass: float = 2.0,
        inertia: Sequence[float] = (1.2416, 1.2416, 2.4832),
        gravity: float = 9.81,
    ):
        super().__init__()
        require_positive(mass=mass, gravity=gravity, **{f"inertia[{i}]": value for i, value in enumerate(inertia)})
        self.mass, self.gravity = mass, gravity
        self.register_buffer("inertia", per_axis("inertia", inertia), persistent=False)

    def f(self, x: State) -> State:
        v, attitude, w = x[..., 3:6], x[..., 6:9], x[..., 9:]
        R = to_body_frame(attitude)
        falling = self.gravity * (torch.tensor(UPWARD).to(v) - R[..., 2]) - cross(w, v)
        turning = -cross(w, self.inertia * w) / self.inertia
        return torch.cat([(R * v[..., None]).sum(-2), falling, attitude_rates(attitude, w), turning], -1)

    def g(self, x: State) -> InputMatrix:
        pushing = x.new_tensor([[0.0]] * 5 + [[1 / self.mass]] + [[0.0]] * 6)
        turning = torch.diag(1 / self.inertia).to(x)
        turning = torch.cat([torch.zeros_like(turning)] * 3 + [turning])
        return torch.cat([pushing, turning], 1).expand(*x.shape[:-1], 12, 4)

    def draw(self, x: np.ndarray, u: np.ndarray) -> list[Shape]:
        """A thrust that carries the weight is drawn as long as an arm."""
        return rotorcraft(x[6:9], x[:3], 1 + u[0] / (self.mass * self.gravity))


class Quadrotor(ControlAffineSystem):
    """A quadrotor as a point mass with a thrust F, and its attitude as three double integrators:

        ṗ = v,   v̇ = F/m · b(η) − (0, 0, g),   η̇ = w,   ẇ = τ,   b(η) = R(η)ᵀ(0, 0, 1),

    where b is the direction of F. The controls are F minus a share of the weight, and the angular accelerations τ.

    Args:
        mass: m in kg.
        gravity: g in m/s².
        carried: the share of the weight m g that F carries at u = 0; with 0 the first control is F itself, and the goal
            is no equilibrium.

    Source: Onken et al., "A neural network approach for real-time high-dimensional optimal control", IEEE Transactions
    on Control Systems Technology 2022, with another order of the angles.
    """

    state_names = ("x", "y", "z", *ATTITUDE, "x velocity", "y velocity", "z velocity", *RATES)
    state_units = ("m",) * 3 + ("rad",) * 3 + ("m/s",) * 3 + ("rad/s",) * 3
    control_names = ("thrust", "roll acceleration", "pitch acceleration", "yaw acceleration")
    control_units = ("N",) + ("rad/s²",) * 3
    angles = (3, 4, 5)

    def __init__(self, mass: float = 1.0, gravity: float = 9.81, carried: float = 1.0):
        super().__init__()
        require_positive(mass=mass, gravity=gravity)
        self.mass, self.gravity, self.carried = mass, gravity, carried

    def f(self, x: State) -> State:
        direction = self._direction(x)
        falling = _column(self.gravity) * (_column(self.carried) * direction - torch.tensor(UPWARD).to(x))
        return torch.cat([x[..., 6:], falling, torch.zeros_like(falling)], -1)

    def g(self, x: State) -> InputMatrix:
        direction = (self._direction(x) / _column(self.mass))[..., None]
        zeros = torch.zeros_like(direction)
        turning = torch.eye(3, dtype=x.dtype, device=x.device).expand(*x.shape[:-1], 3, 3)
        pushing = torch.cat([zeros, zeros, direction, zeros], -2)
        return torch.cat([pushing, torch.cat([torch.zeros_like(turning)] * 3 + [turning], -2)], -1)

    def draw(self, x: np.ndarray, u: np.ndarray) -> list[Shape]:
        """A thrust that carries the weight is drawn as long as an arm."""
        return rotorcraft(x[3:6], x[:3], self.carried + u[0] / (self.mass * self.gravity))

    def _direction(self, x: State) -> Tensor:
        return to_body_frame(x[..., 3:6])[..., 2, :]


def _column(parameter: float | Tensor) -> float | Tensor:
    """A parameter as a factor of vectors: a number, or in a family one for each state."""
    return parameter[..., None] if isinstance(parameter, Tensor) else parameter

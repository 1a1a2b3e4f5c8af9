"""Systems with further states whose rates are known, z = (x, s)."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lyapnet.base.shapes import Shape
from lyapnet.base.types import Control, ControlMatrix, InputMatrix, Noise, State
from lyapnet.task.systems import ControlSystem


class ExtendedSystem(ControlSystem):
    """ẋ = f(x; s) + g(x; s)u with further states s independent of u; constant unless a subclass has other `rates`.

    Args:
        system: f and g.
        names, units: of s.
    """

    def __init__(self, system: ControlSystem, names: Sequence[str], units: Sequence[str]):
        super().__init__()
        self.system = system
        self.state_names = (*system.state_names, *names)
        self.state_units = (*system.state_units, *units)
        self.control_names, self.control_units = tuple(system.control_names), tuple(system.control_units)
        self.angles = tuple(system.angles)
        self.constants, self.settings = tuple(system.constants), tuple(system.settings)

    def split(self, z: State) -> tuple[Tensor, Tensor]:
        """(x, s)."""
        return z[..., : self.system.n], z[..., self.system.n :]

    def at(self, s: Tensor) -> ControlSystem:
        """The system in x for s (*batch, k)."""
        return self.system

    def rates(self, s: Tensor) -> Tensor:
        """ṡ."""
        return torch.zeros_like(s)

    @property
    def reference_time(self) -> int | None:
        return self.system.reference_time

    def recurring(self, x: State) -> State:
        x, s = self.split(x)
        return torch.cat([self.system.recurring(x), s], -1)

    def draw(self, x: np.ndarray, u: np.ndarray) -> Sequence[Shape]:
        return self.system.draw(x[: self.system.n], u)

    def f(self, x: State) -> State:
        x, s = self.split(x)
        return torch.cat([self.at(s).f(x), self.rates(s)], -1)

    def g(self, x: State) -> InputMatrix:
        x, s = self.split(x)
        return self._with_zero_rows(self.at(s).g(x))

    @property
    def affine(self) -> bool:
        return self.system.affine

    def dynamics(self, x: State, u: Control) -> State:
        x, s = self.split(x)
        return torch.cat([self.at(s).dynamics(x, u), self.rates(s)], -1)

    @property
    def noisy(self) -> bool:
        return self.system.noisy

    def noise(self, x: State) -> Noise:
        """σ(x; s), with zeros for s."""
        x, s = self.split(x)
        system: Any = self.at(s)
        return self._with_zero_rows(system.noise(x))

    @property
    def has_output(self) -> bool:
        return self.system.has_output

    def output(self, x: State) -> Tensor:
        """h(x; s)."""
        x, s = self.split(x)
        system: Any = self.at(s)
        return system.output(x)

    def inverse_mass(self, x: State) -> ControlMatrix:
        """BᵀM(q; s)⁻¹B, if the system has a mass matrix."""
        x, s = self.split(x)
        system: Any = self.at(s)
        return system.inverse_mass(x)

    def _with_zero_rows(self, matrix: Tensor) -> Tensor:
        """Append rows of zeros for s."""
        further = self.n - self.system.n
        return torch.cat([matrix, matrix.new_zeros(*matrix.shape[:-2], further, matrix.shape[-1])], -2)

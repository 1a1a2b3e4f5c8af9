"""Outputs: what is measured of a state, with the noise of each reading."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lyapnet.base.contracts import check_function
from lyapnet.base.types import State
from lyapnet.task.systems import ControlSystem

Readings = Float[Tensor, "*batch p"]


class Outputs(nn.Module, ABC):
    """y = h(x) + v: p readings of a state, (*batch, p), with normal v, independent of each other and of other times.

    Args:
        noise: standard deviation of each reading, in its unit.

    Raises:
        ValueError: there is no reading, or a deviation is not positive and finite.
    """

    names: Sequence[str]
    units: Sequence[str]
    angles: Sequence[int] = ()  # indices of readings that are angles in rad
    noise: Float[Tensor, " p"]

    def __init__(self, noise: Sequence[float]):
        super().__init__()
        if not noise or not all(0 < s < math.inf for s in noise):
            raise ValueError(
                f"Expected a standard deviation > 0 for each reading, got {[*noise]}; an exact reading has a small one."
            )
        self.register_buffer("noise", torch.tensor([*noise], dtype=torch.float64), persistent=False)

    @property
    def count(self) -> int:
        """p, the number of readings."""
        return len(self.noise)

    @abstractmethod
    def forward(self, x: State) -> Readings:
        """h(x)."""

    def draw(self, x: State, generator: torch.Generator) -> Readings:
        """Readings of a batch of states, with their noise."""
        h = self(x)
        return h + self.noise.to(h) * torch.randn(h.shape, generator=generator, dtype=torch.float64).to(h)

    def surprise(self, y: Readings, expected: Readings) -> Readings:
        """y − ŷ, for angles modulo 2π in [−π, π]; NaN for a missing reading.

        Thus a reading that wraps at ±π and one that counts turns have the same effect.
        """
        difference = y - expected
        if not self.angles:
            return difference
        wrapped, i = difference.clone(), list(self.angles)
        wrapped[..., i] = torch.remainder(difference[..., i] + math.pi, 2 * math.pi) - math.pi
        return wrapped


class MeasuredStates(Outputs):
    """Some states are measured.

    Args:
        system: the system.
        states: indices of the measured states.
        noise: standard deviation of each reading, in the unit of its state.
    """

    def __init__(self, system: ControlSystem, states: Sequence[int], noise: Sequence[float]):
        super().__init__(noise)
        if len(states) != self.count or len(set(states)) < len(states):
            raise ValueError(
                f"Expected noise with one number for each of {len(states)} different states, got {self.count}; give "
                "one for each."
            )
        self.states = list(states)
        self.names = [system.state_names[i] for i in states]
        self.units = [system.state_units[i] for i in states]
        self.angles = [k for k, i in enumerate(states) if i in system.angles]

    def forward(self, x: State) -> Readings:
        return x[..., self.states]


class SystemOutput(Outputs):
    """The readings that a system declares by its method `output(x)`, (*batch, p).

    They are named by its attributes `output_names` and `output_units`, if it has them. None of them counts as an angle:
    an output that wraps has to be given as its sine and cosine.

    Args:
        system: the system.
        noise: standard deviation of each reading.
        x: states (b, n) at which the contract of h is checked, in float64.

    Raises:
        UsageError: h breaks its contract; states how.
    """

    def __init__(self, system: ControlSystem, noise: Sequence[float], x: State):
        super().__init__(noise)
        self.system: Any = system
        check_function(f"{type(system).__name__}.output(x)", self, [x], (self.count,))
        self.names = getattr(system, "output_names", None) or [f"reading {k + 1}" for k in range(self.count)]
        self.units = getattr(system, "output_units", None) or [""] * self.count

    def forward(self, x: State) -> Readings:
        return self.system.output(x)

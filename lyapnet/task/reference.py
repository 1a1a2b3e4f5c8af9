"""The time on a reference as a further state: ẋ = f(x) + g(x)u, τ̇ = 1."""

import torch
from torch import Tensor

from lyapnet.base.types import State
from lyapnet.task.extended_system import ExtendedSystem
from lyapnet.task.systems import ControlSystem


class TimedSystem(ExtendedSystem):
    """ẋ = f(x) + g(x)u and τ̇ = 1, in the state (x, τ).

    Args:
        system: f and g.
        period: period of the reference; None: it is not periodic.
    """

    def __init__(self, system: ControlSystem, period: float | None):
        super().__init__(system, ["reference time"], ["s"])
        self.period = period
        self.settings = (*system.settings, system.n)

    @property
    def title(self) -> str:
        return f"{self.system.title} along a reference"

    @property
    def reference_time(self) -> int:
        return self.system.n

    def rates(self, s: Tensor) -> Tensor:
        return torch.ones_like(s)

    def recurring(self, x: State) -> State:
        if self.period is None:
            return x
        own, time = self.split(x)
        return torch.cat([own, torch.remainder(time, self.period)], -1)

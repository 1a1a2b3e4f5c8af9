"""Constant disturbances of controls, as further states: ẋ = f(x) + g(x)(u + d), ḋ = 0."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from lyapnet.base.types import Control, ControlMatrix, InputMatrix, Noise, State
from lyapnet.task.family import with_constant_states
from lyapnet.task.noise import Noise as NoiseOfTask
from lyapnet.task.noise import SystemNoise
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box
from lyapnet.task.systems import ControlAffineSystem


class DisturbedSystem(ControlAffineSystem):
    """ẋ = f(x) + g(x)(u + Ed) and ḋ = 0, in the state (x, d).

    Args:
        system: f and g.
        controls: indices of the controls that d disturbs, which E selects.
    """

    def __init__(self, system: ControlAffineSystem, controls: Sequence[int]):
        super().__init__()
        self.system, self.disturbed = system, list(controls)
        names = [f"disturbance of {system.control_names[i]}" for i in controls]
        self.state_names = (*system.state_names, *names)
        self.state_units = (*system.state_units, *(system.control_units[i] for i in controls))
        self.control_names, self.control_units = tuple(system.control_names), tuple(system.control_units)
        self.angles = tuple(system.angles)
        self.constants = (*system.constants, *range(system.n, system.n + len(names)))

    def split(self, z: State) -> tuple[Tensor, Control]:
        """(x, Ed)."""
        x, d = z[..., : self.system.n], z[..., self.system.n :]
        return x, z.new_zeros(*z.shape[:-1], self.m).index_copy(-1, torch.tensor(self.disturbed), d)

    def f(self, x: State) -> State:
        x, d = self.split(x)
        return self._append(self.system.dynamics(x, d))

    def g(self, x: State) -> InputMatrix:
        x, _ = self.split(x)
        return self._append(self.system.g(x).mT).mT

    def dynamics(self, x: State, u: Control) -> State:
        x, d = self.split(x)
        return self._append(self.system.dynamics(x, u + d))

    @property
    def noisy(self) -> bool:
        return self.system.noisy

    def noise(self, x: State) -> Noise:
        """σ(x), with zeros for d."""
        system: Any = self.system
        return self._append(system.noise(self.split(x)[0]).mT).mT

    @property
    def has_output(self) -> bool:
        return self.system.has_output

    def output(self, x: State) -> Tensor:
        """h(x)."""
        system: Any = self.system
        return system.output(self.split(x)[0])

    def inverse_mass(self, x: State) -> ControlMatrix:
        """BᵀM(q)⁻¹B, if the system has a mass matrix."""
        system: Any = self.system
        return system.inverse_mass(self.split(x)[0])

    def _append(self, rates: Tensor) -> Tensor:
        """Append zeros for d along the last axis."""
        return torch.cat([rates, rates.new_zeros(*rates.shape[:-1], len(self.disturbed))], -1)


class NoiseOfFirstStates(NoiseOfTask):
    """σ(x) as noise of (x, d), with zeros for d.

    Args:
        noise: σ.
        n: number of states x.
        further: number of states d.
    """

    def __init__(self, noise: NoiseOfTask, n: int, further: int):
        super().__init__()
        self.noise, self.n, self.further, self.sources = noise, n, further, noise.sources

    def forward(self, x: State) -> Noise:
        sigma = self.noise(x[..., : self.n])
        return torch.cat([sigma, sigma.new_zeros(*sigma.shape[:-2], self.further, self.sources)], -2)


def with_input_disturbances(problem: Problem, controls: Sequence[int], deviations: Sequence[float]) -> Problem:
    """The problem in (x, d): the cost, the controls and the constraints of x, and X₀ with d between −√3 and √3 σ_d.

    A uniform distribution between these has the standard deviation σ_d.

    Args:
        controls: indices of the disturbed controls.
        deviations: σ_d, the standard deviation of each disturbance at first, in the unit of its control.
    """
    n, box, k = problem.system.n, problem.initial_states, len(controls)
    reach = 3**0.5 * box.lower.new_tensor([*deviations])
    initial_states = Box(torch.cat([box.lower, -reach]), torch.cat([box.upper, reach])).to(reach)
    larger = with_constant_states(problem, DisturbedSystem(problem.system, controls), initial_states)
    if problem.noise is not None and not isinstance(problem.noise, SystemNoise):
        larger.noise = NoiseOfFirstStates(problem.noise, n, k)
    return larger

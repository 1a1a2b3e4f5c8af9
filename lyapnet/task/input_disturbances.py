"""Constant disturbances of controls, as further states: ẋ = f(x) + g(x)(u + d), ḋ = 0."""

from collections.abc import Sequence

import torch

from lyapnet.base.types import Control, Noise, State
from lyapnet.task.extended_system import ExtendedSystem
from lyapnet.task.family import with_constant_states
from lyapnet.task.noise import Noise as NoiseOfTask
from lyapnet.task.noise import SystemNoise
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box
from lyapnet.task.systems import ControlSystem


class DisturbedSystem(ExtendedSystem):
    """ẋ = f(x) + g(x)(u + Ed) and ḋ = 0, in the state (x, d).

    Args:
        system: f and g.
        controls: indices of the controls that d disturbs, which E selects.
    """

    def __init__(self, system: ControlSystem, controls: Sequence[int]):
        names = [f"disturbance of {system.control_names[i]}" for i in controls]
        super().__init__(system, names, [system.control_units[i] for i in controls])
        self.disturbed = list(controls)
        self.constants = (*system.constants, *range(system.n, system.n + len(names)))

    def f(self, x: State) -> State:
        return self.dynamics(x, x.new_zeros(*x.shape[:-1], self.m))

    def dynamics(self, x: State, u: Control) -> State:
        x, d = self.split(x)
        disturbed = u.index_add(-1, torch.tensor(self.disturbed), d)
        return torch.cat([self.system.dynamics(x, disturbed), self.rates(d)], -1)


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
    """The problem in (x, d), with the cost, controls and constraints of x, and d in X₀ between −√3σ_d and √3σ_d.

    The uniform distribution in this interval has the standard deviation σ_d.

    Args:
        controls: indices of the disturbed controls.
        deviations: σ_d, the initial standard deviation of each disturbance, in the unit of its control.
    """
    n, box, k = problem.system.n, problem.initial_states, len(controls)
    reach = 3**0.5 * box.lower.new_tensor([*deviations])
    initial_states = Box(torch.cat([box.lower, -reach]), torch.cat([box.upper, reach])).to(reach)
    larger = with_constant_states(problem, DisturbedSystem(problem.system, controls), initial_states)
    if problem.noise is not None and not isinstance(problem.noise, SystemNoise):
        larger.noise = NoiseOfFirstStates(problem.noise, n, k)
    return larger

"""The closed loop as a vector field of the state and the running cost."""

import torch
from torch import Tensor, nn

from lyapnet.base.types import Control, State, Time
from lyapnet.task.cost import Cost
from lyapnet.task.noise import Noise
from lyapnet.task.problem import Problem
from lyapnet.task.systems import ControlSystem
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.policy import PolicyOutput, ValuePolicy


class ClosedLoop(nn.Module):
    """The right-hand side of (x, ∫ℓ): d/dt (x, c) = (f + g u, ℓ(x, u)) with u = policy(t, x)."""

    system: ControlSystem
    cost: Cost
    policy: nn.Module
    noise: Noise | None

    def __init__(self, problem: Problem, policy: nn.Module):
        super().__init__()
        self.system, self.cost, self.policy = problem.system, problem.cost, policy
        self.noise = problem.noise

    @property
    def V(self) -> ValueFunction | None:
        """The V that defines the control law; None if the law is not defined by a V."""
        return self.policy.V if isinstance(self.policy, ValuePolicy) else None

    def forward(self, t: Time, y: Tensor) -> Tensor:
        x = y[..., :-1]
        return self.slope(x, self.policy(t, x))

    def slope(self, x: State, u: Control) -> Tensor:
        """(f + g u, ℓ), (*batch, n + 1)."""
        return torch.cat([self.system.dynamics(x, u), self.cost.running(x, u)[..., None]], -1)

    def displacement(self, x: State, increment: Tensor) -> State:
        """σ(x)ΔW, which noise adds to a step from x."""
        assert self.noise is not None
        return self.noise.displacement(x, increment)

    def control(self, t: Time, x: State) -> PolicyOutput:
        """u, V and V_x; zeros for V and V_x if the law is not defined by a V."""
        if isinstance(self.policy, ValuePolicy):
            return self.policy.with_value(t, x)
        return PolicyOutput(self.policy(t, x), torch.zeros_like(x[..., 0]), torch.zeros_like(x))


class SteppedLoop(ClosedLoop):
    """The means of (f + gu, ℓ) over a step with u held; its Euler steps equal the steps of the horizon's method."""

    def __init__(self, problem: Problem, policy: nn.Module):
        super().__init__(problem, policy)
        self.problem = problem

    def slope(self, x: State, u: Control) -> Tensor:
        rate, cost = self.problem.rates(x, u)
        return torch.cat([rate, cost[..., None]], -1)

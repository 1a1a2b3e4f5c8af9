"""Closed loops on plants that differ from the model: parameters are drawn at random, and the law is not told them."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lyapnet.base.types import Control, PerState, State, Time
from lyapnet.loop.rollout import Rollout, Trajectory
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.policy import PolicyOutput, ValuePolicy

StateOfPlant = Float[Tensor, "*batch states_and_parameters"]  # (x, p)


class UntoldValue(ValueFunction):
    """V(t, x) as a function of (t, (x, p)) that does not depend on the parameters p.

    Args:
        V: V(t, x).
        n: number of states x.
    """

    V: ValueFunction
    n: int

    def __init__(self, V: ValueFunction, n: int):
        super().__init__()
        self.V, self.n = V, n

    def forward(self, t: Time, x: State) -> PerState:
        return self.V(t, x[..., : self.n])

    def value_and_state_gradient(self, t: Time, x: State) -> tuple[PerState, State]:
        value, V_x = self.V.value_and_state_gradient(t, x[..., : self.n])
        return value, _with_zeros(V_x, x)


class UntoldPolicy(ValuePolicy):
    """u(t, x), a law made with the model, as a law of (x, p) that does not depend on the parameters p.

    Args:
        problem: the problem of the plants, with the states (x, p).
        law: u(t, x).
    """

    law: ValuePolicy
    n: int

    def __init__(self, problem: Problem, law: ValuePolicy):
        n = law.system.n
        super().__init__(problem, UntoldValue(law.V, n))
        self.law, self.n, self.held = law, n, law.held

    def forward(self, t: Time, x: State) -> Control:
        return self.law(t, x[..., : self.n])

    def with_value(self, t: Time, x: State) -> PolicyOutput:
        u, value, V_x = self.law.with_value(t, x[..., : self.n])
        return PolicyOutput(u, value, _with_zeros(V_x, x))


def _with_zeros(V_x: Tensor, x: State) -> State:
    """V_x of all states, which is zero for the parameters."""
    return torch.cat([V_x, torch.zeros_like(x[..., V_x.shape[-1] :])], -1)


class RandomPlants(nn.Module):
    """x₀ ↦ the closed loop on a plant with random parameters, uniform in their ranges, under a law made with the model.

    Args:
        problem: the problem of the plants: a FamilySystem, whose X₀ includes the ranges of the parameters.
        rollout: the closed loop of the law with the model.
    """

    problem: Problem
    rollout: Rollout
    ranges: Box
    n: int  # number of states x

    def __init__(self, problem: Problem, rollout: Rollout):
        super().__init__()
        law = rollout.closed_loop.policy
        assert isinstance(law, ValuePolicy)
        limit = None if rollout.discrete is None else rollout.discrete.costate_limit
        options = rollout.solver_arguments
        self.problem, self.n, box = problem, law.system.n, problem.initial_states
        self.rollout = Rollout(
            problem, UntoldPolicy(problem, law), rollout.method, rollout.gradient, options["rtol"], options["atol"],
            limit,
        )  # fmt: skip
        self.ranges = Box(box.lower[self.n :], box.upper[self.n :])

    def draw(self, x0: State, generator: torch.Generator) -> StateOfPlant:
        """(x₀, p) with random parameters for each of a batch of states (b, n)."""
        return torch.cat([x0, self.ranges.sample(len(x0), generator).to(x0)], -1)

    def forward(self, z0: StateOfPlant) -> Trajectory:
        """The closed loops from (x₀, p), with x alone as their states."""
        trajectory = self.rollout(z0)
        return trajectory._replace(x=trajectory.x[..., : self.n])

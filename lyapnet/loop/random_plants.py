"""Closed loops on plants that differ from the model (`randomise`), by parameters that the law does not know."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lyapnet.base.types import Control, PerState, State, Time
from lyapnet.loop.rollout import Rollout, Trajectory
from lyapnet.task.family import FamilySystem, parameter_of
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box
from lyapnet.value.calculus import ValueFunction
from lyapnet.value.policy import PolicyOutput, ValuePolicy

ON_MODEL = slice(0, None, 2)  # the closed loops of a training batch that run on the model
ON_PLANTS = slice(1, None, 2)  # the others, on random plants

StateOfPlant = Float[Tensor, "*batch states_and_parameters"]  # (x, p)


class NominalValue(ValueFunction):
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
        return value, append_zeros(V_x, x)


class NominalLaw(ValuePolicy):
    """u(t, x), a law for the model, as a function of (x, p) that does not depend on the parameters p.

    Args:
        problem: the problem of the plants, with the states (x, p).
        policy: u(t, x).
    """

    policy: ValuePolicy
    n: int

    def __init__(self, problem: Problem, policy: ValuePolicy):
        super().__init__(problem, NominalValue(policy.V, policy.system.n))
        self.policy, self.n, self.held, self.origin = policy, policy.system.n, policy.held, policy.origin

    def forward(self, t: Time, x: State) -> Control:
        return self.policy(t, x[..., : self.n])

    def with_value(self, t: Time, x: State) -> PolicyOutput:
        u, value, V_x = self.policy.with_value(t, x[..., : self.n])
        return PolicyOutput(u, value, append_zeros(V_x, x))


def append_zeros(slope: Tensor, z: Tensor) -> Tensor:
    """The gradient in z = (x, p) of a function that is independent of p, from its gradient in x."""
    return torch.cat([slope, torch.zeros_like(z[..., slope.shape[-1] :])], -1)


class RandomPlants(nn.Module):
    """x₀ ↦ the closed loop on a plant with random parameters, uniform in their ranges, under a law for the model.

    Args:
        problem: the problem of the plants: a FamilySystem, whose X₀ includes the ranges of the parameters.
        rollout: the closed loop of the law with the model.
    """

    problem: Problem
    rollout: Rollout
    ranges: Box
    parameters_of_model: Float[Tensor, " parameters"]
    n: int  # number of states x

    def __init__(self, problem: Problem, rollout: Rollout):
        super().__init__()
        law = rollout.closed_loop.policy
        assert isinstance(law, ValuePolicy)
        limit = None if rollout.discrete is None else rollout.discrete.costate_limit
        options = rollout.solver_arguments
        self.problem, self.n, box = problem, law.system.n, problem.initial_states
        self.rollout = Rollout(
            problem, NominalLaw(problem, law), rollout.method, rollout.gradient, options["rtol"], options["atol"],
            limit,
        )  # fmt: skip
        self.ranges, system = Box(box.lower[self.n :], box.upper[self.n :]), problem.system
        assert isinstance(system, FamilySystem)
        known = [float(parameter_of(system.system, name)) for name in system.parameters_in_f]
        self.register_buffer("parameters_of_model", self.ranges.lower.new_tensor(known), persistent=False)

    def draw(self, x0: State, generator: torch.Generator) -> StateOfPlant:
        """(x₀, p) with random parameters for each of a batch of states (b, n)."""
        return torch.cat([x0, self.ranges.sample(len(x0), generator).to(x0)], -1)

    def draw_beside_model(self, x0: State, generator: torch.Generator) -> StateOfPlant:
        """As `draw`, but with the parameters of the model for the closed loops of ON_MODEL."""
        z0 = self.draw(x0, generator)
        z0[ON_MODEL, self.n :] = self.parameters_of_model
        return z0

    def forward(self, z0: StateOfPlant) -> Trajectory:
        """The closed loops from (x₀, p), with x alone as their states."""
        trajectory = self.rollout(z0)
        return trajectory._replace(x=trajectory.x[..., : self.n])

"""Closed loops on plants that differ from the model, which leave the states where V is known."""

import torch
from torch import Tensor

from lyapnet.base.types import Control, PerState, State
from lyapnet.task.problem import Problem
from lyapnet.training.learner import Learner
from lyapnet.value.expansions import Path, in_float64, path_under

RATE_CHANGE = 0.3  # largest relative change of the rate ẋ_i of a state, without control and by control
TEST_POINTS = 1000  # points of a path at which it is seen which rates every plant has, about
DISTANCE = 0.2  # largest distance of initial states from X₀, relative to its half width


@torch.no_grad()
def disturbed_path(learner: Learner, optimal: Path, generator: torch.Generator) -> Path:
    """The closed loops of a learner on random plants, in float64, from near the initial states of optimal paths.

    These are moved away from the centre of X₀, by up to DISTANCE of their distance from it.

    On each of these plants every step changes the state by s ∘ (F(x, c) − x) + r ∘ (F(x, u) − F(x, c)), where F is the
    model's step, c the control at rest, and s_i and r_i are factors for each state, uniform in 1 ± RATE_CHANGE; they
    are 1 where ẋ_i is the same for every plant, as that of a position. Loops may be non-finite, with an infinite cost.
    """
    problem, goal = in_float64(learner.problem), learner.problem.goal
    policy, times = learner.rollout.closed_loop.policy, problem.horizon.times(goal)
    varies = ~rate_is_certain(problem, optimal)

    def draw(size: Tensor) -> Tensor:
        return torch.rand(size.shape, generator=generator, dtype=torch.float64)

    x = optimal.x[0]
    constants = list(problem.system.constants)
    outwards = DISTANCE * draw(x[:, :1]) * (x - problem.initial_states.center.to(x))
    outwards[:, constants] = 0
    drift, response = (1 + RATE_CHANGE * (2 * draw(x) - 1) * varies for _ in range(2))

    def step(x: State, u: Control) -> tuple[State, PerState]:
        (following, paid), (at_rest, _) = problem.step(x, u), problem.step(x, problem.rest_at(x))
        return x + drift * (at_rest - x) + response * (following - at_rest), paid

    return path_under(problem, lambda n, x: policy(times[n], x.to(goal)).to(x), x + outwards, step=step)


def rate_is_certain(problem: Problem, path: Path) -> Tensor:
    """For each state, whether ẋ_i is a state or a constant along a path, (n,): then it is so for every plant."""
    x, u = path.x[:-1].flatten(0, 1), path.u.flatten(0, 1)
    some = slice(None, None, max(1, len(x) // TEST_POINTS))
    x, u = x[some], u[some]
    rate = problem.system.dynamics(x, u)
    is_constant = (rate == rate[:1]).all(0)
    return is_constant | (rate[:, :, None] == x[:, None, :]).all(0).any(1)

"""Infinite-horizon tasks: the terminal cost is the cost of a regulator after T."""

import torch

from lyapnet.base.errors import UsageError
from lyapnet.task.cost import RegulatorTail
from lyapnet.task.problem import Problem
from lyapnet.value.regulator import Regulator

PURPOSE, INSTEAD = "horizon.stationary", "choose another goal, or stationary: false"  # texts of messages
MAX_COST_AT_GOAL = 1e-3  # largest q at the goal, relative to the mean q on X₀
COST_STATES = 256  # random states of X₀ for this mean


def without_end(problem: Problem) -> Problem:
    """The problem with φ = (x − x*)ᵀP(x − x*), the infinite-horizon cost of the regulator linearised at the goal.

    V of the linearised problem then equals φ at every t, for any T. The control at the goal has to be inside its
    limits.

    Raises:
        UsageError: no control inside the limits holds the goal, it violates constraints, staying there has a cost, or
            no regulator stabilises it.
    """
    limits, rest = problem.controls.limits, problem.rest
    if limits is None:
        raise UsageError(
            f"Expected controls without limits, or a set that tells its `limits`, for {PURPOSE}, got "
            f"{type(problem.controls).__name__}; choose another, or stationary: false."
        )
    lower, upper = (side.to(rest) for side in limits)
    if not bool((lower < rest).all() and (rest < upper).all()):
        raise UsageError(
            f"Expected limits around the control at the goal, {rest.tolist()}, for {PURPOSE}, got {lower.tolist()} to "
            f"{upper.tolist()}; widen controls, or choose another target."
        )
    _require_lasting_goal(problem)
    n = problem.system.n
    try:
        regulator = Regulator(problem.replaced(cost=RegulatorTail(problem.cost, torch.zeros(n, n))), PURPOSE, INSTEAD)
    except ValueError as error:
        raise UsageError(str(error)) from error
    return problem.replaced(cost=RegulatorTail(problem.cost, regulator.P))


def _require_lasting_goal(problem: Problem) -> None:
    """Check that a system may stay at the goal for ever.

    Raises:
        UsageError: the goal violates constraints, or q(x*) > 0, whose integral over an infinite time is infinite.
    """
    place = f"x* = {problem.goal.tolist()}"
    if problem.constraints is not None and bool((problem.constraints(problem.goal) > 0).any()):
        raise UsageError(f"Expected a goal within the constraints for {PURPOSE}, got {place} outside; {INSTEAD}.")
    at_goal, mean = (
        float(problem.cost.state(x).mean())
        for x in (problem.goal, problem.initial_states.sample(COST_STATES, torch.Generator().manual_seed(0)))
    )
    if abs(at_goal) > MAX_COST_AT_GOAL * abs(mean):
        raise UsageError(
            f"Expected q(x*) = 0 for {PURPOSE}, got {at_goal:.3g} per second at {place}; write a cost that vanishes "
            "there, move cost.obstacles away from it, or take stationary: false."
        )

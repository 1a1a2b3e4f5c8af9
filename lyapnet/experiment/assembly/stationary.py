"""Infinite-horizon tasks: the terminal cost is the cost of a regulator after T."""

import torch

from lyapnet.base.errors import UsageError
from lyapnet.base.types import State
from lyapnet.task.cost import RegulatorsTail, RegulatorTail
from lyapnet.task.family import FamilySystem
from lyapnet.task.problem import Problem
from lyapnet.task.sets import Box
from lyapnet.value.regulator import Regulator, goal_of_member, root_of_members

PURPOSE, INSTEAD = "horizon.stationary", "choose another goal, or stationary: false"  # texts of messages
MAX_COST_AT_GOAL = 1e-3  # largest q at the goal, relative to the mean q on X₀
COST_STATES = 256  # random states of X₀ for this mean
MEMBERS = 64  # random members of a family whose goals are checked, besides those at the ends of its ranges


def without_end(problem: Problem) -> Problem:
    """The problem with φ = (x − x*)ᵀP(x − x*), the infinite-horizon cost of the regulator linearised at the goal.

    V of the linearised problem then equals φ at every t, for any T; in a family for each member. The control at the
    goal has to be inside its limits.

    Raises:
        UsageError: no control inside the limits holds the goal, it violates constraints, staying there has a cost, or
            no regulator stabilises it; in a family for some member.
    """
    system, limits = problem.system, problem.controls.limits
    if not system.affine:
        raise UsageError(f"Expected a control-affine system for {PURPOSE}, got {system.title}; take stationary: false.")
    if limits is None:
        raise UsageError(
            f"Expected controls without limits, or a set with known `limits`, for {PURPOSE}, got "
            f"{type(problem.controls).__name__}; choose another, or stationary: false."
        )
    parameters = len(system.names) if isinstance(system, FamilySystem) else 0
    if len(system.constants) > parameters:
        names = ", ".join(system.state_names[i] for i in system.constants[: len(system.constants) - parameters])
        raise UsageError(
            f"Expected constant states that are parameters of a family for {PURPOSE}, got {names}; make them arguments "
            "of the system's constructor, and name them in family."
        )
    for goal in _goals(problem):
        rest = problem.rest_at(goal)
        lower, upper = (side.to(rest) for side in limits)
        if not bool((lower < rest).all() and (rest < upper).all()):
            raise UsageError(
                f"Expected limits around the control at the goal, {rest.tolist()}, for {PURPOSE}, got {lower.tolist()} "
                f"to {upper.tolist()}; widen controls, or choose another target."
            )
    _require_lasting_goals(problem)
    n = system.n
    without_tail = problem.replaced(cost=RegulatorTail(problem.cost, torch.zeros(n, n)))
    try:
        if parameters:
            root = root_of_members(without_tail, PURPOSE, INSTEAD)
            return problem.replaced(cost=RegulatorsTail(problem.cost, root, n - parameters))
        regulator = Regulator(without_tail, PURPOSE, INSTEAD)
    except ValueError as error:
        raise UsageError(str(error)) from error
    return problem.replaced(cost=RegulatorTail(problem.cost, regulator.P))


def _goals(problem: Problem) -> State:
    """x*, or (x*(p), p) of members of a family; (b, n)."""
    constants = list(problem.system.constants)
    if not constants:
        return problem.goal[None]
    box = problem.initial_states
    ranges = Box(box.lower[constants], box.upper[constants])
    drawn = torch.cat([ranges.corners(), ranges.sample(MEMBERS, torch.Generator().manual_seed(0))])
    return torch.stack([goal_of_member(problem, p) for p in drawn])


def _require_lasting_goals(problem: Problem) -> None:
    """Check that a system may stay at the goal for ever.

    Raises:
        UsageError: the goal violates constraints, or q(x*) > 0, whose integral over an infinite time is infinite.
    """
    states = problem.initial_states.sample(COST_STATES, torch.Generator().manual_seed(0))
    mean = float(problem.cost.state(states).mean())
    for goal in _goals(problem):
        place = f"x* = {goal.tolist()}"
        if problem.constraints is not None and bool((problem.constraints(goal) > 0).any()):
            raise UsageError(f"Expected a goal within the constraints for {PURPOSE}, got {place} outside; {INSTEAD}.")
        at_goal = float(problem.cost.state(goal))
        if abs(at_goal) > MAX_COST_AT_GOAL * abs(mean):
            raise UsageError(
                f"Expected q(x*) = 0 for {PURPOSE}, got {at_goal:.3g} per second at {place}; write a cost that "
                "vanishes there, move cost.obstacles away from it, or take stationary: false."
            )

"""Tasks without end: what a regulator goes on to pay after T, as the terminal cost."""

import torch

from lyapnet.beyond import Regulator
from lyapnet.cost import RegulatorTail
from lyapnet.errors import UsageError
from lyapnet.problem import Problem

PURPOSE, INSTEAD = "horizon.stationary", "choose another goal, or stationary: false"


def without_end(problem: Problem) -> Problem:
    """The problem with φ = (x − x*)ᵀP(x − x*), the infinite-horizon cost of the regulator linearised at the goal.

    V of the linearised problem is then φ at every t, whatever T is. No limit may be met at the goal.

    Raises:
        UsageError: no control holds the goal, a limit is met there, or no regulator brings the state there.
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
    n = problem.system.n
    try:
        regulator = Regulator(problem.replaced(cost=RegulatorTail(problem.cost, torch.zeros(n, n))), PURPOSE, INSTEAD)
    except ValueError as error:
        raise UsageError(str(error)) from error
    return problem.replaced(cost=RegulatorTail(problem.cost, regulator.P))

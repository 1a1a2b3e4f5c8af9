"""What a config may have beside limits of controls that depend on the state."""

from lyapnet.base.errors import UsageError
from lyapnet.experiment.config import Config
from lyapnet.task.problem import Problem
from lyapnet.task.sets import ControlSet, Unbounded
from lyapnet.task.varying_limits import VaryingLimits


def constant_limits(controls: ControlSet) -> ControlSet:
    """The set in which the control at a target is sought: limits that depend on the state are tested there later."""
    return Unbounded() if isinstance(controls, VaryingLimits) else controls


def refuse_beside_varying_limits(config: Config) -> None:
    """Refuse the parts of a task that do not know how limits move.

    Raises:
        UsageError: names the part.
    """
    present = {
        "a family": bool(config.family),
        "a reference": bool(config.reference.points),
        "randomise": bool(config.randomise),
        "outputs": config.outputs.noise is not None,
        "cost.control_costs": bool(config.cost.control_costs),
    }
    for name, given in present.items():
        if given:
            raise UsageError(
                f"Expected no limits of controls that depend on the state beside {name}, got some; take constant "
                f"limits, or leave out {name}."
            )


def require_rest_within_limits(problem: Problem) -> None:
    """Refuse a target whose control at rest is outside the limits there.

    Raises:
        UsageError: says the control and the limits.
    """
    controls, goal = problem.controls, problem.cost.goal
    if not isinstance(controls, VaryingLimits) or goal is None or bool(controls.contains(problem.rest)):
        return
    lower, upper = (side.tolist() for side in controls.limits_at(goal))
    u = (controls.middle_and_half(goal)[0] + controls.middle_and_half(goal)[1] * problem.rest).tolist()
    raise UsageError(
        f"Expected limits of controls that admit the control at the target, {u}, got {lower} to {upper} there; widen "
        "them, or choose another target."
    )

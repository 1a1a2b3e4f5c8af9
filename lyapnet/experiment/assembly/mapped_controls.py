"""Restrictions of configs with a mapped control set, such as limits that depend on the state."""

from lyapnet.base.errors import UsageError
from lyapnet.experiment.config import Config
from lyapnet.task.mapped_controls import MappedControls
from lyapnet.task.problem import Problem
from lyapnet.task.sets import ControlSet, Unbounded


def set_for_target(controls: ControlSet) -> ControlSet:
    """The set in which the control at a target is sought; for a mapped set the control is tested later."""
    return Unbounded() if isinstance(controls, MappedControls) else controls


def refuse_beside_mapped_controls(config: Config, controls: MappedControls) -> None:
    """Refuse the parts of a task that do not support shares.

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
                f"Expected constant limits of controls, or a ball, beside {name}, got {controls.words}; take another "
                f"set, or leave out {name}."
            )


def require_rest_in_mapped_controls(problem: Problem) -> None:
    """Refuse a target whose control at rest is outside the set there.

    Raises:
        UsageError: says the control and its limits there.
    """
    controls, goal = problem.controls, problem.cost.goal
    if not isinstance(controls, MappedControls) or goal is None or bool(controls.contains(problem.rest)):
        return
    u, limits = controls.moved(goal, problem.rest).tolist(), controls.limits_at(goal)
    within = "" if limits is None else f" between {limits[0].tolist()} and {limits[1].tolist()} there"
    raise UsageError(
        f"Expected the control at the target, {u}, in {controls.words}, got it outside of a set{within}; widen the "
        "set, or choose another target."
    )

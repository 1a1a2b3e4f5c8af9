"""Builds the random plants of a config."""

import copy

from lyapnet.base.errors import UsageError
from lyapnet.experiment.assembly.classes import float64_defaults
from lyapnet.experiment.assembly.family import checked_ranges, members_of
from lyapnet.experiment.config import Config
from lyapnet.loop.random_plants import RandomPlants
from lyapnet.loop.rollout import Rollout
from lyapnet.task.family import with_constant_states


def build_plants(config: Config, rollout: Rollout) -> RandomPlants | None:
    """The plants of `randomise`, with random parameters that V and the law do not know; None if there are none.

    The cost stays that of the model, also where it depends on a parameter, as R: inverse_mass does.

    Args:
        rollout: the closed loop with the model.

    Raises:
        UsageError: a name is no parameter of f and g, a range is invalid, or the task can have no such plants.
    """
    if not config.randomise:
        return None
    _require_support(config)
    problem, ranges = rollout.problem, checked_ranges(config.randomise, "randomise")
    like = problem.initial_states.lower
    with float64_defaults():  # as when the problem is built
        exact, units = copy.deepcopy(problem.system).double(), [""] * len(ranges)
        system, box = members_of(config, exact, ranges, units, problem.initial_states, "randomise")
    return RandomPlants(with_constant_states(problem, system.to(like), box.to(like)), rollout)


def _require_support(config: Config) -> None:
    """Raise UsageError for settings that do not support random plants."""
    for key, given in (("family", config.family), ("noise", config.noise), ("reference", config.reference.points)):
        if given:
            raise UsageError(f"Expected randomise without {key}, got both; leave one of them out.")
    if config.horizon.stationary:
        raise UsageError("Expected horizon.stationary: false with randomise, got true; give a horizon that ends.")

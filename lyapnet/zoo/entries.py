"""What the zoo holds."""

from pathlib import Path
from typing import Any, NamedTuple

import torch

from lyapnet.base.files import read_json
from lyapnet.controller.controller import Controller
from lyapnet.controller.loading import load
from lyapnet.experiment.checkpoint import ZOO, locate_checkpoint, zoo_names
from lyapnet.loop.rollout import Trajectory


class Entry(NamedTuple):
    """A controller of the zoo."""

    name: str
    checkpoint: Path
    record: dict[str, Any]  # command, seed, versions, evaluation, certificate, export, states and their optima

    def load(self) -> Controller:
        """The controller, as lyapnet.load("zoo:NAME")."""
        return load(self.checkpoint)

    def measured(self, controller: Controller) -> tuple[Trajectory, float, float]:
        """(closed loops from the recorded states, cost / optimum, mean |V(0, x₀) − J*| / mean J*) of a controller.

        The optima J* are those of the record, so that no oracle is needed.
        """
        states = controller.initial_states.lower.new_tensor(self.record["states"])
        optima = states.new_tensor(self.record["optima"])
        trajectory = controller.rollout(states)
        with torch.no_grad():
            error = (controller.value(0.0, states) - optima).abs().mean() / optima.mean()
        return trajectory, float(trajectory.cost.mean() / optima.mean()), float(error)


def entry(name: str) -> Entry:
    """A controller of the zoo.

    Raises:
        UsageError: there is none of that name.
    """
    checkpoint = locate_checkpoint(f"zoo:{name}")
    return Entry(name, checkpoint, read_json(ZOO / f"{name}.json", "install lyapnet again"))


def entries() -> list[Entry]:
    """All of them, in alphabetical order."""
    return [entry(name) for name in zoo_names()]

"""The callback that ends a training in which further steps bring nothing."""

import math
from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer

from lyapnet.experiment.config import Config
from lyapnet.training.curves import members_of
from lyapnet.training.learner import Learner, mean_over_processes
from lyapnet.training.stages import Stages

WINDOW = 40  # steps in which the validation loss has to fall
COOLING = 40  # steps in which the learning rate then falls to its end
NOISE = 5.0  # times the least gain: how far the mean loss of the window may be above the least
PATIENCE = 120  # steps without a lower loss, after which it has stopped falling however it goes up and down


class Settling(Callback):
    """Has a member's learning rate fall to its end once its validation loss has stopped falling; training ends with it.

    The loss has stopped where its least value of the last WINDOW steps, the warmup not counted, is less than
    `least_gain` below its least value before, and its mean not well above that: losses that go up and down need shorter
    steps, not fewer. Where PATIENCE steps have brought no lower value either, that of the start counted, it has stopped
    too: more would only cost time. Of several seeds, each settles as it would alone, and training ends with the last of
    them; one that has ended waits with a rate of zero.

    Args:
        least_gain: in units of the loss, which are shares of the mean cost, or of the spread of the optimum where there
            is no goal; 0: training takes all its steps.
        warmup: steps in which the learning rate rises.
        stages: where it is said.
    """

    def __init__(self, least_gain: float, warmup: int, stages: Stages):
        self.least_gain, self.warmup, self.stages = least_gain, warmup, stages
        self.losses: dict[str, list[tuple[int, float]]] = {}  # label ↦ (step, loss) of each validation
        self.cooling: dict[str, tuple[int, int]] = {}  # label ↦ between which steps the rate falls

    def state_dict(self) -> dict[str, Any]:
        return {"losses": self.losses, "cooling": self.cooling}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        if self.least_gain:
            self.losses, self.cooling = dict(state_dict["losses"]), dict(state_dict["cooling"])

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        for member in members_of(pl_module):
            member.cooling = self.cooling.get(member.label)
        self._shorten(trainer, members_of(pl_module))
        if self.least_gain and trainer.global_step == 0:  # the start was validated by now
            self._note_losses(0, pl_module)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        step, members = trainer.global_step, members_of(pl_module)
        if not self.least_gain or step < self.warmup:
            return
        self._note_losses(step, pl_module)
        for member in members:
            end, last = step + COOLING, trainer.max_epochs or math.inf
            if member.cooling is None and end < last and self._has_stopped(member.label, step):
                self.cooling[member.label] = member.cooling = step, end
                self._shorten(trainer, members)
                if trainer.is_global_zero:
                    named = f" of {member.label.replace('_', ' ')}" if member.label else ""
                    self.stages.console.print(
                        f"settled: in {WINDOW} steps the validation loss{named} fell by less than "
                        f"{self.least_gain:g}; its training ends at step {end}",
                        soft_wrap=True,
                    )

    def _note_losses(self, step: int, module: LightningModule) -> None:
        for member in members_of(module):
            loss = torch.tensor(member.validation_loss, dtype=torch.float64, device=module.device)
            self.losses.setdefault(member.label, []).append((step, float(mean_over_processes(loss))))

    def _has_stopped(self, label: str, step: int) -> bool:
        losses = self.losses[label]

        def fell_by(steps: int, first: int) -> float:
            """How far the least loss of so many last steps is below the least one before, from a first step on."""
            before = [loss for at, loss in losses if first <= at <= step - steps]
            since = [loss for at, loss in losses if at > step - steps]
            return min(before, default=math.inf) - min(since)

        if fell_by(WINDOW, self.warmup) >= self.least_gain:
            return False
        window = [loss for at, loss in losses if at > step - WINDOW]
        above_least = fmean(window) - min(loss for _, loss in losses)
        return above_least <= NOISE * self.least_gain or fell_by(PATIENCE, 0) < self.least_gain

    def _shorten(self, trainer: Trainer, members: Sequence[Learner]) -> None:
        """End when all have settled."""
        end = end_of(self.cooling, len(members))
        if end < (trainer.max_epochs or math.inf):
            trainer.fit_loop.max_epochs = int(end)


def end_of_training(checkpoint: Mapping[str, Any], config: Config) -> float:
    """The last step of a training that has settled, as its checkpoint says; infinite where it has not."""
    state = checkpoint.get("callbacks", {}).get(Settling.__qualname__)
    return end_of(state["cooling"], config.seeds) if state and config.training.least_gain else math.inf


def end_of(cooling: Mapping[str, tuple[int, int]], members: int) -> float:
    """The last step of a training whose members have settled; infinite where one has not."""
    return max(end for _, end in cooling.values()) if len(cooling) == members else math.inf

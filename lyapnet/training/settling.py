"""Early stopping: ends a training for which further steps bring nothing."""

import math
from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer

from lyapnet.evaluation.optimality import ratio_of_means
from lyapnet.experiment.config import Config
from lyapnet.loop.programs import ValueProgram
from lyapnet.training.curves import members_of
from lyapnet.training.learner import Learner, number_over_processes
from lyapnet.training.stage_messages import StageMessages

WINDOW = 40  # steps in which the validation loss has to fall
COOLING = 40  # steps of the final decay of the learning rate
NOISE_FACTOR = 5.0  # largest distance of the window's mean loss from the least loss, in units of `least_gain`
MAX_VALUE_ERROR = 0.02  # largest mean |V(0, x₀) − J*|, relative to mean J*, of a V that counts as nearly optimal
PATIENCE = 120  # steps without a lower loss after which even an oscillating loss has stopped falling


class Settling(Callback):
    """Decays a member's learning rate over COOLING steps once further steps bring nothing; then ends.

    That is so if the law and V are nearly optimal, as after many fits to optima (see `_is_optimal`), or if the
    validation loss has stopped falling, that is, if both hold:

    1. Its least value in the last WINDOW steps is less than `least_gain` below its least value before. The warmup does
       not count.
    2. Its mean in the window is at most NOISE_FACTOR × `least_gain` above the least value, so that it does not
       oscillate (an oscillating loss needs a smaller learning rate), or it has not fallen in PATIENCE steps, the
       initial V included.

    With several seeds each settles as it would alone; training ends with the last one, and the others wait with a
    learning rate of zero.

    Args:
        least_gain: smallest gain, in units of the loss, which is relative to the mean cost, or to the spread of the
            optimum if there is no goal; 0 disables early stopping.
        warmup: steps of the learning rate's warmup.
        stages: shows messages.
    """

    def __init__(self, least_gain: float, warmup: int, stages: StageMessages):
        self.least_gain, self.warmup, self.stages = least_gain, warmup, stages
        self.losses: dict[str, list[tuple[int, float]]] = {}  # label ↦ (step, loss) of each validation
        self.cooling: dict[str, tuple[int, int]] = {}  # label ↦ first and last step of the final decay

    def state_dict(self) -> dict[str, Any]:
        return {"losses": self.losses, "cooling": self.cooling}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        if self.least_gain:
            self.losses, self.cooling = dict(state_dict["losses"]), dict(state_dict["cooling"])

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        for member in members_of(pl_module):
            member.cooling = self.cooling.get(member.label)
        self._set_last_step(trainer, members_of(pl_module))
        if self.least_gain and trainer.global_step == 0:  # the initial V is validated already
            self._note_losses(0, pl_module)
            self._end_settled(trainer, pl_module)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if not self.least_gain:
            return
        if trainer.global_step >= self.warmup:
            self._note_losses(trainer.global_step, pl_module)
        self._end_settled(trainer, pl_module)

    def _note_losses(self, step: int, module: LightningModule) -> None:
        for member in members_of(module):
            loss = number_over_processes(member.validation_loss, module.device)
            self.losses.setdefault(member.label, []).append((step, loss))

    def _end_settled(self, trainer: Trainer, module: LightningModule) -> None:
        """Begin the final decay of the members for which further steps bring nothing."""
        step, members = trainer.global_step, members_of(module)
        end, last = step + COOLING, trainer.max_epochs or math.inf
        for member in members:
            if member.cooling is not None or end >= last:
                continue
            named = f" of {member.label.replace('_', ' ')}" if member.label else ""
            if self._is_optimal(member, module.device):
                reason = f"the law{named} costs less than {100 * self.least_gain:g} % more than the optimum"
            elif step >= self.warmup and self._has_stopped(member.label, step):
                reason = f"in {WINDOW} steps the validation loss{named} fell by less than {self.least_gain:g}"
            else:
                continue
            self.cooling[member.label] = member.cooling = step, end
            self._set_last_step(trainer, members)
            if trainer.is_global_zero:
                self.stages.console.print(f"settled: {reason}; its training ends at step {end}", soft_wrap=True)

    def _is_optimal(self, member: Learner, device: torch.device) -> bool:
        """Whether law and V are nearly optimal at the validation states whose optimum J* is known.

        Under the value program without noise these hold:

        1. Mean max(J − J*, 0) is less than `least_gain` of mean J*, and mean J is not below mean J* by as much, which
           would show that J* is no optimum.
        2. Mean |V(0, x₀) − J*| is at most MAX_VALUE_ERROR of mean J*.
        3. No state is known from which the closed loop costs 5 % more than J*, is gravely lost (see LostStates), or
           violates a constraint.

        All processes have the same validation states; the mean over them makes them decide alike.
        """
        program, states = member.program, member.validation
        if not isinstance(program, ValueProgram) or not program.normalise or member.pointwise is not None:
            return False
        if states is None or states.optimal_cost is None or member.problem.noise is not None:
            return False
        known, violated = states.against_optimum(), states.violated
        ratio, error, lost = known["cost_ratio"], known["value_error"], known.get("lost_fraction") or member.lost_excess
        if ratio is None or error is None or lost or (violated is not None and violated.any()):
            return False
        above = ratio_of_means(states.cost.maximum(states.optimal_cost), states.optimal_cost)
        assert above is not None
        excess = number_over_processes(max(above - 1, 1 - ratio), device)
        return program.trajectory_cost * excess < self.least_gain and error <= MAX_VALUE_ERROR

    def _has_stopped(self, label: str, step: int) -> bool:
        losses = self.losses[label]

        def fell_by(steps: int, first: int) -> float:
            """By how much the least loss of the last `steps` steps is below the least one from `first` until then."""
            before = [loss for at, loss in losses if first <= at <= step - steps]
            since = [loss for at, loss in losses if at > step - steps]
            return min(before, default=math.inf) - min(since)

        if fell_by(WINDOW, self.warmup) >= self.least_gain:
            return False
        window = [loss for at, loss in losses if at > step - WINDOW]
        above_least = fmean(window) - min(loss for _, loss in losses)
        return above_least <= NOISE_FACTOR * self.least_gain or fell_by(PATIENCE, 0) < self.least_gain

    def _set_last_step(self, trainer: Trainer, members: Sequence[Learner]) -> None:
        """Shorten the training if all members have settled."""
        end = end_of(self.cooling, len(members))
        if end < (trainer.max_epochs or math.inf):
            trainer.fit_loop.max_epochs = int(end)


def end_of_training(checkpoint: Mapping[str, Any], config: Config) -> float:
    """The last step of a training that has settled, from its checkpoint; infinite if it has not."""
    state = checkpoint.get("callbacks", {}).get(Settling.__qualname__)
    return end_of(state["cooling"], config.seeds) if state and config.training.least_gain else math.inf


def end_of(cooling: Mapping[str, tuple[int, int]], members: int) -> float:
    """The last step of a training whose members have all settled; infinite otherwise."""
    return max(end for _, end in cooling.values()) if len(cooling) == members else math.inf

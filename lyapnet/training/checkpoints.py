"""The callback that saves a run: its last state, and the best one so far."""

import math
import signal
from collections.abc import Callable, Mapping
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import Checkpoint

from lyapnet.base.errors import Interrupted
from lyapnet.training.learner import mean_over_processes
from lyapnet.training.modules import labelled
from lyapnet.training.runs import Run


class KeptStart(Callback):
    """best.ckpt as soon as training has its start: what compiling and optima take from there may be broken off.

    Args:
        best: label ↦ each member's best checkpoint.
    """

    def __init__(self, best: Mapping[str, Path]):
        self.best = best

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        module: Any = pl_module
        if trainer.global_step == 0:
            for member in module.members:
                module.save_member(member, self.best[member.label])


class Checkpoints(Checkpoint):
    """last.ckpt after every validation, best.ckpt where its loss is least, and last.ckpt on Ctrl-C and SIGTERM.

    What was logged is written first, so that it is never behind the checkpoint. (Lightning's ModelCheckpoint writes
    its last checkpoint only together with a best one, remembers absolute paths, and its position within an interval.)

    Args:
        last: the checkpoint of the whole run.
        best: label ↦ each member's best checkpoint.
        every: steps between validations; the last step is validated and saved whether a multiple or not.
        saved: called when the last checkpoint is written for the first time in this process.
    """

    def __init__(self, last: Path, best: Mapping[str, Path], every: int, saved: Callable[[], None]):
        super().__init__()
        self.last, self.best, self.every = last, best, every
        self._saved: Callable[[], None] | None = saved
        self.best_loss = dict.fromkeys(best, math.inf)
        self._signal: int | None = None
        self._begun = False  # whether a step has been
        self._previous: dict[int, Any] = {}

    def state_dict(self) -> dict[str, Any]:
        return {labelled("best_loss", label): loss for label, loss in self.best_loss.items()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.best_loss = {label: state_dict[labelled("best_loss", label)] for label in self.best_loss}

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        self._install_handlers()  # before the first validation and figures, which take seconds

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._install_handlers()  # again: Lightning sets one for SIGTERM in between
        if trainer.global_step == 0:  # what training starts from may stay the best
            self._save_best(trainer, pl_module)

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._begun = True
        if trainer.global_step + 1 == trainer.max_epochs:
            trainer.check_val_every_n_epoch = 1

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        step = trainer.global_step
        if not Run(self.last.parents[1]).exists:  # writing would make another folder
            raise FileNotFoundError(self.last.parents[1])
        if step % self.every == 0 or step == trainer.max_epochs:
            self._save_best(trainer, pl_module)
            self._save_last(trainer)
        # every process stops if one of them was told to
        if trainer.strategy.reduce_boolean_decision(self._signal is not None, all=False):
            self._save_last(trainer)
            name = signal.Signals(self._signal).name if self._signal else "Stop"
            raise Interrupted(f"{name} after step {step}: saved {self.last}.")

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        self._restore_handlers()

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        self._restore_handlers()

    def _save_best(self, trainer: Trainer, module: Any) -> None:
        _flush(trainer)
        for member in module.members:
            own = torch.tensor(member.validation_loss, dtype=torch.float64, device=module.device)
            loss = float(mean_over_processes(own))
            if loss < self.best_loss[member.label]:
                self.best_loss[member.label] = loss
                module.save_member(member, self.best[member.label])

    def _save_last(self, trainer: Trainer) -> None:
        _flush(trainer)
        trainer.save_checkpoint(self.last)
        if trainer.is_global_zero and self._saved is not None:
            self._saved()
            self._saved = None

    def _remember(self, number: int, frame: FrameType | None) -> None:
        if not self._begun:  # while it compiles, or seeks an optimum: there is nothing yet to be saved
            raise Interrupted(f"{signal.Signals(number).name} before the first step.", 130)
        if self._signal is not None:  # the second time, the user means now
            raise Interrupted("Stopped at once; the last checkpoint is from before this step.", exit_status=130)
        self._signal = number

    def _install_handlers(self) -> None:
        for number in (signal.SIGINT, signal.SIGTERM):
            previous = signal.signal(number, self._remember)
            self._previous.setdefault(number, previous)

    def _restore_handlers(self) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous.clear()


def _flush(trainer: Trainer) -> None:
    if trainer.is_global_zero:
        for logger in trainer.loggers:
            logger.save()

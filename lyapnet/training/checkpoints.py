"""The callbacks that save the last and the best checkpoint of a run."""

import math
import signal
from collections.abc import Callable, Mapping
from pathlib import Path
from types import FrameType
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import Checkpoint

from lyapnet.base.errors import Interrupted
from lyapnet.training.learner import number_over_processes
from lyapnet.training.modules import labelled
from lyapnet.training.runs import TrainingRun


class KeptStart(Callback):
    """Saves best.ckpt as soon as the initial V is known, so that an interrupted compilation does not lose it.

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
    """Saves last.ckpt after every validation and on Ctrl-C or SIGTERM, and best.ckpt when the loss is the least so far.

    Logs are written before the checkpoint, so that they are never older than it. (Lightning's ModelCheckpoint writes
    the last checkpoint only together with a best one, and stores absolute paths and its position in an interval.)

    Args:
        last: path of the last checkpoint.
        best: label ↦ each member's best checkpoint.
        every: steps between validations; the last step is always validated and saved.
        saved: called when the last checkpoint is written for the first time in this process.
    """

    def __init__(self, last: Path, best: Mapping[str, Path], every: int, saved: Callable[[], None]):
        super().__init__()
        self.last, self.best, self.every = last, best, every
        self._saved: Callable[[], None] | None = saved
        self.best_loss = dict.fromkeys(best, math.inf)
        self._signal: int | None = None
        self._begun = False  # whether the first step has begun
        self._previous: dict[int, Any] = {}

    def state_dict(self) -> dict[str, Any]:
        return {labelled("best_loss", label): loss for label, loss in self.best_loss.items()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.best_loss = {label: state_dict[labelled("best_loss", label)] for label in self.best_loss}

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        self._install_handlers()  # before the first validation and figures, which take seconds

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._install_handlers()  # again, because Lightning has replaced the handler of SIGTERM
        if trainer.global_step == 0:  # the initial V may remain the best one
            self._save_best(trainer, pl_module)

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._begun = True
        if trainer.global_step + 1 == trainer.max_epochs:
            trainer.check_val_every_n_epoch = 1

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        step = trainer.global_step
        if not TrainingRun(self.last.parents[1]).exists:  # writing would create the removed folder again
            raise FileNotFoundError(self.last.parents[1])
        if step % self.every == 0 or step == trainer.max_epochs:
            self._save_best(trainer, pl_module)
            self._save_last(trainer)
        # all processes stop if one of them has received a signal
        if trainer.strategy.reduce_boolean_decision(self._signal is not None, all=False):
            self._save_last(trainer)
            name = signal.Signals(self._signal).name if self._signal else "Stop"
            raise Interrupted(f"{name} after step {step}: saved {self.last}.")

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        self._restore_handlers()

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        self._restore_handlers()

    def _save_best(self, trainer: Trainer, module: Any) -> None:
        _save_logs(trainer)
        for member in module.members:
            loss = number_over_processes(member.selection_loss, module.device)
            if loss < self.best_loss[member.label]:
                self.best_loss[member.label] = loss
                module.save_member(member, self.best[member.label])

    def _save_last(self, trainer: Trainer) -> None:
        _save_logs(trainer)
        trainer.save_checkpoint(self.last)
        if trainer.is_global_zero and self._saved is not None:
            self._saved()
            self._saved = None

    def _handle(self, number: int, frame: FrameType | None) -> None:
        """Stop after the current step, so that it can be saved; at once before the first step or a second time."""
        if not self._begun:
            raise Interrupted(f"{signal.Signals(number).name} before the first step.", 130)
        if self._signal is not None:
            raise Interrupted("Stopped at once; the last checkpoint is from before this step.", exit_status=130)
        self._signal = number

    def _install_handlers(self) -> None:
        for number in (signal.SIGINT, signal.SIGTERM):
            previous = signal.signal(number, self._handle)
            self._previous.setdefault(number, previous)

    def _restore_handlers(self) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous.clear()


def _save_logs(trainer: Trainer) -> None:
    if trainer.is_global_zero:
        for logger in trainer.loggers:
            logger.save()

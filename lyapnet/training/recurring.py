"""Base class of callbacks that act at the start of a training, every few steps, and at its end."""

from abc import ABC, abstractmethod

from lightning.pytorch import Callback, LightningModule, Trainer


class Recurring(Callback, ABC):
    """Acts before the first step, at validations every `every` steps, and at the last validation.

    A resumed training does not act again at the step where it is resumed.
    """

    def __init__(self, every: int):
        self.every = every

    @abstractmethod
    def act(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Act on the current weights."""

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.global_step == 0:
            self.act(trainer, pl_module)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        step = trainer.global_step
        if step % self.every == 0 or step == trainer.max_epochs:
            self.act(trainer, pl_module)

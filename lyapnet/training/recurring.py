"""What is done now and then during a training: at its start, every few steps, and at its end."""

from abc import ABC, abstractmethod

from lightning.pytorch import Callback, LightningModule, Trainer


class Recurring(Callback, ABC):
    """Acts before the first step, at validations every `every` steps, and at the last validation.

    A resumed training does not act again at the step from which it goes on.
    """

    def __init__(self, every: int):
        self.every = every

    @abstractmethod
    def act(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """What is done, on the weights as they are."""

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.global_step == 0:
            self.act(trainer, pl_module)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        step = trainer.global_step
        if step % self.every == 0 or step == trainer.max_epochs:
            self.act(trainer, pl_module)

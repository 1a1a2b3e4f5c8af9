"""The curves of a training: the measures of each step and validation, sent to Lightning's loggers."""

import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import Logger

from lyapnet.training.learner import Learner


class Stopwatch(Callback):
    """Measures the rollout steps per second of the last training step, gradient included, for each member.

    `seconds` is the CPU time of all training steps so far, including those before an interruption. On a core of its own
    it equals wall-clock time; it does not depend on other processes. Compilation, validations, figures and checkpoints
    do not count.
    """

    def __init__(self) -> None:
        self._started = self._cpu_started = self.seconds = 0.0

    def state_dict(self) -> dict[str, Any]:
        return {"seconds": self.seconds}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.seconds = state_dict["seconds"]

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        self._started, self._cpu_started = time.perf_counter(), time.process_time()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        seconds = time.perf_counter() - self._started
        self.seconds += time.process_time() - self._cpu_started
        for member in members_of(pl_module):
            steps = batch.shape[-2] * member.problem.horizon.steps * trainer.world_size
            member.steps_per_second = steps / seconds


class ScalarLogger(Callback):
    """Logs the curves at every training step, every validation, and one validation before the first step.

    Args:
        stopwatch: measures the time of the training steps.
    """

    def __init__(self, stopwatch: Stopwatch):
        self.stopwatch = stopwatch

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        data = data_of(trainer)
        if trainer.global_step == 0 and data is not None:
            module: Any = pl_module
            module.validate_on(data.validation_batch().to(module.device))
            self._log_validation(trainer, pl_module)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        rate = trainer.optimizers[0].param_groups[0]["lr"]
        for member, loggers in with_loggers(trainer, pl_module):
            if member.output is not None:
                log_scalars(trainer, loggers, {**member.training_scalars(), "learning_rate": rate})

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if not trainer.sanity_checking:
            self._log_validation(trainer, pl_module)

    def _log_validation(self, trainer: Trainer, pl_module: LightningModule) -> None:
        for member, loggers in with_loggers(trainer, pl_module):
            seconds = {"training_seconds": self.stopwatch.seconds}
            log_scalars(trainer, loggers, {**member.validation_scalars(), **seconds})


def log_scalars(trainer: Trainer, loggers: Sequence[Logger], scalars: Mapping[str, Any]) -> None:
    """Add a point to each curve; only the first process logs."""
    if trainer.is_global_zero:
        values = {name: float(value) for name, value in scalars.items()}
        for logger in loggers:
            logger.log_metrics(values, trainer.global_step)


def loggers_of_each(trainer: Trainer, pl_module: LightningModule) -> list[list[Logger]]:
    """The loggers of each member. The trainer lists them member by member, the same number for each."""
    members = len(members_of(pl_module))
    each = len(trainer.loggers) // members
    return [trainer.loggers[k * each : (k + 1) * each] for k in range(members)]


def with_loggers(trainer: Trainer, pl_module: LightningModule) -> Iterator[tuple[Learner, Sequence[Logger]]]:
    """Each member and the loggers of its curves."""
    return zip(members_of(pl_module), loggers_of_each(trainer, pl_module), strict=True)


def members_of(pl_module: LightningModule) -> Sequence[Learner]:
    """The learners of a TrainingModule."""
    module: Any = pl_module
    return list(module.members)


def data_of(trainer: Trainer) -> Any:
    """The InitialStateDataModule of a training; None if the user passed data loaders."""
    untyped: Any = trainer
    return untyped.datamodule

"""What is shown, logged and saved, and when."""

import math
import signal
import textwrap
import time
import warnings
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import Checkpoint, ProgressBar
from lightning.pytorch.loggers import TensorBoardLogger
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Column
from torch.utils.tensorboard.writer import SummaryWriter

from lyapnet import figures
from lyapnet.config import to_yaml
from lyapnet.errors import DivergenceError, Interrupted
from lyapnet.modules import ProgramModule
from lyapnet.randomness import FIGURES, stream

LAST, BEST = "last", "best"

# the paper's panels: constraint loss beside trajectory cost
LAYOUT = {
    "lyapnet": {
        "constraint loss": ["Multiline", ["constraint_loss/train", "constraint_loss/val"]],
        "trajectory cost": ["Multiline", ["trajectory_cost/train", "trajectory_cost/val"]],
        "optimality gap and value error": ["Multiline", ["optimality_gap/val", "value_error/val"]],
        "satisfied and decreasing": ["Multiline", ["satisfied_fraction/val", "decreasing_fraction/val"]],
    }
}


class Stopwatch(Callback):
    """Tells the module how many rollout steps per second the last training step made, gradient included."""

    def __init__(self) -> None:
        self._started = 0.0

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        self._started = time.perf_counter()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        module = _program_module(pl_module)
        steps = len(batch) * module.task.horizon.steps * trainer.world_size
        module.steps_per_second = steps / (time.perf_counter() - self._started)


class ScalarLogger(Callback):
    """Writes the curves: every training step, every validation, and one validation before the first step."""

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.global_step == 0:
            module = _program_module(pl_module)
            writer(trainer).add_custom_scalars(LAYOUT)
            writer(trainer).add_text("config", textwrap.indent(to_yaml(module.config), "    "))
            with torch.no_grad():
                states = next(iter(trainer.datamodule.val_dataloader())).to(module.device)  # pyright: ignore
                module.validate_on(states)
            self._log_validation(trainer, module)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        module = _program_module(pl_module)
        _log(
            trainer,
            {
                "loss/train": outputs["loss"].detach(),
                **{f"term/{name}": value for name, value in outputs["terms"].items()},
                "constraint_loss/train": outputs["constraint_loss"],
                "trajectory_cost/train": outputs["trajectory_cost"],
                "gradient_norm": module.gradient_norm,
                "learning_rate": trainer.optimizers[0].param_groups[0]["lr"],
                "rollout_steps_per_second": module.steps_per_second,
            },
        )

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._log_validation(trainer, _program_module(pl_module))

    @staticmethod
    def _log_validation(trainer: Trainer, module: ProgramModule) -> None:
        assert module.validation is not None
        summary = module.validation.summary()
        names = {
            "constraint_loss/val": summary["constraint_loss"],
            "trajectory_cost/val": summary["cost_mean"],
            "optimality_gap/val": None if summary["cost_ratio"] is None else summary["cost_ratio"] - 1,
            "value_error/val": summary["value_error"],
            "value_to_cost/val": summary["value_to_cost"],
            "satisfied_fraction/val": summary["satisfied_fraction"],
            "bounded_fraction/val": summary["bounded_fraction"],
            "decreasing_fraction/val": summary["decreasing_fraction"],
            "terminal_error/val": summary["terminal_error"],
        }
        _log(trainer, {name: value for name, value in names.items() if value is not None})


class FigureLogger(Callback):
    """Draws the certified region, some trajectories and slices of V during training.

    Args:
        every: steps between drawings; the last validation always draws.
    """

    def __init__(self, every: int):
        self.every = every

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.global_step == 0:
            self._draw(trainer, _program_module(pl_module))

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        step = trainer.global_step
        if step % self.every == 0 or step == trainer.max_epochs:
            self._draw(trainer, _program_module(pl_module))

    def _draw(self, trainer: Trainer, module: ProgramModule) -> None:
        if not trainer.is_global_zero:
            return
        try:
            drawn = self._figures(module)
        except DivergenceError as error:  # from a corner of X₀ that no batch has met yet: no reason to stop training
            warnings.warn(f"No figures at step {trainer.global_step}: {error}", stacklevel=1)
            return
        for name, figure in drawn.items():
            writer(trainer).add_image(name, _pixels(figure), trainer.global_step, dataformats="HWC")

    @staticmethod
    def _figures(module: ProgramModule) -> dict[str, Figure]:
        system, _, initial_states, horizon = module.task
        x0 = initial_states.sample(12, stream(module.config.seed, FIGURES))
        with torch.no_grad():
            sample = module.closed_loop(x0)
        return {
            "certified_region": figures.certified_region(module.V, module.closed_loop, system, initial_states),
            "trajectories": figures.trajectories(module.V, sample, system),
            "value_slices": figures.value_slices(module.V, system, initial_states, horizon.duration),
        }


class Checkpoints(Checkpoint):
    """last.ckpt after every validation, best.ckpt where loss/val is least, and last.ckpt on Ctrl-C and SIGTERM.

    The event file is flushed first, so that it is never behind the checkpoint. (Lightning's ModelCheckpoint writes its
    last checkpoint only together with a best one, remembers absolute paths, and its position within an interval.)

    Args:
        folder: where both files go.
        every: steps between validations; the last step is validated and saved whether a multiple or not.
    """

    def __init__(self, folder: Path, every: int):
        super().__init__()
        self.folder, self.every = folder, every
        self.best_loss = math.inf
        self._signal: int | None = None
        self._previous: dict[int, Any] = {}

    def state_dict(self) -> dict[str, Any]:
        return {"best_loss": self.best_loss}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.best_loss = state_dict["best_loss"]

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        self._install_handlers()  # before the first validation and figures, which take seconds

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._install_handlers()  # again: Lightning sets one for SIGTERM in between

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.global_step + 1 == trainer.max_epochs:
            trainer.check_val_every_n_epoch = 1

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        step = trainer.global_step
        if step % self.every == 0 or step == trainer.max_epochs:
            loss = float(trainer.callback_metrics["loss/val"])
            if loss < self.best_loss:
                self.best_loss = loss
                self._save(trainer, BEST)
            self._save(trainer, LAST)
        # every process stops if one of them was told to
        if trainer.strategy.reduce_boolean_decision(self._signal is not None, all=False):
            path = self._save(trainer, LAST)
            name = signal.Signals(self._signal).name if self._signal else "Stop"
            raise Interrupted(f"{name} after step {step}: saved {path}.")

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        self._restore_handlers()

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        self._restore_handlers()

    def _save(self, trainer: Trainer, name: str) -> Path:
        path = self.folder / f"{name}.ckpt"
        writer(trainer).flush()
        trainer.save_checkpoint(path)
        return path

    def _remember(self, number: int, frame: FrameType | None) -> None:
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


class TrainingProgress(ProgressBar):
    """A line for each validation, and below them in a terminal: step, loss, cost, speed, time left."""

    def __init__(self, console: Console):
        super().__init__()
        self._console, self._progress, self._task = console, None, None

    def disable(self) -> None:
        self._enabled = False

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if not trainer.is_global_zero:
            return
        self._progress = Progress(
            MofNCompleteColumn(),
            BarColumn(bar_width=None),
            TextColumn("{task.description}", table_column=Column(no_wrap=True)),
            TimeRemainingColumn(elapsed_when_finished=True),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self._task = self._progress.add_task("…", total=trainer.max_epochs, completed=trainer.global_step)
        self._progress.start()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        if self._progress is None or self._task is None:
            return
        module = _program_module(pl_module)
        loss, cost = float(outputs["loss"]), float(outputs["trajectory_cost"])
        line = f"loss {loss:.4g}  cost {cost:.4g}  {module.steps_per_second:,.0f} rollout steps/s"
        self._progress.update(self._task, completed=trainer.global_step, description=line)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        module = _program_module(pl_module)
        if self._progress is None or module.validation is None:
            return
        summary = module.validation.summary()
        ratio = "" if summary["cost_ratio"] is None else f"  cost/optimum {summary['cost_ratio']:.4f}"
        self._console.print(
            f"step {trainer.global_step}/{trainer.max_epochs}  cost {summary['cost_mean']:.4g}{ratio}  "
            f"constraint loss {summary['constraint_loss']:.3g}  satisfied {summary['satisfied_fraction']:.0%}",
            soft_wrap=True,
        )

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        self._stop()

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        self._stop()

    def _stop(self) -> None:
        if self._progress is not None:  # gives the cursor back to the terminal
            self._progress.stop()
            self._progress = None


def writer(trainer: Trainer) -> SummaryWriter:
    """TensorBoard's writer of the run."""
    assert isinstance(trainer.logger, TensorBoardLogger)
    return trainer.logger.experiment


def _log(trainer: Trainer, scalars: dict[str, Any]) -> None:
    if trainer.is_global_zero:
        for name, value in scalars.items():
            writer(trainer).add_scalar(name, float(value), trainer.global_step)


def _program_module(module: LightningModule) -> ProgramModule:
    assert isinstance(module, ProgramModule)
    return module


def _pixels(figure: Figure):
    """The figure as an array (height, width, 4) of bytes."""
    canvas = FigureCanvasAgg(figure)
    figure.set_dpi(110)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())

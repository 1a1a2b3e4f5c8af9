"""What is shown, logged and saved, and when."""

import math
import signal
import textwrap
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import fmean
from types import FrameType
from typing import Any, TypeVar

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import Checkpoint, ProgressBar
from lightning.pytorch.loggers import TensorBoardLogger
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Column
from torch import Tensor
from torch.utils.tensorboard.writer import SummaryWriter

from lyapnet import figures
from lyapnet.compilation import cache_folder, has_compiler
from lyapnet.config import to_yaml
from lyapnet.data import InitialStateDataModule
from lyapnet.errors import CompilationError, DivergenceError, Interrupted, OracleError, UntraceableError
from lyapnet.modules import ProgramModule, TrainedModule, labelled
from lyapnet.oracles import Report, oracle_of
from lyapnet.randomness import FIGURES, stream

# the line of a validation: name, key of the summary, format
VALIDATED = (
    ("cost", "cost_mean", ".4g"),
    ("cost/optimum", "cost_ratio", ".4f"),
    ("constraint loss", "constraint_loss", ".3g"),
    ("satisfied", "satisfied_fraction", ".0%"),
)

# the paper's panels: constraint loss beside trajectory cost
LAYOUT = {
    "lyapnet": {
        "constraint loss": ["Multiline", ["constraint_loss/train", "constraint_loss/val"]],
        "trajectory cost": ["Multiline", ["trajectory_cost/train", "trajectory_cost/val"]],
        "optimality gap and value error": ["Multiline", ["optimality_gap/val", "value_error/val"]],
        "satisfied and decreasing": ["Multiline", ["satisfied_fraction/val", "decreasing_fraction/val"]],
    }
}


class Compilation(Callback):
    """Compiles the closed loop and its gradient before the first step, where that pays, and says so.

    Args:
        console: where it is said.
        batch_size: initial states in a training batch.
        wanted: whether to compile in any case; else only what is on disk already.
        record: hears that the run is compiled, and in how many seconds.
    """

    def __init__(self, console: Console, batch_size: int, wanted: bool, record: Callable[..., None]):
        self.console, self.batch_size, self.wanted, self.record = console, batch_size, wanted, record

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        module = trained_module(pl_module)
        try:
            on_disk = module.compiled_before(self.batch_size)
            if on_disk or self.wanted:
                self._compile(trainer, module, on_disk)
        except UntraceableError:  # which says so itself, where it runs as it is written
            return
        except CompilationError as error:
            self._say(trainer, f"{error}; running without compilation.")

    def _compile(self, trainer: Trainer, module: TrainedModule, on_disk: bool) -> None:
        if not on_disk and has_compiler():
            self._say(trainer, "compiling the closed loop and its gradient, once for this task and machine …")
        started = time.perf_counter()
        module.compile_for(self.batch_size)
        verb, seconds = "loaded" if on_disk else "compiled", time.perf_counter() - started
        self._say(trainer, f"{verb} machine code in {seconds:.0f} s, kept in {cache_folder()}")
        if trainer.is_global_zero:
            self.record(compiled=True, compilation_seconds=round(seconds, 2))

    def _say(self, trainer: Trainer, line: str) -> None:
        if trainer.is_global_zero:
            self.console.print(line, soft_wrap=True)


class ValidationOptimum(Callback):
    """Finds the optimum of the validation states before the first step, and says so.

    A checkpoint keeps it, so that a run is compared with the same numbers to its end, whatever the cache has by then.

    Args:
        console: where it is said.
    """

    def __init__(self, console: Console):
        self.console = console
        self.cost: Tensor | None = None  # (members, b)

    def state_dict(self) -> dict[str, Any]:
        return {} if self.cost is None else {"cost": self.cost}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.cost = state_dict.get("cost")

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        module = trained_module(pl_module)
        if self.cost is None and module.config.evaluation.optimum:
            states = _data(trainer).validation_batch()
            found = self._solve(module.members[0], states) if trainer.is_global_zero else None
            self.cost = trainer.strategy.broadcast(found)
        if self.cost is not None:
            for member, cost in zip(module.members, self.cost.to(module.device), strict=True):
                member.validation_optimum = cost

    def _solve(self, member: ProgramModule, states: Tensor) -> Tensor | None:
        """J* (members, b) of states (members, b, n), or (1, b) of (b, n); None where there is no oracle."""
        system, cost, _, horizon = member.task
        started = time.perf_counter()
        try:
            with optimum_progress(self.console) as progress:
                oracle = oracle_of(system, cost, horizon, member.config.rollout.method)
                optima = oracle.solve(states.flatten(0, -2), progress=progress)
        except OracleError as error:
            self.console.print(f"no optimum to compare with: {error}", soft_wrap=True, markup=False)
            return None
        seconds, missing = time.perf_counter() - started, ""
        if optima.failures:
            missing = f"; unknown for {optima.failures}, which are left out"
        if missing or seconds > 0.2:  # else nobody waits for it
            mean = f"mean {optima.cost.nanmean():.4g}, in {seconds:.0f} s"
            self.console.print(f"optimum of {len(optima.cost)} validation states: {mean}{missing}", soft_wrap=True)
        return optima.cost.cpu().reshape(-1, states.shape[-2])


@contextmanager
def optimum_progress(console: Console) -> Iterator[Report]:
    """A line in a terminal that says how far an oracle is."""
    with console.status("optimum …") as status:
        yield lambda done, total: status.update(f"optimum: {done} of {total} initial states")


class Stopwatch(Callback):
    """Tells each member how many rollout steps per second the last training step made, gradient included.

    `seconds` is what all training steps took so far, before an interruption too, in CPU time of the process: on a core
    of its own that is wall-clock time, and it does not depend on what else the machine does. Neither compilation nor
    validations, figures and checkpoints count.
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
        module = trained_module(pl_module)
        seconds = time.perf_counter() - self._started
        self.seconds += time.process_time() - self._cpu_started
        for member in module.members:
            steps = batch.shape[-2] * member.task.horizon.steps * trainer.world_size
            member.steps_per_second = steps / seconds


class ScalarLogger(Callback):
    """Writes the curves: every training step, every validation, and one validation before the first step.

    Args:
        stopwatch: tells how long the training steps took.
    """

    def __init__(self, stopwatch: Stopwatch):
        self.stopwatch = stopwatch

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.global_step == 0:
            module = trained_module(pl_module)
            for member, curves in with_writers(trainer, module):
                curves.add_custom_scalars(LAYOUT)
                curves.add_text("config", textwrap.indent(to_yaml(member.config), "    "))
            with torch.no_grad():
                states = _data(trainer).validation_batch().to(module.device)
                module.validate_on(states)
            self._log_validation(trainer, module)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        for member, curves in with_writers(trainer, trained_module(pl_module)):
            output = _shown(member.output)
            scalars = {
                "loss/train": output.loss,
                **{f"term/{name}": value for name, value in output.terms.items()},
                "constraint_loss/train": output.constraint_loss,
                "trajectory_cost/train": output.trajectory_cost,
                "gradient_norm": member.gradient_norm,
                "learning_rate": trainer.optimizers[0].param_groups[0]["lr"],
                "rollout_steps_per_second": member.steps_per_second,
            }
            log_scalars(trainer, curves, scalars)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._log_validation(trainer, trained_module(pl_module))

    def _log_validation(self, trainer: Trainer, module: TrainedModule) -> None:
        for member, curves in with_writers(trainer, module):
            summary = _shown(member.validation).summary()
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
                "training_seconds": self.stopwatch.seconds,
            }
            log_scalars(trainer, curves, {name: value for name, value in names.items() if value is not None})


class FigureLogger(Callback):
    """Draws the certified region, some trajectories and slices of V during training: the first member's.

    Args:
        every: steps between drawings; the last validation always draws.
    """

    def __init__(self, every: int):
        self.every = every

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.global_step == 0:
            self._draw(trainer, trained_module(pl_module))

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        step = trainer.global_step
        if step % self.every == 0 or step == trainer.max_epochs:
            self._draw(trainer, trained_module(pl_module))

    def _draw(self, trainer: Trainer, module: TrainedModule) -> None:
        if not trainer.is_global_zero:
            return
        member, pictures = next(with_writers(trainer, module))
        try:
            drawn = self._figures(member)
        except DivergenceError as error:  # from a corner of X₀ that no batch has met yet: no reason to stop training
            warnings.warn(f"No figures at step {trainer.global_step}: {error}", stacklevel=1)
            return
        for name, figure in drawn.items():
            pictures.add_image(name, figures.pixels(figure), trainer.global_step, dataformats="HWC")

    @staticmethod
    def _figures(module: ProgramModule) -> dict[str, Figure]:
        system, _, initial_states, horizon = module.task
        x0 = initial_states.sample(12, stream(module.config.seed, FIGURES))
        with torch.no_grad():
            sample = module.closed_loop(x0)
        return {
            "certified_region": figures.certified_region(module.closed_loop, system, initial_states),
            "trajectories": figures.trajectories(sample, system),
            "value_slices": figures.value_slices(module.V, system, initial_states, horizon.duration),
        }


class Checkpoints(Checkpoint):
    """last.ckpt after every validation, best.ckpt where loss/val is least, and last.ckpt on Ctrl-C and SIGTERM.

    The event files are flushed first, so that they are never behind the checkpoint. (Lightning's ModelCheckpoint writes
    its last checkpoint only together with a best one, remembers absolute paths, and its position within an interval.)

    Args:
        last: the checkpoint of the whole run.
        best: label ↦ each member's best checkpoint.
        every: steps between validations; the last step is validated and saved whether a multiple or not.
    """

    def __init__(self, last: Path, best: Mapping[str, Path], every: int):
        super().__init__()
        self.last, self.best, self.every = last, best, every
        self.best_loss = dict.fromkeys(best, math.inf)
        self._signal: int | None = None
        self._previous: dict[int, Any] = {}

    def state_dict(self) -> dict[str, Any]:
        return {labelled("best_loss", label): loss for label, loss in self.best_loss.items()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.best_loss = {label: state_dict[labelled("best_loss", label)] for label in self.best_loss}

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
            self._save_best(trainer, trained_module(pl_module))
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

    def _save_best(self, trainer: Trainer, module: TrainedModule) -> None:
        _flush(trainer)
        for member, label in zip(module.members, module.labels, strict=True):
            loss = float(trainer.callback_metrics[labelled("loss/val", label)])
            if loss < self.best_loss[label]:
                self.best_loss[label] = loss
                module.save_member(member, self.best[label])

    def _save_last(self, trainer: Trainer) -> None:
        _flush(trainer)
        trainer.save_checkpoint(self.last)

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
        members = trained_module(pl_module).members
        loss = fmean(float(_shown(member.output).loss) for member in members)
        cost = fmean(float(_shown(member.output).trajectory_cost) for member in members)
        speed = sum(member.steps_per_second for member in members)
        line = f"loss {loss:.4g}  cost {cost:.4g}  {speed:,.0f} rollout steps/s"
        self._progress.update(self._task, completed=trainer.global_step, description=line)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self._progress is None:
            return
        summaries = [_shown(member.validation).summary() for member in trained_module(pl_module).members]
        measures = [f"{name} {text}" for name, key, form in VALIDATED if (text := mean_and_range(summaries, key, form))]
        self._console.print(f"step {trainer.global_step}/{trainer.max_epochs}  {'  '.join(measures)}", soft_wrap=True)

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        self._stop()

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        self._stop()

    def _stop(self) -> None:
        if self._progress is not None:  # gives the cursor back to the terminal
            self._progress.stop()
            self._progress = None


def mean_and_range(summaries: Sequence[Mapping[str, Any]], key: str, form: str) -> str:
    """A measure's mean over the seeds and, of several, its range; nothing where it is not known."""
    values = [summary[key] for summary in summaries]
    if None in values:
        return ""
    mean, low, high = (format(value, form) for value in (fmean(values), min(values), max(values)))
    return mean if len(values) == 1 else f"{mean} ({low} – {high})"


def with_writers(trainer: Trainer, module: TrainedModule) -> Iterator[tuple[ProgramModule, SummaryWriter]]:
    """Each member and TensorBoard's writer of its curves."""
    return zip(module.members, _writers(trainer), strict=True)


def _writers(trainer: Trainer) -> list[SummaryWriter]:
    loggers = [logger for logger in trainer.loggers if isinstance(logger, TensorBoardLogger)]
    return [logger.experiment for logger in loggers]


def _flush(trainer: Trainer) -> None:
    for curves in _writers(trainer):
        curves.flush()


def log_scalars(trainer: Trainer, curves: SummaryWriter, scalars: Mapping[str, Any]) -> None:
    """Add a point to each curve, in the first process."""
    if trainer.is_global_zero:
        for name, value in scalars.items():
            curves.add_scalar(name, float(value), trainer.global_step)


T = TypeVar("T")


def _shown(record: T | None) -> T:
    """What a member keeps of its last step or validation, once there was one."""
    assert record is not None
    return record


def _data(trainer: Trainer) -> InitialStateDataModule:
    data: Any = trainer
    return data.datamodule


def trained_module(module: LightningModule) -> TrainedModule:
    """The module as what it is here."""
    assert isinstance(module, TrainedModule)
    return module

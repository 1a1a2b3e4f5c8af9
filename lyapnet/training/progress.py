"""The callback that shows the progress of a training."""

from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import ProgressBar
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Column

from lyapnet.evaluation.states import StateTable
from lyapnet.training.curves import members_of
from lyapnet.training.stage_messages import StageMessages

# columns of a validation's line: name, key of the summary, format
VALIDATED = (
    ("cost", "cost_mean", ".4g"),
    ("cost/optimum", "cost_ratio", ".4f"),
    ("worst", "worst_ratio", ".3g"),
    ("regret", "regret", ".2%"),
    ("constraint loss", "constraint_loss", ".3g"),
    ("satisfied", "satisfied_fraction", ".0%"),
)


class TrainingProgress(ProgressBar):
    """Prints a line for each validation, and shows step, loss, cost and speed: in a terminal as a bar, else as lines.

    The bar also shows the remaining time.

    Args:
        stages: shows the work before the first step, and the steps if there is no terminal.
    """

    def __init__(self, stages: StageMessages):
        super().__init__()
        self._stages, self._console, self._progress, self._task = stages, stages.console, None, None
        self._named = False  # whether the states of the validation means were described

    def disable(self) -> None:
        self._enabled = False

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        if trainer.is_global_zero:
            self._stages.__enter__()("preparing the first step")

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if not trainer.is_global_zero:
            return
        self._progress = Progress(
            MofNCompleteColumn(),
            BarColumn(bar_width=None),
            TextColumn("{task.description}", markup=False, table_column=Column(no_wrap=True)),
            TimeRemainingColumn(elapsed_when_finished=True),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self._task = self._progress.add_task("…", total=trainer.max_epochs, completed=trainer.global_step)
        if self._console.is_terminal:  # the bar replaces it
            self._stages.rest()
        self._progress.start()
        self._log(f"step {trainer.global_step} of {trainer.max_epochs}")

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        if self._progress is None or self._task is None:
            return
        members = members_of(pl_module)
        outputs = [member.output for member in members if member.output is not None]
        loss = fmean(float(output.loss) for output in outputs)
        cost = fmean(float(output.trajectory_cost) for output in outputs)
        speed = sum(member.steps_per_second for member in members)
        line = f"loss {loss:.4g}, cost {cost:.4g} of its batch  {speed:,.0f} rollout steps/s"
        self._progress.update(self._task, completed=trainer.global_step, total=trainer.max_epochs, description=line)
        self._log(f"step {trainer.global_step} of {trainer.max_epochs}", line)

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._log(f"validation at step {trainer.global_step}")

    def _log(self, stage: str, detail: str = "") -> None:
        """Show a stage if there is no bar."""
        if self._progress is not None and not self._console.is_terminal:
            self._stages(stage, detail=detail)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self._progress is None:
            return
        if not self._console.is_terminal:
            self._stages.rest()
        members = members_of(pl_module)
        tables = [member.validation for member in members]
        if not self._named:
            self._named = True
            self._console.print(
                describe_validation_states([table for table in tables if table is not None]), soft_wrap=True
            )
        summaries = [table.summary() for table in tables if table is not None]
        measures = [f"{name} {text}" for name, key, form in VALIDATED if (text := mean_and_range(summaries, key, form))]
        shares = [float(member.region_share) for member in members if member.region_share is not None]
        if shares:
            measures.append(f"region {fmean(shares):.1%} of D")
        self._console.print(f"step {trainer.global_step}/{trainer.max_epochs}  {'  '.join(measures)}", soft_wrap=True)

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        self._stop()

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        self._stop()

    def _stop(self) -> None:
        if self._progress is not None:  # also shows the cursor again
            self._progress.stop()
            self._progress = None
        self._stages.__exit__()


def describe_validation_states(tables: Sequence[StateTable]) -> str:
    """Describe the states over which validations take means."""
    states = sum(len(table.cost) for table in tables)
    optima = [table.optimal_cost for table in tables if table.optimal_cost is not None]
    known = sum(int(optimum.isfinite().sum()) for optimum in optima)
    measure = "cost/optimum" if tables[0].has_goal else "regret"
    fewer = f"; {measure} over the {known} of them whose optimum is known" if 0 < known < states else ""
    return f"below: means over {states} validation states, the same at every step{fewer}"


def mean_and_range(summaries: Sequence[Mapping[str, Any]], key: str, form: str) -> str:
    """Format a measure's mean over the seeds and, for several seeds, its range; empty if unknown."""
    values = [summary[key] for summary in summaries if summary.get(key) is not None]
    if len(values) < len(summaries):
        return ""
    mean, low, high = (format(value, form) for value in (fmean(values), min(values), max(values)))
    return mean if len(values) == 1 else f"{mean} ({low} – {high})"

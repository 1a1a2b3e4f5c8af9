"""The loggers of a run: always metrics.csv, and those that the config names."""

import importlib
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lightning.pytorch.loggers import Logger, MLFlowLogger, TensorBoardLogger, WandbLogger

from lyapnet.base.errors import UsageError
from lyapnet.experiment.config import Config, abridge_texts, to_plain
from lyapnet.training.metrics_file import METRICS, MetricsFile
from lyapnet.training.runs import TrainingRun


def require_libraries(names: Sequence[str]) -> None:
    """Check that the libraries of the loggers are installed.

    Raises:
        UsageError: a library is missing.
    """
    for name in names:
        try:
            importlib.import_module(LIBRARIES.get(name, "lightning"))
        except ImportError as error:
            line = f"Expected {name} for loggers=[{name}], got none ({error}); pip install {name}."
            raise UsageError(line) from error


@contextmanager
def without_writer_tracebacks() -> Iterator[None]:
    """Suppress the traceback of TensorBoard's thread if its file cannot be written; the next step raises that error."""
    before = threading.excepthook

    def without_writers(raised: Any) -> None:
        if not (type(raised.thread).__module__.startswith("tensorboard") and issubclass(raised.exc_type, OSError)):
            before(raised)

    threading.excepthook = without_writers
    try:
        yield
    finally:
        threading.excepthook = before


def loggers_of_run(config: Config, run: TrainingRun, resumed_at: int | None) -> list[Logger]:
    """The loggers of one seed's curves.

    Args:
        run: the run of that seed.
        resumed_at: the step at which the run is resumed; None for a new run.
    """
    return [
        MetricsFile(run.folder),
        *(LOGGERS[name](config, run, resumed_at) for name in config.loggers if name in LOGGERS),
    ]


def drop_logs_after(run: TrainingRun, step: int | None) -> None:
    """Remove logs after a step from a run's folder, or all logs if the step is None; and hparams.yaml.

    TensorBoard keeps all event files of a resumed run; its next file says from which step earlier values are dropped.
    """
    (run.folder / TensorBoardLogger.NAME_HPARAMS_FILE).unlink(
        missing_ok=True
    )  # is written again from the current config
    if step is not None:
        MetricsFile(run.folder).drop_after(step)
        return
    for path in (run.folder / METRICS, *run.folder.glob("events.out.tfevents.*")):
        path.unlink(missing_ok=True)


def log_result(loggers: Sequence[Logger], config: Config, result: dict[str, Any], step: int) -> None:
    """Log the evaluation at the end of a training, with the config where a logger compares runs, and close the logger.

    It is logged one step after the last one, so that a resumed run removes it together with other later values.
    """
    metrics = {f"hp/{key}": value for key, value in result.items() if isinstance(value, float)}
    for logger in loggers:
        if isinstance(logger, TensorBoardLogger):
            logger.log_hyperparams(to_plain(abridge_texts(config)), metrics, step=step + 1)
        elif not isinstance(logger, MetricsFile):  # evaluation.json has these numbers
            logger.log_metrics(metrics, step + 1)
        logger.finalize("success")
        if isinstance(logger, WandbLogger):
            logger.experiment.finish()


def _tensorboard(config: Config, run: TrainingRun, resumed_at: int | None) -> Logger:
    # Each process writes its first step into its event file. TensorBoard then drops this step and later ones from
    # earlier files. It treats the second file as a restart only if the first one has such a mark too.
    first = 0 if resumed_at is None else resumed_at + 1
    folder = run.folder
    logger = TensorBoardLogger(folder.parent, name="", version=folder.name, default_hp_metric=False, purge_step=first)
    logger.hparams = to_plain(abridge_texts(config))  # written to hparams.yaml by its first `save`
    return logger


def _wandb(config: Config, run: TrainingRun, resumed_at: int | None) -> Logger:
    # a new record, even if this process already has records of other seeds or trainings
    options = {"project": config.experiment, "save_dir": run.folder, "reinit": "create_new"}
    return WandbLogger(name=_name(config, run, resumed_at), **options)


def _mlflow(config: Config, run: TrainingRun, resumed_at: int | None) -> Logger:
    logs, name = Path(config.logs).resolve(), _name(config, run, resumed_at)
    tracking_uri = os.environ.get("MLFLOW_TRACKING_URI", f"sqlite:///{logs / 'mlflow.db'}")
    return MLFlowLogger(config.experiment, name, tracking_uri=tracking_uri, artifact_location=str(logs / "mlruns"))


def _name(config: Config, run: TrainingRun, resumed_at: int | None) -> str:
    """The name of a run in loggers that make one record for each process."""
    folder = run.folder
    name = folder.name if config.seeds == 1 else f"{folder.parent.name}/{folder.name}"
    return name if resumed_at is None else f"{name} from step {resumed_at}"


LOGGERS: dict[str, Callable[[Config, TrainingRun, int | None], Logger]] = {
    "tensorboard": _tensorboard, "wandb": _wandb, "mlflow": _mlflow,
}  # fmt: skip
LIBRARIES = {"wandb": "wandb", "mlflow": "mlflow"}

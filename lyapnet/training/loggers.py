"""The loggers of a run: metrics.csv always, and what the config names."""

import importlib
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lightning.pytorch.loggers import Logger, MLFlowLogger, TensorBoardLogger, WandbLogger

from lyapnet.base.errors import UsageError
from lyapnet.experiment.config import Config, to_plain
from lyapnet.training.metrics_file import METRICS, MetricsFile
from lyapnet.training.runs import Run


def require_libraries(names: Sequence[str]) -> None:
    """Refuse loggers whose library is missing.

    Raises:
        UsageError: naming it.
    """
    for name in names:
        try:
            importlib.import_module(LIBRARIES.get(name, "lightning"))
        except ImportError as error:
            line = f"Expected {name} for loggers=[{name}], got none ({error}); pip install {name}."
            raise UsageError(line) from error


@contextmanager
def quiet_writers() -> Iterator[None]:
    """No traceback of TensorBoard's thread where its file cannot be written: the next step meets the same error."""
    before = threading.excepthook

    def without_writers(raised: Any) -> None:
        if not (type(raised.thread).__module__.startswith("tensorboard") and issubclass(raised.exc_type, OSError)):
            before(raised)

    threading.excepthook = without_writers
    try:
        yield
    finally:
        threading.excepthook = before


def loggers_of_run(config: Config, run: Run, resumed_at: int | None) -> list[Logger]:
    """The loggers of one seed's curves.

    Args:
        run: of that seed.
        resumed_at: the step from which the run goes on, if it does.
    """
    return [
        MetricsFile(run.folder),
        *(LOGGERS[name](config, run, resumed_at) for name in config.loggers if name in LOGGERS),
    ]


def take_back_after(run: Run, step: int | None) -> None:
    """Remove from a run's folder what it logged after a step, everything if it stands where it began, and hparams.yaml.

    TensorBoard keeps all event files of a resumed run: the next one tells it what to purge.
    """
    (run.folder / TensorBoardLogger.NAME_HPARAMS_FILE).unlink(missing_ok=True)  # written anew, with what was changed
    if step is not None:
        MetricsFile(run.folder).drop_after(step)
        return
    for path in (run.folder / METRICS, *run.folder.glob("events.out.tfevents.*")):
        path.unlink(missing_ok=True)


def log_result(loggers: Sequence[Logger], config: Config, result: dict[str, Any], step: int) -> None:
    """Show the evaluation at the end of a training, beside the config where a logger compares runs, and close.

    It counts as logged one step after the last: with whatever else is later than its checkpoint, a run that goes on
    takes it back.
    """
    metrics = {f"hp/{key}": value for key, value in result.items() if isinstance(value, float)}
    for logger in loggers:
        if isinstance(logger, TensorBoardLogger):
            logger.log_hyperparams(to_plain(config), metrics, step=step + 1)
        elif not isinstance(logger, MetricsFile):  # evaluation.json lies beside that one
            logger.log_metrics(metrics, step + 1)
        logger.finalize("success")
        if isinstance(logger, WandbLogger):
            logger.experiment.finish()


def _tensorboard(config: Config, run: Run, resumed_at: int | None) -> Logger:
    # Each process opens an event file with a mark of its first step, at which TensorBoard drops what the files before
    # have of it and of later ones; the mark of the first process makes the second one's count as a restart.
    first = 0 if resumed_at is None else resumed_at + 1
    folder = run.folder
    logger = TensorBoardLogger(folder.parent, name="", version=folder.name, default_hp_metric=False, purge_step=first)
    logger.hparams = to_plain(config)  # what its first `save` writes to hparams.yaml
    return logger


def _wandb(config: Config, run: Run, resumed_at: int | None) -> Logger:
    # a new record, although other seeds or earlier trainings of this process have one
    options = {"project": config.experiment, "save_dir": run.folder, "reinit": "create_new"}
    return WandbLogger(name=_name(config, run, resumed_at), **options)


def _mlflow(config: Config, run: Run, resumed_at: int | None) -> Logger:
    logs, name = Path(config.logs).resolve(), _name(config, run, resumed_at)
    where = os.environ.get("MLFLOW_TRACKING_URI", f"sqlite:///{logs / 'mlflow.db'}")
    return MLFlowLogger(config.experiment, name, tracking_uri=where, artifact_location=str(logs / "mlruns"))


def _name(config: Config, run: Run, resumed_at: int | None) -> str:
    """What a run is called where each process leaves a record of its own."""
    folder = run.folder
    name = folder.name if config.seeds == 1 else f"{folder.parent.name}/{folder.name}"
    return name if resumed_at is None else f"{name} from step {resumed_at}"


LOGGERS: dict[str, Callable[[Config, Run, int | None], Logger]] = {
    "tensorboard": _tensorboard, "wandb": _wandb, "mlflow": _mlflow,
}  # fmt: skip
LIBRARIES = {"wandb": "wandb", "mlflow": "mlflow"}

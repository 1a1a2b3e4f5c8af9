"""What the section `trainer` of a config may hand to lightning.Trainer."""

import inspect
import logging
import warnings
from typing import Any

import lightning as L
from lightning.fabric.utilities.exceptions import MisconfigurationException

from lyapnet.config import Config
from lyapnet.errors import UsageError, did_you_mean

TRAINER_OPTIONS = (
    "accelerator", "strategy", "devices", "gradient_clip_val", "gradient_clip_algorithm",
    "deterministic", "benchmark", "detect_anomaly", "profiler",
)  # fmt: skip


def trainer_options(config: Config) -> dict[str, Any]:
    """The options of a config: one CPU process unless it says otherwise."""
    return {"accelerator": "cpu", "devices": 1, **config.trainer}


def check_trainer_options(config: Config) -> None:
    """Have Lightning judge the options now, before a run has a folder.

    Raises:
        UsageError: an option that is unknown, or lyapnet's own; a value that Lightning refuses; devices that cannot
            share an ensemble.
    """
    for key in config.trainer:
        if key not in TRAINER_OPTIONS:
            owned = key in inspect.signature(L.Trainer).parameters
            nearest = did_you_mean(key, TRAINER_OPTIONS, "remove it", "trainer.")
            hint = "lyapnet sets that one itself" if owned else nearest
            raise UsageError(f"Expected trainer options among {', '.join(TRAINER_OPTIONS)}, got trainer.{key}; {hint}")
    _quiet()
    try:
        trainer = L.Trainer(logger=False, enable_checkpointing=False, **trainer_options(config))
    except (MisconfigurationException, ValueError, TypeError, RuntimeError) as error:
        raise UsageError(
            f"Expected trainer options that Lightning accepts, got: {' '.join(str(error).split())}"
        ) from error
    if config.seeds > 1 and trainer.num_devices > 1:
        raise UsageError(
            f"Expected trainer.devices=1 for seeds={config.seeds}, got {trainer.num_devices} devices; one batch holds "
            "all seeds, so train on one device, or the seeds one by one."
        )


def _quiet() -> None:
    """Lightning's notes that are wrong here: one epoch is one step, and drawing states needs no workers."""
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    for message in (".*LeafSpec.*", ".*does not have many workers.*"):
        warnings.filterwarnings("ignore", message)

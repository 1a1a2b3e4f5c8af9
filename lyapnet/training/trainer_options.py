"""What the section `trainer` of a config may hand to lightning.Trainer."""

import inspect
import logging
import math
import warnings
from collections.abc import Callable
from typing import Any

import lightning as L

from lyapnet.base.errors import UsageError, did_you_mean, one_line
from lyapnet.base.sizes import require_memory
from lyapnet.experiment.config import Config

TRAINER_OPTIONS = (
    "accelerator", "strategy", "devices", "gradient_clip_val", "gradient_clip_algorithm",
    "deterministic", "benchmark", "detect_anomaly", "profiler",
)  # fmt: skip
PROCESS = 200_000_000  # bytes that torch takes in each process of a training on several devices
SWITCH = "true or false", lambda value: isinstance(value, bool)
VALUES: dict[str, tuple[str, Callable[[Any], bool]]] = {  # that Lightning does not judge: what is expected of them
    "gradient_clip_val": ("a number ≥ 0", lambda value: type(value) in (int, float) and 0 <= value < math.inf),
    "deterministic": ("true, false or warn", lambda value: value in (True, False, "warn")),
    "benchmark": SWITCH,
    "detect_anomaly": SWITCH,
}


def trainer_options(config: Config) -> dict[str, Any]:
    """The options of a config: one CPU process unless it says otherwise."""
    return {"accelerator": "cpu", "devices": 1, **config.trainer}


def check_trainer_options(config: Config) -> None:
    """Have Lightning judge the options now, before a run has a folder.

    Raises:
        UsageError: an option that is unknown, or lyapnet's own; a value that Lightning refuses; devices that cannot
            share an ensemble.
    """
    for key, value in config.trainer.items():
        if key not in TRAINER_OPTIONS:
            owned = key in inspect.signature(L.Trainer).parameters
            nearest = did_you_mean(key, TRAINER_OPTIONS, "remove it.", "trainer.")
            hint = "lyapnet sets that one itself." if owned else nearest
            raise UsageError(f"Expected trainer options among {', '.join(TRAINER_OPTIONS)}, got trainer.{key}; {hint}")
        expected, holds = VALUES.get(key, ("", lambda _: True))
        if value is not None and not holds(value):
            raise UsageError(f"Expected trainer.{key} as {expected}, got {value!r}; correct it, or leave it out.")
    _quiet()
    try:
        trainer = L.Trainer(logger=False, enable_checkpointing=False, **trainer_options(config))
    except Exception as error:  # of many kinds: MisconfigurationException, ValueError, AttributeError, …
        raise UsageError(
            f"Expected trainer options that Lightning accepts, got: {one_line(error).rstrip('.')}; correct the section."
        ) from error
    require_memory("trainer.devices", trainer.num_devices, PROCESS * (trainer.num_devices - 1), "take fewer")
    if config.seeds > 1 and trainer.num_devices > 1:
        raise UsageError(
            f"Expected trainer.devices=1 for seeds={config.seeds}, got {trainer.num_devices} devices; seeds train side "
            "by side on one device: take one, or train the seeds one by one."
        )


def _quiet() -> None:
    """Lightning's notes that are wrong here: one epoch is one step, and drawing states needs no workers."""
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    for message in (".*LeafSpec.*", ".*does not have many workers.*"):
        warnings.filterwarnings("ignore", message)

"""The options of lightning.Trainer that the section `trainer` of a config may set."""

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
PROCESS_BYTES = 200_000_000  # memory of torch in each further process, in bytes
SWITCH = "true or false", lambda value: isinstance(value, bool)
VALUES: dict[
    str, tuple[str, Callable[[Any], bool]]
] = {  # options that Lightning does not check: the expected value, its test
    "gradient_clip_val": ("a number ≥ 0", lambda value: type(value) in (int, float) and 0 <= value < math.inf),
    "deterministic": ("true, false or warn", lambda value: value in (True, False, "warn")),
    "benchmark": SWITCH,
    "detect_anomaly": SWITCH,
}


def trainer_options(config: Config) -> dict[str, Any]:
    """The options of a config; by default one CPU process."""
    return {"accelerator": "cpu", "devices": 1, **config.trainer}


def check_trainer_options(config: Config) -> None:
    """Check the options, also by Lightning, before the folder of a run is created.

    Raises:
        UsageError: an option is unknown or reserved for lyapnet, Lightning refuses its value, or an ensemble has
            several devices.
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
    _silence_notes()
    try:
        trainer = L.Trainer(logger=False, enable_checkpointing=False, **trainer_options(config))
    except Exception as error:  # MisconfigurationException, ValueError, AttributeError, …
        raise UsageError(
            f"Expected trainer options that Lightning accepts, got: {one_line(error).rstrip('.')}; correct the section."
        ) from error
    require_memory("trainer.devices", trainer.num_devices, PROCESS_BYTES * (trainer.num_devices - 1), "take fewer")
    if config.seeds > 1 and trainer.num_devices > 1:
        raise UsageError(
            f"Expected trainer.devices=1 for seeds={config.seeds}, got {trainer.num_devices} devices; seeds train side "
            "by side on one device: take one, or train the seeds one by one."
        )


def _silence_notes() -> None:
    """Suppress notes of Lightning that do not apply: one epoch is one step, and the data loader needs no workers."""
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    for message in (".*LeafSpec.*", ".*does not have many workers.*"):
        warnings.filterwarnings("ignore", message)

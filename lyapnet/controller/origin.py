"""The checkpoint that a controller was loaded from, and its recorded evaluation."""

import math
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lyapnet.base.errors import LyapnetError
from lyapnet.base.files import read_json
from lyapnet.base.provenance import EVALUATION
from lyapnet.experiment.checkpoint import KEY, ZOO, locate_checkpoint


@dataclass(frozen=True)
class Origin:
    """A checkpoint: its path as given, the number of training steps before it, and the version that wrote it."""

    path: str
    steps: int | None
    version: str | None

    @classmethod
    def of(cls, path: str | Path, content: dict[str, Any]) -> "Origin":
        """The origin of a controller from the content of its checkpoint."""
        return cls(str(path), content.get("global_step"), content[KEY].get("version"))

    def evaluation(self) -> dict[str, Any]:
        """The evaluation at the end of its training, or that in the zoo; empty if none is recorded."""
        file = locate_checkpoint(self.path)
        with suppress(LyapnetError):
            if file.parent == ZOO:
                return _mapping(_mapping(read_json(file.with_suffix(".json"), "")).get("evaluation"))
            if file.name == "best.ckpt":  # the one that is evaluated at the end
                return _mapping(read_json(file.parents[1] / EVALUATION, ""))
        return {}


def number_in(record: dict[str, Any], key: str) -> float | None:
    """The finite number for a key of a record; None if there is none."""
    found = record.get(key)
    return float(found) if isinstance(found, int | float) and math.isfinite(found) else None


def _mapping(content: Any) -> dict[str, Any]:
    return content if isinstance(content, dict) else {}

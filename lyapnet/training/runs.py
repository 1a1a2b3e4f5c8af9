"""The folder of a run: what it holds, how it is made, and which one is the last."""

import json
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lyapnet.config import Config, configs_of_seeds, label_of
from lyapnet.errors import LyapnetError, UsageError
from lyapnet.files import write_json
from lyapnet.provenance import commit, versions

LAST, BEST = "last", "best"
CONFIG = "config.yaml"
PROVENANCE = "run.json"
EVALUATION = "evaluation.json"  # written last: its presence says that the run is finished


@dataclass(frozen=True)
class Run:
    """The folder of one run: config.yaml, run.json, metrics.csv, evaluation.json, checkpoints/ and what loggers add."""

    folder: Path

    @property
    def checkpoints(self) -> Path:
        """Where last.ckpt and best.ckpt are."""
        return self.folder / "checkpoints"

    @property
    def last(self) -> Path:
        """The newest checkpoint."""
        return self.checkpoints / f"{LAST}.ckpt"

    @property
    def best(self) -> Path:
        """The checkpoint of the least validation loss."""
        return self.checkpoints / f"{BEST}.ckpt"

    def members(self, config: Config) -> list["Run"]:
        """Where each seed's best checkpoint and curves are: folders of their own, if there are several seeds."""
        labels = [label_of(one) for one in configs_of_seeds(config)]
        return [Run(self.folder / label) for label in labels] if config.seeds > 1 else [self]

    @property
    def finetuned_from(self) -> Path | None:
        """The checkpoint whose weights the run started from."""
        origin = self.record()["finetuned_from"]
        return Path(origin) if origin else None

    @property
    def compiled(self) -> bool:
        """Whether the run is compiled, as it then goes on: machine code rounds differently."""
        return self.record().get("compiled", False)

    def record(self) -> dict[str, Any]:
        """What made the run, and what it took."""
        return json.loads((self.folder / PROVENANCE).read_text(encoding="utf-8"))

    def note(self, **facts: Any) -> None:
        """Add to the record, or replace in it."""
        write_json(self.folder / PROVENANCE, {**self.record(), **facts})

    @property
    def finished(self) -> bool:
        """Whether the run reached its end."""
        return (self.folder / EVALUATION).is_file()

    @property
    def evaluation(self) -> dict[str, Any]:
        """What the best checkpoint of a finished run reaches, as `lyapnet evaluate --json` prints it.

        For several seeds: mean, spread, and each.
        """
        return json.loads((self.folder / EVALUATION).read_text(encoding="utf-8"))


def new_run(config: Config, finetuned_from: Path | None) -> Run:
    """A folder of its own that says what it is from its first moment on, so that a stopped run can always go on."""
    if int(os.environ.get("LOCAL_RANK", "0")) > 0:  # a further process of a run whose folder the first one made
        return last_run(config)
    root = Path(config.logs) / config.experiment
    try:
        root.mkdir(parents=True, exist_ok=True)
        draft = Path(tempfile.mkdtemp(prefix=".new_", dir=root))
        draft.chmod(0o755)
        write_json(draft / PROVENANCE, _provenance(config, finetuned_from))
        newest = max((number for number, _ in _versions(root)), default=-1)
        return Run(draft.rename(root / f"version_{newest + 1}"))
    except OSError as error:
        raise LyapnetError(
            f"Expected a writable folder for runs, got {str(root)!r} ({error.strerror}); choose another with logs=PATH."
        ) from error


def last_run(config: Config) -> Run:
    """The newest run of an experiment.

    Raises:
        UsageError: there is none.
    """
    runs = runs_of(config)
    if not runs:
        root = Path(config.logs) / config.experiment
        raise UsageError(f"Expected a run to resume in {str(root)!r}, got none; start one without --resume.")
    return runs[-1]


def runs_of(config: Config) -> list[Run]:
    """The runs of an experiment, oldest first."""
    return [Run(path) for _, path in sorted(_versions(Path(config.logs) / config.experiment))]


def _provenance(config: Config, finetuned_from: Path | None) -> dict[str, Any]:
    return {
        "seed": config.seed,
        "compiled": False,
        "training_seconds": 0.0,  # of the processes that came to an end, kill -9 aside
        "peak_bytes": 0,  # of memory, in the process that held most
        "finetuned_from": str(finetuned_from.resolve()) if finetuned_from else None,
        **versions("torch", "lightning"),
        "commit": commit(),
    }


def _versions(root: Path) -> list[tuple[int, Path]]:
    numbered = [(path.name.removeprefix("version_"), path) for path in root.glob("version_*")]
    return [(int(number), path) for number, path in numbered if number.isdigit()]

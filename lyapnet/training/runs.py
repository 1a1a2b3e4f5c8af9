"""The folder of a run: its files, how it is created, and the newest run of an experiment."""

import errno
import os
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lyapnet.base.errors import LyapnetError, UsageError
from lyapnet.base.files import read_json, write_json
from lyapnet.base.provenance import EVALUATION, RUN_RECORD, commit, versions
from lyapnet.experiment.config import Config, configs_of_seeds, label_of
from lyapnet.training.run_lock import RunLock

LAST, BEST = "last", "best"
CONFIG = "config.yaml"
RECORDED = {  # keys of run.json ↦ types, and the default for version 0.1, which lacks some keys (...: required)
    "finetuned_from": (str | None, ...), "compiled": (bool, False), "saved": (bool | None, None),
    "training_seconds": (float | int, 0.0), "peak_bytes": (int, 0), "returns": (list, []),
}  # fmt: skip
REPAIR = "restore it, or start a new run with --finetune"


@dataclass(frozen=True)
class TrainingRun:
    """The folder of one run: config.yaml, run.json, metrics.csv, evaluation.json, checkpoints/ and what loggers add."""

    folder: Path

    @property
    def exists(self) -> bool:
        """Whether the folder is that of a run."""
        return (self.folder / RUN_RECORD).is_file()

    @property
    def checkpoints(self) -> Path:
        """The folder of last.ckpt and best.ckpt."""
        return self.folder / "checkpoints"

    @property
    def last(self) -> Path:
        """The newest checkpoint."""
        return self.checkpoints / f"{LAST}.ckpt"

    @property
    def best(self) -> Path:
        """The checkpoint with the least validation loss."""
        return self.checkpoints / f"{BEST}.ckpt"

    def members(self, config: Config) -> list["TrainingRun"]:
        """The runs with each seed's best checkpoint and curves: subfolders, if there are several seeds."""
        labels = [label_of(one) for one in configs_of_seeds(config)]
        return [TrainingRun(self.folder / label) for label in labels] if config.seeds > 1 else [self]

    @property
    def finetuned_from(self) -> Path | None:
        """The checkpoint with the initial weights of the run, if it was fine-tuned."""
        origin = self.record()["finetuned_from"]
        return Path(origin) if origin else None

    @property
    def compiled(self) -> bool:
        """Whether the run is compiled. It is resumed the same way, because compiled code rounds differently."""
        return self.record()["compiled"]

    @property
    def begun(self) -> bool:
        """Whether the run has saved a checkpoint or a result that starting again would overwrite."""
        saved = self.record()["saved"]  # None under version 0.1, which did not record it
        return os.path.lexists(self.last) or self.finished or (self.best.exists() if saved is None else saved)

    def record(self) -> dict[str, Any]:
        """The content of run.json: provenance, training time and memory."""
        path = self.folder / RUN_RECORD
        record = {key: default for key, (_, default) in RECORDED.items()} | read_json(path, REPAIR)
        for key, (kinds, _) in RECORDED.items():
            if not isinstance(record[key], kinds):
                got = repr(record[key])[:40].replace("Ellipsis", "none")
                raise LyapnetError(f"Expected {key} in {str(path)!r}, got {got}; {REPAIR}.")
        return record

    def note(self, **facts: Any) -> None:
        """Add facts to the record, or replace them."""
        write_json(self.folder / RUN_RECORD, {**self.record(), **facts})

    def note_return(self, entry: Mapping[str, Any]) -> None:
        """Add a return to earlier weights to the record."""
        self.note(returns=[*self.record()["returns"], dict(entry)])

    @property
    def finished(self) -> bool:
        """Whether the run is finished."""
        return (self.folder / EVALUATION).is_file()

    @property
    def evaluation(self) -> dict[str, Any]:
        """The evaluation of the best checkpoint of a finished run, as `lyapnet evaluate --json` prints it.

        For several seeds: mean, standard deviation, and the evaluation of each.
        """
        return read_json(self.folder / EVALUATION, "resume the run with more iterations, which writes it anew")


def is_further_process() -> bool:
    """Whether this process is not the first one of a run; the first one owns the folder and the lock."""
    return int(os.environ.get("LOCAL_RANK", "0")) > 0


def new_run(config: Config, finetuned_from: Path | None) -> tuple[TrainingRun, RunLock | None]:
    """Create the folder of a new run and lock it. It appears together with run.json, so that it can always be resumed.

    Raises:
        LyapnetError: the folder cannot be created.
    """
    if is_further_process():
        return last_run(config), None
    root = Path(config.logs) / config.experiment
    try:
        root.mkdir(parents=True, exist_ok=True)
        draft = Path(tempfile.mkdtemp(prefix=".new_", dir=root))
        try:
            draft.chmod(0o755)
            write_json(draft / RUN_RECORD, _provenance(config, finetuned_from))
            run = TrainingRun(_rename_to_next_number(draft))
        except BaseException:
            shutil.rmtree(draft, ignore_errors=True)
            raise
        return run, RunLock(run.folder)  # after renaming: Windows cannot rename a folder with an open file
    except OSError as error:
        raise LyapnetError(
            f"Expected a writable folder for runs, got {str(root)!r} ({error.strerror}); choose another with logs=PATH."
        ) from error


def _rename_to_next_number(draft: Path) -> Path:
    """Rename a draft to version_K with the next free number K; tries again if another process takes the number."""
    while True:
        newest = max((number for number, _ in _versions(draft.parent)), default=-1)
        try:
            return draft.rename(draft.with_name(f"version_{newest + 1}"))
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise


def last_run(config: Config) -> TrainingRun:
    """The newest run of an experiment.

    Raises:
        UsageError: there is none.
    """
    runs = runs_of(config)
    if not runs:
        root = Path(config.logs) / config.experiment
        raise UsageError(f"Expected a run to resume in {str(root)!r}, got none; start one without --resume.")
    return runs[-1]


def runs_of(config: Config) -> list[TrainingRun]:
    """The runs of an experiment, oldest first."""
    return [TrainingRun(path) for _, path in sorted(_versions(Path(config.logs) / config.experiment)) if path.is_dir()]


def _provenance(config: Config, finetuned_from: Path | None) -> dict[str, Any]:
    return {
        "seed": config.seed,
        "compiled": False,
        "saved": False,  # whether last.ckpt was ever written
        "training_seconds": 0.0,  # total of all processes that were not killed
        "peak_bytes": 0,  # largest memory of a process
        "finetuned_from": str(finetuned_from.resolve()) if finetuned_from else None,
        **versions("torch", "lightning"),
        "commit": commit(),
    }


def _versions(root: Path) -> list[tuple[int, Path]]:
    numbered = [(path.name.removeprefix("version_"), path) for path in root.glob("version_*")]
    return [(int(number), path) for number, path in numbered if number.isascii() and number.isdigit()]

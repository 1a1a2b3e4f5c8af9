"""metrics.csv: the curves of a run as a table, written for every run."""

import csv
import io
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from lightning.fabric.utilities import rank_zero_only
from lightning.pytorch.loggers import Logger

from lyapnet.base.files import open_for_appending, read_file, write_atomically

METRICS = "metrics.csv"
STEP, WALL_TIME = "step", "wall_time"  # wall_time: seconds since the Epoch


class MetricsFile(Logger):
    """A CSV table with a row for each step and a column for each metric; empty where a step has no value.

    Rows are appended before each checkpoint is saved. Rows that a killed process loses are logged again on resuming.

    Args:
        folder: the folder of the run.
    """

    def __init__(self, folder: Path):
        super().__init__()
        self.path = folder / METRICS
        self._pending: list[dict[str, Any]] = []

    @property
    def name(self) -> str:
        return METRICS

    @property
    def version(self) -> str:
        return self.path.parent.name

    @rank_zero_only
    def log_hyperparams(self, params: Any, *args: Any, **kwargs: Any) -> None:
        """Do nothing: the config has a file of its own."""

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        step = step or 0  # a user's callback may omit it
        if not self._pending or self._pending[-1][STEP] != step:
            self._pending.append({STEP: step, WALL_TIME: time.time()})
        self._pending[-1].update(metrics)

    @rank_zero_only
    def save(self) -> None:
        """Append the rows since the last call; a new metric rewrites the file with one more column."""
        if not self._pending:
            return
        known = _columns(self.path)
        columns = list(dict.fromkeys([*known, *(name for row in self._pending for name in row)]))
        if len(columns) > len(known):
            _, rows = _read(self.path)
            _write(self.path, columns, [*rows, *self._pending])
        else:
            with open_for_appending(self.path) as file:
                _writer(file, columns).writerows(self._pending)
        self._pending.clear()

    @rank_zero_only
    def finalize(self, status: str) -> None:
        self.save()

    @rank_zero_only
    def drop_after(self, step: int) -> None:
        """Remove the rows after a step, so that a run resumed at that step logs nothing twice."""
        columns, rows = _read(self.path)
        if columns:
            _write(self.path, columns, [row for row in rows if int(row[STEP]) <= step])


def read_curves(folder: Path, *names: str) -> list[tuple[Any, ...]]:
    """The values of some columns of metrics.csv, for each row with a value in the first; None for other empty cells."""
    _, rows = _read(folder / METRICS)
    chosen = [row for row in rows if row.get(names[0])]
    return [tuple(float(row[name]) if row.get(name) else None for name in names) for row in chosen]


def _columns(path: Path) -> list[str]:
    """The names of the columns; empty if there is no file."""
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return next(csv.reader(file), [])


def _read(path: Path) -> tuple[list[str], list[dict[str, Any]]]:
    """The columns and rows of the file, without an unfinished last line of a killed process; empty without a file."""
    if not path.is_file():
        return [], []
    whole, newline, _ = read_file(path).decode().rpartition("\n")
    reader = csv.DictReader(io.StringIO(whole + newline))
    return list(reader.fieldnames or []), list(reader)


def _write(path: Path, columns: list[str], rows: Iterable[Mapping[str, Any]]) -> None:
    text = io.StringIO()
    writer = _writer(text, columns)
    writer.writeheader()
    writer.writerows(rows)
    write_atomically(path, text.getvalue().encode())


def _writer(file: io.TextIOBase, columns: list[str]) -> csv.DictWriter:
    return csv.DictWriter(file, columns, lineterminator="\n")

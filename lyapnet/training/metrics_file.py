"""metrics.csv: the curves of a run as a table, whatever other loggers it has."""

import csv
import io
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from lightning.fabric.utilities import rank_zero_only
from lightning.pytorch.loggers import Logger

from lyapnet.base.files import appending, read_file, write_atomically

METRICS = "metrics.csv"
STEP, WALL_TIME = "step", "wall_time"  # wall_time: seconds since the Epoch


class MetricsFile(Logger):
    """A row for each step and a column for each metric; empty where a step has no value.

    Rows are appended where the training saves, before each checkpoint: what a killed process loses of them, the
    resumed one logs again.

    Args:
        folder: of the run.
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
        """The config lies beside the file."""

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        step = step or 0  # a callback of the user's own may leave it out
        if not self._pending or self._pending[-1][STEP] != step:
            self._pending.append({STEP: step, WALL_TIME: time.time()})
        self._pending[-1].update(metrics)

    @rank_zero_only
    def save(self) -> None:
        """Append what came since the last time; a metric that is new rewrites the file with one more column."""
        if not self._pending:
            return
        known = _columns(self.path)
        columns = list(dict.fromkeys([*known, *(name for row in self._pending for name in row)]))
        if len(columns) > len(known):
            _, rows = _read(self.path)
            _write(self.path, columns, [*rows, *self._pending])
        else:
            with appending(self.path) as file:
                _writer(file, columns).writerows(self._pending)
        self._pending.clear()

    @rank_zero_only
    def finalize(self, status: str) -> None:
        self.save()

    @rank_zero_only
    def drop_after(self, step: int) -> None:
        """Remove what was logged after a step, so that going on from that step logs nothing twice."""
        columns, rows = _read(self.path)
        if columns:
            _write(self.path, columns, [row for row in rows if int(row[STEP]) <= step])


def read_curves(folder: Path, *names: str) -> list[tuple[Any, ...]]:
    """The values of some columns of a run's metrics.csv, for each row in which the first has one; None where another
    has none."""
    _, rows = _read(folder / METRICS)
    chosen = [row for row in rows if row.get(names[0])]
    return [tuple(float(row[name]) if row.get(name) else None for name in names) for row in chosen]


def _columns(path: Path) -> list[str]:
    """The columns of the file; none without a file."""
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return next(csv.reader(file), [])


def _read(path: Path) -> tuple[list[str], list[dict[str, Any]]]:
    """The columns and rows of the file, without a last line that a killed process left unfinished; none without a
    file."""
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

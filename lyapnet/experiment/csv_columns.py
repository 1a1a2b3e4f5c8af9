"""Columns of numbers from a CSV file whose first row names them."""

import csv
import io
import math
from pathlib import Path

from lyapnet.base.errors import UsageError
from lyapnet.base.files import read_file

LARGEST_CSV = 10_000_000  # bytes
MOST_ROWS = 10_000


def read_columns(path: Path) -> dict[str, list[float]]:
    """Name ↦ numbers of each column.

    Raises:
        UsageError: no such file, no names, a name twice, a row of another length, or an entry that is no finite number;
            names the line.
    """
    try:
        text = read_file(path, LARGEST_CSV).decode("utf-8-sig")
    except OSError as error:
        raise UsageError(f"Expected a CSV file, got {str(path)!r} ({error.strerror or error}).") from error
    except (UnicodeDecodeError, ValueError) as error:
        raise UsageError(f"Expected a CSV file of text below {LARGEST_CSV // 10**6} MB, got {str(path)!r}.") from error
    try:
        rows = [row for row in csv.reader(io.StringIO(text), skipinitialspace=True) if row]
    except csv.Error as error:
        raise UsageError(f"Expected a CSV file, got {str(path)!r} ({error}); separate numbers by commas.") from error
    names = [name.strip() for name in rows[0]] if rows else []
    if len(rows) < 3 or len(set(names)) < len(names) or not all(names) or len(rows) > MOST_ROWS + 1:
        raise UsageError(
            f"Expected a row of different names and 2 to {MOST_ROWS} rows of numbers in {str(path)!r}, got "
            f"{len(rows)} rows, the first {', '.join(names[:8])}; begin with t and names of states."
        )
    columns: dict[str, list[float]] = {name: [] for name in names}
    for line, row in enumerate(rows[1:], 2):
        if len(row) != len(names):
            raise UsageError(f"Expected {len(names)} numbers in row {line} of {str(path)!r}, got {len(row)}.")
        for name, entry in zip(names, row, strict=True):
            try:
                number = float(entry)
            except ValueError:
                number = math.nan
            if not math.isfinite(number):
                raise UsageError(f"Expected finite numbers in {str(path)!r}, got {entry!r} for {name} in row {line}.")
            columns[name].append(number)
    return columns

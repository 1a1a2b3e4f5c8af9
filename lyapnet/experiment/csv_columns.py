"""Columns of numbers from a CSV file whose first row names them."""

import csv
import io
import math
from itertools import islice
from pathlib import Path

from lyapnet.base.errors import UsageError
from lyapnet.base.files import read_file

LARGEST_CSV = 10_000_000  # largest file, in bytes
MOST_ROWS = 10_000  # default limit of the number of rows


def read_columns(
    path: Path,
    most_rows: int = MOST_ROWS,
    largest: int = LARGEST_CSV,
    advice: str = "begin with t and names of states",
) -> dict[str, list[float]]:
    """Name ↦ numbers of each column.

    Args:
        most_rows: largest number of rows of numbers.
        largest: largest file, in bytes.
        advice: the required content of the first row, for messages.

    Raises:
        UsageError: no such file, no names, a name twice, a row of another length, or an entry that is no finite number;
            names the line.
    """
    try:
        text = read_file(path, largest).decode("utf-8-sig")
    except OSError as error:
        raise UsageError(
            f"Expected a CSV file, got {str(path)!r} ({error.strerror or error}); correct the name."
        ) from error
    except (UnicodeDecodeError, ValueError) as error:
        raise UsageError(
            f"Expected a CSV file of text below {largest // 10**6} MB, got {str(path)!r}; give less of it."
        ) from error
    try:
        read = (row for row in csv.reader(io.StringIO(text), skipinitialspace=True) if row)
        rows = list(islice(read, most_rows + 2))  # one more than allowed
    except csv.Error as error:
        raise UsageError(f"Expected a CSV file, got {str(path)!r} ({error}); separate numbers by commas.") from error
    names = [name.strip() for name in rows[0]] if rows else []
    if len(rows) < 3 or len(set(names)) < len(names) or not all(names) or len(rows) > most_rows + 1:
        raise UsageError(
            f"Expected a row of different names and 2 to {most_rows} rows of numbers in {str(path)!r}, got "
            f"{len(rows)} rows{' and more' * (len(rows) > most_rows + 1)}, the first {', '.join(names[:8])[:200]!r}; "
            f"{advice}."
        )
    columns: dict[str, list[float]] = {name: [] for name in names}
    for line, row in enumerate(rows[1:], 2):
        if len(row) != len(names):
            raise UsageError(
                f"Expected {len(names)} numbers in row {line} of {str(path)!r}, got {len(row)}; complete it."
            )
        for name, entry in zip(names, row, strict=True):
            try:
                number = float(entry)
            except ValueError:
                number = math.nan
            if not math.isfinite(number):
                raise UsageError(
                    f"Expected finite numbers in {str(path)!r}, got {entry[:60]!r} for {name} in row {line}; "
                    "correct it."
                )
            columns[name].append(number)
    return columns
